"""One cell carried out: its order handed to the stage that every single run uses."""

import traceback
from dataclasses import replace
from pathlib import Path
from time import monotonic

from madoc import data
from madoc.errors import MadocError, NotAllowed
from madoc.pipeline import calibrate_in, evaluate_folder, learn_in, read_calibration, record_named
from madoc.pipeline.folders import ENDED, holds_run
from madoc.pipeline.orders import NO_PERMISSION, CalibrationOrder, EvaluationOrder, Permission, PolicyOrder, RecordOrder
from madoc.runs.checkpoint import OtherState
from madoc.suites.cells import RECORDED, Cell, read_plans
from madoc.suites.checks import forget_contents, name_of
from madoc.suites.claims import MOST_ATTEMPTS, Claim, Outcome
from madoc.suites.options import Order


def carry_out(claim: Claim, suite: Path, *, permission: Permission = NO_PERMISSION) -> Outcome | None:
    """Do what a cell asks, or go on with it where an earlier process was stopped.

    Returns:
        How it ended; None where it was interrupted, and the next process goes on.

    Raises:
        NotAllowed: A spec asks for what is not allowed.
    """
    if claim.attempts > MOST_ATTEMPTS:
        tried = (
            f"begun {MOST_ATTEMPTS} times and never got further; its process was ended from outside: was memory short?"
        )
        return claim.end("failed", tried, 0.0)
    started = monotonic()
    try:
        status, sentence = _done(claim, suite, permission=permission)
    except NotAllowed:
        claim.take_back()
        raise  # another worker may be allowed to
    except MadocError as error:
        # A full disk, a missing library, a file that is gone or changed, or a checkpoint of another version is no
        # refusal: the same order may go through another time.
        broken = isinstance(error, (_Changed, OtherState)) or isinstance(error.__cause__, OSError | ImportError)
        return claim.end("failed" if broken else "refused", str(error), monotonic() - started)
    except Exception as error:
        (claim.folder / "failure.txt").write_text(traceback.format_exc(), encoding="utf-8")
        sentence = f"{type(error).__name__}: {error}; see {claim.folder / 'failure.txt'}"
        return claim.end("failed", sentence, monotonic() - started)
    if status == "interrupted":
        return None
    known = status if status in ENDED else "diverged"
    return claim.end(known, sentence, monotonic() - started)  # type: ignore[arg-type]


def _done(claim: Claim, suite: Path, *, permission: Permission) -> tuple[str, str]:
    """Carry the order out: the status, and that in words."""
    folder, order = claim.folder, claim.cell.read()
    _require_unchanged(claim.cell, order, permission=permission)
    resume = holds_run(folder)
    needed = suite / "cells" / (claim.cell.needs or "")
    match order:
        case RecordOrder():
            dataset = record_named(order, quiet=True)
            data.save(dataset, folder / RECORDED)
            return "finished", f"{len(dataset):,} transitions are recorded"
        case CalibrationOrder():
            asked = _with_recording(order, claim, suite)
            result = calibrate_in(folder, asked, resume=resume, quiet=True, permission=permission)
            return result.status, result.sentence
        case PolicyOrder():
            calibrated = read_calibration(needed, permission=permission)
            learnt = learn_in(folder, calibrated, order, resume=resume, quiet=True)
            return learnt.status, learnt.sentence
        case EvaluationOrder():
            policy = next(cell for cell in read_plans(suite) if cell.name == claim.cell.needs)
            calibration = suite / "cells" / (policy.needs or "")
            evaluation = evaluate_folder(
                needed, order, calibration=calibration, out=folder, quiet=True, permission=permission
            )
            return "finished", f"{evaluation.episodes} episodes are evaluated"


class _Changed(MadocError):
    """A file that a cell names is not what it was when the cell was planned and named."""


def _require_unchanged(cell: Cell, order: Order, *, permission: Permission) -> None:
    """Refuse a cell whose name no longer tells what its files hold, so that no result stands under a wrong name."""
    forget_contents()
    try:
        name = name_of(cell.kind, order, cell.needs, permission=permission)
    except NotAllowed:
        raise
    except MadocError as error:
        raise _Changed(f"since this cell was planned a file that it names has changed: {error}") from error
    if name != cell.name:
        raise _Changed("since this cell was planned a file that it names has changed; run madoc suite again")


def _with_recording(order: CalibrationOrder, claim: Claim, suite: Path) -> CalibrationOrder:
    """The order with the path of the data that another cell has recorded, where it takes such data."""
    if claim.cell.needs is None:
        return order
    paths = tuple(str(suite.resolve() / "cells" / path) for path in order.source.paths)
    return replace(order, source=replace(order.source, paths=paths))
