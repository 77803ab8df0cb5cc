"""What a search computes before and after a step, what it has found, and statistics of residuals, for all searches."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.data import stride
from madoc.identification.gauss_newton import TRIALS
from madoc.identification.information import Uncertainty
from madoc.identification.losses import ALL_FAILED, NORMAL_MAD
from madoc.identification.noise import NOISY_STRIDE, OUTLIER
from madoc.identification.replay import window_residuals
from madoc.identification.windows import consecutive_rows, windows_at

FEWEST = 5
"""Smallest number of windows beyond that of parameters; with fewer, Student's t would widen the intervals much."""
_SMALLEST = 1e-100
EXACT = 1e-6
"""Residual in typical changes of a stride; smaller ones mean that states were logged without noise."""
LONG_TAILS = 1.1
"""Cost of residuals, in squared standard deviations; above it they are not normal noise, whose cost is 0.8 with
Cauchy's loss and 1 with squares."""
_LARGEST = 3.0
"""Standard deviations of the noise at which residuals are clipped before they are correlated."""
_ROUNDING = 1e-12
"""Residual in typical changes of a channel; smaller ones are rounding errors."""
Residuals = Float[np.ndarray, "pairs channels"]


@dataclass(frozen=True)
class Plan:
    """Residuals and derivatives around a point, and the steps to try from there.

    Attributes:
        point: The point, in [-1, 1].
        residuals: The residuals of each window there, over `deviation`.
        relative: Weight of each window's residuals, in (0, 1], by which they are multiplied already.
        kept: Windows that move the parameters.
        steps: Steps of the parameters, one for each of `TRIALS`; the last is zero.
        state_steps: Steps of unknown initial states that go with each of these, in units of `spread`.
        spread: Standard deviation of each value of (qpos, qvel) over the log; empty where initial states are known.
        scale: The tuning constant c of the loss.
        deviation: Noise of each channel, in its typical changes.
        bread: Curvature of the cost.
        meat: Scatter of the cost's gradient.
        failures: Number of simulations that failed.
        autocorrelation: Correlation of residuals of consecutive readings.
        exact: Whether residuals are rounding errors, so that their size cannot show whether initial states still move.
        left_out: Share of the windows that the cost does not count.
        tail_cost: Cost with no noise below the rounding of counts; 0 while searching and for known states.
    """

    point: Float[np.ndarray, " d"]
    residuals: Float[np.ndarray, "windows values"]
    relative: Float[np.ndarray, " windows"]
    kept: Bool[np.ndarray, " windows"]
    steps: Float[np.ndarray, "trials d"]
    state_steps: Float[np.ndarray, "trials unknown physical"]
    spread: Float[np.ndarray, " physical"]
    scale: float
    deviation: Float[np.ndarray, " channels"]
    bread: Float[np.ndarray, "d d"]
    meat: Float[np.ndarray, "d d"]
    failures: int
    autocorrelation: float = 0.0
    exact: bool = True
    left_out: float = 0.0
    tail_cost: float = 0.0

    def comparable(self, cost: float) -> float:
        """A cost in typical changes, by which searches are compared; a window left out adds a whole change."""
        return ALL_FAILED if self.left_out == 1.0 else cost * float(self.deviation[0]) ** 2 + self.left_out


@dataclass(frozen=True)
class Found:
    """What a search has found.

    Attributes:
        point: The parameters, in [-1, 1].
        windows: Number of independent windows that tell it.
        settled: Whether the search has come to its end.
        unlike_noise: Whether residuals have longer tails than noise has, add up over longer windows, are each like the
            next, or follow from state and action.
        force: Size of random forces in N/√kg (`identification.random_forces`); 0 where none were found.
        shorter_steps: By how much the parameters of a filter move without the timestep's error, unless the log is
            likelier with it.
    """

    point: Float[np.ndarray, " d"]
    uncertainty: Uncertainty
    windows: int
    settled: bool
    unlike_noise: bool
    force: float = 0.0
    shorter_steps: Float[np.ndarray, " d"] | float = 0.0


@dataclass(frozen=True)
class Outcome:
    """The costs after the steps of a plan.

    Attributes:
        before: Cost at the plan's point.
        totals: Cost after each step that was tried; the last has no step of the parameters.
        followed: Share of its initial state's step that fits each window best, where initial states are unknown.
        failures: Number of simulations that failed.
    """

    before: float
    totals: Float[np.ndarray, " trials"]
    followed: Float[np.ndarray, "trials unknown"]
    failures: int

    def with_no_step(self) -> "Outcome":
        """The same with the cost of staying where the plan is, as the last step."""
        return replace(
            self,
            totals=np.append(self.totals, self.before),
            followed=np.concatenate([self.followed, np.zeros_like(self.followed[:1])]),
        )

    def saved(self, trial: int) -> float:
        """Share of the cost that a step saves."""
        return 1.0 - float(self.totals[trial]) / max(self.before, _SMALLEST)

    def chosen(self) -> tuple[int, float]:
        """Index of the step with the smallest cost, the last one for none, and the factor of the damping."""
        last = len(self.totals) - 1
        trial = int(np.argmin(self.totals))
        return (trial, TRIALS[trial]) if self.totals[trial] < self.totals[last] else (last, 1e3)


