"""Calibration as a stage: by one method, or by `auto`, where the next begins at what the first has found."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from madoc.calibration import CALIBRATORS, CalibrationResult, Calibrator, calibrate
from madoc.calibration.holdout import NotRun, Tried
from madoc.errors import MadocError
from madoc.pipeline.folders import ENDED, ended, holds_run, working_folder
from madoc.pipeline.keys import seed_key
from madoc.pipeline.methods import CANDIDATES, candidates_for, hyperparameters, make_method
from madoc.pipeline.orders import AUTO, NO_PERMISSION, CalibrationOrder, Permission
from madoc.pipeline.preparation import Prepared, prepare
from madoc.pipeline.priors import prior_for
from madoc.pipeline.refusals import check_order, method_of
from madoc.runs.budget import Budget, Seconds
from madoc.runs.files import read_json
from madoc.runs.progress import waiting
from madoc.verdict import Assessment, assess
from madoc.verdict.evidence import evidence, save_evidence
from madoc.verdict.judge import explains_all

COMPARISON = "comparison.json"
"""Name of the file that `auto` leaves of what it has compared."""


def calibrate_in(
    out: str | Path,
    order: CalibrationOrder,
    *,
    resume: bool = False,
    quiet: bool = False,
    permission: Permission = NO_PERMISSION,
) -> CalibrationResult:
    """Calibrate, judge the result where rows are held out, and leave a run folder.

    Raises:
        MadocError: The order cannot be carried out; a new folder is then not left behind.
    """
    out = Path(out)
    check_order(order, out)
    if method_of(order) == AUTO:
        return _calibrate_auto(out, prepare(order, permission=permission), resume=resume, quiet=quiet)
    (method,) = methods_for(order).values()
    return _calibrate_by(method, out, prepare(order, permission=permission), resume=resume, quiet=quiet)[0]


def default_folder(order: CalibrationOrder) -> Path:
    """The run folder of an order that names none: `runs/TASK-METHOD-SEED`."""
    return Path("runs") / f"{Path(order.task).stem}-{method_of(order)}-{order.search.seed}"


def methods_for(order: CalibrationOrder) -> dict[str, Calibrator]:
    """The methods of an order by name: one, or the candidates of `auto`.

    Raises:
        MadocError: As `make_method` or `candidates_for`.
    """
    name = method_of(order)
    if name == AUTO:
        return candidates_for(order.search.changes)
    return {name: make_method(CALIBRATORS, name, order.search.changes)}


def _calibrate_by(
    method: Calibrator, out: Path, prepared: Prepared, *, resume: bool, quiet: bool
) -> tuple[CalibrationResult, Assessment | None]:
    """Calibrate by one method, and judge the result; no assessment without a hold-out or an end of the run."""
    problem = prepared.problem
    spec = prepared.spec(out) | {"hyperparameters": hyperparameters(method)}
    with working_folder(out, spec, resume=resume) as folder:
        result = calibrate(
            method,
            problem,
            key=seed_key(prepared.seed),
            budget=prepared.budget,
            truth=prepared.calibrated_truth,
            folder=folder,
            resume=resume,
            quiet=quiet,
        )
        if prepared.holdout is None or result.status not in ENDED:
            return result, None
        with waiting("judging the estimate on the rows held out", quiet=quiet):
            assessment = assess(result, prepared.bench)
        result = assessment.result
        _leave_evidence(out, prepared, result)
        folder.write_json("result.json", result.to_json())
        return result, assessment


def _calibrate_auto(out: Path, prepared: Prepared, *, resume: bool, quiet: bool) -> CalibrationResult:
    """Try the candidates within the budget, each in a folder of its own, and keep what predicts the hold-out best.

    Madoc begins at the estimate of least squares, where that has settled and predicts the hold-out better than
    mid-range. The first whose estimate explains the hold-out down to the noise and is CALIBRATED ends the search, and
    so does a verdict on the data itself. Killed at any moment and resumed, the result has the same bits but for its
    seconds.

    Returns:
        The best candidate's result, with the cost of all of them; `holdout` has a row for each candidate.

    Raises:
        MadocError: Every candidate refuses the data, or as `methods_for`.
    """
    methods = methods_for(prepared.order)
    spec = prepared.spec(out) | {"hyperparameters": {name: hyperparameters(made) for name, made in methods.items()}}
    with working_folder(out, spec, resume=resume, keep=COMPARISON) as folder:
        if ended(out, COMPARISON) and read_json(out / COMPARISON).get("budget") == spec["budget"]:
            return CalibrationResult.from_json(read_json(folder.result))
        folder.result.unlink(missing_ok=True)
        rows: list[Tried | NotRun] = []
        tried: dict[str, tuple[CalibrationResult, Assessment]] = {}
        spent: list[CalibrationResult] = []
        for name, share in CANDIDATES.items():
            allowed = _allowed(prepared.budget, share, spent)
            reason = _reason_to_stop(tried) or ("the budget is spent" if allowed == 0 else "")
            reason = reason or _refusal(methods[name], prepared)
            if reason:
                rows.append(NotRun(name, reason))
                if spent:  # else nothing is to be kept if the others refuse too
                    folder.write_json(COMPARISON, {"candidates": [asdict(row) for row in rows]})
                continue
            place = out / name
            part = replace(prepared, method=name, budget=allowed, prior=prior_for(place, tried))
            result, assessment = _calibrate_by(methods[name], place, part, resume=holds_run(place), quiet=quiet)
            if result.status == "interrupted":
                return result
            spent.append(result)
            if assessment is None:
                rows.append(NotRun(name, f"it diverged: {result.sentence}"))
            else:
                tried[name] = result, assessment
                rows.append(_row(name, result, assessment))
            folder.write_json(COMPARISON, {"candidates": [asdict(row) for row in rows]})
        if not tried and spent:
            return spent[-1]
        if not tried:
            raise MadocError("; ".join(f"{row.method}: {row.not_run}" for row in rows if isinstance(row, NotRun)))
        chosen = min(tried, key=lambda name: tried[name][1].holdout.score)
        best = _with_cost_of_all(*tried[chosen], spent, rows, chosen)
        _leave_evidence(out, prepared, best)
        compared = {"candidates": [asdict(row) for row in rows], "chosen": chosen, "budget": spec["budget"]}
        folder.write_json(COMPARISON, compared)
        folder.write_json("result.json", best.to_json())
        return best


def _leave_evidence(out: Path, prepared: Prepared, result: CalibrationResult) -> None:
    """Leave `evidence.npz`: windows of the hold-out beside their simulation."""
    arrays = evidence(prepared.bench, result.mean, control_step=prepared.simulator.control_step)
    save_evidence(out / "evidence.npz", arrays)


def _allowed(budget: Budget | None, share: float, earlier: Sequence[CalibrationResult]) -> Budget | None:
    """The budget of a candidate, at most a share of that of `auto` and what earlier ones left of it; 0 if nothing.

    None where `auto` has none, so that each candidate has its own.
    """
    if budget is None:
        return None
    if isinstance(budget, Seconds):
        time_left = budget.seconds - sum(result.seconds for result in earlier)
        return Seconds(min(share * budget.seconds, time_left)) if time_left > 0.0 else 0
    left = budget - sum(result.control_steps for result in earlier)
    return max(1, min(round(share * budget), left)) if left > 0 else 0


def _reason_to_stop(tried: Mapping[str, tuple[CalibrationResult, Assessment]]) -> str:
    """Why no other candidate is needed; empty to go on."""
    for name, (_, assessment) in tried.items():
        word = assessment.verdict.word
        if word == "DATA_REJECTED":
            return "the data was rejected, and no method changes that"
        if word == "CALIBRATED" and explains_all(assessment.holdout):
            return f"{name} explains the hold-out down to its noise"
    return ""


def _refusal(method: Calibrator, prepared: Prepared) -> str:
    """Why a candidate refuses this data; empty if it takes it."""
    try:
        method.init(prepared.problem, seed_key(prepared.seed))
    except MadocError as error:
        return f"refused: {error}"
    return ""


def _row(name: str, result: CalibrationResult, assessment: Assessment) -> Tried:
    """A candidate's row of the comparison."""
    holdout, word = assessment.holdout, assessment.verdict.word
    return Tried(name, holdout.score, holdout.score_interval, word, result.control_steps, result.seconds)


def _with_cost_of_all(
    result: CalibrationResult,
    assessment: Assessment,
    spent: Sequence[CalibrationResult],
    rows: Sequence[Tried | NotRun],
    chosen: str,
) -> CalibrationResult:
    """The chosen candidate's result, with the comparison and the cost of all candidates."""
    return replace(
        result,
        control_steps=sum(each.control_steps for each in spent),
        seconds=round(sum(each.seconds for each in spent), 3),
        holdout=replace(assessment.holdout, candidates=tuple(rows), chosen=chosen),
    )
