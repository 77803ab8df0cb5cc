"""Windows whose initial states are unknown and estimated with the parameters: for noisy and partial observations.

Channels weigh by the noise that the fit finds in them, and windows that no initial state explains are left out.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.plan import TRIALS, Outcome, Plan
from madoc.calibration.least_squares.statistics import autocorrelation, clipped_change, noise_ratio, outlier_limits
from madoc.errors import MadocError
from madoc.identification.gauss_newton import damped_step, eliminate, triangular_factors
from madoc.identification.information import at_least_noise, bread, jackknife_meat, least_share
from madoc.identification.linearisation import WindowSlopes
from madoc.identification.losses import TUNING, Loss, curvature_share, loss_slope, loss_value
from madoc.identification.noise import channel_noise
from madoc.identification.replay import Readings, slopes_at
from madoc.identification.windows import disjoint_windows
from madoc.simulation.base import Simulator

FOLLOWED = (1.0, 0.3, 0.0)
"""Shares of an initial state's step, from 0 to 1, that every window chooses from: at contacts all of it is too far."""
FAILED_WINDOW = 1e6
"""Cost of a window that failed, in squared standard deviations of the noise."""
LIKE_NOISE = 1.5
"""Cost of a window, in squared standard deviations, that noise alone exceeds rarely; it leaves 0.8 on average."""
ROUNDING = 1e-8
"""Largest noise, in a channel's typical change, of exact readings: their residuals cannot become smaller."""
_SUFFICIENT = 0.02
"""Share of what all windows tell of a direction, from 0 to 1, that others need to tell to do without a window."""
_LEAST_DAMPING = 1e-9


@dataclass(frozen=True)
class UnknownStarts:
    """Each window's initial state is an unknown besides the parameters, and its first reading one like the others.

    Attributes:
        loss: Of residuals in standard deviations of the noise.
        failed_cost: Cost at which every window fails.
        stuck: Damping at which steps are a thousandth of undamped ones.
        waiting: Epochs on all windows in which parameters wait: initial states of new windows are first guesses.
    """

    loss: Loss
    failed_cost: float = FAILED_WINDOW
    stuck: float = 1e3
    waiting: int = 2

    def possible_rows(self, problem: CalibrationProblem, horizon: int, most: int) -> Int[np.ndarray, " windows"]:
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

    def guesses(
        self, problem: CalibrationProblem, rows: Int[np.ndarray, " windows"]
    ) -> Float[np.ndarray, "windows state"]:
        """Initial states to begin with, as near as the log tells."""
        states, known = problem.states.guesses()
        return states[np.searchsorted(known, rows)]

    def columns(self, problem: CalibrationProblem) -> int:
        """Systems simulated an epoch: differences by parameters and states, and the steps tried."""
        unknown = 2 * len(problem.simulator.parameters) + problem.states.physical_size
        return 1 + unknown + len(FOLLOWED) * (len(TRIALS) + 1)

    def windows(self, problem: CalibrationProblem, rows: Int[np.ndarray, " windows"], horizon: int) -> "UnknownWindows":
        """The windows that begin at the given rows."""
        readings = Readings.at(problem.dataset, problem.states, rows, horizon, problem.typical_change)
        return UnknownWindows(problem.simulator, readings, self.loss)


