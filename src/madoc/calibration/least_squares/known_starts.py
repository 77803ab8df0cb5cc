"""Windows that begin at logged states, which are taken for true.

The robust standard deviation of all residuals is the scale of the loss, and a window whose simulation fails counts as
the worst that does not.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.plan import TRIALS, Outcome, Plan
from madoc.errors import MadocError
from madoc.identification.gauss_newton import damped_step, triangular_factors
from madoc.identification.information import bread, meat
from madoc.identification.linearisation import difference_points, linearise
from madoc.identification.losses import ALL_FAILED, Loss, mean_cost, scale_of
from madoc.identification.replay import window_residuals
from madoc.identification.windows import Windows, disjoint_windows, first_rows, windows_at


@dataclass(frozen=True)
class KnownStarts:
    """Windows begin at logged states, which are taken for true; attributes as of `UnknownStarts`."""

    loss: Loss
    failed_cost: float = ALL_FAILED
    stuck: float = 0.0
    waiting: int = 0

    def possible_rows(self, problem: CalibrationProblem, horizon: int, most: int) -> Int[np.ndarray, " windows"]:
        """Rows at which windows can begin. Those that share readings are not independent, but intervals take them so.

        Raises:
            MadocError: No state can be rebuilt, no episode is long enough, or there are fewer values than parameters.
        """
        pick = first_rows if horizon == 1 else disjoint_windows
        possible = pick(problem.dataset, problem.states.exact()[1], horizon)
        count, values = len(problem.simulator.parameters), problem.simulator.task.observation_size
        windows = min(most, len(possible))
        if windows * horizon * values < count:
            raise MadocError(
                f"expected at least as many logged values as parameters, got {windows} windows of {horizon} rows "
                f"with {values} values for {count} parameters; give it more rows or fewer parameters"
            )
        return problem.states.exact()[1][possible]

    def guesses(self, problem: CalibrationProblem, rows: Int[np.ndarray, " windows"]) -> Float[np.ndarray, "0 0"]:
        """None: there is nothing to guess."""
        return np.zeros((0, 0))

    def columns(self, problem: CalibrationProblem) -> int:
        """Systems simulated an epoch: central differences, and the steps tried."""
        return 1 + 2 * len(problem.simulator.parameters) + len(TRIALS)

    def windows(self, problem: CalibrationProblem, rows: Int[np.ndarray, " windows"], horizon: int) -> "KnownWindows":
        """The windows that begin at the given rows."""
        states = problem.states.exact()[0][np.searchsorted(problem.states.exact()[1], rows)]
        return KnownWindows(problem, windows_at(problem.dataset, states, rows, horizon), self.loss)


@dataclass(frozen=True)
class KnownWindows:
    """Windows to be simulated from logged states."""

    problem: CalibrationProblem
    windows: Windows
    loss: Loss

    def in_state_units(self, steps: Float[np.ndarray, "0 0"], size: int) -> Float[np.ndarray, "0 0"]:
        """No steps of initial states, of which there are none."""
        return steps

    def plans(
        self,
        unit: Float[np.ndarray, "searches d"],
        states: Float[np.ndarray, "searches 0 0"],
        damping: Float[np.ndarray, " searches"],
        state_damping: Float[np.ndarray, "searches 0"],
        *,
        refining: bool,
    ) -> list[Plan]:
        """Central differences around every search's point, in one batch."""
        points = np.stack([difference_points(point) for point in unit])
        around = self._residuals(points)
        return [self._plan(*each) for each in zip(points, around, damping.tolist(), strict=True)]

    def outcomes(self, plans: list[Plan], states: Float[np.ndarray, "searches 0 0"]) -> list[Outcome]:
        """Costs after every step of every search, in one batch."""
        tried = np.stack([plan.unit + plan.steps[:-1] for plan in plans])
        outcomes = []
        for plan, residuals in zip(plans, self._residuals(tried), strict=True):
            before = mean_cost(plan.residuals, plan.scale, self.loss)
            totals = np.array([*(mean_cost(each, plan.scale, self.loss) for each in residuals), before])
            failures = int((~np.isfinite(residuals).all(-1)).sum())
            outcomes.append(Outcome(before, totals, np.zeros((len(totals), 0)), failures))
        return outcomes

    def _plan(
        self,
        points: Float[np.ndarray, "points d"],
        residuals: Float[np.ndarray, "points windows values"],
        damping: float,
    ) -> Plan:
        around = linearise(points, residuals)
        scale = scale_of(around.residuals, self.loss)
        factors = triangular_factors(around, scale, self.loss)
        steps = [damped_step(*factors, points[0], damping * trial) for trial in TRIALS]
        return Plan(
            unit=points[0],
            residuals=residuals[0],
            kept=np.isfinite(residuals).all((0, 2)),
            steps=np.stack([*steps, np.zeros_like(points[0])]),
            state_steps=np.zeros((len(TRIALS) + 1, 0, 0)),
            scale=scale,
            deviation=np.ones(self.problem.states.measured),
            bread=bread(around, scale, self.loss),
            meat=meat(around, scale, self.loss),
            autocorrelation=0.0,
            exact=True,
            left_out=0.0,
            failures=int((~np.isfinite(residuals).all(-1)).sum()),
        )

    def _residuals(
        self, points: Float[np.ndarray, "searches points d"]
    ) -> Float[np.ndarray, "searches points windows values"]:
        flat = points.reshape(-1, points.shape[-1])
        residuals = window_residuals(self.problem.simulator, self.windows, flat, self.problem.typical_change)
        return residuals.reshape(*points.shape[:2], *residuals.shape[1:])
