"""Least squares, assembled: from logged states, with estimated ones, or first the one and then the other."""

from dataclasses import dataclass, replace
from typing import Literal

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.cautions import at_end_of_range
from madoc.calibration.least_squares.estimated_states import STATES_FIRST, EstimatedState, EstimatedStates
from madoc.calibration.least_squares.lengthening import (
    LENGTHS,
    READINGS,
    begun,
    hopeless,
    lengthened,
    noise_alone,
    says_more,
)
from madoc.calibration.least_squares.logged_states import LoggedState, LoggedStates
from madoc.calibration.least_squares.noise import consecutive_residuals, takes_turns
from madoc.data import Dataset
from madoc.errors import check_at_least
from madoc.identification.information import half_width, identifiability, sandwich
from madoc.identification.losses import Loss
from madoc.types import Epoch, Metrics

InitialStates = Literal["logged", "estimated"]
LOGGED_HORIZON = 1
"""Control steps of a window from a logged state: what is taken for true is best left at once."""
ESTIMATED_HORIZONS = (3, 20)
"""Of one with an estimated state: fewer tell little besides that state, more are slow."""
WINDOWS: dict[InitialStates, int] = {"logged": 1000, "estimated": 100}
SEARCH_WINDOWS: dict[InitialStates, int] = {"logged": 64, "estimated": 24}
NOISY = 0.25
"""Of `takes_turns`: noise alone has about a half, a model that is wrong in the same way all along less than nothing."""
LONG_TAILS = 1.1
"""Cost of residuals in deviations of the noise; normal noise leaves 0.8 under Cauchy's loss, and 1 under squares."""
EXACT = 1e-6
"""Typical changes: smaller residuals are those of states that were logged exactly."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LeastSquaresState:
    """Everything least squares carries.

    Attributes:
        logged: The search from logged states; None where they cannot be rebuilt.
        estimated: Searches with estimated ones on longer and longer windows; none where it never comes to that.
        length: Which of them is under way; their number once none has to be any more.
        found: Which of them has the estimate.
        phase: `estimated` once the latter is under way; `starting` before it, where it is known to come; `undecided`
            where the data is yet to be asked; `logged` where it never comes.
        checking: Control steps spent on asking.
    """

    logged: LoggedState | None
    estimated: tuple[EstimatedState, ...]
    length: int
    found: int
    phase: str
    checking: int


@dataclass(frozen=True)
class LeastSquares:
    """Damped Gauss-Newton on differences between simulated and logged observations, over windows of the log.

    Residuals are in units of each channel's typical change in one step. From `logged` initial states it is exact where
    they are clean and complete, and biased by noise in them, as it takes them for true. With `estimated` ones each
    window's initial state is an unknown besides the parameters, the first reading is a reading like the others, and
    channels weigh by the noise that the fit finds in them. Once nothing moves, windows become three times as long, and
    again, for as long as they say more and leave noise alone: where a robot moves smoothly, long windows say more, and
    what the model does wrong shows in them. By default
    states are estimated where they cannot be rebuilt, where the data is known to be noisy, and where residuals of
    consecutive rows speak of noise: a reading that is too high makes the step to it look too long and the step from it
    too short.

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
    horizon: int | None = None
    loss: Loss = "cauchy"
    windows: int | None = None
    searches: int = 3
    search_windows: int | None = None
    search_epochs: int = 8
    tolerance: float = 1e-7

    def __post_init__(self) -> None:
        counts = ("horizon", "windows", "searches", "search_windows", "search_epochs")
        check_at_least(self, **dict.fromkeys(counts, 1), tolerance=0.0)

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> LeastSquaresState:
        """Windows drawn, searches at their starts.

        Raises:
            MadocError: No state can be rebuilt and no position is known, no episode is long enough, there are fewer
                values than unknowns, or the data's next observations are shuffled.
        """
        problem.require_pairs()
        phase = self._first_phase(problem)
        return LeastSquaresState(
            logged=None if phase == "estimated" else self._logged(problem).init(problem, key),
            estimated=() if phase == "logged" else self._searches(problem, jax.random.fold_in(key, 1)),
            length=0,
            found=0,
            phase=phase,
            checking=0,
        )

    def step(self, problem: CalibrationProblem, state: LeastSquaresState) -> tuple[LeastSquaresState, Epoch]:
        """One damped step of the search under way: two simulations, one of slopes, one of the steps tried."""
        stage = self._stage(state)
        following, metrics = self._next(problem, state)
        spent = self._control_steps(following) - self._control_steps(state)
        return following, Epoch(metrics, spent, stage=stage, converged=self._converged(following))

    def _next(self, problem: CalibrationProblem, state: LeastSquaresState) -> tuple[LeastSquaresState, Metrics]:
        if state.phase == "estimated":
            under_way = state.length if state.length < len(state.estimated) else state.found
            search, metrics = self._estimated(problem, under_way).step(problem, state.estimated[under_way])
            return self._lengthen(problem, _with(state, under_way, search)), metrics
        assert state.logged is not None
        logged, metrics = self._logged(problem).step(problem, state.logged)
        following = replace(state, logged=logged)
        if state.phase == "undecided" and logged.refining and not logged.epochs:
            following = self._ask(problem, following)
        elif state.phase == "undecided" and self._logged(problem).settled(logged):
            following = self._ask(problem, following)
            following = replace(following, phase="logged") if following.phase == "undecided" else following
        elif state.phase == "starting" and logged.refining:
            following = _go_on(following)
        return following, metrics

    def estimate(self, problem: CalibrationProblem, state: LeastSquaresState) -> Estimate:
        """Where the best search stands, with the sandwich covariance and Student's t intervals around it."""
        space, (search, windows) = problem.simulator.parameters, self._search(problem, state)
        unit = search.unit[0 if search.refining else int(np.argmin(search.cost))]
        found = sandwich(search.bread, search.meat)
        half = (space.high - space.low) / 2.0
        mean = space.to_physical(unit)
        covariance = half[:, None] * found.covariance * half
        width = half * half_width(found.covariance, windows)
        interval = np.clip(np.stack([mean - width, mean + width], axis=-1), space.low[:, None], space.high[:, None])
        failures = sum(part.failures for part in _parts(state))
        return Estimate(
            mean=mean,
            std=np.sqrt(np.diag(covariance)),
            groups=(tuple(range(len(space))),),
            failures=failures,
            warnings=(
                *identifiability(found, space.names),
                *at_end_of_range(unit, space.names),
                *_said_of_ending(search, state.phase),
                *self._said_of_states(problem, state),
            ),
            covariance=covariance,
            interval=interval,
        )

    def _control_steps(self, state: LeastSquaresState) -> int:
        """Simulated control steps so far."""
        return state.checking + sum(part.control_steps for part in _parts(state))

    def whole_run(self, problem: CalibrationProblem, state: LeastSquaresState, *, refining_epochs: int) -> int:
        """About how many control steps a run from the beginning takes, as far as the data has chosen already."""
        steps = 0
        if state.logged is not None:
            steps += self._logged(problem).whole_run(state.logged, 0 if state.phase == "starting" else refining_epochs)
        if state.phase != "undecided":
            for length, search in enumerate(state.estimated):
                steps += self._estimated(problem, length).whole_run(problem, search, refining_epochs)
        return steps

    def _stage(self, state: LeastSquaresState) -> str:
        """What the next epoch does."""
        search = state.estimated[state.found] if state.phase == "estimated" else state.logged
        return "calibrating" if search is not None and search.refining else "searching"

    def _converged(self, state: LeastSquaresState) -> str | None:
        """A sentence once the steps are too small to matter."""
        search: LoggedState | EstimatedState | None = None
        if state.phase == "estimated":
            search = state.estimated[state.found] if state.length == len(state.estimated) else None
        elif state.phase == "logged" and state.logged is not None:
            search = state.logged if LoggedStates.settled(state.logged) else None
        if search is None:
            return None
        steps = search.epochs - (STATES_FIRST if state.found else 0)
        return f"after {steps} steps on all windows the next would change nothing worth a simulation"

    def _first_phase(self, problem: CalibrationProblem) -> str:
        """What the first epoch does: `logged`, `estimated`, `starting` from logged for estimated, or `undecided`."""
        if self.initial_states == "logged":
            return "logged"
        if problem.states.kind != "exact" and len(problem.states.rows):
            return "estimated"
        known = problem.dataset.disturbance
        told = self.initial_states == "estimated" or known.noise > 0 or known.velocities == "differences"
        return "starting" if told else "undecided"

    def _logged(self, problem: CalibrationProblem) -> LoggedStates:
        """A search from logged states; where it only finds a start for the other, short windows mislead least."""
        starting = self._first_phase(problem) == "starting"
        return LoggedStates(
            horizon=LOGGED_HORIZON if starting else self.horizon or LOGGED_HORIZON,
            loss=self.loss,
            windows=self.windows or WINDOWS["logged"],
            searches=self.searches,
            search_windows=self.search_windows or SEARCH_WINDOWS["logged"],
            search_epochs=self.search_epochs,
            tolerance=self.tolerance,
        )

    def _estimated(self, problem: CalibrationProblem, length: int = 0) -> EstimatedStates:
        """A search from logged states, where there was one, is where this one starts: it needs no others."""
        return EstimatedStates(
            horizon=self.horizon or LENGTHS[length] * horizon_of(problem.dataset),
            loss=self.loss,
            windows=self.windows or WINDOWS["estimated"],
            searches=self.searches if self._first_phase(problem) == "estimated" else 1,
            search_windows=self.search_windows or SEARCH_WINDOWS["estimated"],
            search_epochs=self.search_epochs,
            tolerance=self.tolerance,
        )

    def _searches(self, problem: CalibrationProblem, key: PRNGKeyArray) -> tuple[EstimatedState, ...]:
        """All lengths of windows that the data has room for; one where the length is given."""
        searches = [self._estimated(problem).init(problem, key)]
        for length in range(1, len(LENGTHS) if self.horizon is None else 1):
            most = READINGS * len(searches[0].rows) // LENGTHS[length]
            longer = lengthened(problem, searches[-1], self._estimated(problem, length).horizon, most)
            if longer is None:
                break
            searches.append(longer)
        return tuple(searches)

    def _lengthen(self, problem: CalibrationProblem, state: LeastSquaresState) -> LeastSquaresState:
        """On to longer windows once nothing moves, while those say more.

        Back to the first if longer ones leave more than noise: what the model lacks moves the estimate by about as much
        for all lengths, and wide intervals may count it.
        """
        searches, length, last = state.estimated, state.length, len(state.estimated)
        if length == last:
            return state
        search, ended = searches[length], replace(state, length=last)
        if not EstimatedStates.settled(search):
            lost = hopeless(search, searches[0]) or search.epochs >= STATES_FIRST + self.search_epochs
            return ended if length and lost else state
        if length and not self._noise_alone(problem, state, length):
            return replace(ended, found=0)
        if length and not says_more(search, searches[state.found]):
            return ended
        following = replace(state, found=length, length=length + 1)
        if length + 1 == last or float(search.deviation.max()) < EXACT:
            return replace(following, length=last)
        return _with(following, length + 1, begun(searches[length + 1], search))

    def _noise_alone(self, problem: CalibrationProblem, state: LeastSquaresState, length: int) -> bool:
        """Whether windows of this length leave what the first did."""
        readings = self._estimated(problem, length).horizon + 1
        return noise_alone(state.estimated[length], state.estimated[0], readings)

    def _search(
        self, problem: CalibrationProblem, state: LeastSquaresState
    ) -> tuple[LoggedState | EstimatedState, int]:
        """The search that has the estimate, and its windows; one with estimated states has it once it has begun."""
        logged = state.logged
        if state.estimated and (logged is None or state.estimated[0].control_steps):
            estimated = state.estimated[state.found]
            return estimated, estimated.explained
        assert logged is not None
        return logged, self._logged(problem).window_count(logged)

    def _ask(self, problem: CalibrationProblem, state: LeastSquaresState) -> LeastSquaresState:
        """Estimate states where residuals of consecutive rows take turns, as noise of the sensors makes them.

        Asked once the search has ended, and, as what the model does wrong may hide it, again once nothing moves.
        """
        assert state.logged is not None
        if np.sqrt(state.logged.cost[0]) < EXACT:
            return state
        pairs, spent = consecutive_residuals(problem, state.logged.unit[0], state.logged.chosen)
        state = replace(state, checking=state.checking + spent)
        return _go_on(state) if takes_turns(*pairs) > NOISY else state

    def _said_of_states(self, problem: CalibrationProblem, state: LeastSquaresState) -> tuple[str, ...]:
        """That states were estimated, and why, where the data has chosen so."""
        if not state.estimated or not state.estimated[0].control_steps or self.initial_states is not None:
            return ()
        estimated = state.estimated[state.found]
        noise = problem.dataset.disturbance.noise
        if problem.states.kind != "exact":
            why = "states cannot be rebuilt from the data"
        elif problem.dataset.disturbance.velocities == "differences":
            why = "velocities are differences of positions, which are what it compares"
        elif noise:
            why = "the data is noisy"
        else:
            why = "residuals of consecutive rows speak of noise"
        horizon = self._estimated(problem, state.found).horizon
        told = f"initial states of windows of {horizon} control steps were estimated with the parameters, as {why}"
        if estimated.refining:
            told += f"; the noise it finds is {100.0 * float(np.median(estimated.deviation)):.2g} % of a step's change"
        if not (estimated.refining and estimated.epochs) or float(estimated.deviation.max()) < EXACT:
            return (told,)
        left_out = len(estimated.rows) - estimated.explained
        windows = (
            f"{left_out} of {len(estimated.rows)} windows count for nothing: no initial state found explains them as "
            "well as others, as where contacts begin, or their simulation failed"
        )
        tails = "residuals have longer tails than noise has: the intervals are too narrow"
        return (
            told,
            *([windows] if left_out else []),
            *([tails] if estimated.cost[0] > LONG_TAILS else []),
            *self._said_of_longer_windows(problem, state),
        )

    def _said_of_longer_windows(self, problem: CalibrationProblem, state: LeastSquaresState) -> tuple[str, ...]:
        """That they were not done with, or that they leave more than noise."""
        length, last = state.length, len(state.estimated)
        if 0 < length < last:
            return ("longer windows were under way when it ended: a larger budget may narrow the intervals",)
        for longer in range(state.found + 1, last):
            if EstimatedStates.settled(state.estimated[longer]) and not self._noise_alone(problem, state, longer):
                horizon = self._estimated(problem, longer).horizon
                return (
                    f"over {horizon} control steps the simulator leaves more than noise: something the model lacks, "
                    "which intervals do not count",
                )
        return ()