@dataclass(frozen=True)
class UnknownWindows:
    """Windows to be simulated from estimated states."""

    simulator: Simulator
    readings: Readings
    loss: Loss

    def in_state_units(
        self, steps: Float[np.ndarray, "windows physical"], size: int
    ) -> Float[np.ndarray, "windows state"]:
        """Steps of initial states, in their units."""
        return self.readings.in_state_units(steps, size)

    def plans(
        self,
        unit: Float[np.ndarray, "searches d"],
        states: Float[np.ndarray, "searches windows state"],
        damping: Float[np.ndarray, " searches"],
        state_damping: Float[np.ndarray, "searches windows"],
        *,
        refining: bool,
    ) -> list[Plan]:
        """Differences around every search's point and initial states, in one batch each."""
        slopes = slopes_at(self.simulator, self.readings, unit, states)
        searches = zip(slopes, unit, damping.tolist(), state_damping, strict=True)
        return [self._plan(*each, refining=refining) for each in searches]

    def outcomes(self, plans: list[Plan], states: Float[np.ndarray, "searches windows state"]) -> list[Outcome]:
        """Costs after every step of every search, each window's state following as far as fits it best."""
        ways = np.array(FOLLOWED)[:, None, None]
        readings, size = self.readings, states.shape[2]
        starts = [
            state + ways * readings.in_state_units(plan.state_steps, size)[:, None]
            for plan, state in zip(plans, states, strict=True)
        ]
        flat = np.concatenate(starts).reshape(-1, len(FOLLOWED) * len(readings), size)
        units = np.concatenate([plan.unit + plan.steps for plan in plans])
        residuals = readings.residuals(self.simulator, units, flat)
        residuals = residuals.reshape(len(plans), -1, *residuals.shape[1:])
        return [
            self._outcome(plan, part / np.tile(plan.deviation, readings.steps + 1))
            for part, plan in zip(residuals, plans, strict=True)
        ]

    def _outcome(self, plan: Plan, residuals: Float[np.ndarray, "trials ways windows values"]) -> Outcome:
        costs = self._costs(residuals)
        followed = np.array(FOLLOWED)[costs.argmin(1)]
        if not plan.kept.any():
            return Outcome(FAILED_WINDOW, costs.min(1).mean(-1), followed, 0)
        before, after = self._costs(plan.residuals)[plan.kept], costs.min(1)[:, plan.kept]
        change = after - before
        if self.loss != "linear":
            activity = self.readings.activity[plan.kept]
            change = clipped_change(before, after, activity, least=LIKE_NOISE, failed=FAILED_WINDOW)
        return Outcome(float(before.mean()), before.mean() + change.mean(-1), followed, 0)

    def _plan(
        self,
        slopes: WindowSlopes,
        unit: Float[np.ndarray, " d"],
        damping: float,
        state_damping: Float[np.ndarray, " windows"],
        *,
        refining: bool,
    ) -> Plan:
        """While refining, channels weigh by their noise, and only windows that are `_trusted` move the parameters."""
        channels, readings = len(self.readings.scale), self.readings.steps + 1
        least = np.full(len(state_damping), _LEAST_DAMPING)
        alike = eliminate(slopes, np.ones_like(slopes.residuals), least)
        kept = slopes.whole
        deviation = _deviation(slopes, alike.spare, channels, kept)
        if refining:
            kept = self._trusted(slopes.over(np.tile(deviation, readings)), self.readings.activity)
            deviation = _deviation(slopes, alike.spare, channels, kept)
        else:
            deviation = np.full(channels, np.median(deviation))
        slopes = slopes.over(np.tile(deviation, readings))
        z = (slopes.residuals / TUNING[self.loss]) ** 2
        weights = loss_slope(z, self.loss) * slopes.whole[:, None]
        damped = eliminate(slopes, weights, state_damping)
        factors = triangular_factors(damped.reduced.where(kept), 1.0, "linear")
        steps = [*(damped_step(*factors, unit, damping * trial) for trial in TRIALS), np.zeros_like(unit)]
        exact = eliminate(slopes, weights, least).reduced.of(kept)
        share = curvature_share(z[kept], self.loss)
        curved = share * bread(exact, 1.0, "linear")
        freedom = float(alike.spare[kept].sum()) - len(unit)
        ratio = noise_ratio(slopes.residuals[kept], weights[kept], share, freedom)
        return Plan(
            unit=unit,
            residuals=slopes.residuals,
            kept=kept,
            steps=np.stack(steps),
            state_steps=np.stack([damped.states_step(step) for step in steps]),
            scale=TUNING[self.loss],
            deviation=deviation,
            bread=curved,
            meat=at_least_noise(jackknife_meat(exact, share, curved), curved, ratio),
            autocorrelation=autocorrelation(slopes.residuals.reshape(len(kept), -1, channels)[kept]),
            exact=float(deviation.max()) < ROUNDING,
            left_out=1.0 - float(kept.mean()),
            failures=int((~slopes.whole).sum()),
        )

    def _trusted(self, slopes: WindowSlopes, activity: Float[np.ndarray, " windows"]) -> Bool[np.ndarray, " windows"]:
        """Windows that an initial state explains; all of them if the others tell of a direction hardly anything.

        At contacts a search for an initial state ends in a wrong one now and then. Such a window pulls the parameters
        anywhere. One is explained if its cost is like most others' or near that of noise.
        """
        whole = slopes.whole
        if self.loss == "linear" or not whole.any():
            return whole
        costs = self._costs(slopes.residuals)
        middle, reach = outlier_limits(costs[whole], activity[whole])
        kept = whole & (costs <= np.maximum(middle + reach, LIKE_NOISE))
        weights = loss_slope((slopes.residuals / TUNING[self.loss]) ** 2, self.loss)
        reduced = eliminate(slopes, weights, np.full(len(whole), _LEAST_DAMPING)).reduced
        return kept if least_share(reduced.of(kept), reduced.of(whole)) > _SUFFICIENT else whole

    def _costs(self, residuals: Float[np.ndarray, "*windows values"]) -> Float[np.ndarray, "*windows"]:
        """Mean loss of each window."""
        scale = TUNING[self.loss]
        with np.errstate(invalid="ignore", over="ignore"):
            cost = scale**2 * loss_value((residuals / scale) ** 2, self.loss).mean(-1)
        return np.where(np.isfinite(cost), np.minimum(cost, FAILED_WINDOW), FAILED_WINDOW)


def _deviation(
    slopes: WindowSlopes,
    spare: Float[np.ndarray, "windows values"],
    channels: int,
    kept: Bool[np.ndarray, " windows"],
) -> Float[np.ndarray, " channels"]:
    """Each channel's noise in windows that are kept."""
    shape = (int(kept.sum()), slopes.residuals.shape[1] // channels, channels)
    return channel_noise(slopes.residuals[kept].reshape(shape), spare[kept].reshape(shape))
