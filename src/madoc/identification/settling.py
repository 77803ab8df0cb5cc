"""Initial states of windows fitted at given parameters, by differences that are first as wide as the states' errors.

At a contact the derivative at a noisy state is not that around it: a foot just above the ground feels nothing of it. A
descent by narrow differences ends in the nearest of many minima, so that the states, and with them the parameters, are
biased. Differences as wide as the errors tell the average slope (statistical linearisation, Gelb 1974, section 6.2);
they are narrowed from step to step, as the filters that iterate it do (Garcia-Fernandez et al. 2015).
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Bool, Float

from madoc.identification.gauss_newton import (
    FIRST_DAMPING,
    LEAST_DAMPING,
    TRIALS,
    left_by_states,
    states_errors,
    states_steps,
)
from madoc.identification.linearisation import DIFFERENCE, WindowSlopes
from madoc.identification.losses import TUNING, Loss, loss_slope, loss_value
from madoc.identification.noise import channel_noise
from madoc.identification.replay import Readings, slopes_at
from madoc.simulation.base import Simulator

WIDTHS = (3.0, 3.0, 1.5, 0.7, 0.3, 0.1, 0.0, 0.0)
"""Widths of the differences from step to step, in standard errors of the initial states; 0 is `DIFFERENCE`."""
RESETTLING = (1.0, 0.3, 0.0)
"""The same where initial states are nearly right, as drawn by an ensemble."""
FIT_STEPS = 10
"""Largest number of steps by narrow differences."""
GAIN = 0.01
"""Share in (0, 1] of a window's cost; after a step that saves less its initial state is fitted."""
ANEW = 2
"""Number of times that windows whose residuals are more than noise begin anew near the guess of their state, in the fit
for prediction and, after once at the guess itself, in tests of a model."""
FARTHEST = 30.0
"""Largest error of a guess in standard errors of the state: that of a velocity that jumps between two positions."""
BEYOND = 3.0
"""Standard deviations of a window's cost under noise alone, above its mean; a higher cost is more than noise."""
WORTH_MORE = 0.1
"""Smallest share in [0, 1] of the windows left with more than noise that a new beginning explains if another is to
follow."""
FEW = 0.01
"""Share in [0, 1] of the windows whose residuals are more than noise, up to which nothing further is tried."""
DAMPING_RANGE = (1e-9, 1e6)
"""Smallest and largest relative damping of an initial state's step; it is clipped to them."""
WIDE_DAMPING = 1.0
"""Largest relative damping after a step by wide differences, as the next ones are of other slopes."""
FAILED_WINDOW = 1e6
"""Cost of a window whose simulation failed, in squared standard deviations of the noise; no cost is larger."""


@dataclass(frozen=True)
class Settled:
    """Initial states after a step.

    Attributes:
        states: Each window's.
        damping: Relative damping of each window's next step.
        errors: Standard error of each value of (qpos, qvel), median over the windows, in standard deviations of the
            value over the log; at most 1.
        deviation: Noise of each channel, in its typical changes: what no initial state explains, to first order.
        costs: Mean loss of each window's residuals after the step, in squared standard deviations of the noise.
        gaining: Windows whose cost the step lowered by more than `GAIN`.
        failures: Windows whose simulation failed before it.
    """

    states: Float[np.ndarray, "windows state"]
    damping: Float[np.ndarray, " windows"]
    errors: Float[np.ndarray, " physical"]
    deviation: Float[np.ndarray, " channels"]
    costs: Float[np.ndarray, " windows"]
    gaining: Bool[np.ndarray, " windows"]
    failures: int

    def unexplained(self, values: int, loss: Loss) -> Bool[np.ndarray, " windows"]:
        """Windows of so many values whose residuals are more than noise."""
        mean, deviation = cost_of_noise(loss)
        return self.costs > mean + BEYOND * deviation / np.sqrt(values)


