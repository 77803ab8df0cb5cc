"""Least squares, assembled: several damped Gauss-Newton searches on few windows, the best refined on many."""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.cautions import at_end_of_range, exploded
from madoc.calibration.least_squares.damped_step import damped_step, triangular_factors
from madoc.data.windows import Windows, first_rows, windows_at
from madoc.errors import MadocError, check_at_least
from madoc.residuals.linearisation import difference_points, linearise
from madoc.residuals.losses import ALL_FAILED, Loss, mean_cost, scale_of
from madoc.residuals.uncertainty import bread, half_width, identifiability, meat, sandwich
from madoc.residuals.window_residuals import window_residuals
from madoc.types import Metrics

TRIALS = (1e-2, 1.0, 1e2)
"""Dampings tried at once, relative to the last that helped; where none helps, the next are a thousand times larger."""
DAMPING_RANGE = (1e-10, 1e10)
FIRST_DAMPING = 1e-2
SETTLED = 0.1
"""Of its standard error: a step smaller than this changes nothing worth a simulation."""
_SMALLEST = 1e-100
"""Keeps a move over a tolerance of 0 finite."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LeastSquaresState:
    """Everything least squares carries. Once it calibrates, only the first of the searches goes on.

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
class LeastSquares:
    """Damped Gauss-Newton on differences between simulated and logged observations, from logged states.

    Residuals are in units of each channel's typical change in one step. With clean, complete states it is exact;
    it takes logged states for true, so noise in them biases it.

    Attributes:
        horizon: Control steps replayed from each logged state; the observation after every one of them counts.
        loss: `linear`, or a robust one (`huber`, `soft-l1`, `cauchy`) whose scale follows the residuals.
        windows: Logged states it starts from, at most; all there are if fewer.
        searches: The first begins at mid-range, the others at random places. The best goes on.
        search_windows: Windows while searching.
        search_epochs: Epochs of searching, at most; it ends once the best search has settled.
        tolerance: Share of each range; a step that moves no parameter by more, nor by a tenth of its standard error,
            is the last.
    """

    horizon: int = 1
    loss: Loss = "cauchy"
    windows: int = 1000
    searches: int = 3
    search_windows: int = 64
    search_epochs: int = 8
    tolerance: float = 1e-7

    def __post_init__(self) -> None:
        check_at_least(self, horizon=1, windows=1, searches=1, search_windows=1, search_epochs=1, tolerance=0.0)

    @property
    def name(self) -> str:
        """As `madoc methods` lists it."""
        return "least-squares"

    @property
    def shown(self) -> tuple[str, ...]:
        """Metrics beside the progress bar."""
        return ("residual", "moved")

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> LeastSquaresState:
        """Windows drawn, searches at their starts.

        Raises:
            MadocError: No state can be rebuilt, no episode is long enough, there are fewer values than parameters,
                or the data's next observations are shuffled.
        """
        problem.require_pairs(self.name)
        of_windows, of_starts = jax.random.split(key)
        count, task = len(problem.simulator.parameters), problem.simulator.task
        possible = first_rows(problem.dataset, problem.logged_rows, self.horizon)
        drawn = min(self.windows, len(possible))
        if drawn * self.horizon * task.observation_size < count:
            raise MadocError(
                f"expected at least as many logged values as parameters, got {drawn} windows of {self.horizon} rows "
                f"with {task.observation_size} values for {count} parameters; give it more rows or fewer parameters"
            )
        order = jax.random.choice(of_windows, len(possible), (drawn,), replace=False)
        unit = np.array(jax.random.uniform(of_starts, (self.searches, count), minval=-1.0, maxval=1.0), np.float64)
        unit[0] = 0.0
        return LeastSquaresState(
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

    def step(self, problem: CalibrationProblem, state: LeastSquaresState) -> tuple[LeastSquaresState, Metrics]:
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
            control_steps=state.control_steps
            + windows.steps * len(windows) * running * (points.shape[1] + len(TRIALS)),
            failures=state.failures + sum(int((~np.isfinite(part).all(-1)).sum()) for part in (around, tried)),
        )
        metrics = {"residual": float(np.sqrt(cost[leader])), "moved": float(moved[leader])}
        if searching and (moved[leader] < 1.0 or following.epochs >= self.search_epochs):
            following = _refine(following, leader)
        return following, metrics

    def estimate(self, problem: CalibrationProblem, state: LeastSquaresState) -> Estimate:
        """Where the best search stands, with the sandwich covariance and Student's t intervals around it."""
        space = problem.simulator.parameters
        unit = state.unit[0 if state.refining else int(np.argmin(state.cost))]
        found = sandwich(state.bread, state.meat)
        half = (space.high - space.low) / 2.0
        mean = space.to_physical(unit)
        covariance = half[:, None] * found.covariance * half
        width = half * half_width(found.covariance, self._window_count(state))
        interval = np.clip(np.stack([mean - width, mean + width], axis=-1), space.low[:, None], space.high[:, None])
        return Estimate(
            mean=mean,
            std=np.sqrt(np.diag(covariance)),
            groups=(tuple(range(len(space))),),
            warnings=(
                *identifiability(found, space.names),
                *at_end_of_range(unit, space.names),
                *exploded(state.failures, state.control_steps),
            ),
            covariance=covariance,
            interval=interval,
        )

    def control_steps(self, state: LeastSquaresState) -> int:
        """Simulated control steps so far."""
        return state.control_steps

    def stage(self, state: LeastSquaresState) -> str:
        """What the next epoch does."""
        return "calibrating" if state.refining else "searching"

    def progress(self, state: LeastSquaresState, budget: int) -> float:
        """Share of the control steps."""
        return min(1.0, state.control_steps / budget)

    def converged(self, state: LeastSquaresState) -> str | None:
        """A sentence once the steps are too small to matter."""
        if not state.refining or not state.epochs or state.moved[0] >= 1.0:
            return None
        return f"after {state.epochs} steps on all windows the next would change nothing worth a simulation"

    def _window_count(self, state: LeastSquaresState) -> int:
        return len(state.chosen) if state.refining else min(self.search_windows, len(state.chosen))

    def _windows(self, problem: CalibrationProblem, state: LeastSquaresState) -> Windows:
        chosen = state.chosen[: self._window_count(state)]
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
    scale = problem.scalings["standardised"].next_scale
    residuals = window_residuals(problem.simulator, windows, points.reshape(-1, points.shape[-1]), scale)
    return residuals.reshape(*points.shape[:2], *residuals.shape[1:])


def _refine(state: LeastSquaresState, leader: int) -> LeastSquaresState:
    """Go on with the best search alone, in the first place."""
    order = np.argsort(np.arange(len(state.cost)) != leader, kind="stable")
    searches = {name: getattr(state, name)[order] for name in ("unit", "damping", "cost", "moved")}
    return replace(state, **searches, refining=1, epochs=0)