def _said_of_ending(search: LoggedState | EstimatedState, phase: str) -> tuple[str, ...]:
    """That it did not come to an end, where it did not."""
    if isinstance(search, EstimatedState):
        ended = EstimatedStates.settled(search)
    else:
        ended = LoggedStates.settled(search) and phase in ("logged", "undecided")
    said = "the search had not settled when it ended, and intervals do not count what is missing; take a larger budget"
    return () if ended else (said,)


def horizon_of(dataset: Dataset) -> int:
    """Control steps in which a channel changes by as much as it differs between any two rows, the median over channels.

    In shorter windows little happens; in longer ones small errors grow until simulated and logged motion have nothing
    to do with each other. Within `ESTIMATED_HORIZONS`, and no longer than the episode that the median row is in.
    """
    logged = dataset.transitions
    change = np.asarray(logged.next_observation - logged.observation).std(0)
    moving = change > 0.0
    ratio = np.median(np.asarray(logged.observation).std(0)[moving] / change[moving]) if moving.any() else 0.0
    lengths = dataset.episode_ends - dataset.episode_starts
    return min(int(np.clip(round(float(ratio)), *ESTIMATED_HORIZONS)), int(np.median(np.repeat(lengths, lengths))))


def _go_on(state: LeastSquaresState) -> LeastSquaresState:
    """With estimated states from where the best search stands."""
    assert state.logged is not None
    first = replace(state.estimated[0], unit=state.logged.unit[:1].copy())
    return replace(_with(state, 0, first), phase="estimated")


def _with(state: LeastSquaresState, length: int, search: EstimatedState) -> LeastSquaresState:
    """The state with the search of this length in its place."""
    return replace(state, estimated=(*state.estimated[:length], search, *state.estimated[length + 1 :]))


def _parts(state: LeastSquaresState) -> tuple[LoggedState | EstimatedState, ...]:
    """Every search there is."""
    return (*(() if state.logged is None else (state.logged,)), *state.estimated)