def settle(
    simulator: Simulator,
    readings: Readings,
    point: Float[np.ndarray, " d"],
    states: Float[np.ndarray, "windows state"],
    damping: Float[np.ndarray, " windows"],
    width: Float[np.ndarray, " physical"],
    loss: Loss,
) -> Settled:
    """One damped Gauss-Newton step of every window's initial state, of the damping of `TRIALS` that fits it best.

    `width` is that of the differences, in standard deviations of each value over the log, at least `DIFFERENCE`. It
    takes 1 + n + 3 simulations of every window, for states of n values.
    """
    (slopes,) = slopes_at(simulator, readings, point[None], states[None], parameters=False, width=width)
    deviation, errors = _noise_and_errors(slopes, readings)
    scaled = slopes.over(np.tile(deviation, readings.steps + 1))
    weights = loss_slope((scaled.residuals / TUNING[loss]) ** 2, loss) * scaled.whole[:, None]
    tried = np.maximum(np.array(TRIALS)[:, None] * damping, LEAST_DAMPING)
    steps = states_steps(scaled, weights, tried)
    moved = states + readings.in_state_units(steps, states.shape[1])
    after = readings.residuals(simulator, point[None], moved.reshape(1, -1, states.shape[1]))[0]
    whole = np.where(slopes.whole[:, None], slopes.residuals, np.nan)
    costs = window_costs(np.concatenate([after, whole[None]]) / np.tile(deviation, readings.steps + 1), loss)
    best = costs.argmin(0)
    factor = np.array([*TRIALS, TRIALS[-1]])[best]
    most = WIDE_DAMPING if (width > DIFFERENCE).any() else DAMPING_RANGE[1]
    return Settled(
        states=np.concatenate([moved, states[None]])[best, np.arange(len(states))],
        damping=np.clip(damping * factor, DAMPING_RANGE[0], most),
        errors=errors,
        deviation=deviation,
        costs=costs.min(0),
        gaining=costs.min(0) < (1.0 - GAIN) * costs[-1],
        failures=int((~slopes.whole).sum()),
    )


def fitted_states(
    simulator: Simulator,
    readings: Readings,
    point: Float[np.ndarray, " d"],
    guesses: Float[np.ndarray, "windows state"],
    loss: Loss,
    most: int = FIT_STEPS,
) -> Float[np.ndarray, "windows state"]:
    """Initial states after steps by narrow differences: each step moves the windows that the last one gained on.

    They end after `most` of them, or once hardly any window is left.
    """
    states, damping = guesses.copy(), np.full(len(guesses), FIRST_DAMPING)
    moving, narrow = np.arange(len(guesses)), np.zeros(len(readings.spread))
    for _ in range(most):
        part = readings.of(moving)
        after = settle(simulator, part, point, states[moving], damping[moving], narrow, loss)
        states[moving], damping[moving] = after.states, after.damping
        moving = moving[after.gaining]
        if len(moving) <= FEW * len(readings):
            break
    return states


def restart(
    simulator: Simulator,
    readings: Readings,
    point: Float[np.ndarray, " d"],
    guesses: Float[np.ndarray, "windows state"],
    before: Settled,
    loss: Loss,
    random: np.random.Generator | None,
) -> Settled:
    """Settle anew the windows whose residuals are more than noise, and keep what fits each of them better.

    They begin at their guess, without `random` at that itself, and else with a normal error of the size of the states'
    standard errors or of up to `FARTHEST` times that: where velocities jump, guesses may be far off.
    """
    worse = np.flatnonzero(before.unexplained(readings.observed[0].size, loss))
    if not len(worse):
        return before
    part = readings.of(worse)
    error = np.zeros((len(worse), len(before.errors)))
    if random is not None:
        size = FARTHEST ** random.random((len(worse), 1)) * before.errors
        error = np.minimum(size, 1.0) * random.standard_normal(error.shape)
    states = guesses[worse] + readings.in_state_units(error, guesses.shape[1])
    damping = np.full(len(worse), FIRST_DAMPING)
    for width in WIDTHS:
        after = settle(simulator, part, point, states, damping, width * before.errors, loss)
        states, damping = after.states, after.damping
    residuals = part.residuals(simulator, point[None], states[None])[0, 0]
    costs = window_costs(residuals / np.tile(before.deviation, readings.steps + 1), loss)
    better = costs < before.costs[worse]
    new_states, new_damping, new_costs = before.states.copy(), before.damping.copy(), before.costs.copy()
    chosen = worse[better]
    new_states[chosen], new_damping[chosen], new_costs[chosen] = states[better], damping[better], costs[better]
    return replace(before, states=new_states, damping=new_damping, costs=new_costs)


