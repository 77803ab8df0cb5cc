"""A worker: one process that claims cells of a suite and carries them out, one after another."""

import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from madoc.errors import NotAllowed
from madoc.pipeline.orders import NO_PERMISSION, Permission
from madoc.suites.cells import Cell, read_plans
from madoc.suites.claims import Outcome, attempts_of, claimed, outcome_of
from madoc.suites.stages import carry_out

_LAST = 3
"""How often a cell is begun without getting any further before it has to wait for all others."""
_PAUSES = (0.05, 2.0)
"""Shortest and longest pause in s before cells that wait for others are looked at again."""


def work(
    suite: Path, names: Sequence[str] | None = None, *, plan: str | None = None, permission: Permission = NO_PERMISSION
) -> list[Outcome] | None:
    """Carry out cells of a suite's plans until none is left that this process could begin.

    Any number of processes, on any number of machines that share the folder, may do this at once: each cell is done
    by one of them. A cell that another process has is left to it, but waited for where others need its result.

    Args:
        suite: The folder of the suite.
        names: Only these cells. Default: all.
        plan: Only the cells of this plan. Default: of all.
        permission: What specs of robots may ask for.

    Returns:
        How the cells ended that this process did; None where it was interrupted.

    Raises:
        NotAllowed: A spec asks for what is not allowed; the cell is left to others, and all
            that could be done without it is done.
    """
    planned = {cell.name: cell for cell in read_plans(suite, plan)}
    cells = list(planned.values()) if names is None else [planned[name] for name in names]
    return _work(suite, cells, planned, permission=permission)


def _work(
    suite: Path, cells: Sequence[Cell], known: dict[str, Cell], *, permission: Permission
) -> list[Outcome] | None:
    """The loop of `work`."""
    done: list[Outcome] = []
    not_allowed: NotAllowed | None = None
    in_vain: set[str] = set()
    waiting, pause, patient = deque(cells), _PAUSES[0], True
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
