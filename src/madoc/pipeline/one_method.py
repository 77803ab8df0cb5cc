"""One calibrator in a run folder of its own, its result judged where rows are held out."""

from dataclasses import replace
from pathlib import Path

from madoc.calibration import CalibrationResult, Calibrator, calibrate
from madoc.pipeline.folders import ENDED, working_folder
from madoc.pipeline.keys import seed_key
from madoc.pipeline.methods import hyperparameters
from madoc.pipeline.preparation import Prepared
from madoc.verdict import Assessment, assess
from madoc.verdict.evidence import evidence, save_evidence


def calibrate_prepared(
    out: Path, prepared: Prepared, method: Calibrator, *, resume: bool = False, quiet: bool = False
) -> tuple[CalibrationResult, Assessment | None]:
    """Calibrate with a method, judge the result where rows are held out, and leave a run folder.

    Returns:
        The result, and what the held-out rows say of it; None where nothing is held out, and where the run was
        interrupted or diverged.

    Raises:
        MadocError: The method refuses; a new folder is then not left behind.
    """
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
        assessment = assess(result, prepared.bench)
        result = replace(result, verdict=assessment.verdict, holdout=assessment.holdout)
        leave_evidence(out, prepared, result)
        folder.write_json("result.json", result.to_json())
        return result, assessment


def leave_evidence(out: Path, prepared: Prepared, result: CalibrationResult) -> None:
    """Leave `evidence.npz`: held-out stretches of the log beside what the simulator makes of them."""
    arrays = evidence(prepared.bench, result.mean, control_step=prepared.simulator.control_step)
    save_evidence(out / "evidence.npz", arrays)
