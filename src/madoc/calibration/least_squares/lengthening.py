"""Longer windows, and the state that goes on from one length to the next.

Where motion is smooth they narrow the intervals, as fewer readings serve to fit initial states.

They begin where shorter ones do, whose initial states are estimated already, so a search on them starts near its end.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.instruments import FilterState
from madoc.calibration.least_squares.plan import FEWEST, touched
from madoc.calibration.least_squares.predicting import Prediction
from madoc.calibration.least_squares.search import SearchState
from madoc.data import Dataset
from madoc.identification.ensembles import likely_states
from madoc.identification.gauss_newton import FIRST_DAMPING
from madoc.identification.information import half_width, sandwich
from madoc.identification.replay import Readings
from madoc.identification.settling import FAILED_WINDOW, RESETTLING, settled, settled_to_noise
from madoc.identification.windows import disjoint_windows, evenly, rows_that_fit

Stage = Literal["logged", "undecided", "starting", "estimated", "lengthening", "filtering"]
LENGTHS = (1, 3, 9)
"""Length of the windows of each search, relative to the first's."""
LONGER = 1
"""Index of the first search on longer windows."""
SHORTEST = 3
"""Smallest length of the first windows in control steps: shorter ones hold little information besides their initial
state."""
READINGS = 2
"""Largest number of readings in all longer windows, relative to the first search; more only for `FEWEST` windows."""
AS_WELL = 1.2
"""Ratio of a channel's noise to that of the first windows, at least 1; above it longer windows show model errors."""
HOPELESS = 2.0
"""Ratio as of `AS_WELL`; above it a search ends before it has settled."""
FIRST_STEPS = 3
"""Number of steps after which a search on longer windows may end before it has settled: until then initial states are
inexact."""
LEFT_OUT = 0.1
"""Share in [0, 1] of windows; longer windows are refused if more than this share of them is newly unexplained."""
LESS, MUCH_LESS = 0.5, 0.1
"""Shares in [0, 1] of the noise that the filter found: what fitted starts leave at most of data with much less, at
the filter's estimate and after `FIRST_STEPS`."""
CHANCE = 3.0
"""Autocorrelation in its standard errors under white noise; above it residuals are not white."""
_SMALLEST = 1e-100


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LeastSquaresState:
    """The state of least squares.

    Attributes:
        known: The search from logged states; None where they cannot be rebuilt.
        unknown: Searches with unknown initial states: on the shortest windows, and on longer and longer
            ones; none are needed with stage `logged`. After a filter one at most, for data without noise.
        stage: `logged`: from logged states, to the end. `undecided`: from logged states, until residuals show whether
            these are noisy. `starting`: from logged states, to find parameters for `estimated` to begin at.
            `estimated`: with unknown initial states on the shortest windows. `lengthening`: the same on longer ones.
            `filtering`: by an ensemble filter.
        filtered: The search by an ensemble filter, which takes the place of those with unknown initial states where
            windows show contacts; else None.
        prediction: The fit for prediction, the last; None where the log does not serve for one.
        length: Index of the unknown search in progress.
        best: Index of the unknown search that has the estimate.
        finished: 1 once the next step would be too small to matter, else 0.
        timesteps: Into how many steps each timestep of the model is divided, once it is known with how many the log is
            likelier; 0 before.
        trying: 1 while a shorter timestep is on trial, else 0.
        of_own: What the searches with the model's own timestep came to, while a shorter one is on trial. It is there
            before and after as well, as the layout of a state must not change, and means nothing then.
    """

    known: SearchState | None
    unknown: tuple[SearchState, ...]
    stage: Stage
    filtered: FilterState | None
    prediction: Prediction | None
    length: int = 0
    best: int = 0
    finished: int = 0
    timesteps: int = 0
    trying: int = 0
    of_own: "LeastSquaresState | None" = None

    @property
    def answer(self) -> "LeastSquaresState":
        """The state that has the estimate: with the model's own timestep as long as a shorter one is on trial."""
        return self.of_own if self.trying and self.of_own is not None else self

    @property
    def estimates_starts(self) -> bool:
        """Whether the estimate is that of a search with unknown initial states."""
        return self.stage in ("estimated", "lengthening")

    @property
    def by_filter(self) -> FilterState | None:
        """The filter if the estimate is its own, as long as a search after it does not explain much more."""
        if self.filtered is None or self.stage not in ("filtering", "estimated"):
            return None
        first = self.unknown[0] if self.unknown else None
        follows = first is not None and first.epochs >= FIRST_STEPS and leaves_much_less(first, self.filtered)
        return self.filtered if self.stage == "filtering" or not follows else None

    @property
    def searched(self) -> bool:
        """Whether the searches have come to their end, and at most the fit for prediction has not."""
        return bool(self.finished) or (self.prediction is not None and self.prediction.progress == "under way")


