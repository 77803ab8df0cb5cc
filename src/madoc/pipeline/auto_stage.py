"""`--method auto`: what the data allows, one method after another, compared on the hold-out; the best is kept."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from madoc.calibration import CALIBRATORS, CalibrationResult, Calibrator
from madoc.errors import MadocError, unknown_name
from madoc.pipeline.calibration_stage import (
    HOLDOUT,
    CalibrationOrder,
    Prepared,
    calibrate_prepared,
    check_order,
    check_place,
    prepare,
    spec_of,
)
from madoc.pipeline.folders import ended, holds_run, working_folder
from madoc.pipeline.keys import seed_key
from madoc.pipeline.methods import hyperparameters, make_method
from madoc.runs.files import read_json
from madoc.verdict import Assessment
from madoc.verdict.evidence import evidence, save_evidence
from madoc.verdict.judge import explains_all

AUTO = "auto"
COMPARISON = "comparison.json"


@dataclass(frozen=True)
class Candidate:
    """A method that `auto` tries.

    Attributes:
        name: In `CALIBRATORS`.
        most: Share of the budget that it may have; what it leaves is there for those after it, up to their own.
        hidden: Hyperparameters that differ where the log does not tell where rollouts may start.
    """

    name: str
    most: float
    hidden: Mapping[str, Any] = field(default_factory=dict)


CANDIDATES = (Candidate("least-squares", most=2 / 3), Candidate("madoc", most=1 / 2, hidden={"starts": "policy"}))
"""In the order they are tried: seconds before minutes."""
AUTO_BUDGET = 600_000
"""Control steps of all candidates together, unless told otherwise; the last has what it has alone."""


def calibrate_auto_in(
    out: Path, order: CalibrationOrder, *, resume: bool = False, quiet: bool = True
) -> CalibrationResult:
    """Try the candidates within the budget, each in a folder of its own, and keep what predicts the hold-out best.

    The first whose estimate explains the hold-out down to the noise and is CALIBRATED ends the search, and so does a
    verdict on the data itself. Killed at any moment and resumed, the result has the same bits but for its seconds.

    Returns:
        The best candidate's result, with what all of them have cost; `holdout` has a row a candidate.

    Raises:
        MadocError: The order cannot be carried out, or every candidate refuses.
    """
    order = order if order.holdout is not None else replace(order, holdout=HOLDOUT)
    check_order(order)
    check_place(out, order)
    prepared = prepare(order)
    methods = candidates_for(prepared, order.changes)
    spec = spec_of(order, prepared, out) | {
        "hyperparameters": {name: hyperparameters(method) for name, method in methods.items()}
    }
    with working_folder(out, spec, resume=resume, keep=COMPARISON) as folder:
        if ended(out, COMPARISON) and read_json(out / COMPARISON).get("budget") == order.budget:
            return CalibrationResult.from_json(read_json(folder.result))
        folder.result.unlink(missing_ok=True)
        rows: list[dict[str, Any]] = []
        tried: list[tuple[CalibrationResult, Assessment]] = []
        for candidate in CANDIDATES:
            name, method = candidate.name, methods[candidate.name]
            spent = sum(result.control_steps for result, _ in tried)
            why_not = _why_not(tried, order.budget - spent) or _refusal(method, prepared, order)
            if why_not:
                rows.append({"method": name, "not_run": why_not})
                continue
            budget = max(1, min(round(candidate.most * order.budget), order.budget - spent))
            part = replace(order, method=name, changes={}, budget=budget)
            place = out / name
            result, assessment = calibrate_prepared(place, part, prepared, method, resume=holds_run(place), quiet=quiet)
            if assessment is None:  # interrupted or diverged
                if result.status == "diverged" and tried:
                    rows.append({"method": name, "not_run": result.sentence})
                    continue
                return result
            tried.append((result, assessment))
            rows.append(_row(result, assessment))
            folder.write_json(COMPARISON, {"candidates": rows})
        if not tried:
            raise MadocError("; ".join(f"{row['method']}: {row['not_run']}" for row in rows))
        best = _joined(tried, rows)
        arrays = evidence(prepared.bench, best.mean, control_step=prepared.simulator.control_step)
        save_evidence(out / "evidence.npz", arrays)
        folder.write_json(COMPARISON, {"candidates": rows, "chosen": best.method, "budget": order.budget})
        folder.write_json("result.json", best.to_json())
        return best


def candidates_for(prepared: Prepared, changes: Mapping[str, Any]) -> dict[str, Calibrator]:
    """The candidates as the data wants them, by name.

    Raises:
        MadocError: A hyperparameter is not given as `madoc.updates`, or as `make_method`.
    """
    hidden = not prepared.problem.states.starts_known
    mine = _changes_by_candidate(changes)
    return {
        candidate.name: make_method(
            CALIBRATORS, candidate.name, (dict(candidate.hidden) if hidden else {}) | mine[candidate.name]
        )
        for candidate in CANDIDATES
    }


def _changes_by_candidate(changes: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Hyperparameters given as `madoc.updates`, by candidate."""
    found: dict[str, dict[str, Any]] = {candidate.name: {} for candidate in CANDIDATES}
    for changed, value in changes.items():
        whole, _, part = changed.partition(".")
        name = whole.replace("_", "-")
        if name not in found or not part:
            known = [f"{candidate}.NAME" for candidate in found]
            raise unknown_name("hyperparameter of auto", changed, known)
        found[name][part] = value
    return found


def _why_not(tried: list[tuple[CalibrationResult, Assessment]], left: int) -> str:
    """Why no other candidate is needed, or can be; empty to go on."""
    for result, assessment in tried:
        word = result.verdict["word"] if result.verdict else ""
        if word == "DATA_REJECTED":
            return "the data was rejected, and no method changes that"
        if word == "CALIBRATED" and explains_all(assessment):
            return f"{result.method} explains the hold-out down to its noise"
    return "" if left > 0 else "the budget is spent"


def _refusal(method: Calibrator, prepared: Prepared, order: CalibrationOrder) -> str:
    """Why a candidate will not have this data; empty if it will."""
    try:
        method.init(prepared.problem, seed_key(order.seed))
    except MadocError as error:
        return f"refused: {error}"
    return ""


def _row(result: CalibrationResult, assessment: Assessment) -> dict[str, Any]:
    """A line of the comparison."""
    low, high = assessment.relative_interval
    return {
        "method": result.method,
        "score": assessment.score,
        "interval": [low, high],
        "verdict": result.verdict["word"] if result.verdict else "",
        "control_steps": result.control_steps,
        "seconds": result.seconds,
    }


def _joined(tried: list[tuple[CalibrationResult, Assessment]], rows: list[dict[str, Any]]) -> CalibrationResult:
    """The best result with the cost of all."""
    best, assessment = min(tried, key=lambda pair: pair[1].score)
    return replace(
        best,
        control_steps=sum(result.control_steps for result, _ in tried),
        seconds=round(sum(result.seconds for result, _ in tried), 3),
        holdout=assessment.report | {"candidates": rows, "chosen": best.method},
    )
