"""`--method auto`: what the data allows, one method after another, compared on the hold-out; the best is kept."""

from dataclasses import asdict, replace
from pathlib import Path

from madoc.calibration import CALIBRATORS, CalibrationResult, Calibrator
from madoc.calibration.holdout import NotRun, Tried
from madoc.errors import MadocError, unknown_name
from madoc.pipeline.folders import ended, holds_run, working_folder
from madoc.pipeline.keys import seed_key
from madoc.pipeline.methods import hyperparameters, make_method
from madoc.pipeline.one_method import calibrate_prepared, leave_evidence
from madoc.pipeline.preparation import Prepared
from madoc.runs.files import read_json
from madoc.verdict import Assessment
from madoc.verdict.judge import explains_all

COMPARISON = "comparison.json"
CANDIDATES = {"least-squares": 2 / 3, "madoc": 1 / 2}
"""The methods that are tried, in this order (seconds before minutes), and the share of the budget each may have.

What a method leaves of its share is there for those after it, up to their own.
"""


def calibrate_auto(out: Path, prepared: Prepared, *, resume: bool = False, quiet: bool = False) -> CalibrationResult:
    """Try the candidates within the budget, each in a folder of its own, and keep what predicts the hold-out best.

    The first whose estimate explains the hold-out down to the noise and is CALIBRATED ends the search, and so does a
    verdict on the data itself. Killed at any moment and resumed, the result has the same bits but for its seconds.

    Returns:
        The best candidate's result, with what all of them have cost; `holdout` has a row a candidate.

    Raises:
        MadocError: Every candidate refuses, or a hyperparameter is not given as `madoc.updates`.
    """
    methods = candidates_for(prepared)
    spec = prepared.spec(out) | {"hyperparameters": {name: hyperparameters(made) for name, made in methods.items()}}
    with working_folder(out, spec, resume=resume, keep=COMPARISON) as folder:
        if ended(out, COMPARISON) and read_json(out / COMPARISON).get("budget") == prepared.budget:
            return CalibrationResult.from_json(read_json(folder.result))
        folder.result.unlink(missing_ok=True)
        rows: list[Tried | NotRun] = []
        tried: list[tuple[CalibrationResult, Assessment]] = []
        for name, share in CANDIDATES.items():
            left = prepared.budget - sum(result.control_steps for result, _ in tried)
            reason = _reason_to_stop(tried, left) or _refusal(methods[name], prepared)
            if reason:
                rows.append(NotRun(name, reason))
                continue
            part = replace(prepared, method=name, budget=max(1, min(round(share * prepared.budget), left)))
            place = out / name
            result, assessment = calibrate_prepared(place, part, methods[name], resume=holds_run(place), quiet=quiet)
            if assessment is None:  # interrupted or diverged
                if result.status == "diverged" and tried:
                    rows.append(NotRun(name, result.sentence))
                    continue
                return result
            tried.append((result, assessment))
            rows.append(_row(result, assessment))
            folder.write_json(COMPARISON, {"candidates": [asdict(row) for row in rows]})
        if not tried:
            raise MadocError("; ".join(f"{row.method}: {row.not_run}" for row in rows if isinstance(row, NotRun)))
        best = _joined(tried, rows)
        leave_evidence(out, prepared, best)
        compared = {"candidates": [asdict(row) for row in rows], "chosen": best.method, "budget": prepared.budget}
        folder.write_json(COMPARISON, compared)
        folder.write_json("result.json", best.to_json())
        return best


def candidates_for(prepared: Prepared) -> dict[str, Calibrator]:
    """The candidates by name, with hyperparameters changed that are named as `madoc.updates`.

    Raises:
        MadocError: A hyperparameter is named otherwise, or as `make_method`.
    """
    changed: dict[str, dict[str, object]] = {name: {} for name in CANDIDATES}
    for setting, value in prepared.order.search.changes.items():
        whole, _, part = setting.partition(".")
        name = whole.replace("_", "-")
        if name not in changed or not part:
            raise unknown_name("hyperparameter of auto", setting, [f"{candidate}.NAME" for candidate in CANDIDATES])
        changed[name][part] = value
    return {name: make_method(CALIBRATORS, name, changed[name]) for name in CANDIDATES}


def _reason_to_stop(tried: list[tuple[CalibrationResult, Assessment]], left: int) -> str:
    """Why no other candidate is needed, or none can be tried; empty to go on."""
    for result, assessment in tried:
        word = assessment.verdict.word
        if word == "DATA_REJECTED":
            return "the data was rejected, and no method changes that"
        if word == "CALIBRATED" and explains_all(assessment.holdout):
            return f"{result.method} explains the hold-out down to its noise"
    return "" if left > 0 else "the budget is spent"


def _refusal(method: Calibrator, prepared: Prepared) -> str:
    """Why a candidate refuses this data; empty if it takes it."""
    try:
        method.init(prepared.problem, seed_key(prepared.seed))
    except MadocError as error:
        return f"refused: {error}"
    return ""


def _row(result: CalibrationResult, assessment: Assessment) -> Tried:
    """A line of the comparison."""
    holdout = assessment.holdout
    return Tried(
        method=result.method,
        score=holdout.score,
        interval=holdout.score_interval,
        verdict=assessment.verdict.word,
        control_steps=result.control_steps,
        seconds=result.seconds,
    )


def _joined(tried: list[tuple[CalibrationResult, Assessment]], rows: list[Tried | NotRun]) -> CalibrationResult:
    """The best result with the cost of all."""
    best, assessment = min(tried, key=lambda pair: pair[1].holdout.score)
    return replace(
        best,
        control_steps=sum(result.control_steps for result, _ in tried),
        seconds=round(sum(result.seconds for result, _ in tried), 3),
        holdout=replace(assessment.holdout, candidates=tuple(rows), chosen=best.method),
    )
