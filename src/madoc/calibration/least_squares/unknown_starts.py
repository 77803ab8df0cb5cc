"""Windows whose initial states are unknown and estimated with the parameters: for noisy and partial observations.

Channels are weighted by their noise as estimated from the fit, and windows that no initial state explains are left out.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.plan import TRIALS, Outcome, Plan
from madoc.calibration.least_squares.statistics import (
    autocorrelation,
    clipped_change,
    noise_ratio,
    outlier_limits,
    steady_cost,
    touched,
)
from madoc.errors import MadocError
from madoc.identification.gauss_newton import damped_step, eliminate, triangular_factors
from madoc.identification.information import at_least_noise, bread, jackknife_meat, least_share
from madoc.identification.linearisation import WindowSlopes
from madoc.identification.losses import TUNING, Loss, curvature_share, loss_slope
from madoc.identification.noise import channel_noise
from madoc.identification.replay import Readings, slopes_at
from madoc.identification.settling import (
    FAILED_WINDOW,
    FEW,
    FIRST_DAMPING,
    LEAST_DAMPING,
    RESETTLING,
    RESTARTS,
    WIDTHS,
    Settled,
    restart,
    settle,
    window_costs,
)
from madoc.identification.windows import disjoint_windows
from madoc.simulation.base import Simulator

FOLLOWED = (1.0, 0.3, 0.0)
"""Shares in [0, 1] of an initial state's step, of which every window takes the best: at contacts 1 may be too far."""
LIKE_NOISE = 1.5
"""Cost of a window, in squared standard deviations; noise alone rarely exceeds it, as its mean is 0.8."""
UNLIKE_NOISE = 4.0
"""The same where the log shows no contact, so that nothing but what the model lacks, or false readings, make it."""
SECOND_CHANCES = 2
"""Number of times that windows which a step of the parameters leaves unexplained begin anew."""
WORSE = 2.0
"""Mean change of the windows' costs in its standard errors; above it a step makes them worse."""
ROUNDING = 1e-8
"""Noise in typical changes of a channel; smaller residuals are rounding errors."""
_SUFFICIENT = 0.02
"""Share in [0, 1] of the information about every direction that the trusted windows need; else all are trusted."""


