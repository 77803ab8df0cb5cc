"""The model with the parameter that it seems to lack: whether that is what it lacks is tested before anybody adds it.

A term may explain much of the residuals because it acts somewhat like what is missing. The model with it is therefore
fitted to the same windows and put to the same tests: only where these find nothing more, and what it leaves is noise,
is it the cause, as far as the log tells.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from madoc import simulation
from madoc.calibration.holdout import RicherModel
from madoc.data import Dataset
from madoc.identification.candidate_effects import FINER
from madoc.identification.candidate_terms import INTEGRATION
from madoc.identification.missing_terms import suspicions
from madoc.identification.noise import WHITE
from madoc.identification.states import LoggedStates, states_of
from madoc.identification.term_tests import LIKELY_FORCE, MissingTerm, named
from madoc.parameters import ParameterSpace
from madoc.simulation.base import Simulator
from madoc.simulation.delay import pending_actions
from madoc.verdict.remedies import line_of


def richer_model(
    dataset: Dataset,
    logged: LoggedStates,
    simulator: Simulator,
    point: Float[np.ndarray, " d"],
    half_widths: Float[np.ndarray, " d"],
    scale: Float[np.ndarray, " observation"],
    term: MissingTerm,
    *,
    finer: bool,
    most: int | None,
    shorter: int,
) -> RicherModel | None:
    """The model with the parameter of a term, or None if it cannot be tested.

    Args:
        dataset: The log that was calibrated to.
        logged: What it says of states.
        simulator: The model with its calibrated parameters.
        point: Their estimate in [-1, 1].
        half_widths: Half of each one's 95 % interval in [-1, 1].
        scale: Typical change of each signal in a stride.
        term: The term, which a parameter of a spec adds.
        finer: Whether to integrate in steps of a quarter of the length, as the tests that found the term did.
        most: Largest number of windows; None for the usual one.
        shorter: How many times as short and as many they are, as in the tests that found the term.
    """
    added, task = line_of(term), simulator.task
    space = ParameterSpace((*simulator.parameters.parameters, added))
    delay, lag = (
        max((row.high for row in space.parameters if row.field == field), default=0.0)
        for field in ("action_delay", "action_lag")
    )
    late = pending_actions(delay, lag, simulator.control_step)
    task = replace(task, parameters=space, pending=max(task.pending, late))
    wide = simulation.make(task.with_time_step(1.0 / FINER, substeps=FINER) if finer else task)
    shift = np.array([term.shifts.get(name, 0.0) for name in simulator.parameters.names]) * half_widths
    start = np.append(point + shift, space.to_unit(np.append(simulator.parameters.middle, term.value))[-1])
    widths = np.append(half_widths, 4.0 * term.standard_error / (added.high - added.low))
    logged = logged if wide.task.pending == simulator.task.pending else states_of(dataset, wide)
    at = np.clip(start, -1.0, 1.0)
    found = suspicions(dataset, logged, wide, at, widths, scale, of_other_model=True, most=most, shorter=shorter)
    left = [each for each in found.terms if each.cause != INTEGRATION and abs(each.t) >= LIKELY_FORCE]
    more = (f"something that lasts over several rows (correlation {found.alike:.2f})",) if found.alike > WHITE else ()
    return RicherModel(term.parameter, (*map(named, left), *more)) if found.tested else None