def settled(
    simulator: Simulator,
    readings: Readings,
    point: Float[np.ndarray, " d"],
    guesses: Float[np.ndarray, "windows state"],
    widths: tuple[float, ...],
    anew: int,
) -> Settled:
    """Initial states after steps by differences of these widths, in standard errors, and so many new beginnings."""
    states, damping, errors = guesses, np.full(len(guesses), FIRST_DAMPING), np.zeros(len(readings.spread))
    for width in widths:
        after = settle(simulator, readings, point, states, damping, width * errors, "cauchy")
        states, damping, errors = after.states, after.damping, after.errors
    for again in range(anew):
        after = restart(simulator, readings, point, guesses, after, "cauchy", np.random.default_rng(again))
    return after


def settled_to_noise(
    simulator: Simulator,
    readings: Readings,
    point: Float[np.ndarray, " d"],
    guesses: Float[np.ndarray, "windows state"],
) -> Settled:
    """Initial states after a few steps and, of windows that are then left with more than noise, new beginnings.

    The first of these is at the guess, the others near it. They end once residuals of nearly all windows are noise, or
    one of them explains hardly any more windows: what is left then has another cause.
    """
    widths, values = (0.0, *RESETTLING), readings.observed[0].size
    after = settled(simulator, readings, point, guesses, widths, 0)
    left = after.unexplained(values, "cauchy").sum()
    for random in (None, *map(np.random.default_rng, range(ANEW))):
        if left <= FEW * len(readings):
            break
        after = restart(simulator, readings, point, guesses, after, "cauchy", random)
        before, left = left, after.unexplained(values, "cauchy").sum()
        if left > (1.0 - WORTH_MORE) * before:
            break
    return after


@cache
def cost_of_noise(loss: Loss) -> tuple[float, float]:
    """Mean and standard deviation of the loss of a value that is normal noise, in squared standard deviations of it."""
    at, weights = np.polynomial.hermite_e.hermegauss(100)
    weights, losses = weights / weights.sum(), window_costs(at[:, None], loss)
    mean = float(weights @ losses)
    return mean, float(np.sqrt(weights @ (losses - mean) ** 2))


def window_costs(residuals: Float[np.ndarray, "*windows values"], loss: Loss) -> Float[np.ndarray, "*windows"]:
    """Mean loss of each window's residuals in standard deviations of the noise, at most `FAILED_WINDOW`."""
    with np.errstate(invalid="ignore", over="ignore"):
        cost = TUNING[loss] ** 2 * loss_value((residuals / TUNING[loss]) ** 2, loss).mean(-1)
    return np.where(np.isfinite(cost), np.minimum(cost, FAILED_WINDOW), FAILED_WINDOW)


def _noise_and_errors(
    slopes: WindowSlopes, readings: Readings
) -> tuple[Float[np.ndarray, " channels"], Float[np.ndarray, " physical"]]:
    """Noise of each channel by what initial states cannot explain, and the states' standard errors that follow."""
    whole = slopes.whole
    left = (part.reshape(-1, *readings.observed.shape[1:])[whole] for part in left_by_states(slopes))
    deviation = channel_noise(*left)
    if not whole.any():
        return deviation, np.zeros(len(readings.spread))
    errors = states_errors(slopes.by_states[whole] / np.tile(deviation, readings.steps + 1)[:, None])
    return deviation, np.minimum(np.median(errors, axis=0), 1.0)