@dataclass(frozen=True)
class UnknownStarts:
    """Windows whose initial states are unknowns besides the parameters; the first reading is a reading like the others.

    Attributes:
        simulator: The simulator.
        readings: Actions and observations of the windows.
        guesses: Initial states as the log tells them.
        touching: Whether the log shows a contact in each window.
        rounding: Deviation of the rounding of counts in typical changes of each channel.
        loss: Loss of residuals in standard deviations of the noise.
        unknown: Whether initial states are unknown.
        failed_cost: Cost at which every window fails.
        stuck: Damping at which steps are so short that their length no longer shows how far the minimum is.
        waiting: Number of epochs in which only initial states move, as those of new windows are guesses.
    """

    simulator: Simulator
    readings: Readings
    guesses: Float[np.ndarray, "windows state"]
    touching: Bool[np.ndarray, " windows"]
    rounding: Float[np.ndarray, " channels"]
    loss: Loss
    unknown: ClassVar[bool] = True
    failed_cost: ClassVar[float] = FAILED_WINDOW
    stuck: ClassVar[float] = 1e3
    waiting: ClassVar[int] = len(WIDTHS) + RESTARTS

    @classmethod
    def at(
        cls,
        problem: CalibrationProblem,
        rows: Int[np.ndarray, " windows"],
        touching: Bool[np.ndarray, " windows"],
        horizon: int,
        loss: Loss,
    ) -> "UnknownStarts":
        """The windows that begin at the given rows."""
        readings = Readings.at(problem.dataset, problem.states, rows, horizon, problem.typical_change)
        guesses = problem.states.states[np.searchsorted(problem.states.rows, rows)]
        rounding = (problem.rounding / problem.typical_change)[: problem.states.measured]
        return cls(problem.simulator, readings, guesses, touching, rounding, loss)

    @staticmethod
    def touched(
        problem: CalibrationProblem, rows: Int[np.ndarray, " windows"], horizon: int
    ) -> Bool[np.ndarray, " windows"]:
        """Whether bodies were in contact at any state of a window, as far as the log tells."""
        return touched(problem, *problem.states.guesses(), rows, horizon)

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
    def columns(problem: CalibrationProblem, *, smooth: bool) -> int:
        """Number of systems simulated for the derivatives of an epoch: differences by parameters and states."""
        return 1 + (1 if smooth else 2) * len(problem.simulator.parameters) + problem.states.physical_size

    @staticmethod
    def trial_columns(*, smooth: bool) -> int:
        """Number of systems simulated for the steps tried in an epoch; for smooth motion the first mostly serves."""
        return 1 if smooth else len(FOLLOWED) * (len(TRIALS) + 1)

    @staticmethod
    def settling_columns(problem: CalibrationProblem) -> int:
        """About how many systems are simulated in an epoch in which only initial states move."""
        return 4 + problem.states.physical_size

    def settle(
        self,
        point: Float[np.ndarray, " d"],
        states: Float[np.ndarray, "windows state"],
        damping: Float[np.ndarray, " windows"],
        errors: Float[np.ndarray, " physical"],
        waiting: int,
    ) -> tuple[Settled, int]:
        """Move initial states alone, with `waiting` epochs to go; also how many are to go after it.

        None are once residuals of nearly all windows are noise. Until there are as many to go as restarts, differences
        become narrower; then windows whose residuals are more than noise begin anew.
        """
        width = WIDTHS[self.waiting - waiting] if waiting > RESTARTS else 0.0
        after = settle(self.simulator, self.readings, point, states, damping, width * errors, self.loss)
        if waiting <= RESTARTS:
            random = np.random.default_rng(waiting)
            after = restart(self.simulator, self.readings, point, self.guesses, after, self.loss, random)
        noiseless = after.deviation.max() < ROUNDING and after.costs.min() < FAILED_WINDOW
        return after, 0 if self.share_unexplained(after) <= FEW or noiseless else waiting - 1

    def share_unexplained(self, settled: Settled) -> float:
        """Share of the windows whose residuals are more than noise."""
        return float(settled.unexplained(self.readings.observed[0].size, self.loss).mean())

    def profiled(
        self,
        plan: Plan,
        states: Float[np.ndarray, "windows state"],
        errors: Float[np.ndarray, " physical"],
        second_chances: int,
    ) -> tuple[Settled, bool, float]:
        """Initial states settled after the least damped step of a plan, whether it helps, and the mean cost then kept.

        It does unless the windows' costs are significantly higher: at contacts initial states end here and there in
        another minimum, and where they were before they had several chances. Windows that it leaves unexplained begin
        anew so many times.
        """
        point = np.clip(plan.point + plan.steps[0], -1.0, 1.0)
        states = states + self.readings.in_state_units(plan.state_steps[0], states.shape[1])
        damping, simulations = np.full(len(states), FIRST_DAMPING), 0
        for width in RESETTLING:
            after = settle(self.simulator, self.readings, point, states, damping, width * errors, self.loss)
            states, damping, simulations = after.states, after.damping, simulations + after.simulations
        residuals = self.readings.residuals(self.simulator, point[None], states[None])[0, 0]
        costs = window_costs(residuals / np.tile(plan.deviation, self.readings.steps + 1), self.loss)
        simulations += len(states)
        after = replace(after, costs=costs, deviation=plan.deviation, errors=errors, simulations=simulations)
        for again in range(second_chances):
            random = np.random.default_rng(RESTARTS + 1 + again)
            after = restart(self.simulator, self.readings, point, self.guesses, after, self.loss, random)
        if not plan.kept.any():
            return after, False, FAILED_WINDOW
        before = window_costs(plan.residuals, self.loss)[plan.kept]
        change = after.costs[plan.kept] - before
        if self.loss != "linear":
            activity, costs = self.readings.activity[plan.kept], after.costs[None, plan.kept]
            change = clipped_change(before, costs, activity, least=LIKE_NOISE, failed=FAILED_WINDOW)[0]
        helps = bool(change.mean() <= WORSE * change.std() / np.sqrt(len(change)))
        return after, helps, float((before + change).mean() if helps else before.mean())

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
        slopes = slopes_at(self.simulator, self.readings, points, states, central=bool(self.touching.any()))
        searches = zip(slopes, points, damping.tolist(), state_damping, strict=True)
        return [
            self._plan(*each, contacts=self._contacts(each[1], state) if refining else None)
            for each, state in zip(searches, states, strict=True)
        ]

    def outcomes(
        self, plans: list[Plan], states: Float[np.ndarray, "searches windows state"], *, refining: bool
    ) -> list[Outcome]:
        """Costs after every step of every search, with the share of its state's step that fits each window best.

        Where a search refines on windows without contacts, the least damped step is tried first, with the whole steps
        of the states, and the others only if that does not help: motion is smooth there, and the whole step mostly
        leads to the minimum.
        """
        spent = 0
        if refining and not self.touching.any():
            alone = self._tried(plans, states, trials=1, shares=FOLLOWED[:1])
            helping = (plan.kept.any() and one.totals[0] < one.before for plan, one in zip(plans, alone, strict=True))
            if all(helping):
                return [outcome.with_no_step() for outcome in alone]
            spent = len(self.readings)
        every = self._tried(plans, states, trials=len(TRIALS) + 1, shares=FOLLOWED)
        return [replace(outcome, simulations=outcome.simulations + spent) for outcome in every]

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
        costs, simulations = window_costs(residuals, self.loss), int(np.prod(residuals.shape[:-1]))
        followed = np.array(shares)[costs.argmin(1)]
        if len(shares) == 1:  # a state whose step makes its window worse stays where it is
            worse = costs[:, 0] > np.maximum(window_costs(plan.residuals, self.loss), LIKE_NOISE)
            followed = np.where(worse, 0.0, followed)
        if not plan.kept.any():
            return Outcome(FAILED_WINDOW, costs.min(1).mean(-1), followed, 0, simulations)
        before, after = window_costs(plan.residuals, self.loss)[plan.kept], costs.min(1)[:, plan.kept]
        change = after - before
        if self.loss != "linear":
            activity = self.readings.activity[plan.kept]
            change = clipped_change(before, after, activity, least=LIKE_NOISE, failed=FAILED_WINDOW)
        return Outcome(float(before.mean()), before.mean() + change.mean(-1), followed, 0, simulations)

    def _plan(
        self,
        slopes: WindowSlopes,
        point: Float[np.ndarray, " d"],
        damping: float,
        state_damping: Float[np.ndarray, " windows"],
        *,
        contacts: Int[np.ndarray, "windows readings"] | None,
    ) -> Plan:
        """The plan of one search; `contacts` are known while it refines.

        Channels are weighted by noise then, and untrusted windows left out.
        """
        least = np.full(len(state_damping), LEAST_DAMPING)
        spare = eliminate(slopes, np.ones_like(slopes.residuals), least).spare
        kept, deviation = self._weighted(slopes, spare, refining=contacts is not None)
        slopes = slopes.over(np.tile(deviation, self.readings.steps + 1))
        z = (slopes.residuals / TUNING[self.loss]) ** 2
        weights = loss_slope(z, self.loss) * slopes.whole[:, None]
        share = curvature_share(z[kept], self.loss)
        # At contacts shorter steps serve better: intervals of a bouncing leg hold 93 % of truths, 90 % with Newton's.
        newton = slopes if self.touching.any() else slopes.curved(share)
        damped = eliminate(newton, weights, state_damping)
        factors = triangular_factors(damped.reduced.where(kept), 1.0, "linear")
        steps = [*(damped_step(*factors, point, damping * trial) for trial in TRIALS), np.zeros_like(point)]
        exact = eliminate(slopes, weights, least).reduced.of(kept)
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
            steady_cost=self._steady_cost(slopes, spare, contacts, kept, deviation),
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

    def _contacts(
        self, point: Float[np.ndarray, " d"], states: Float[np.ndarray, "windows state"]
    ) -> Int[np.ndarray, "windows readings"]:
        """Number of contacts at every reading of the simulated windows; 0 if the log shows no contact in any."""
        if self.touching.any():
            return self.readings.contacts(self.simulator, point, states)
        return np.zeros(self.readings.observed.shape[:2], np.int64)

    def _steady_cost(
        self,
        slopes: WindowSlopes,
        spare: Float[np.ndarray, "windows values"],
        contacts: Int[np.ndarray, "windows readings"] | None,
        kept: Bool[np.ndarray, " windows"],
        deviation: Float[np.ndarray, " channels"],
    ) -> float:
        if contacts is None:
            return 0.0
        shape = (-1, *self.readings.observed.shape[1:])
        residuals, left = (part[kept].reshape(shape) for part in (slopes.residuals, spare))
        return steady_cost(residuals, left, contacts[kept], self.rounding / deviation, self.loss)

    def _trusted(self, slopes: WindowSlopes) -> Bool[np.ndarray, " windows"]:
        """Windows that an initial state explains; all of them if these hold too little information on a direction.

        At contacts a search for an initial state sometimes ends in a wrong one, and such a window would bias the
        parameters. A window is explained if its cost is no outlier among the others' or near that of noise. Without
        contacts one is whose errors are up to twice as large as noise: it counts less by the loss.
        """
        whole = slopes.whole
        if self.loss == "linear" or not whole.any():
            return whole
        costs = window_costs(slopes.residuals, self.loss)
        middle, reach = outlier_limits(costs[whole], self.readings.activity[whole])
        most = LIKE_NOISE if self.touching.any() else UNLIKE_NOISE
        kept = whole & (costs <= np.maximum(middle + reach, most))
        weights = loss_slope((slopes.residuals / TUNING[self.loss]) ** 2, self.loss)
        reduced = eliminate(slopes, weights, np.full(len(whole), LEAST_DAMPING)).reduced
        return kept if least_share(reduced.of(kept), reduced.of(whole)) > _SUFFICIENT else whole
