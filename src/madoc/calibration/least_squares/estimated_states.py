"""Least squares on windows whose initial states are estimated with the parameters: for noisy and partial readings."""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.noise import echo, noise_ratio, unlike
from madoc.errors import MadocError
from madoc.identification.gauss_newton import damped_step, eliminate, triangular_factors
from madoc.identification.information import SETTLED, at_least_noise, bread, jackknife_meat, least_share, sandwich
from madoc.identification.linearisation import WindowSlopes
from madoc.identification.losses import (
    ALL_FAILED,
    TUNING,
    Loss,
    curvature_share,
    loss_slope,
    loss_value,
)
from madoc.identification.noise import channel_noise
from madoc.identification.replay import Readings, slopes_at
from madoc.identification.windows import disjoint_windows
from madoc.types import Metrics

TRIALS = (1e-2, 1.0, 1e2)
"""Dampings of the parameters' step tried at once; where none helps, the next are a thousand times larger."""
DAMPING_RANGE = (1e-10, 1e10)
STUCK = 1e3
"""Damping at which steps are a thousandth of Gauss and Newton's."""
STATE_DAMPING_RANGE = (1e-9, 1e6)
FIRST_DAMPING = 1e-2
LITTLE = 5e-3
"""A share of the cost: a step that saves less has found the states too."""
ROUNDING = 1e-8
"""Of a channel's typical change: residuals as small as this are those of exact readings, and cannot become smaller."""
FOLLOWED = (1.0, 0.3, 0.0)
"""Shares of a state's step that every window chooses from: at contacts the whole of it often leads too far."""
STATES_FIRST = 2
"""Epochs on all windows in which parameters wait: states of windows that are new begin at their readings."""
FAILED_WINDOW = 1e6
"""Cost of a window that failed, in squared deviations of the noise; a state holds no infinity."""
LIKE_NOISE = 1.5
"""Cost of a window that noise alone leaves now and then; it leaves 0.8 on average under Cauchy's loss."""
TOLD = 0.02
"""Share of what windows tell of a direction that is enough to do without the rest."""
_SMALLEST = 1e-100
"""Keeps a move over a tolerance of 0 finite."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EstimatedState:
    """Everything the search carries. Once it refines, only the first of the searches goes on.

    Attributes:
        unit: Parameters where each search stands, in [-1, 1].
        states: Initial state of every window there.
        damping: λ of the parameters' step.
        state_damping: λ of every window's.
        cost: Mean loss of a residual, in squared typical changes, and in squared deviations of the noise once refining;
            `ALL_FAILED` before the first epoch.
        moved: The largest move of the last step over what is worth one; below 1 the search has settled.
        rows: Where the windows begin.
        deviation: Noise of each channel, in its typical changes.
        bread: Of the best search, where it last linearised.
        meat: The same.
        explained: How many windows they are of: those that are trusted.
        echo: Correlation of what is left of consecutive readings of these.
        refining: 0 while searching on few windows, 1 on all.
        epochs: Done in this stage.
        control_steps: Simulated.
        failures: Windows that exploded, each counted once an epoch.
    """

    unit: Float[np.ndarray, "searches d"]
    states: Float[np.ndarray, "searches windows state"]
    damping: Float[np.ndarray, " searches"]
    state_damping: Float[np.ndarray, "searches windows"]
    cost: Float[np.ndarray, " searches"]
    moved: Float[np.ndarray, " searches"]
    rows: Int[np.ndarray, " windows"]
    deviation: Float[np.ndarray, " channels"]
    bread: Float[np.ndarray, "d d"]
    meat: Float[np.ndarray, "d d"]
    explained: int
    echo: float
    refining: int
    epochs: int
    control_steps: int
    failures: int


@dataclass(frozen=True)
class EstimatedStates:
    """Damped Gauss-Newton on all readings of windows, each window's initial state unknown; as `LeastSquares` says."""

    horizon: int
    loss: Loss
    windows: int
    searches: int
    search_windows: int
    search_epochs: int
    tolerance: float

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> EstimatedState:
        """Windows that share no reading drawn, searches at their starts, states as near as the log tells.

        Raises:
            MadocError: No position is known, no episode is long enough, or there are fewer readings than unknowns.
        """
        of_windows, of_starts = jax.random.split(key)
        count, channels = len(problem.simulator.parameters), problem.states.measured
        guessed, rows = problem.states.guesses()
        possible = disjoint_windows(problem.dataset, rows, self.horizon)
        drawn = min(self.windows, len(possible))
        readings, unknowns = drawn * (self.horizon + 1) * channels, count + drawn * problem.states.physical_size
        if readings < unknowns:
            raise MadocError(
                f"expected at least as many readings as unknowns, got {drawn} windows of {self.horizon} rows with "
                f"{readings} readings for {unknowns} parameters and initial states; take a longer horizon"
            )
        chosen = possible[np.asarray(jax.random.choice(of_windows, len(possible), (drawn,), replace=False))]
        unit = np.array(jax.random.uniform(of_starts, (self.searches, count), minval=-1.0, maxval=1.0), np.float64)
        unit[0] = 0.0
        return EstimatedState(
            unit=unit,
            states=np.repeat(guessed[chosen][None], self.searches, axis=0),
            damping=np.full(self.searches, FIRST_DAMPING),
            state_damping=np.full((self.searches, drawn), FIRST_DAMPING),
            cost=np.full(self.searches, ALL_FAILED),
            moved=np.full(self.searches, 1.0 / _SMALLEST),
            rows=rows[chosen],
            deviation=np.ones(channels),
            bread=np.zeros((count, count)),
            meat=np.zeros((count, count)),
            explained=0,
            echo=0.0,
            refining=0,
            epochs=0,
            control_steps=0,
            failures=0,
        )

    def step(self, problem: CalibrationProblem, state: EstimatedState) -> tuple[EstimatedState, Metrics]:
        """One damped step of every search under way: slopes in one simulation, the steps tried in another."""
        running, windows = 1 if state.refining else self.searches, self.window_count(state)
        readings = Readings.at(
            problem.dataset, problem.states, state.rows[:windows], self.horizon, problem.typical_change
        )
        unit, states = state.unit[:running], state.states[:running, :windows]
        slopes = slopes_at(problem.simulator, readings, unit, states)
        plans = [
            self._plan(around, point, damping, own[:windows], readings, refining=bool(state.refining))
            for around, point, damping, own in zip(slopes, unit, state.damping, state.state_damping, strict=False)
        ]
        residuals = _tried(problem, readings, plans, states)
        waiting = bool(state.refining) and state.epochs < STATES_FIRST
        moves = [self._best(*parts, waiting=waiting) for parts in zip(plans, residuals, strict=True)]
        carried = ("unit", "states", "damping", "state_damping", "cost", "moved")
        new = {name: getattr(state, name).copy() for name in carried}
        for index, (plan, move) in enumerate(zip(plans, moves, strict=True)):
            new["unit"][index] = np.clip(unit[index] + plan.steps[move.trial], -1.0, 1.0)
            steps = move.followed[:, None] * plan.state_steps[move.trial]
            new["states"][index, :windows] += readings.in_state_units(steps, states.shape[2])
            new["damping"][index] = np.clip(state.damping[index] * move.factor, *DAMPING_RANGE)
            factor = np.select([move.followed == 1.0, move.followed > 0.0], [0.1, 1.0], 10.0)
            new["state_damping"][index, :windows] = np.clip(
                state.state_damping[index, :windows] * factor, *STATE_DAMPING_RANGE
            )
            # Searches are compared by what they leave; once one is left, it is measured in deviations of the noise.
            new["cost"][index] = move.cost if state.refining else _left(move.cost, plan)
            new["moved"][index] = move.moved
        leader = int(np.argmin(new["cost"][:running]))
        following = replace(
            state,
            **new,
            deviation=plans[leader].deviation,
            bread=plans[leader].bread,
            meat=plans[leader].meat,
            explained=int(plans[leader].kept.sum()),
            echo=plans[leader].echo,
            epochs=state.epochs + 1,
            control_steps=state.control_steps + self._epoch_steps(problem, state),
            failures=state.failures + sum(int((~around.whole).sum()) for around in slopes),
        )
        noise = float(np.median(plans[leader].deviation))
        metrics = {
            "residual": float(np.sqrt(new["cost"][leader])) * (noise if state.refining else 1.0),
            "moved": float(new["moved"][leader]),
            "noise": noise,
        }
        if not state.refining and (new["moved"][leader] < 1.0 or following.epochs >= self.search_epochs):
            order = np.argsort(np.arange(self.searches) != leader, kind="stable")
            new["damping"] = np.full(self.searches, FIRST_DAMPING)
            following = replace(following, **{name: new[name][order] for name in carried}, refining=1, epochs=0)
        return following, metrics

    @staticmethod
    def settled(state: EstimatedState) -> bool:
        """Whether the next step would change nothing worth a simulation; not where every window fails."""
        moves = not float(state.moved[0]) < 1.0 or float(state.cost[0]) >= FAILED_WINDOW
        return bool(state.refining) and state.epochs > STATES_FIRST and not moves

    def window_count(self, state: EstimatedState) -> int:
        """Windows of the stage."""
        return len(state.rows) if state.refining else min(self.search_windows, len(state.rows))

    def whole_run(self, problem: CalibrationProblem, state: EstimatedState, refining_epochs: int) -> int:
        """Control steps of a search as long as it may be, where it has yet to end, and of epochs on all windows."""
        searching, refining = (self._epoch_steps(problem, replace(state, refining=stage)) for stage in (0, 1))
        return searching * self.search_epochs * (1 - state.refining) + refining * refining_epochs

    def _epoch_steps(self, problem: CalibrationProblem, state: EstimatedState) -> int:
        """Control steps of an epoch of the stage: differences by parameters and states, and the steps tried."""
        running, parameters = 1 if state.refining else self.searches, state.unit.shape[1]
        columns = 1 + 2 * parameters + problem.states.physical_size + len(FOLLOWED) * (len(TRIALS) + 1)
        return running * self.window_count(state) * columns * self.horizon

    def _plan(
        self,
        slopes: WindowSlopes,
        unit: Float[np.ndarray, " d"],
        damping: float,
        state_damping: Float[np.ndarray, " windows"],
        readings: Readings,
        *,
        refining: bool,
    ) -> "_Plan":
        """What the slopes say: the noise, the steps to try, the curvature.

        While refining, channels weigh by their noise, and only windows that are `_trusted` move the parameters.
        """
        channels = len(readings.scale)
        least = np.full(len(state_damping), STATE_DAMPING_RANGE[0])
        alike = eliminate(slopes, np.ones_like(slopes.residuals), least)
        kept = slopes.whole
        deviation = _deviation(slopes, alike.spare, channels, kept)
        if refining:
            kept = self._trusted(slopes.over(np.tile(deviation, readings.steps + 1)), readings.activity)
            deviation = _deviation(slopes, alike.spare, channels, kept)
        else:
            deviation = np.full(channels, np.median(deviation))
        slopes = slopes.over(np.tile(deviation, readings.steps + 1))
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
        return _Plan(
            unit=unit,
            damping=damping,
            residuals=slopes.residuals,
            kept=kept,
            echo=echo(slopes.residuals.reshape(len(kept), -1, channels)[kept]),
            deviation=deviation,
            steps=np.stack(steps),
            state_steps=np.stack([damped.states_step(step) for step in steps]),
            activity=readings.activity,
            bread=curved,
            meat=at_least_noise(jackknife_meat(exact, share, curved), curved, ratio),
        )

    def _best(
        self, plan: "_Plan", residuals: Float[np.ndarray, "trials ways windows values"], *, waiting: bool
    ) -> "_Move":
        """Which step of the parameters helps most, each window's state following as far as fits it best."""
        costs = self._costs(residuals)
        if plan.kept.any():
            before, after = self._costs(plan.residuals)[plan.kept], costs.min(1)[:, plan.kept]
            robust = self.loss != "linear"
            change = clipped_change(before, after, plan.activity[plan.kept]) if robust else after - before
            totals = before.mean() + change.mean(-1)
        else:
            before, totals = np.array([FAILED_WINDOW]), costs.min(1).mean(-1)
        trial = len(TRIALS) if waiting else int(np.argmin(totals))
        better = bool(totals[trial] < totals[-1])
        trial = trial if better else len(TRIALS)
        saved = 1.0 - float(totals[trial]) / max(float(before.mean()), _SMALLEST)
        # A short step that helps, or none, says that the end is near only where no longer one is tried any more.
        tried = np.abs(plan.steps[0 if plan.damping <= STUCK else min(trial, len(TRIALS) - 1)])
        error = np.sqrt(np.maximum(np.diag(sandwich(plan.bread, plan.meat).covariance), 0.0))
        worthwhile = np.maximum(2.0 * max(self.tolerance, _SMALLEST), SETTLED * error)
        exact = float(plan.deviation.max()) < ROUNDING
        return _Move(
            trial=trial,
            followed=np.array(FOLLOWED)[costs[trial].argmin(0)],
            factor=TRIALS[trial] if better else 1.0 if waiting else 1e3,
            cost=float(totals[trial]),
            moved=max(float((tried / worthwhile).max()), 0.0 if exact else saved / LITTLE),
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
        middle, reach = unlike(costs[whole], activity[whole])
        kept = whole & (costs <= np.maximum(middle + reach, LIKE_NOISE))
        weights = loss_slope((slopes.residuals / TUNING[self.loss]) ** 2, self.loss)
        reduced = eliminate(slopes, weights, np.full(len(whole), STATE_DAMPING_RANGE[0])).reduced
        return kept if least_share(reduced.of(kept), reduced.of(whole)) > TOLD else whole

    def _costs(self, residuals: Float[np.ndarray, "*windows values"]) -> Float[np.ndarray, "*windows"]:
        """Mean loss of each window."""
        scale = TUNING[self.loss]
        with np.errstate(invalid="ignore", over="ignore"):
            cost = scale**2 * loss_value((residuals / scale) ** 2, self.loss).mean(-1)
        return np.where(np.isfinite(cost), np.minimum(cost, FAILED_WINDOW), FAILED_WINDOW)


@dataclass(frozen=True)
class _Plan:
    """What the slopes around a point say; residuals in deviations of the noise. The last step moves states alone."""

    unit: Float[np.ndarray, " d"]
    damping: float
    residuals: Float[np.ndarray, "windows values"]
    kept: Bool[np.ndarray, " windows"]
    echo: float
    deviation: Float[np.ndarray, " channels"]
    steps: Float[np.ndarray, "trials d"]
    state_steps: Float[np.ndarray, "trials windows state"]
    activity: Float[np.ndarray, " windows"]
    bread: Float[np.ndarray, "d d"]
    meat: Float[np.ndarray, "d d"]


@dataclass(frozen=True)
class _Move:
    """The step taken, and how far each window's state followed it."""

    trial: int
    followed: Float[np.ndarray, " windows"]
    factor: float
    cost: float
    moved: float


def clipped_change(
    before: Float[np.ndarray, " windows"],
    after: Float[np.ndarray, "trials windows"],
    activity: Float[np.ndarray, " windows"],
) -> Float[np.ndarray, "trials windows"]:
    """Change of the windows' costs; one that becomes worse, `unlike` the others, counts as the worst that is like.

    A window that a step takes across a contact becomes much worse until its state has followed, in later epochs; it
    alone does not forbid a step that helps the others. One whose simulation fails does.
    """
    change = after - before
    middle, reach = unlike(change, activity)
    return np.where(after < FAILED_WINDOW, np.minimum(change, np.maximum(middle + reach, LIKE_NOISE)), change)


def _left(cost: float, plan: _Plan) -> float:
    """What a search leaves, in typical changes; a window that failed counts as a whole one."""
    failed = 1.0 - float(plan.kept.mean())
    return ALL_FAILED if failed == 1.0 else cost * float(plan.deviation[0]) ** 2 + failed


def _deviation(
    slopes: WindowSlopes, spare: np.ndarray, channels: int, kept: Bool[np.ndarray, " windows"]
) -> Float[np.ndarray, " channels"]:
    """Each channel's noise in windows that are kept."""
    shape = (int(kept.sum()), slopes.residuals.shape[1] // channels, channels)
    return channel_noise(slopes.residuals[kept].reshape(shape), spare[kept].reshape(shape))


def _tried(
    problem: CalibrationProblem,
    readings: Readings,
    plans: list[_Plan],
    states: Float[np.ndarray, "searches windows state"],
) -> list[Float[np.ndarray, "trials ways windows values"]]:
    """Residuals after every step of every search, the windows' states moved along all the way, in part, or not."""
    ways = np.array(FOLLOWED)[:, None, None]
    starts = [
        state + ways * readings.in_state_units(plan.state_steps, states.shape[2])[:, None]
        for plan, state in zip(plans, states, strict=True)
    ]
    flat = np.concatenate(starts).reshape(-1, len(FOLLOWED) * len(readings), states.shape[2])
    units = np.concatenate([plan.unit + plan.steps for plan in plans])
    found = readings.residuals(problem.simulator, units, flat)
    found = found.reshape(len(plans), -1, *found.shape[1:])
    return [part / np.tile(plan.deviation, readings.steps + 1) for part, plan in zip(found, plans, strict=True)]
