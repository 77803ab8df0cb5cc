"""Calibration as a stage: by one method, which `auto` chooses by what the data allows."""

import time
from dataclasses import replace
from pathlib import Path

from madoc.calibration import CalibrationResult, calibrate
from madoc.calibration.holdout import Fitted
from madoc.pipeline.folders import ENDED, working_folder
from madoc.pipeline.keys import seed_key
from madoc.pipeline.methods import choose, hyperparameters, methods_for
from madoc.pipeline.orders import NO_PERMISSION, CalibrationOrder, Permission
from madoc.pipeline.preparation import prepare
from madoc.pipeline.refusals import check_order, method_of
from madoc.runs.budget import Seconds
from madoc.runs.progress import waiting
from madoc.verdict import assess
from madoc.verdict.evidence import evidence, save_evidence


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
    out, began = Path(out), time.monotonic()
    check_order(order, out)
    methods = methods_for(order)
    prepared = prepare(order, permission=permission)
    key = seed_key(prepared.seed)
    name, why = choose(methods, prepared.problem, key)
    prepared, method = prepared.by(name), methods[name]
    judged_by, budget = None, prepared.budget
    if prepared.holdout is not None and isinstance(budget, Seconds):
        if order.search.budget is None:  # the usual time is that of a search
            judged_by = began + budget.with_judging.seconds
        else:
            judged_by, budget = began + budget.until_judged.seconds, budget.for_search(time.monotonic() - began)
    spec = prepared.spec(out) | {"hyperparameters": hyperparameters(method)}
    with working_folder(out, spec, resume=resume) as folder:
        result = calibrate(
            method,
            prepared.problem,
            key=key,
            budget=budget,
            truth=prepared.calibrated_truth,
            folder=folder,
            resume=resume,
            quiet=quiet,
        )
        result = replace(result, chosen=why)
        if prepared.holdout is not None and result.status in ENDED:
            rate = result.control_steps / max(result.seconds, 1e-3)
            with waiting("judging the estimate on the rows held out", quiet=quiet) as tell:
                bench = replace(prepared.bench, until=judged_by, rate=max(rate, 1.0), tell=tell)
                result = assess(result, bench).result
                tell("whole runs")
                fits_starts, step = isinstance(result.holdout, Fitted), prepared.simulator.control_step
                arrays = evidence(bench, result.mean, control_step=step, fits_starts=fits_starts)
            save_evidence(out / "evidence.npz", arrays)
        folder.write_json("result.json", result.to_json())
        return result


def default_folder(order: CalibrationOrder) -> Path:
    """The run folder of an order that names none: `runs/TASK-METHOD-SEED`."""
    return Path("runs") / f"{Path(order.task).stem}-{method_of(order)}-{order.search.seed}"
