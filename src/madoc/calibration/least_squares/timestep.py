"""Whether the log is likelier with a shorter timestep, from which the search then goes on.

A machine has no timesteps, and a log of a simulation has those of its simulator. Parameters make up for the error of a
timestep that is too long, as a delay does for half a step, and what they cannot make up for hides what the model lacks.
So the searches, once at their end, begin again there with a timestep a quarter as long. Their estimate counts if they
leave certainly less noise, or nothing that adds up over longer windows where the others did. An ensemble filter, whose
epochs are long, asks the same by a few steps (`left_over`).
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.lengthening import FIRST_STEPS, LEFT_OUT, LeastSquaresState, continued
from madoc.calibration.least_squares.plan import EXACT
from madoc.calibration.least_squares.search import SearchState
from madoc.identification.gauss_newton import FIRST_DAMPING
from madoc.simulation import FINER

CERTAINLY = 10.0
"""Logarithm of how many times as likely a shorter timestep makes the log at least: a quarter of one is no other model,
and by chance one in 20 thousand gains as much."""
_SMALLEST = 1e-100


def followed(
    problem: CalibrationProblem,
    state: LeastSquaresState,
    horizon: int,
    adds_up: Callable[[LeastSquaresState], bool | None],
) -> LeastSquaresState:
    """The state after a step, with a shorter timestep where that is to be tried, or with the one that is likelier.

    `horizon` is the length of the shortest windows with unknown initial states, `adds_up` whether what a search leaves
    is more than noise over longer ones; None where none has settled.
    """
    own, at_end = state.of_own, bool(state.finished)
    if not state.trying or own is None:
        if not at_end or state.timesteps:
            return state
        return _begun(state) if own is not None and _worth_trying(problem, state) else replace(state, timesteps=1)
    enough = at_end or (_first(state).epochs >= FIRST_STEPS and not adds_up(own))
    mends = bool(adds_up(own)) and adds_up(state) is False and not likelier(state, own, horizon)
    if enough and not mends and not likelier(own, state, horizon):
        return replace(own, of_own=own, timesteps=1)
    return replace(state, trying=0, timesteps=FINER) if at_end else state


def likelier(own: LeastSquaresState, shorter: LeastSquaresState, horizon: int) -> bool:
    """Whether a search leaves certainly less noise of as many windows: the log is likelier with its timestep then."""
    before, after = _first(own), _first(shorter)
    if after.explained < (1.0 - LEFT_OUT) * before.explained:
        return False
    noise = [np.maximum(_noise(each), _SMALLEST) for each in (own, shorter)]
    gain = float(np.log(noise[0] / noise[1]).sum())
    windows = min(before.explained, after.explained)
    return gain * windows * (horizon if shorter.estimates_starts else 1) > CERTAINLY


def _worth_trying(problem: CalibrationProblem, state: LeastSquaresState) -> bool:
    """Whether the log is of a robot of one's own and has noise, and no filter has asked already."""
    return state.filtered is None and problem.simulator.task.source is not None and float(_noise(state).max()) >= EXACT


def _first(state: LeastSquaresState) -> SearchState:
    """The search on the shortest windows."""
    search = state.unknown[0] if state.estimates_starts else state.known
    assert search is not None
    return search


def _noise(state: LeastSquaresState) -> Float[np.ndarray, " channels"]:
    """What the searches leave of each channel, in typical changes; of logged initial states a mean over channels."""
    search = _first(state)
    return search.deviation if state.estimates_starts else np.sqrt(search.cost[:1])


def _begun(own: LeastSquaresState) -> LeastSquaresState:
    """The searches begun anew where those with the model's own timestep have come to their end."""
    begun = replace(own, of_own=replace(own, of_own=None), trying=1, finished=0)
    if own.estimates_starts:
        first, point = own.unknown[0], own.unknown[0].point.copy()
        point[0] = own.unknown[own.best].point[0]
        longer = (continued(each, first) for each in own.unknown[1:])
        searches = (_search_begun(replace(first, point=point)), *longer)
        return replace(begun, unknown=searches, stage="estimated", length=0, best=0)
    assert own.known is not None
    return replace(begun, known=_search_begun(own.known))


def _search_begun(search: SearchState) -> SearchState:
    return replace(search, epochs=0, damping=np.full_like(search.damping, FIRST_DAMPING))