def outlier_limits(
    values: Float[np.ndarray, "*rows windows"], activity: Float[np.ndarray, " windows"]
) -> tuple[Float[np.ndarray, "*rows 1"], Float[np.ndarray, "*rows 1"]]:
    """The median of windows' values, and the distance from it beyond which a window is an outlier.

    That is `OUTLIER` robust standard deviations. Windows are weighted by their activity: those in which nothing moves
    are all alike, whatever the parameters.
    """
    weights = activity + np.finfo(float).tiny

    def medians(part: np.ndarray) -> np.ndarray:
        return np.quantile(part, 0.5, axis=-1, weights=weights, method="inverted_cdf", keepdims=True)

    middle = medians(values)
    return middle, OUTLIER * NORMAL_MAD * medians(np.abs(values - middle))


def touched(
    problem: CalibrationProblem, rows: Int[np.ndarray, " windows"], horizon: int
) -> Bool[np.ndarray, " windows"]:
    """Whether bodies were in contact at any state of a window, from its first to its last, that is known about."""
    states, known = problem.states.guesses()
    ends = problem.dataset.episode_ends[problem.dataset.episode_of(rows)]
    touching = np.zeros(len(rows), dtype=bool)
    for later in range(horizon + 1):
        there = np.minimum(rows + later, ends - 1)
        place = np.minimum(np.searchsorted(known, there), len(known) - 1)
        touching |= (problem.simulator.contacts(states[place]) > 0) & (known[place] == there)
    return touching


def without_contacts(
    problem: CalibrationProblem, rows: Int[np.ndarray, " windows"], horizon: int
) -> Int[np.ndarray, " free"]:
    """Rows of windows in which the log shows no contact, or all where these are too few or fewer than the others."""
    free = rows[~touched(problem, rows, horizon)]
    return free if len(free) >= max(FEWEST + len(problem.simulator.parameters), len(rows) / 2) else rows


def clipped_change(
    before: Float[np.ndarray, " windows"],
    after: Float[np.ndarray, "trials windows"],
    activity: Float[np.ndarray, " windows"],
    *,
    least: float,
    failed: float,
) -> Float[np.ndarray, "trials windows"]:
    """Change of the windows' costs, outliers that become worse clipped to the largest change that is none.

    A window that a step takes across a contact becomes much worse until its initial state has followed, in later
    epochs; it alone does not forbid a step that helps the others. One whose simulation fails does.

    The costs `before` are compared with those `after` each of the steps tried. A change up to `least` is never clipped;
    `failed` is the cost of a window whose simulation failed.
    """
    change = after - before
    middle, reach = outlier_limits(change, activity)
    return np.where(after < failed, np.minimum(change, np.maximum(middle + reach, least)), change)


def noise_ratio(
    residuals: Float[np.ndarray, "windows values"],
    weights: Float[np.ndarray, "windows values"],
    share: float,
    freedom: float,
) -> float:
    """Variance of ψ, the gradient of a reading's loss, over its mean curvature ψ'; 1 for squares of deviations."""
    pull = ((weights * residuals) ** 2).sum() / max(1.0, freedom)
    curvature = share * weights.sum() / max(1, weights.size)
    return float(pull / max(curvature, _ROUNDING))


def autocorrelation(residuals: Float[np.ndarray, "windows readings channels"]) -> float:
    """Largest correlation, over channels, of a reading's residual with the next reading's.

    It is 0 for white noise, and positive for model errors. Residuals are in standard deviations of the noise and
    clipped at three of them; a channel with smaller residuals than its noise counts as uncorrelated.
    """
    clipped = np.clip(residuals, -_LARGEST, _LARGEST)
    power = np.maximum((clipped**2).sum((0, 1)), clipped[..., 0].size)
    return float(((clipped[:, 1:] * clipped[:, :-1]).sum((0, 1)) / power).max())


def consecutive_residuals(
    problem: CalibrationProblem, point: Float[np.ndarray, " d"], rows: Int[np.ndarray, " windows"]
) -> tuple[Residuals, Residuals]:
    """One-step residuals from logged states and from those a row later.

    `point` are parameters in [-1, 1], `rows` have a logged state; those without one a row later are left out.
    """
    states, known = problem.states.exact()
    first = np.searchsorted(known, rows)
    first = first[np.isin(first, consecutive_rows(problem.dataset, known))]
    both = np.concatenate([first, first + 1])
    windows = windows_at(problem.dataset, states[both], known[both], 1)
    residuals = window_residuals(problem.simulator, windows, point[None], problem.typical_change)[0]
    pairs = residuals.reshape(2, len(first), residuals.shape[-1])
    before, after = pairs[:, np.isfinite(pairs).all((0, 2))]
    return before, after


def noisy_rows(problem: CalibrationProblem) -> bool:
    """Whether noise hides the motion from row to row, in a log whose rate is high for its robot.

    There noise need not alternate: steps of an encoder and filters of a drive last for several rows.
    """
    loud = problem.noise_by_differences > NOISY_STRIDE * problem.typical_change
    return stride(problem.dataset) > 1 and bool(loud.any())
