"""Windows whose initial states are unknown and estimated with the parameters: for noisy and partial observations.

Channels are weighted by their noise as estimated from the fit, and windows that no initial state explains are left out.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.plan import (
    Outcome,
    Plan,
    autocorrelation,
    clipped_change,
    noise_ratio,
    outlier_limits,
)
from madoc.errors import MadocError
from madoc.identification.gauss_newton import TRIALS, damped_step, eliminate, left_by_states, triangular_factors
from madoc.identification.information import at_least_noise, bread, jackknife_meat, least_share
from madoc.identification.linearisation import WindowSlopes
from madoc.identification.losses import TUNING, Loss, curvature_share, loss_slope
from madoc.identification.noise import channel_noise
from madoc.identification.replay import Readings, slopes_at
from madoc.identification.settling import FAILED_WINDOW, window_costs
from madoc.identification.windows import disjoint_windows
from madoc.simulation.base import Simulator

FOLLOWED = (1.0, 0.3, 0.0)
"""Shares in [0, 1] of an initial state's step, of which every window takes the best."""
LIKE_NOISE = 1.5
"""Cost of a window, in squared standard deviations; noise alone rarely exceeds it, as its mean is 0.8."""
UNLIKE_NOISE = 4.0
"""The same above which a window may be left out."""
ROUNDING = 1e-8
"""Noise in typical changes of a channel; smaller residuals are rounding errors."""
_SUFFICIENT = 0.02
"""Share in [0, 1] of the information about every direction that the trusted windows need; else all are trusted."""


