"""Least squares from logged states, with unknown initial states, or first the one and then the other."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.calibration.base import CalibrationProblem, Estimate, at_end_of_range
from madoc.calibration.least_squares import filtering, lengthening, predicting, sentences, timestep
from madoc.calibration.least_squares.known_starts import KnownStarts
from madoc.calibration.least_squares.lengthening import LENGTHS, LONGER, READINGS, LeastSquaresState, Stage
from madoc.calibration.least_squares.plan import EXACT, FEWEST, Found, consecutive_residuals, noisy_rows
from madoc.calibration.least_squares.search import Search, SearchState
from madoc.calibration.least_squares.unknown_starts import UnknownStarts
from madoc.data import stride
from madoc.errors import MadocError
from madoc.identification.information import identifiability, quantile, sandwich
from madoc.identification.losses import Loss
from madoc.identification.noise import NOISY, alternation
from madoc.identification.random_forces import by_dof
from madoc.simulation import FINER
from madoc.simulation.base import SIMULATED, counted_as
from madoc.types import Count, Epoch, NotNegative, check_hyperparameters, named_key

InitialStates = Literal["logged", "estimated"]
LOGGED_HORIZON = 1
"""Length in control steps of a window from a logged state: noise of the state disturbs the first step least."""
WINDOWS: dict[InitialStates, int] = {"logged": 1000, "estimated": 100}
"""Largest number of windows in the end."""
SEARCH_WINDOWS: dict[InitialStates, int] = {"logged": 64, "estimated": 24}
"""Largest number of windows while searching."""
STARTING_STRIDES = 1
"""Length in strides of the rows of windows from logged states where these are noisy and only a start is wanted."""


@dataclass(frozen=True)
class LeastSquares:
    """Damped Gauss-Newton on differences between simulated and logged observations, over windows of the log.

    Residuals are in typical changes of a channel in a stride. With `logged` initial states, which are assumed to be
    exact, noise in them biases the estimate. With `estimated` ones each window's initial state is a further unknown,
    its first reading is a reading like the others, and channels are weighted by their estimated noise. Once a search
    has settled, windows become nine times as long, or three times where these fail, while that narrows the intervals
    and residuals remain noise: long windows hold more information, and they show model errors. By default states are
    estimated where they cannot be rebuilt, where the data is declared noisy, and where residuals of consecutive rows
    alternate as noise makes them: a reading that is too high makes the step to it look too long and the step from it
    too short. Where windows show contacts and positions are measured, an ensemble filter takes their place
    (`filtering`); what it leaves of data without noise is left to estimated ones.

    Attributes:
        initial_states: `logged`, `estimated`, or None to choose by the data.
        horizon: Length of a window in control steps; the observation after each of them counts. None is 1 from logged
            states, and with estimated ones `horizon_of` the data, then 9 or 3 times as many; by the filter its own.
        loss: `linear`, or a robust one (`huber`, `soft-l1`, `cauchy`) whose scale follows the residuals.
        windows: Largest number of windows. None is 1000 from logged states, 100 with estimated ones, and by the filter
            `filtering.MOST_BLOCKS` times as many as an epoch has.
        searches: Number of points to search from: mid-range, then random ones. The best goes on.
        search_windows: Largest number of windows while searching. None is 64 from logged states, else 24.
        search_epochs: Largest number of epochs of searching, which ends once the best search has settled.
        tolerance: Share of each range; the search ends with a step that moves no parameter by more than this, nor by a
            tenth of its standard error (half of it where states are estimated from the step on that is the last of
            `search_epochs`).
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
        """Draw the windows, and the points at which the searches begin.

        Raises:
            MadocError: No state can be rebuilt and no position is observed, no episode is long enough, there are fewer
                values than unknowns, or the data's next observations are shuffled.
        """
        problem.require_pairs()
        stage = self._first_stage(problem)
        chosen = self.horizon is not None or self.initial_states is not None
        of_filter = problem, named_key(key, "ensembles"), self.horizon, self.windows
        filtered = None if stage == "logged" else filtering.of_contacts(*of_filter)
        if stage == "estimated" and filtered is not None:
            stage = "filtering"
        of_starts = named_key(key, "unknown starts")
        begun = LeastSquaresState(
            known=None if stage in ("estimated", "filtering") else self._known(problem).init(problem, key),
            unknown=() if stage == "logged" else self._all_lengths(problem, of_starts, filtered=filtered is not None),
            stage=stage,
            filtered=filtered,
            prediction=None if chosen or stage == "filtering" else predicting.windows_for(problem),
        )
        return replace(begun, of_own=begun)

    def step(self, problem: CalibrationProblem, state: LeastSquaresState) -> tuple[LeastSquaresState, Epoch]:
        """Take one damped step of the current search, and decide which search goes on."""
        began, windows = SIMULATED.control_steps, (state.stage, state.length, state.trying)
        with counted_as(FINER if state.trying else 1):
            state, epoch = self._stepped(problem, state)
        converged = "another iteration would hardly change any estimate" if state.finished else None
        steps, following = SIMULATED.control_steps - began, self._following(problem, state, windows)
        return state, replace(epoch, control_steps=steps, converged=converged, following=following)

    def _stepped(self, problem: CalibrationProblem, state: LeastSquaresState) -> tuple[LeastSquaresState, Epoch]:
        given = problem.with_shorter_timestep if state.trying else problem
        if state.prediction is not None and state.prediction.progress == "under way":
            prediction, epoch = predicting.step(problem, state.prediction)
            return replace(state, prediction=prediction, finished=int(prediction.progress != "under way")), epoch
        if state.stage == "filtering" and state.filtered is not None:
            by_filter, epoch = filtering.step(problem, state.filtered, self.loss)
            horizon = self._unknown(problem).horizon
            return lengthening.after_filter(problem, replace(state, filtered=by_filter), horizon), epoch
        if state.estimates_starts:
            search, epoch = self._unknown(problem, state.length).step(given, state.unknown[state.length])
            if state.filtered is not None and not lengthening.leaves_much_less(search, state.filtered):
                return lengthening.back_to_filter(lengthening.with_search(state, 0, search)), epoch
            state = lengthening.with_search(state, state.length, search)
            return self._then_predicting(problem, self._after_unknown(problem, state)), epoch
        assert state.known is not None
        search, epoch = self._known(problem).step(given, state.known)
        return self._then_predicting(problem, self._after_known(problem, replace(state, known=search))), epoch

    def _following(
        self, problem: CalibrationProblem, state: LeastSquaresState, was: tuple[Stage, int, int]
    ) -> int | None:
        """About how many control steps the next step simulates, where windows are of the same kind as they were."""
        prediction = state.prediction is not None and state.prediction.progress == "under way"
        if state.finished or prediction or was != (state.stage, state.length, state.trying):
            return None
        if state.stage == "filtering" and state.filtered is not None:
            return filtering.epoch_steps(problem, state.filtered)
        times = FINER if state.trying else 1
        if state.estimates_starts:
            return times * self._unknown(problem, state.length).epoch_steps(problem, state.unknown[state.length])
        return None if state.known is None else times * self._known(problem).epoch_steps(problem, state.known)

    def _then_predicting(self, problem: CalibrationProblem, state: LeastSquaresState) -> LeastSquaresState:
        """Once the searches have ended, try a shorter timestep; then fit for prediction if more than noise is left."""
        adds_up = partial(self._adds_up, problem)
        state = timestep.followed(problem, state, self._unknown(problem).horizon, adds_up)
        prediction = state.prediction
        if not state.finished or prediction is None or not self._leaves_more_than_noise(problem, state):
            return state
        horizon = self._unknown(problem).horizon if state.estimates_starts else 0
        prediction = predicting.begun(problem, prediction, self._fitted(state).point[0], horizon)
        return replace(state, prediction=prediction, finished=int(prediction.progress != "under way"))

    def _fitted(self, state: LeastSquaresState) -> SearchState:
        """The search with windows of fitted or known states that has the estimate, but for one that predicts better."""
        if state.estimates_starts:
            return state.unknown[state.best]
        assert state.known is not None
        return state.known

    def _found(self, problem: CalibrationProblem, state: LeastSquaresState) -> Found:
        """What the search in progress, or the best one, has found."""
        if state.by_filter is not None:
            return state.by_filter.found
        best = self._fitted(state)
        if state.estimates_starts:
            windows, settled = best.explained, self._unknown(problem).settled(best)
        else:
            windows, settled = self._known(problem).window_count(best), state.searched
        spread = best
        if state.best and self._with_model_errors(problem, state) is not None:
            # Model errors bias all lengths, and only the wide intervals of the shortest may cover that.
            spread = state.unknown[0]
            windows = spread.explained
        adds_up = bool(self._adds_up(problem, state))
        return Found(
            point=best.point[0 if best.refining else int(np.argmin(best.cost))],
            uncertainty=sandwich(spread.bread, spread.meat),
            windows=windows,
            settled=settled,
            unlike_noise=settled and state.estimates_starts and (adds_up or sentences.have_long_tails(problem, best)),
        )

    def _adds_up(self, problem: CalibrationProblem, state: LeastSquaresState) -> bool | None:
        """Whether longer windows leave more than noise; None where no search on longer ones has settled."""
        longer = state.unknown[LONGER:] if state.searched and state.estimates_starts else ()
        settled = any(map(self._unknown(problem).settled, longer))
        return self._with_model_errors(problem, state) is not None if settled else None

    def estimate(self, problem: CalibrationProblem, state: LeastSquaresState) -> Estimate:
        """The best search's point, with its sandwich covariance and intervals of Student's t."""
        tries, state = bool(state.trying), state.answer
        space, found = problem.simulator.parameters, self._found(problem, state)
        notes, about = self._told(problem, state)
        point, uncertainty = found.point, found.uncertainty
        prediction, progress = state.prediction, state.prediction.progress if state.prediction else "not begun"
        if prediction is not None and progress == "better":
            point, uncertainty = prediction.best, prediction.of_both(uncertainty)
        timesteps = 1 if progress == "better" else max(1, state.timesteps)  # such a fit is with the model's own
        notes = (*notes, sentences.about_timestep(problem)) if timesteps > 1 else notes
        half = (space.high - space.low) / 2.0
        mean = space.to_physical(point)
        covariance = half[:, None] * uncertainty.covariance * half
        errors = quantile(found.windows, len(space))
        width, moved = half * errors * np.sqrt(np.diag(uncertainty.covariance)), half * found.shorter_steps
        ends = np.stack([mean - width + np.minimum(moved, 0.0), mean + width + np.maximum(moved, 0.0)], axis=-1)
        interval = np.clip(ends, space.low[:, None], space.high[:, None])
        return Estimate(
            mean=mean,
            std=np.sqrt(np.diag(covariance)),
            failures=sum(each.failures for each in (state.known, state.filtered, *state.unknown) if each is not None),
            notes=notes,
            warnings=(
                *identifiability(uncertainty, space.names),
                *at_end_of_range(point, space, space.to_unit(interval.T).T),
                *(() if found.settled else (sentences.NOT_SETTLED,)),
                *about,
                *((sentences.STILL_TRYING,) if tries and found.unlike_noise else ()),
                *((sentences.PREDICTS,) if progress == "better" else ()),
                *((sentences.STILL_PREDICTING,) if progress == "under way" else ()),
            ),
            covariance=covariance,
            interval=interval,
            quantile=errors,
            settled=found.settled,
            unlike_noise=found.unlike_noise,
            effective=progress == "better",
            random_forces=by_dof(problem.simulator, found.force),
            timesteps=timesteps,
            test_timesteps=FINER if moved.any() else timesteps,
        )

    def whole_run(self, problem: CalibrationProblem, state: LeastSquaresState, *, refining_epochs: int) -> int:
        """About how many control steps a whole run takes, counting the stages that the data is known to need so far."""
        steps = 0
        if state.known is not None:
            steps += self._known(problem).whole_run(problem, state.known, refining_epochs * (state.stage != "starting"))
        if state.filtered is not None and state.stage in ("starting", "filtering"):
            steps += filtering.whole_run(problem, state.filtered)
        elif state.stage != "undecided":
            for length, search in enumerate(state.unknown):
                if LONGER <= length < len(state.unknown) - 1 and not search.epochs:
                    continue
                steps += self._unknown(problem, length).whole_run(problem, search, refining_epochs)
                if not length and problem.simulator.task.source is not None:  # a shorter timestep, given up at once
                    tried = replace(search, refining=1), lengthening.FIRST_STEPS
                    steps += FINER * self._unknown(problem).whole_run(problem, *tried)
        return steps

    def _first_stage(self, problem: CalibrationProblem) -> Stage:
        if self.initial_states == "logged":
            return "logged"
        if problem.states.kind != "exact" and len(problem.states.rows):
            return "estimated"
        disturbance = problem.dataset.disturbance
        noisy = disturbance.noise > 0 or disturbance.velocities == "differences" or noisy_rows(problem)
        return "starting" if noisy or self.initial_states == "estimated" else "undecided"

    def _known(self, problem: CalibrationProblem) -> Search:
        """The search from logged states; its windows are shortest where it only finds where the other begins."""
        starting = self._first_stage(problem) == "starting"
        horizon = STARTING_STRIDES * stride(problem.dataset) if starting else self.horizon or LOGGED_HORIZON
        return self._search(KnownStarts, "logged", horizon, self.searches)

    def _unknown(self, problem: CalibrationProblem, length: int = 0) -> Search:
        """The search with unknown initial states; after one from logged states it needs to begin at one point only."""
        searches = self.searches if self._first_stage(problem) == "estimated" else 1
        fewest = 2 * (FEWEST + len(problem.simulator.parameters))
        horizon = self.horizon or LENGTHS[length] * lengthening.horizon_of(problem.dataset, fewest)
        return self._search(UnknownStarts, "estimated", horizon, searches)

    def _search(
        self, starts: type[KnownStarts] | type[UnknownStarts], states: InitialStates, horizon: int, searches: int
    ) -> Search:
        windows, search_windows = self.windows or WINDOWS[states], self.search_windows or SEARCH_WINDOWS[states]
        return Search(starts, self.loss, horizon, windows, searches, search_windows, self.search_epochs, self.tolerance)

    def _all_lengths(
        self, problem: CalibrationProblem, key: PRNGKeyArray, *, filtered: bool
    ) -> tuple[SearchState, ...]:
        """Searches on the shortest windows, and on every length that the episodes are long enough for.

        If `horizon` is given, there is one length. After a filter there is one, in whose windows bodies may touch, or
        none where these have more unknowns than readings.
        """
        if filtered:
            try:
                windows = 2 * (FEWEST + len(problem.simulator.parameters))
                return (replace(self._unknown(problem), searches=1, windows=windows, free=False).init(problem, key),)
            except MadocError:
                return ()
        first = self._unknown(problem).init(problem, key)
        searches = [first]
        for length in range(LONGER, LONGER if self.horizon is not None else len(LENGTHS)):
            most = READINGS * len(first.rows) // LENGTHS[length]
            longer = lengthening.lengthened(problem, searches[-1], self._unknown(problem, length).horizon, most)
            if longer is None:
                break
            searches.append(longer)
        return tuple(searches)

    def _after_known(self, problem: CalibrationProblem, state: LeastSquaresState) -> LeastSquaresState:
        """Go on to unknown initial states where logged ones are noisy.

        That is decided once the search refines and, as model errors may hide noise, again once it has settled.
        """
        known = state.known
        assert known is not None
        settled = self._known(problem).settled(known)
        if state.stage == "starting" and known.refining:
            return lengthening.begun(state, known)
        if state.stage == "undecided" and (settled or (known.refining and not known.epochs)):
            if np.sqrt(known.cost[0]) >= EXACT:
                pairs = consecutive_residuals(problem, known.point[0], known.rows)
                if alternation(*pairs) > NOISY:
                    return lengthening.begun(state, known)
            state = replace(state, stage="logged" if settled else "undecided")
        return replace(state, finished=int(settled and state.stage == "logged"))

    def _after_unknown(self, problem: CalibrationProblem, state: LeastSquaresState) -> LeastSquaresState:
        """Go on to longer windows once a search has settled, while they narrow the intervals.

        The longest come first, which mostly serve as motion is smooth. Where they do not, shorter ones have their turn,
        and then the longest again unless they have settled.

        If longer windows show model errors, the estimate is that of windows three times as long as the first, with the
        wide intervals of the shortest: with a wrong model it predicts better, as the free initial states of short
        windows explain much of what it gets wrong.
        """
        searches, length = state.unknown, state.length
        search = searches[length]
        if state.finished:
            return state
        if not self._unknown(problem).settled(search):
            lost = length != LONGER and lengthening.hopeless(search, searches[0], searches[state.best])
            lost = lost or search.epochs >= self.search_epochs
            return lengthening.failed(state) if length >= LONGER and lost else state
        if length and not self._noise_alone(problem, state, length):
            return lengthening.finished(state, LONGER) if length == LONGER else lengthening.failed(state)
        if length and not lengthening.tells_more(search, searches[state.best]):
            return lengthening.failed(state)
        if float(search.deviation.max()) < EXACT:
            return lengthening.finished(state, length)
        following = length + 1
        if not length and len(searches) > LONGER and lengthening.enough(searches[-1], search):
            following = len(searches) - 1
        if following == len(searches) or self._unknown(problem).settled(searches[following]):
            return lengthening.finished(state, length)
        return lengthening.gone_on(replace(state, best=length), following)

    def _noise_alone(self, problem: CalibrationProblem, state: LeastSquaresState, length: int) -> bool:
        """Whether residuals of windows of this length are the noise that those of the shortest windows are."""
        readings = self._unknown(problem, length).horizon + 1
        return lengthening.noise_alone(state.unknown[length], state.unknown[0], readings)

    def _leaves_more_than_noise(self, problem: CalibrationProblem, state: LeastSquaresState) -> bool:
        """Whether the model may lack something, so that another estimate may predict better.

        From logged states, which have no noise, that is residuals that are alike in consecutive rows, as those of
        random forces are not; from estimated ones long tails of the residuals, or more than noise on longer windows,
        whether or not a search on these has settled.
        """
        best = self._fitted(state)
        if not state.estimates_starts:
            if float(np.sqrt(best.cost[0])) < EXACT:
                return False
            searched = problem.with_shorter_timestep if state.timesteps > 1 else problem
            before, after = consecutive_residuals(searched, best.point[0], best.rows)
            return alternation(before, -after) > 0.0
        tried = [length for length in range(LONGER, len(state.unknown)) if state.unknown[length].epochs]
        noise = all(self._noise_alone(problem, state, length) for length in tried)
        return not noise or sentences.have_long_tails(problem, best)

    def _with_model_errors(self, problem: CalibrationProblem, state: LeastSquaresState) -> int | None:
        """Index of the first longer windows, none shorter than the estimate's, that leave more than noise, or None."""
        for longer in range(max(state.best, LONGER), len(state.unknown)):
            settled = self._unknown(problem).settled(state.unknown[longer])
            if settled and not self._noise_alone(problem, state, longer):
                return longer
        return None

    def _told(self, problem: CalibrationProblem, state: LeastSquaresState) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Notes on estimated initial states, and warnings of what they leave, unless the user asked for them."""
        if state.by_filter is not None:
            note = sentences.about_filtered_states(problem, state.by_filter, asked=self.initial_states is not None)
            return (note,), sentences.about_surprises(problem, state.by_filter)
        if not state.estimates_starts or self.initial_states is not None:
            return (), ()
        best, horizon = state.unknown[state.best], self._unknown(problem, state.best).horizon
        notes = (sentences.about_estimated_states(problem, best, horizon),)
        about = sentences.about_residuals(problem, best)
        if float(best.deviation.max()) >= EXACT:
            if state.stage == "lengthening" and not state.searched:
                about = (*about, sentences.STILL_LENGTHENING)
            elif (longer := self._with_model_errors(problem, state)) is not None:
                about = (*about, sentences.about_model_errors(self._unknown(problem, longer).horizon))
        return notes, about
