"""Least squares: a search from logged states, one with unknown initial states, or first the one and then the other."""

from dataclasses import dataclass, replace
from typing import Literal

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.cautions import at_end_of_range
from madoc.calibration.least_squares import sentences
from madoc.calibration.least_squares.known_starts import KnownStarts
from madoc.calibration.least_squares.lengthening import (
    LENGTHS,
    READINGS,
    continued,
    hopeless,
    horizon_of,
    lengthened,
    noise_alone,
    tells_more,
)
from madoc.calibration.least_squares.search import Search, SearchState
from madoc.calibration.least_squares.statistics import alternation, consecutive_residuals
from madoc.calibration.least_squares.unknown_starts import UnknownStarts
from madoc.identification.information import half_width, identifiability, sandwich
from madoc.identification.losses import Loss
from madoc.types import Count, Epoch, NotNegative, check_hyperparameters

InitialStates = Literal["logged", "estimated"]
Stage = Literal["logged", "undecided", "starting", "estimated", "lengthening"]
LOGGED_HORIZON = 1
"""Control steps of a window from a logged state: a state that is taken for true is best left at once."""
WINDOWS: dict[InitialStates, int] = {"logged": 1000, "estimated": 100}
"""Windows refined on, at most."""
SEARCH_WINDOWS: dict[InitialStates, int] = {"logged": 64, "estimated": 24}
"""Windows searched on, at most."""
NOISY = 0.25
"""Alternation of residuals, from -1 to 1, above which logged states are noisy: noise alone has about a half."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LeastSquaresState:
    """Everything least squares carries.

    Attributes:
        known: The search from logged states; None where they cannot be rebuilt.
        unknown: Searches with unknown initial states on longer and longer windows; none if it never comes to that.
        stage: `logged`: from logged states, to the end. `undecided`: from logged states, until residuals tell whether
            they are noisy. `starting`: from logged states, until a start for unknown ones is found. `estimated`: with
            unknown ones on the shortest windows. `lengthening`: the same on longer ones.
        length: Which of the unknown searches is under way.
        best: Which of them has the estimate.
        finished: 1 once the next step would change nothing worth a simulation, else 0.
    """

    known: SearchState | None
    unknown: tuple[SearchState, ...]
    stage: Stage
    length: int
    best: int
    finished: int

    @property
    def estimates_starts(self) -> bool:
        """Whether a search with unknown initial states has begun; then the estimate is its."""
        return self.stage in ("estimated", "lengthening")


@dataclass(frozen=True)
class LeastSquares:
    """Damped Gauss-Newton on differences between simulated and logged observations, over windows of the log.

    Residuals are in units of each channel's typical change in one step. From `logged` initial states it is exact where
    they are clean and complete, and biased by noise in them, as it takes them for true. With `estimated` ones each
    window's initial state is an unknown besides the parameters, the first reading is a reading like the others, and
    channels weigh by the noise that the fit finds in them. Once nothing moves, windows become three times as long, and
    again, for as long as they narrow the intervals and leave noise alone: where a robot moves smoothly, long windows
    tell more, and model errors show in them. By default states are estimated where they cannot be rebuilt, where the
    data is known to be noisy, and where residuals of consecutive rows alternate as noise makes them: a reading that is
    too high makes the step to it look too long and the step from it too short.

    Attributes:
        initial_states: `logged`, `estimated`, or None for the data to choose.
        horizon: Control steps of a window; the observation after every one of them counts. None takes 1 from logged
            states; with estimated ones as many as it takes the robot to move from one pose to another (`horizon_of`),
            then 3 and 9 times as many.
        loss: `linear`, or a robust one (`huber`, `soft-l1`, `cauchy`) whose scale follows the residuals.
        windows: Windows, at most; all there are if fewer. None takes 1000 from logged states, 100 with estimated ones.
        searches: The first begins at mid-range, the others at random places. The best goes on.
        search_windows: Windows while searching; None takes 64 from logged states, 24 with estimated ones.
        search_epochs: Epochs of searching, at most; it ends once the best search has settled.
        tolerance: Share of each range; a step that moves no parameter by more, nor by a tenth of its standard error,
            is the last.
    """

    initial_states: InitialStates | None = None
    horizon: Count | None = None
    loss: Loss = "cauchy"
    windows: Count | None = None
    searches: Count = 3
    search_windows: Count | None = None
    search_epochs: Count = 8
    tolerance: NotNegative = 1e-7

    def __post_init__(self) -> None:
        check_hyperparameters(self)

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> LeastSquaresState:
        """Draw windows, and put the searches at their starts.

        Raises:
            MadocError: No state can be rebuilt and no position is known, no episode is long enough, there are fewer
                values than unknowns, or the data's next observations are shuffled.
        """
        problem.require_pairs()
        stage = self._first_stage(problem)
        return LeastSquaresState(
            known=None if stage == "estimated" else self._known(problem).init(problem, key),
            unknown=() if stage == "logged" else self._all_lengths(problem, jax.random.fold_in(key, 1)),
            stage=stage,
            length=0,
            best=0,
            finished=0,
        )

    def step(self, problem: CalibrationProblem, state: LeastSquaresState) -> tuple[LeastSquaresState, Epoch]:
        """One damped step of the search under way, and what follows from it."""
        if state.estimates_starts:
            search, epoch = self._unknown(problem, state.length).step(problem, state.unknown[state.length])
            state = self._after_unknown(problem, _with(state, state.length, search))
        else:
            assert state.known is not None
            search, epoch = self._known(problem).step(problem, state.known)
            state, asking = self._after_known(problem, replace(state, known=search))
            epoch = replace(epoch, control_steps=epoch.control_steps + asking)
        if not state.finished:
            return state, epoch
        steps = (state.unknown[state.best] if state.estimates_starts else search).epochs
        converged = f"after {steps} steps on all windows the next would change nothing worth a simulation"
        return state, replace(epoch, converged=converged)

    def estimate(self, problem: CalibrationProblem, state: LeastSquaresState) -> Estimate:
        """Where the best search stands, with the sandwich covariance and Student's t intervals around it."""
        space = problem.simulator.parameters
        if state.estimates_starts:
            best = state.unknown[state.best]
            windows, settled = best.explained, self._unknown(problem).settled(best)
        else:
            assert state.known is not None
            best = state.known
            windows, settled = self._known(problem).window_count(best), bool(state.finished)
        unit = best.unit[0 if best.refining else int(np.argmin(best.cost))]
        uncertainty = sandwich(best.bread, best.meat)
        half = (space.high - space.low) / 2.0
        mean = space.to_physical(unit)
        covariance = half[:, None] * uncertainty.covariance * half
        width = half * half_width(uncertainty.covariance, windows)
        interval = np.clip(np.stack([mean - width, mean + width], axis=-1), space.low[:, None], space.high[:, None])
        searches = (*(() if state.known is None else (state.known,)), *state.unknown)
        return Estimate(
            mean=mean,
            std=np.sqrt(np.diag(covariance)),
            groups=(tuple(range(len(space))),),
            failures=sum(search.failures for search in searches),
            warnings=(
                *identifiability(uncertainty, space.names),
                *at_end_of_range(unit, space.names),
                *(() if settled else (sentences.NOT_SETTLED,)),
                *self._about_states(problem, state),
            ),
            covariance=covariance,
            interval=interval,
        )

    def whole_run(self, problem: CalibrationProblem, state: LeastSquaresState, *, refining_epochs: int) -> int:
        """About how many control steps a run from the beginning takes, as far as the data has chosen already."""
        steps = 0
        if state.known is not None:
            epochs = 0 if state.stage == "starting" else refining_epochs
            steps += self._known(problem).whole_run(problem, state.known, epochs)
        if state.stage != "undecided":
            for length, search in enumerate(state.unknown):
                steps += self._unknown(problem, length).whole_run(problem, search, refining_epochs)
        return steps

    def _first_stage(self, problem: CalibrationProblem) -> Stage:
        if self.initial_states == "logged":
            return "logged"
        if problem.states.kind != "exact" and len(problem.states.rows):
            return "estimated"
        disturbance = problem.dataset.disturbance
        noisy = disturbance.noise > 0 or disturbance.velocities == "differences"
        return "starting" if noisy or self.initial_states == "estimated" else "undecided"

    def _known(self, problem: CalibrationProblem) -> Search:
        """The search from logged states; where it only finds a start for the other, short windows mislead least."""
        starting = self._first_stage(problem) == "starting"
        horizon = LOGGED_HORIZON if starting else self.horizon or LOGGED_HORIZON
        return self._search(KnownStarts(self.loss), "logged", horizon, self.searches)

    def _unknown(self, problem: CalibrationProblem, length: int = 0) -> Search:
        """The search with unknown initial states; it starts where one from logged states ended, if there was one."""
        searches = self.searches if self._first_stage(problem) == "estimated" else 1
        horizon = self.horizon or LENGTHS[length] * horizon_of(problem.dataset)
        return self._search(UnknownStarts(self.loss), "estimated", horizon, searches)

    def _search(
        self, starts: KnownStarts | UnknownStarts, states: InitialStates, horizon: int, searches: int
    ) -> Search:
        windows, search_windows = self.windows or WINDOWS[states], self.search_windows or SEARCH_WINDOWS[states]
        return Search(starts, horizon, windows, searches, search_windows, self.search_epochs, self.tolerance)

    def _all_lengths(self, problem: CalibrationProblem, key: PRNGKeyArray) -> tuple[SearchState, ...]:
        """Searches on all lengths of windows that the data has room for; on one where the length is given."""
        searches = [self._unknown(problem).init(problem, key)]
        for length in range(1, len(LENGTHS) if self.horizon is None else 1):
            most = READINGS * len(searches[0].rows) // LENGTHS[length]
            longer = lengthened(problem, searches[-1], self._unknown(problem, length).horizon, most)
            if longer is None:
                break
            searches.append(longer)
        return tuple(searches)

    def _after_known(self, problem: CalibrationProblem, state: LeastSquaresState) -> tuple[LeastSquaresState, int]:
        """On to unknown initial states where logged ones are noisy, and the control steps spent on that question.

        Asked once the search refines and, as model errors may hide noise, again once nothing moves.
        """
        known, asking = state.known, 0
        assert known is not None
        settled = self._known(problem).settled(known)
        if state.stage == "starting" and known.refining:
            return _begun(state, known), asking
        if state.stage == "undecided" and (settled or (known.refining and not known.epochs)):
            if np.sqrt(known.cost[0]) >= sentences.EXACT:
                pairs, asking = consecutive_residuals(problem, known.unit[0], known.rows)
                if alternation(*pairs) > NOISY:
                    return _begun(state, known), asking
            state = replace(state, stage="logged" if settled else "undecided")
        return replace(state, finished=int(settled and state.stage == "logged")), asking

    def _after_unknown(self, problem: CalibrationProblem, state: LeastSquaresState) -> LeastSquaresState:
        """On to longer windows once nothing moves, while those tell more.

        Back to the shortest if longer ones leave more than noise: model errors move the estimate by about as much
        for all lengths, and wide intervals may count them.
        """
        searches, length = state.unknown, state.length
        search = searches[length]
        if state.finished:
            return state
        if not self._unknown(problem).settled(search):
            lost = hopeless(search, searches[0]) or search.epochs >= self.search_epochs
            return _finished(state, state.best) if length and lost else state
        if length and not self._noise_alone(problem, state, length):
            return _finished(state, 0)
        if length and not tells_more(search, searches[state.best]):
            return _finished(state, state.best)
        if length + 1 == len(searches) or float(search.deviation.max()) < sentences.EXACT:
            return _finished(state, length)
        longer = _with(state, length + 1, continued(searches[length + 1], search))
        return replace(longer, stage="lengthening", best=length, length=length + 1)

    def _noise_alone(self, problem: CalibrationProblem, state: LeastSquaresState, length: int) -> bool:
        """Whether windows of this length leave what the shortest did."""
        readings = self._unknown(problem, length).horizon + 1
        return noise_alone(state.unknown[length], state.unknown[0], readings)

    def _about_states(self, problem: CalibrationProblem, state: LeastSquaresState) -> tuple[str, ...]:
        """That states were estimated, where the data has chosen so, and what came of it."""
        if not state.estimates_starts or self.initial_states is not None:
            return ()
        best, horizon = state.unknown[state.best], self._unknown(problem, state.best).horizon
        about = (sentences.about_estimated_states(problem, best, horizon), *sentences.about_residuals(best))
        if float(best.deviation.max()) < sentences.EXACT:
            return about
        if state.stage == "lengthening" and not state.finished:
            return (*about, sentences.STILL_LENGTHENING)
        for longer in range(state.best + 1, len(state.unknown)):
            settled = self._unknown(problem).settled(state.unknown[longer])
            if settled and not self._noise_alone(problem, state, longer):
                return (*about, sentences.about_model_errors(self._unknown(problem, longer).horizon))
        return about


def _begun(state: LeastSquaresState, known: SearchState) -> LeastSquaresState:
    """With unknown initial states from where the best search from logged ones stands."""
    first = replace(state.unknown[0], unit=known.unit[:1].copy())
    return replace(_with(state, 0, first), stage="estimated")


def _finished(state: LeastSquaresState, best: int) -> LeastSquaresState:
    return replace(state, best=best, length=best, finished=1)


def _with(state: LeastSquaresState, length: int, search: SearchState) -> LeastSquaresState:
    """The state with the search of this length in its place."""
    return replace(state, unknown=(*state.unknown[:length], search, *state.unknown[length + 1 :]))