def horizon_of(dataset: Dataset, fewest: int) -> int:
    """Length in control steps of the first windows with unknown initial states: the robot's time scale.

    In shorter windows little moves; in longer ones small errors grow until simulated and logged motion are unrelated.
    The length is at least `SHORTEST`, no longer than the episode that the median row is in, and short enough for
    `fewest` windows in all rows.
    """
    lengths = dataset.episode_ends - dataset.episode_starts
    longest = min(int(np.median(np.repeat(lengths, lengths))), len(dataset) // fewest - 1)
    return max(min(SHORTEST, int(lengths.max())), min(dataset.time_scale, longest))


def lengthened(problem: CalibrationProblem, shorter: SearchState, horizon: int, most: int) -> SearchState | None:
    """A search on at most `most` windows of `horizon` rows that share no reading, at rows where shorter ones begin.

    Bodies touch in none of them. It has not begun: its initial states are those of the shorter windows. None where too
    few windows fit.
    """
    rows, fewest = np.sort(shorter.rows), FEWEST + shorter.point.shape[1]
    rows = rows[rows_that_fit(problem.dataset, rows, horizon)]
    if not len(rows):
        return None
    free = rows[~touched(problem, rows, horizon)]
    chosen = evenly(free[disjoint_windows(problem.dataset, free, horizon)], max(most, fewest))
    if len(chosen) < fewest:
        return None
    return replace(
        shorter,
        point=shorter.point[:1].copy(),
        states=_states_at(shorter, chosen),
        damping=shorter.damping[:1],
        state_damping=shorter.state_damping[:1, : len(chosen)],
        cost=shorter.cost[:1],
        moved=shorter.moved[:1],
        rows=chosen,
        touching=np.zeros(len(chosen), bool),
        refining=1,
    )


def continued(longer: SearchState, shorter: SearchState) -> SearchState:
    """The longer search, begun anew with the parameters and initial states of the shorter one."""
    return replace(
        longer,
        point=shorter.point[:1].copy(),
        states=_states_at(shorter, longer.rows),
        damping=np.full_like(longer.damping, FIRST_DAMPING),
        state_damping=np.full_like(longer.state_damping, FIRST_DAMPING),
        waiting=1,
        epochs=0,
    )


def _states_at(search: SearchState, rows: Int[np.ndarray, " windows"]) -> Float[np.ndarray, "1 windows state"]:
    """The best search's initial states at some of its rows."""
    assert np.isin(rows, search.rows).all()
    return search.states[:1, np.argsort(search.rows)[np.searchsorted(np.sort(search.rows), rows)]].copy()


def hopeless(longer: SearchState, first: SearchState, best: SearchState) -> bool:
    """Whether a search on longer windows need not go on until it settles.

    It finds so much more noise than the first, or tells no more than the best so far.
    """
    if longer.epochs < FIRST_STEPS:
        return False
    return bool((longer.deviation > HOPELESS * first.deviation).any()) or not tells_more(longer, best)


def enough(longer: SearchState, shorter: SearchState) -> bool:
    """Whether there are enough longer windows if initial states explain as large a share of them as of shorter ones."""
    return round(shorter.explained / len(shorter.rows) * len(longer.rows)) >= FEWEST + longer.point.shape[1]


def noise_alone(longer: SearchState, first: SearchState, readings: int) -> bool:
    """Whether the residuals of a settled search are white noise, no larger in any channel than on the first windows.

    `readings` is the number of readings of a longer window.
    """
    quiet = bool((longer.deviation <= AS_WELL * first.deviation).all())
    return quiet and longer.autocorrelation <= CHANCE / math.sqrt(max(1, longer.explained * readings))


def tells_more(longer: SearchState, shorter: SearchState) -> bool:
    """Whether as many longer windows are explained, and intervals are narrower, on average over parameters."""
    fewest = FEWEST + longer.point.shape[1]
    explained, before = (search.explained / len(search.rows) for search in (longer, shorter))
    if longer.explained < fewest or explained < before - LEFT_OUT:
        return False
    widths = (half_width(sandwich(each.bread, each.meat).covariance, each.explained) for each in (longer, shorter))
    now, then = (np.log(np.maximum(width, _SMALLEST)).mean() for width in widths)
    return bool(now < then)


def begun(state: LeastSquaresState, known: SearchState) -> LeastSquaresState:
    """The stage after logged initial states where these are noisy, begun at the best point of the search from them."""
    if state.filtered is not None:
        return replace(state, filtered=replace(state.filtered, point=known.point[0].copy()), stage="filtering")
    first = replace(state.unknown[0], point=known.point[:1].copy())
    return replace(with_search(state, 0, first), stage="estimated")


def after_filter(problem: CalibrationProblem, state: LeastSquaresState, horizon: int) -> LeastSquaresState:
    """The state after an epoch of the filter: at its end, or going on where it left what is unlike noise.

    What an ensemble leaves of data without noise is like what it leaves of the next reading. Where fitted starts of a
    few windows of this horizon leave less, the search goes on with them to the exact values.
    """
    filtered = state.filtered
    assert filtered is not None
    if not filtered.settled:
        return state
    if not state.unknown or filtered.asked == "known" or not filtered.unlike_noise:
        return back_to_filter(state)
    first, point, log = state.unknown[0], filtered.point, (problem.dataset, problem.states, problem.simulator)
    readings = Readings.at(problem.dataset, problem.states, first.rows, horizon, problem.typical_change)
    (likely,) = likely_states(*log, readings, first.rows, point[None], first.states[0])
    tried = settled(problem.simulator, readings, point, likely, (0.0, *RESETTLING), 0)
    whole = (tried.costs < FAILED_WINDOW).sum() >= FEWEST + len(point)
    if not whole or (tried.deviation > LESS * filtered.noise).any():
        return back_to_filter(state)
    found = settled_to_noise(problem.simulator, readings, point, likely)
    first = replace(first, point=point[None].copy(), states=found.states[None], refining=1)
    return replace(state, unknown=(first,), stage="estimated", filtered=replace(filtered, asked="exact"))


def leaves_much_less(search: SearchState, filtered: FilterState) -> bool:
    """Whether fitted starts leave much less of every channel than the filter did, or have had too few steps yet."""
    if search.epochs < FIRST_STEPS:
        return True
    much = bool((search.deviation <= MUCH_LESS * filtered.noise).all())
    return much and search.explained >= FEWEST + len(filtered.point)


def back_to_filter(state: LeastSquaresState) -> LeastSquaresState:
    """The end of all with the filter's estimate, once it is known what it leaves.

    The data has noise then, the model's timestep is too long for it, random forces act, or it lacks something.
    """
    assert state.filtered is not None
    if state.filtered.asked == "known":
        return replace(state, stage="filtering", finished=1)
    return replace(state, stage="filtering", filtered=replace(state.filtered, asked="shorter"))


def failed(state: LeastSquaresState) -> LeastSquaresState:
    """The state after a search on longer windows in vain: the next shorter ones begin, unless they had their turn."""
    shorter = state.length - 1
    if shorter < LONGER or state.unknown[shorter].epochs:
        return finished(state, state.best)
    return gone_on(state, shorter)


def gone_on(state: LeastSquaresState, length: int) -> LeastSquaresState:
    """The state in which windows of this length begin where the best search is, or the end if too few are explained."""
    best, longer = state.unknown[state.best], state.unknown[length]
    if not enough(longer, best):
        return finished(state, state.best)
    return replace(with_search(state, length, continued(longer, best)), stage="lengthening", length=length)


def finished(state: LeastSquaresState, best: int) -> LeastSquaresState:
    """The end of all, with this search's estimate."""
    return replace(state, best=best, length=best, finished=1)


def with_search(state: LeastSquaresState, length: int, search: SearchState) -> LeastSquaresState:
    """The state with this search in place of the one of its length."""
    return replace(state, unknown=(*state.unknown[:length], search, *state.unknown[length + 1 :]))
