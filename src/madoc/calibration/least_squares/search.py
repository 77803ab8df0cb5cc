"""One least-squares search: damped Gauss-Newton steps from several points on few windows, then the best of them on all.

Windows' initial states are known (`known_starts`) or further unknowns (`unknown_starts`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.known_starts import KnownStarts
from madoc.calibration.least_squares.plan import Outcome, Plan, touched, without_contacts
from madoc.calibration.least_squares.unknown_starts import UnknownStarts
from madoc.identification import settling
from madoc.identification.gauss_newton import FIRST_DAMPING, TRIALS
from madoc.identification.information import SETTLED, sandwich
from madoc.identification.losses import ALL_FAILED, Loss
from madoc.types import Epoch, generator

DAMPING_RANGE = (1e-10, 1e10)
"""Smallest and largest relative damping of the parameters' step; it is clipped to them."""
SEEN = 4
"""Number of windows of which it is asked whether bodies touch in them, for each that is taken at most."""
LITTLE = 5e-3
"""Share in [0, 1] of the cost; after a step that saves less, unknown initial states count as settled too."""
ROUGHLY_SETTLED = 0.5
"""Ratio in [0, 1] of a step to the standard error that settles a search of many steps."""
_SMALLEST = 1e-100
"""Smallest tolerance, so that the ratio of a step to a tolerance of 0 is finite."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SearchState:
    """The state of a search. Once it refines, only the first of the points moves on.

    Attributes:
        point: The current point of each search, in [-1, 1].
        states: Initial state of every window there; without windows where they are known.
        damping: λ of each search's steps of the parameters.
        state_damping: λ of each unknown initial state's step.
        cost: Mean loss of a residual, `ALL_FAILED` before the first epoch. In squared typical changes of a stride; in
            squared standard deviations of the noise where initial states are unknown and the search refines.
        moved: The largest component of each search's last step, relative to one that matters; below 1 it has settled.
        rows: First rows of the windows.
        touching: Whether a contact was seen in each window, as far as its states are known.
        without: Number of windows in which bodies touch that were left out, of those that were looked at.
        deviation: Noise of each channel in its typical changes; 1 where initial states are known.
        bread: Curvature of the best search's cost where it last linearised.
        meat: Scatter of the cost's gradient there, and the last step's where steps of half a standard error settle.
        explained: Number of windows from which these two were computed.
        tail_cost: Mean loss of a residual in these, with no noise below the rounding of counts.
        autocorrelation: Correlation of these windows' residuals with the next reading's; 0 for known initial states.
        refining: 0 while searching on few windows, 1 on all of them.
        waiting: 1 before an epoch in which only initial states move, as those of new windows are guesses; else 0.
        epochs: Number of epochs of this stage so far, those of waiting not counted.
        failures: Number of windows whose simulation failed.
    """

    point: Float[np.ndarray, "searches d"]
    states: Float[np.ndarray, "searches unknown state"]
    damping: Float[np.ndarray, " searches"]
    state_damping: Float[np.ndarray, "searches unknown"]
    cost: Float[np.ndarray, " searches"]
    moved: Float[np.ndarray, " searches"]
    rows: Int[np.ndarray, " windows"]
    touching: Bool[np.ndarray, " windows"]
    without: int
    deviation: Float[np.ndarray, " channels"]
    bread: Float[np.ndarray, "d d"]
    meat: Float[np.ndarray, "d d"]
    explained: int = 0
    tail_cost: float = 0.0
    autocorrelation: float = 0.0
    refining: int = 0
    waiting: int = 0
    epochs: int = 0
    failures: int = 0


_OF_EACH_SEARCH = ("point", "states", "damping", "state_damping", "cost", "moved")


@dataclass(frozen=True)
class Search:
    """Settings of a search: how its windows begin, and those that `LeastSquares` has under the same names.

    Those with unknown initial states leave out windows in which bodies touch if `free` (`without_contacts`).
    """

    starts: type[KnownStarts] | type[UnknownStarts]
    loss: Loss
    horizon: int
    windows: int
    searches: int
    search_windows: int
    search_epochs: int
    tolerance: float
    free: bool = True

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> SearchState:
        """Draw the windows; put one search at mid-range, others at random places.

        Raises:
            MadocError: No state is known well enough, no episode is long enough, or there are too few values.
        """
        of_windows, of_starts = jax.random.split(key)
        count = len(problem.simulator.parameters)
        possible = self.starts.possible_rows(problem, self.horizon, self.windows)
        seen = possible[generator(of_windows).permutation(len(possible))][: SEEN * self.windows]
        free = without_contacts(problem, seen, self.horizon) if self.starts.unknown and self.free else seen
        rows = free[: self.windows]
        points = np.array(jax.random.uniform(of_starts, (self.searches, count), minval=-1.0, maxval=1.0), np.float64)
        points[0] = 0.0
        logged = problem.states
        states = logged.states[np.searchsorted(logged.rows, rows)] if self.starts.unknown else np.zeros((0, 0))
        return SearchState(
            point=points,
            states=np.repeat(states[None], self.searches, axis=0),
            damping=np.full(self.searches, FIRST_DAMPING),
            state_damping=np.full((self.searches, len(states)), FIRST_DAMPING),
            cost=np.full(self.searches, ALL_FAILED),
            moved=np.full(self.searches, 1.0 / _SMALLEST),
            rows=rows,
            touching=touched(problem, rows, self.horizon),
            without=len(seen) - len(free),
            deviation=np.ones(problem.states.measured),
            bread=np.zeros((count, count)),
            meat=np.zeros((count, count)),
        )

    def step(self, problem: CalibrationProblem, state: SearchState) -> tuple[SearchState, Epoch]:
        """One damped step of every point that still moves: derivatives in one batch, the steps tried in another."""
        running, count = self._running(state), self.window_count(state)
        windows: KnownStarts | UnknownStarts
        if self.starts is KnownStarts:
            windows = KnownStarts.at(problem, state.rows[:count], state.touching[:count], self.horizon, self.loss)
        else:
            windows = UnknownStarts.at(problem, state.rows[:count], self.horizon, self.loss)
            if state.waiting:
                return self._settled_states(windows, state)
        points, states = state.point[:running], state.states[:running, :count]
        damping, state_damping = state.damping[:running], state.state_damping[:running, :count]
        plans = windows.plans(points, states, damping, state_damping, refining=bool(state.refining))
        outcomes = windows.outcomes(plans, states, refining=bool(state.refining))
        # Windows may be trusted after one step and not after the next, and parameters then go to and fro. After many
        # steps those of half a standard error are small enough, and the covariance counts the last as an error.
        roughly = self.starts.unknown and bool(state.refining) and state.epochs + 1 >= self.search_epochs
        new = self._advanced(state, plans, outcomes, share=ROUGHLY_SETTLED if roughly else SETTLED)
        leader = int(np.argmin(new["cost"][:running]))
        best = plans[leader]
        pull = best.bread @ best.steps[0]
        following = replace(
            state,
            **new,
            deviation=best.deviation,
            bread=best.bread,
            meat=best.meat + (np.outer(pull, pull) if roughly and new["moved"][leader] < 1.0 else 0.0),
            explained=int(best.kept.sum()),
            tail_cost=best.tail_cost,
            autocorrelation=best.autocorrelation,
            epochs=state.epochs + 1,
            failures=state.failures + sum(each.failures for each in plans) + sum(each.failures for each in outcomes),
        )
        noise = float(np.median(best.deviation))
        metrics = {
            "residual": float(np.sqrt(new["cost"][leader])) * (noise if state.refining else 1.0),
            "moved": float(new["moved"][leader]),
        }
        metrics |= {"noise": noise} if states.size else {}
        if not state.refining and (new["moved"][leader] < 1.0 or following.epochs >= self.search_epochs):
            following = self._refined(following, leader)
        stage = "calibrating" if state.refining else "searching"
        return following, Epoch(metrics, stage=stage)

    def _advanced(
        self, state: SearchState, plans: Sequence[Plan], outcomes: Sequence[Outcome], *, share: float
    ) -> dict[str, Any]:
        """What each search has of its own, after the best of the steps that it tried."""
        count = self.window_count(state)
        new = {name: getattr(state, name).copy() for name in _OF_EACH_SEARCH}
        for index, (plan, outcome) in enumerate(zip(plans, outcomes, strict=True)):
            trial, factor = outcome.chosen()
            followed, damping = outcome.followed[trial], float(state.damping[index])
            new["point"][index] = np.clip(state.point[index] + plan.steps[trial], -1.0, 1.0)
            change = followed[:, None] * plan.state_steps[trial] * plan.spread
            new["states"][index, :count, : len(plan.spread)] += change
            new["damping"][index] = np.clip(damping * factor, *DAMPING_RANGE)
            state_factor = np.select([followed == 1.0, followed > 0.0], [0.1, 1.0], 10.0)
            state_damping = state.state_damping[index, :count] * state_factor
            new["state_damping"][index, :count] = np.clip(state_damping, *settling.DAMPING_RANGE)
            cost = float(outcome.totals[trial])
            new["cost"][index] = cost if state.refining else plan.comparable(cost)
            new["moved"][index] = self._moved(plan, outcome, trial, damping=damping, share=share)
        return new

    def _settled_states(self, windows: UnknownStarts, state: SearchState) -> tuple[SearchState, Epoch]:
        """One step of initial states alone, which every search on new windows begins with."""
        width = np.zeros(len(windows.readings.spread))
        given = state.point[0], state.states[0], state.state_damping[0], width
        after = settling.settle(windows.simulator, windows.readings, *given, windows.loss)
        new_states, new_damping = state.states.copy(), state.state_damping.copy()
        new_states[0], new_damping[0] = after.states, after.damping
        following = replace(
            state,
            states=new_states,
            state_damping=new_damping,
            deviation=after.deviation,
            waiting=0,
            failures=state.failures + after.failures,
        )
        noise = float(np.median(after.deviation))
        metrics = {"residual": float(np.sqrt(after.costs.mean())) * noise, "noise": noise}
        return following, Epoch(metrics, stage="calibrating")

    def settled(self, state: SearchState) -> bool:
        """Whether the last step on all windows was too small to matter; never while every window fails."""
        still = float(state.moved[0]) < 1.0 and float(state.cost[0]) < self.starts.failed_cost
        return bool(state.refining) and state.epochs > 0 and still

    def window_count(self, state: SearchState) -> int:
        """Number of windows in use."""
        return len(state.rows) if state.refining else min(self.search_windows, len(state.rows))

    def whole_run(self, problem: CalibrationProblem, state: SearchState, refining_epochs: int) -> int:
        """Control steps of the longest search, unless it has ended, and of `refining_epochs` on all windows."""
        searching, refining, settling = (
            self.epoch_steps(problem, replace(state, refining=stage, waiting=waiting))
            for stage, waiting in ((0, 0), (1, 0), (1, 1))
        )
        waiting = max(state.waiting, int(self.starts.unknown and not state.refining))
        return searching * self.search_epochs * (1 - state.refining) + refining * refining_epochs + settling * waiting

    def _running(self, state: SearchState) -> int:
        return 1 if state.refining else self.searches

    def epoch_steps(self, problem: CalibrationProblem, state: SearchState) -> int:
        """About how many control steps an epoch simulates."""
        systems = self.starts.systems(problem, refining=bool(state.refining), waiting=bool(state.waiting))
        return self._running(state) * self.window_count(state) * self.horizon * systems

    def _moved(self, plan: Plan, outcome: Outcome, trial: int, *, damping: float, share: float) -> float:
        """The largest component of a step relative to one that matters: a share of a standard error, or the tolerance.

        While the damping is at most `starts.stuck` the least damped step counts, whether it helped or not: a damped one
        may be small far from the minimum too.
        """
        tried = plan.steps[0 if damping <= self.starts.stuck else min(trial, len(TRIALS) - 1)]
        error = np.sqrt(np.maximum(np.diag(sandwich(plan.bread, plan.meat).covariance), 0.0))
        relative = float((np.abs(tried) / np.maximum(max(2.0 * self.tolerance, _SMALLEST), share * error)).max())
        return max(relative, 0.0 if plan.exact else outcome.saved(trial) / LITTLE)

    def _refined(self, state: SearchState, leader: int) -> SearchState:
        """Put the best search first, which alone goes on, to all windows."""
        order = np.argsort(np.arange(self.searches) != leader, kind="stable")
        searches = {name: getattr(state, name)[order] for name in _OF_EACH_SEARCH}
        if self.starts.unknown:
            searches["damping"] = np.full(self.searches, FIRST_DAMPING)
            searches["state_damping"] = np.full_like(state.state_damping, FIRST_DAMPING)
        return replace(state, **searches, refining=1, waiting=int(self.starts.unknown), epochs=0)
