"""Windows that begin at logged states, which are assumed to be exact.

The loss is scaled by the robust standard deviation of all residuals, and a window whose simulation fails counts as the
worst that does not. Windows with contacts have a scale of their own where they are explained worse than the others, so
that a wrong contact model does not bias what the others tell.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.plan import Outcome, Plan
from madoc.errors import MadocError
from madoc.identification.gauss_newton import TRIALS, damped_step, triangular_factors
from madoc.identification.information import bread, meat
from madoc.identification.linearisation import difference_points, linearise
from madoc.identification.losses import ALL_FAILED, Loss, mean_cost, robust_deviation, scale_of
from madoc.identification.replay import window_residuals
from madoc.identification.windows import Windows, disjoint_windows, first_rows, windows_at

FEWEST_FREE = 0.05
"""Share in [0, 1] of windows without a contact; with fewer, those with contacts are weighted like them."""
LEAST_WEIGHT = 1e-3
"""Smallest weight of the residuals of windows with contacts, so that parameters of contacts are still identified."""
_SMALLEST = 1e-100


@dataclass(frozen=True)
class KnownStarts:
    """Windows that begin at logged states, which are assumed to be exact; class variables as of `UnknownStarts`."""

    problem: CalibrationProblem
    windows: Windows
    touching: Bool[np.ndarray, " windows"]
    loss: Loss
    unknown: ClassVar[bool] = False
    failed_cost: ClassVar[float] = ALL_FAILED
    stuck: ClassVar[float] = 0.0

    @classmethod
    def at(
        cls,
        problem: CalibrationProblem,
        rows: Int[np.ndarray, " windows"],
        touching: Bool[np.ndarray, " windows"],
        horizon: int,
        loss: Loss,
    ) -> "KnownStarts":
        """The windows that begin at the given rows, and whether a contact was seen in each."""
        states = problem.states.states[np.searchsorted(problem.states.rows, rows)]
        return cls(problem, windows_at(problem.dataset, states, rows, horizon), touching, loss)

    @staticmethod
    def possible_rows(problem: CalibrationProblem, horizon: int, most: int) -> Int[np.ndarray, " windows"]:
        """Rows at which windows can begin that do not overlap: intervals assume that windows are independent.

        Single steps may be neighbours, which share a reading. Where that is noisy, their residuals alternate, and the
        search goes on to unknown initial states.

        Raises:
            MadocError: No state can be rebuilt, no episode is long enough, or there are fewer values than parameters.
        """
        pick = first_rows if horizon == 1 else disjoint_windows
        rows = problem.states.exact()[1]
        rows = rows[pick(problem.dataset, rows, horizon)]
        count, values = len(problem.simulator.parameters), problem.simulator.task.observation_size
        windows = min(most, len(rows))
        if windows * horizon * values < count:
            raise MadocError(
                f"expected at least as many logged values as parameters, got {windows} windows of {horizon} rows "
                f"with {values} values for {count} parameters; give it more rows or fewer parameters"
            )
        return rows

    @staticmethod
    def systems(problem: CalibrationProblem, *, refining: bool, waiting: bool) -> int:
        """Number of systems simulated in an epoch: central differences, and the steps tried."""
        return 1 + 2 * len(problem.simulator.parameters) + len(TRIALS)

    def plans(
        self,
        points: Float[np.ndarray, "searches d"],
        states: Float[np.ndarray, "searches 0 0"],
        damping: Float[np.ndarray, " searches"],
        state_damping: Float[np.ndarray, "searches 0"],
        *,
        refining: bool,
    ) -> list[Plan]:
        """Central differences around every search's point, in one batch."""
        around = np.stack([difference_points(point) for point in points])
        residuals = self._residuals(around)
        return [self._plan(*each) for each in zip(around, residuals, damping.tolist(), strict=True)]

    def outcomes(
        self, plans: list[Plan], states: Float[np.ndarray, "searches 0 0"], *, refining: bool
    ) -> list[Outcome]:
        """Costs after every step of every search, in one batch."""
        tried = np.stack([plan.point + plan.steps[:-1] for plan in plans])
        outcomes = []
        for plan, simulated in zip(plans, self._residuals(tried), strict=True):
            residuals = simulated * plan.relative[:, None]
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
        relative = self._relative(residuals[0])
        residuals = residuals * relative[:, None]
        around = linearise(points, residuals)
        scale = scale_of(around.residuals[(relative == 1.0)[np.isfinite(residuals).all((0, 2))]], self.loss)
        factors = triangular_factors(around, scale, self.loss)
        steps = [damped_step(*factors, points[0], damping * trial) for trial in TRIALS]
        return Plan(
            point=points[0],
            residuals=residuals[0],
            relative=relative,
            kept=np.isfinite(residuals).all((0, 2)),
            steps=np.stack([*steps, np.zeros_like(points[0])]),
            state_steps=np.zeros((len(TRIALS) + 1, 0, 0)),
            spread=np.zeros(0),
            scale=scale,
            deviation=np.ones(self.problem.states.measured),
            bread=bread(around, scale, self.loss),
            meat=meat(around, scale, self.loss),
            failures=int((~np.isfinite(residuals).all(-1)).sum()),
        )

    def _relative(self, residuals: Float[np.ndarray, "windows values"]) -> Float[np.ndarray, " windows"]:
        """Weight of each window's residuals, in (0, 1]; below 1 where contacts are explained worse than the rest."""
        weights = np.ones(len(residuals))
        whole = np.isfinite(residuals).all(-1)
        free, touching = whole & ~self.touching, whole & self.touching
        fewest = FEWEST_FREE * residuals.shape[0]
        if (
            self.loss == "linear"
            or not touching.any()
            or free.sum() < max(fewest, len(self.problem.simulator.parameters))
        ):
            return weights
        scales = [robust_deviation(np.abs(residuals[part])) for part in (free, touching)]
        weights[self.touching] = np.clip(scales[0] / max(scales[1], _SMALLEST), LEAST_WEIGHT, 1.0)
        return weights

    def _residuals(
        self, points: Float[np.ndarray, "searches points d"]
    ) -> Float[np.ndarray, "searches points windows values"]:
        flat = points.reshape(-1, points.shape[-1])
        residuals = window_residuals(self.problem.simulator, self.windows, flat, self.problem.typical_change)
        return residuals.reshape(*points.shape[:2], *residuals.shape[1:])
