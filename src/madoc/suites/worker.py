"""A worker: one process that claims cells of a suite and carries them out, one after another."""

import time
import traceback
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from madoc import data
from madoc.errors import MadocError, NotAllowed
from madoc.pipeline import calibrate_in, evaluate_folder, learn_in, read_calibration, record_named
from madoc.pipeline.orders import NO_PERMISSION, CalibrationOrder, EvaluationOrder, Permission, PolicyOrder, RecordOrder
from madoc.runs.checkpoint import OtherState
from madoc.runs.run_folder import ENDED, holds_run
from madoc.suites.cells import RECORDED, Cell, Order, read_plans
from madoc.suites.checks import forget_contents, name_of
from madoc.suites.claims import MOST_ATTEMPTS, Claim, Outcome, attempts_of, claimed, outcome_of

_LAST = 3
"""How often a cell is begun without getting any further before it has to wait for all others."""
_PAUSES = (0.05, 2.0)
"""Shortest and longest pause in s before cells that wait for others are looked at again."""


def work(
    suite: Path, names: Sequence[str] | None = None, *, plan: str | None = None, permission: Permission = NO_PERMISSION
) -> list[Outcome] | None:
    """Carry out cells of a suite's plans until none is left that this process could begin.

    Any number of processes, on any number of machines that share the folder, may do this at once: each cell is done
    by one of them. A cell that another process has is left to it, but waited for where others need its result. By
    default they are all cells of all plans.

    Returns:
        How the cells ended that this process did; None where it was interrupted.

    Raises:
        NotAllowed: A spec asks for what is not allowed; the cell is left to others, and all
            that could be done without it is done.
    """
    known = {cell.name: cell for cell in read_plans(suite, plan)}
    done: list[Outcome] = []
    not_allowed: NotAllowed | None = None
    in_vain: set[str] = set()
    waiting = deque(known.values() if names is None else [known[name] for name in names])
    pause, patient = _PAUSES[0], True
    while waiting:
        later: deque[Cell] = deque()
        blocked, progressed, postponed = False, False, False
        for cell in waiting:
            if outcome_of(cell, suite) is not None:
                continue
            needed = None if cell.needs is None else outcome_of(known[cell.needs], suite)
            if cell.needs in in_vain or (needed is not None and not needed.usable):
                in_vain.add(cell.name)  # what needs a cell without result is not run
                continue
            if cell.needs is not None and needed is None:
                later.append(cell)
                blocked = True
                continue
            if patient and attempts_of(cell, suite) >= _LAST:
                later.append(cell)  # whatever ends its processes should not end those of all others first
                postponed = True
                continue
            with claimed(cell, suite, fresh=not done) as claim:
                if claim is None:
                    later.append(cell)
                    continue
                try:
                    outcome = carry_out(claim, suite, permission=permission)
                except NotAllowed as error:
                    not_allowed = not_allowed or error
                    in_vain.add(cell.name)
                    continue
                if outcome is None:
                    return None
                done.append(outcome)
                progressed = True
        if not progressed and not postponed:
            if not blocked:
                break
            time.sleep(pause)
            pause = min(2 * pause, _PAUSES[1])
        patient = progressed
        waiting = later
    if not_allowed is not None:
        raise not_allowed
    return done


def carry_out(claim: Claim, suite: Path, *, permission: Permission = NO_PERMISSION) -> Outcome | None:
    """Do what a cell asks, or go on with it where an earlier process was stopped; how it ended.

    It is None where the cell was interrupted, and the next process goes on.

    Raises:
        NotAllowed: A spec asks for what is not allowed.
    """
    if claim.attempts > MOST_ATTEMPTS:
        tried = (
            f"begun {MOST_ATTEMPTS} times and never got further; its process was ended from outside: was memory short?"
        )
        return claim.end("failed", tried, 0.0)
    started = time.monotonic()
    try:
        status, sentence = _done(claim, suite, permission=permission)
    except NotAllowed:
        claim.take_back()
        raise  # another worker may be allowed to
    except MadocError as error:
        # A full disk, a missing library, a file that is gone or changed, or a checkpoint of another version is no
        # refusal: the same order may go through another time.
        broken = isinstance(error, (_Changed, OtherState)) or isinstance(error.__cause__, OSError | ImportError)
        return claim.end("failed" if broken else "refused", str(error), time.monotonic() - started)
    except Exception as error:
        (claim.folder / "failure.txt").write_text(traceback.format_exc(), encoding="utf-8")
        sentence = f"{type(error).__name__}: {error}; see {claim.folder / 'failure.txt'}"
        return claim.end("failed", sentence, time.monotonic() - started)
    if status == "interrupted":
        return None
    known = status if status in ENDED else "diverged"
    return claim.end(known, sentence, time.monotonic() - started)  # type: ignore[arg-type]


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