@dataclass(frozen=True)
class UnknownStarts:
    """Windows whose initial states are unknowns besides the parameters; the first reading is a reading like the others.

    Attributes:
        readings: Actions and observations of the windows.
        rounding: Deviation of the rounding of counts in typical changes of each channel.
        loss: Loss of residuals in standard deviations of the noise.
        failed_cost: Cost at which every window fails.
        stuck: Damping at which steps are so short that their length no longer shows how far the minimum is.
    """

    simulator: Simulator
    readings: Readings
    rounding: Float[np.ndarray, " channels"]
    loss: Loss
    unknown: ClassVar[bool] = True
    failed_cost: ClassVar[float] = FAILED_WINDOW
    stuck: ClassVar[float] = 1e3

    @classmethod
    def at(
        cls,
        problem: CalibrationProblem,
        rows: Int[np.ndarray, " windows"],
        horizon: int,
        loss: Loss,
    ) -> "UnknownStarts":
        """The windows that begin at the given rows."""
        readings = Readings.at(problem.dataset, problem.states, rows, horizon, problem.typical_change)
        rounding = (problem.rounding / problem.typical_change)[: problem.states.measured]
        return cls(problem.simulator, readings, rounding, loss)

    @staticmethod
    def possible_rows(problem: CalibrationProblem, horizon: int, most: int) -> Int[np.ndarray, " windows"]:
        """Rows at which windows can begin that share no reading.

        Raises:
            MadocError: No position is observed, no episode is long enough, or there are fewer readings than unknowns.
        """
        rows = problem.states.guesses()[1]
        rows = rows[disjoint_windows(problem.dataset, rows, horizon)]
        windows = min(most, len(rows))
        readings = windows * (horizon + 1) * problem.states.measured
        unknowns = len(problem.simulator.parameters) + windows * problem.states.physical_size
        if readings < unknowns:
            raise MadocError(
                f"expected at least as many readings as unknowns, got {windows} windows of {horizon} rows with "
                f"{readings} readings for {unknowns} parameters and initial states; take a longer horizon"
            )
        return rows

    @staticmethod
    def systems(problem: CalibrationProblem, *, refining: bool, waiting: bool) -> int:
        """Number of systems simulated in an epoch: differences by parameters and states, and the steps tried.

        While it refines the first step mostly serves. If it is `waiting`, only initial states move.
        """
        size = problem.states.physical_size
        if waiting:
            return 4 + size
        return 1 + len(problem.simulator.parameters) + size + (1 if refining else len(FOLLOWED) * (len(TRIALS) + 1))

    def plans(
        self,
        points: Float[np.ndarray, "searches d"],
        states: Float[np.ndarray, "searches windows state"],
        damping: Float[np.ndarray, " searches"],
        state_damping: Float[np.ndarray, "searches windows"],
        *,
        refining: bool,
    ) -> list[Plan]:
        """Differences around every search's point and initial states, in one batch each."""
        slopes = slopes_at(self.simulator, self.readings, points, states, central=False)
        searches = zip(slopes, points, damping.tolist(), state_damping, strict=True)
        return [self._plan(*each, refining=refining) for each in searches]

    def outcomes(
        self, plans: list[Plan], states: Float[np.ndarray, "searches windows state"], *, refining: bool
    ) -> list[Outcome]:
        """Costs after every step of every search, with the share of its state's step that fits each window best.

        Where a search refines, the least damped step is tried first, with the whole steps of the states, and the others
        only if that does not help: where motion is smooth, the whole step mostly leads to the minimum.
        """
        if refining:
            alone = self._tried(plans, states, trials=1, shares=FOLLOWED[:1])
            helping = (plan.kept.any() and one.totals[0] < one.before for plan, one in zip(plans, alone, strict=True))
            if all(helping):
                return [outcome.with_no_step() for outcome in alone]
        return self._tried(plans, states, trials=len(TRIALS) + 1, shares=FOLLOWED)

    def _tried(
        self,
        plans: list[Plan],
        states: Float[np.ndarray, "searches windows state"],
        *,
        trials: int,
        shares: tuple[float, ...],
    ) -> list[Outcome]:
        """Costs after the first steps of every search, each with these shares of the initial states' steps."""
        ways, readings, size = np.array(shares)[:, None, None], self.readings, states.shape[2]
        starts = [
            state + ways * readings.in_state_units(plan.state_steps[:trials], size)[:, None]
            for plan, state in zip(plans, states, strict=True)
        ]
        flat = np.concatenate(starts).reshape(-1, len(shares) * len(readings), size)
        points = np.concatenate([plan.point + plan.steps[:trials] for plan in plans])
        residuals = readings.residuals(self.simulator, points, flat)
        residuals = residuals.reshape(len(plans), trials, *residuals.shape[1:])
        return [
            self._outcome(plan, part / np.tile(plan.deviation, readings.steps + 1), shares)
            for part, plan in zip(residuals, plans, strict=True)
        ]

    def _outcome(
        self, plan: Plan, residuals: Float[np.ndarray, "trials ways windows values"], shares: tuple[float, ...]
    ) -> Outcome:
        costs = window_costs(residuals, self.loss)
        followed = np.array(shares)[costs.argmin(1)]
        if len(shares) == 1:  # a state whose step makes its window worse stays where it is
            worse = costs[:, 0] > np.maximum(window_costs(plan.residuals, self.loss), LIKE_NOISE)
            followed = np.where(worse, 0.0, followed)
        if not plan.kept.any():
            return Outcome(FAILED_WINDOW, costs.min(1).mean(-1), followed, 0)
        before, after = window_costs(plan.residuals, self.loss)[plan.kept], costs.min(1)[:, plan.kept]
        change = after - before
        if self.loss != "linear":
            activity = self.readings.activity[plan.kept]
            change = clipped_change(before, after, activity, least=LIKE_NOISE, failed=FAILED_WINDOW)
        return Outcome(float(before.mean()), before.mean() + change.mean(-1), followed, 0)

    def _plan(
        self,
        slopes: WindowSlopes,
        point: Float[np.ndarray, " d"],
        damping: float,
        state_damping: Float[np.ndarray, " windows"],
        *,
        refining: bool,
    ) -> Plan:
        """The plan of one search; once it refines, channels are weighted by noise and untrusted windows left out."""
        spare = left_by_states(slopes)[1]
        kept, deviation = self._weighted(slopes, spare, refining=refining)
        slopes = slopes.over(np.tile(deviation, self.readings.steps + 1))
        z = (slopes.residuals / TUNING[self.loss]) ** 2
        weights = loss_slope(z, self.loss) * slopes.whole[:, None]
        share = curvature_share(z[kept], self.loss)
        damped = eliminate(slopes.curved(share), weights, state_damping)
        factors = triangular_factors(damped.reduced.where(kept), 1.0, "linear")
        steps = [*(damped_step(*factors, point, damping * trial) for trial in TRIALS), np.zeros_like(point)]
        exact = eliminate(slopes, weights).reduced.of(kept)
        curved = share * bread(exact, 1.0, "linear")
        freedom = float(spare[kept].sum()) - len(point)
        ratio = noise_ratio(slopes.residuals[kept], weights[kept], share, freedom)
        return Plan(
            point=point,
            residuals=slopes.residuals,
            relative=np.ones(len(kept)),
            kept=kept,
            steps=np.stack(steps),
            state_steps=np.stack([damped.states_step(step) for step in steps]),
            spread=self.readings.spread,
            scale=TUNING[self.loss],
            deviation=deviation,
            bread=curved,
            meat=at_least_noise(jackknife_meat(exact, share, curved), curved, ratio),
            autocorrelation=autocorrelation(slopes.residuals.reshape(len(kept), -1, len(deviation))[kept]),
            exact=float(deviation.max()) < ROUNDING,
            left_out=1.0 - float(kept.mean()),
            failures=int((~slopes.whole).sum()),
            tail_cost=self._tail_cost(slopes.residuals[kept], deviation) if refining else 0.0,
        )

    def _weighted(
        self, slopes: WindowSlopes, spare: Float[np.ndarray, "windows values"], *, refining: bool
    ) -> tuple[Bool[np.ndarray, " windows"], Float[np.ndarray, " channels"]]:
        """The windows that count, and the noise of each channel, which divides residuals; one for all at first."""
        shape = (-1, *self.readings.observed.shape[1:])

        def noise_in(some: Bool[np.ndarray, " windows"]) -> Float[np.ndarray, " channels"]:
            return channel_noise(*(part[some].reshape(shape) for part in (slopes.residuals, spare)))

        deviation = noise_in(slopes.whole)
        if not refining:
            return slopes.whole, np.full(len(deviation), np.median(deviation))
        kept = self._trusted(slopes.over(np.tile(deviation, self.readings.steps + 1)))
        return kept, noise_in(kept)

    def _tail_cost(
        self, residuals: Float[np.ndarray, "windows values"], deviation: Float[np.ndarray, " channels"]
    ) -> float:
        share = np.minimum(1.0, deviation / np.maximum(self.rounding, np.finfo(float).tiny))
        costs = window_costs(residuals * np.tile(share, self.readings.steps + 1), self.loss)
        return float(costs.mean()) if len(costs) else 0.0

    def _trusted(self, slopes: WindowSlopes) -> Bool[np.ndarray, " windows"]:
        """Windows that an initial state explains; all of them if these hold too little information on a direction.

        A search for an initial state sometimes ends in a wrong one, and such a window would bias the parameters. A
        window is explained if its cost is no outlier among the others', or its errors are up to twice as large as
        noise: it counts less by the loss.
        """
        whole = slopes.whole
        if self.loss == "linear" or not whole.any():
            return whole
        costs = window_costs(slopes.residuals, self.loss)
        middle, reach = outlier_limits(costs[whole], self.readings.activity[whole])
        kept = whole & (costs <= np.maximum(middle + reach, UNLIKE_NOISE))
        weights = loss_slope((slopes.residuals / TUNING[self.loss]) ** 2, self.loss)
        reduced = eliminate(slopes, weights).reduced
        return kept if least_share(reduced.of(kept), reduced.of(whole)) > _SUFFICIENT else whole
