"""The model with the parameters that it seems to lack: whether that is what it lacks is tested before they are added.

A term may explain much of the residuals because it acts somewhat like what is missing. The model with it is therefore
fitted to the same windows and put to the same tests: only where these find nothing more, and what it leaves is noise,
is it the cause, as far as the log tells. Where they find another term that a spec can add, and none explains nearly as
much, the model with both is tested in turn: machines often lack the same at several joints.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from madoc import simulation
from madoc.calibration.holdout import RicherModel
from madoc.data import Dataset
from madoc.identification.causes import INTEGRATION
from madoc.identification.missing_terms import suspicions
from madoc.identification.noise import WHITE
from madoc.identification.states import LoggedStates, states_of
from madoc.identification.term_tests import LIKELY_FORCE, MissingTerm, named
from madoc.parameters import ParameterSpace
from madoc.simulation.base import Simulator
from madoc.simulation.delay import pending_actions
from madoc.verdict.adequacy import as_likely, is_certain, likeliest, worth_naming
from madoc.verdict.remedies import is_of_spec, line_of

MOST_ADDED = 3
"""Largest number of terms that are added to a model together, at least 1."""

Tested = tuple[RicherModel, MissingTerm | None] | None
"""A model that was tested, and the term to add next, if any; None if it could not be tested."""


def in_turn(term: MissingTerm, tested: Callable[[Sequence[MissingTerm]], Tested]) -> RicherModel | None:
    """The model with a term, or with others that it still lacks as well if all together explain the log.

    A delay is tried alone, as a lag may be what is there in its place. `tested` tests the model with some terms. None
    if the first one could not be tested.
    """
    first, added, further = None, list[MissingTerm](), term
    most = 1 if term.parameter.startswith(("action_delay", "action_lag")) else MOST_ADDED
    while len(added) < most and (found := tested([*added, further])) is not None:
        model, following = found
        if not model.left:
            return model
        first = first or model
        if following is None:
            break
        added, further = [*added, further], following
    return first


def richer_model(
    dataset: Dataset,
    logged: LoggedStates,
    simulator: Simulator,
    point: Float[np.ndarray, " d"],
    half_widths: Float[np.ndarray, " d"],
    scale: Float[np.ndarray, " observation"],
    terms: Sequence[MissingTerm],
    *,
    most: int | None,
) -> Tested:
    """The model with the parameters of terms, put to the tests.

    Args:
        dataset: The log that was calibrated to.
        logged: What it says of states.
        simulator: The model with its calibrated parameters.
        point: Their estimate in [-1, 1].
        half_widths: Half of each one's 95 % interval in [-1, 1].
        scale: Typical change of each signal in a stride.
        terms: The terms, each of which a parameter of a spec adds, in the order in which they were found.
        most: Largest number of windows; None for the usual one.
    """
    added, task = [line_of(term) for term in terms], simulator.task
    space = ParameterSpace((*simulator.parameters.parameters, *added))
    delay, lag = (
        max((row.high for row in space.parameters if row.field == field), default=0.0)
        for field in ("action_delay", "action_lag")
    )
    late = pending_actions(delay, lag, simulator.control_step)
    task = replace(task, parameters=space, pending=max(task.pending, late))
    wide = simulation.make(task)
    values = [term.value for term in terms]
    start = np.append(point, space.to_unit(np.append(simulator.parameters.middle, values))[len(point) :])
    of_added = [4.0 * term.standard_error / (line.high - line.low) for term, line in zip(terms, added, strict=True)]
    widths = np.append(half_widths, of_added)
    for term in terms:
        start += widths * [term.shifts.get(name, 0.0) for name in space.names]
    logged = logged if wide.task.pending == simulator.task.pending else states_of(dataset, wide)
    at = np.clip(start, -1.0, 1.0)
    found = suspicions(dataset, logged, wide, at, widths, scale, most=most)
    left = [each for each in found.terms if each.cause != INTEGRATION and abs(each.t) >= LIKELY_FORCE]
    more = (f"something that lasts over several rows (correlation {found.alike:.2f})",) if found.alike > WHITE else ()
    model = RicherModel(terms[0].parameter, (*map(named, left), *more), tuple(terms[1:]))
    return (model, _next(found.terms)) if found.tested else None


def _next(terms: Sequence[MissingTerm]) -> MissingTerm | None:
    """The likeliest of the certain terms that a model still lacks, if a spec can add that one and none as likely."""
    certain = [term for term in terms if is_certain(term) and term.explained >= worth_naming(terms)]
    term = likeliest(certain)
    alone = term is not None and is_of_spec(term) and not any(map(is_of_spec, as_likely(certain, term)))
    return term if alone else None
