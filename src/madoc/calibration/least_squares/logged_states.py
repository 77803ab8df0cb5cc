"""Least squares from logged states: several damped Gauss-Newton searches on few windows, the best refined on many."""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.errors import MadocError
from madoc.identification.gauss_newton import damped_step, triangular_factors
from madoc.identification.information import SETTLED, bread, meat, sandwich
from madoc.identification.linearisation import difference_points, linearise
from madoc.identification.losses import ALL_FAILED, Loss, mean_cost, scale_of
from madoc.identification.replay import window_residuals
from madoc.identification.windows import Windows, disjoint_windows, first_rows, windows_at
from madoc.types import Metrics

TRIALS = (1e-2, 1.0, 1e2)
"""Dampings tried at once, relative to the last that helped; where none helps, the next are a thousand times larger."""
DAMPING_RANGE = (1e-10, 1e10)
FIRST_DAMPING = 1e-2
_SMALLEST = 1e-100
"""Keeps a move over a tolerance of 0 finite."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LoggedState:
    """Everything the search carries. Once it calibrates, only the first of the searches goes on.

    Attributes:
        unit: Where each search stands, in [-1, 1].
        damping: λ of each.
        cost: Of each; `ALL_FAILED` before the first epoch.
        moved: The largest move of each in its last step, over what is worth a step; below 1 it has settled.
        chosen: Which rebuilt states the windows begin at.
        bread: Of the best search, where it last linearised.
        meat: The same.
        refining: 0 while searching, 1 on all windows.
        epochs: Done in this stage.
        control_steps: Simulated.
        failures: Windows that exploded, each counted once in every system.
    """

    unit: Float[np.ndarray, "searches d"]
    damping: Float[np.ndarray, " searches"]
    cost: Float[np.ndarray, " searches"]
    moved: Float[np.ndarray, " searches"]
    chosen: Int[np.ndarray, " windows"]
    bread: Float[np.ndarray, "d d"]
    meat: Float[np.ndarray, "d d"]
    refining: int
    epochs: int
    control_steps: int
    failures: int


@dataclass(frozen=True)
class LoggedStates:
    """Damped Gauss-Newton on what follows logged states, which it takes for true; as `LeastSquares` says."""

    horizon: int
    loss: Loss
    windows: int
    searches: int
    search_windows: int
    search_epochs: int
    tolerance: float

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> LoggedState:
        """Windows drawn, searches at their starts.

        Raises:
            MadocError: No state can be rebuilt, no episode is long enough, or there are fewer values than parameters.
        """
        of_windows, of_starts = jax.random.split(key)
        count, task = len(problem.simulator.parameters), problem.simulator.task
        # Windows that share readings are not independent, and intervals take them to be.
        starts = first_rows if self.horizon == 1 else disjoint_windows
        possible = starts(problem.dataset, problem.logged_rows, self.horizon)
        drawn = min(self.windows, len(possible))
        if drawn * self.horizon * task.observation_size < count:
            raise MadocError(
                f"expected at least as many logged values as parameters, got {drawn} windows of {self.horizon} rows "
                f"with {task.observation_size} values for {count} parameters; give it more rows or fewer parameters"
            )
        order = jax.random.choice(of_windows, len(possible), (drawn,), replace=False)
        unit = np.array(jax.random.uniform(of_starts, (self.searches, count), minval=-1.0, maxval=1.0), np.float64)
        unit[0] = 0.0
        return LoggedState(
            unit=unit,
            damping=np.full(self.searches, FIRST_DAMPING),
            cost=np.full(self.searches, ALL_FAILED),
            moved=np.full(self.searches, 1.0 / _SMALLEST),
            chosen=possible[np.asarray(order)],
            bread=np.zeros((count, count)),
            meat=np.zeros((count, count)),
            refining=0,
            epochs=0,
            control_steps=0,
            failures=0,
        )

    def step(self, problem: CalibrationProblem, state: LoggedState) -> tuple[LoggedState, Metrics]:
        """One damped step of every search under way: two simulations, one of slopes, one of the steps tried."""
        searching = not state.refining
        windows = self._windows(problem, state)
        running = self.searches if searching else 1
        points = np.stack([difference_points(unit) for unit in state.unit[:running]])
        around = _simulate_each(problem, windows, points)
        unit, damping, cost, moved = (getattr(state, name).copy() for name in ("unit", "damping", "cost", "moved"))
        plans = [self._plan(*row) for row in zip(points, around, damping[:running], strict=True)]
        tried = _simulate_each(problem, windows, np.stack([plan.tried for plan in plans]))
        for index, (plan, residuals) in enumerate(zip(plans, tried, strict=True)):
            costs = [mean_cost(candidate, plan.scale, self.loss) for candidate in residuals]
            best = int(np.argmin(costs))
            better = costs[best] < plan.cost
            factor = TRIALS[best] if better else 1e3
            chosen = plan.tried[best] if better else unit[index]
            # Of steps that did not help, the shortest tells how near the search is to the end of what helps.
            shortest = plan.tried[best if better else -1] - unit[index]
            moved[index] = float((np.abs(shortest) / self._worthwhile(plan, len(windows))).max())
            unit[index], cost[index] = chosen, costs[best] if better else plan.cost
            damping[index] = np.clip(damping[index] * factor, *DAMPING_RANGE)
        leader = int(np.argmin(cost[:running]))
        following = replace(
            state,
            unit=unit,
            damping=damping,
            cost=cost,
            moved=moved,
            bread=plans[leader].bread,
            meat=plans[leader].meat,
            epochs=state.epochs + 1,
            control_steps=state.control_steps + self._epoch_steps(state),
            failures=state.failures + sum(int((~np.isfinite(part).all(-1)).sum()) for part in (around, tried)),
        )
        metrics = {"residual": float(np.sqrt(cost[leader])), "moved": float(moved[leader])}
        if searching and (moved[leader] < 1.0 or following.epochs >= self.search_epochs):
            following = _refine(following, leader)
        return following, metrics

    @staticmethod
    def settled(state: LoggedState) -> bool:
        """Whether the next step would change nothing worth a simulation; not where every window fails."""
        moves = float(state.moved[0]) >= 1.0 or float(state.cost[0]) >= ALL_FAILED
        return bool(state.refining and state.epochs) and not moves

    def window_count(self, state: LoggedState) -> int:
        """Windows of the stage."""
        return len(state.chosen) if state.refining else min(self.search_windows, len(state.chosen))

    def whole_run(self, state: LoggedState, refining_epochs: int) -> int:
        """Control steps of a search as long as it may be, and so many epochs on all windows."""
        searching, refining = (self._epoch_steps(replace(state, refining=stage)) for stage in (0, 1))
        return searching * self.search_epochs + refining * refining_epochs

    def _epoch_steps(self, state: LoggedState) -> int:
        """Control steps of an epoch of the stage: central differences, and the steps tried."""
        running, count = 1 if state.refining else self.searches, state.unit.shape[1]
        return self.window_count(state) * self.horizon * running * (1 + 2 * count + len(TRIALS))

    def _windows(self, problem: CalibrationProblem, state: LoggedState) -> Windows:
        chosen = state.chosen[: self.window_count(state)]
        return windows_at(problem.dataset, problem.logged_states[chosen], problem.logged_rows[chosen], self.horizon)

    def _plan(
        self,
        points: Float[np.ndarray, "points d"],
        residuals: Float[np.ndarray, "points windows values"],
        damping: float,
    ) -> "_Plan":
        around = linearise(points, residuals)
        scale = scale_of(around.residuals, self.loss)
        factors = triangular_factors(around, scale, self.loss)
        steps = [damped_step(*factors, points[0], damping * trial) for trial in TRIALS]
        return _Plan(
            tried=points[0] + np.stack(steps),
            scale=scale,
            cost=mean_cost(residuals[0], scale, self.loss),
            bread=bread(around, scale, self.loss),
            meat=meat(around, scale, self.loss),
        )

    def _worthwhile(self, plan: "_Plan", windows: int) -> Float[np.ndarray, " d"]:
        """The smallest move in [-1, 1] that is worth a step, by parameter."""
        error = np.sqrt(np.diag(sandwich(plan.bread, plan.meat).covariance))
        return np.maximum(2.0 * max(self.tolerance, _SMALLEST), SETTLED * error)


@dataclass(frozen=True)
class _Plan:
    """What the slopes around a point say: steps to try, and the cost and the curvature there."""

    tried: Float[np.ndarray, "trials d"]
    scale: float
    cost: float
    bread: Float[np.ndarray, "d d"]
    meat: Float[np.ndarray, "d d"]


def _simulate_each(
    problem: CalibrationProblem, windows: Windows, points: Float[np.ndarray, "searches points d"]
) -> Float[np.ndarray, "searches points windows values"]:
    """Residuals at the points of all searches, in one batch."""
    scale = problem.typical_change
    residuals = window_residuals(problem.simulator, windows, points.reshape(-1, points.shape[-1]), scale)
    return residuals.reshape(*points.shape[:2], *residuals.shape[1:])


def _refine(state: LoggedState, leader: int) -> LoggedState:
    """Go on with the best search alone, in the first place."""
    order = np.argsort(np.arange(len(state.cost)) != leader, kind="stable")
    searches = {name: getattr(state, name)[order] for name in ("unit", "damping", "cost", "moved")}
    return replace(state, **searches, refining=1, epochs=0)
