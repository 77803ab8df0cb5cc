"""Every estimator of sensor noise, each with what it assumes; all return one standard deviation a channel.

Of attitudes it is that of small rotations, as in `simulation.attitudes`, but for `difference_noise`.

| estimator | from | assumes |
|---|---|---|
| `difference_noise` | the log alone | motion is smooth over five rows |
| `consecutive_noise` | one-step residuals of consecutive rows | their model errors do not alternate in sign |
| `residual_noise` | all residuals of a fit | the fit leaves nothing but noise |
| `channel_noise` | all residuals of a fit | most of them are noise |
"""

import numpy as np
from jaxtyping import Float, Int

from madoc.data.dataset import Dataset
from madoc.identification.losses import NORMAL_MAD, robust_deviation
from madoc.identification.states import states_observed_as
from madoc.simulation.attitudes import differences, moved
from madoc.simulation.base import Simulator

WHITE = 0.2
"""Autocorrelation in [-1, 1]; above it residuals are not white. It is four standard errors of 400 independent rows."""
OUTLIER = 5.0
"""Robust standard deviations to which residuals are clipped, as contacts turn small noise into large ones; of normal
values one in two million is larger."""
STEP = 1e-3
"""Change of an observation, in typical changes of a stride, by which the derivative of a control step is taken."""
SLOPE_LIMIT = 2.0
"""Largest derivative of a channel by itself over a control step; a contact's is larger, and is clipped to it."""
NOISY = 0.2
"""Alternation of residuals in [-1, 1]; above it logged states are noisy. Noise alone has about 0.5, and random forces
as large as it half of that."""
NOISY_STRIDE = 1e-3
"""Noise of a channel in its typical changes in a stride; above it logged states are noisy where rows are close."""
_BY_CHANCE = 3.0
"""Standard errors of a correlation, by which the most negative one of several channels may be so by chance."""
_SHORTEST = 5
"""Smallest number of rows of an episode; shorter ones have too few second differences and are left out."""
_STANDARD_ERRORS = 3.0
"""Ratio of a variance to its standard error; with a smaller one the noise counts as 0."""
_LEAST_SPARE = 0.05
"""1 - leverage of a reading, in [0, 1]; with less it is left out, as its residual is small whatever the noise."""
_LEAST_SHARE = 1e-3
"""Smallest deviation relative to the noisiest channel's: no channel has more than a million times another's weight."""
_SMALLEST = 1e-12
"""Smallest deviation in typical changes of a channel in a step; below it are rounding errors."""
_COUNTED = (5, 0.5)
"""Smallest number of distinct readings, and largest as a share of the rows, between which their step is looked for."""
_WHOLE = 0.05
"""Largest distance of a reading from a whole number of steps, in steps: logs are written with few digits."""


def difference_noise(dataset: Dataset) -> Float[np.ndarray, " observation"]:
    """Noise of a log whose motion is smooth, in each channel's unit: from how second differences alternate.

    Noise gives second differences of neighbouring rows the covariance -4 σ² and those of next neighbours σ². Smooth
    motion gives both the same; a position under a force that is held for a step makes (c₂ - c₁) / 5 smaller, a speed
    under one that is another in every step makes it larger. What is not significantly above 0 counts as 0.
    """
    observation = np.asarray(dataset.transitions.observation)
    parts = [
        np.diff(observation[start:end], 2, axis=0)
        for start, end in zip(dataset.episode_starts, dataset.episode_ends, strict=True)
        if end - start >= _SHORTEST
    ]
    if not parts:
        return np.zeros(observation.shape[1])
    limited = np.split(clipped(np.concatenate(parts)), np.cumsum([len(part) for part in parts[:-1]]))
    first = np.concatenate([part[1:-1] * part[:-2] for part in limited])
    second = np.concatenate([part[2:] * part[:-2] for part in limited])
    variance = (second - first).mean(0) / 5.0
    error = (second - first).std(0) / 5.0 / np.sqrt(len(first))
    return np.asarray(np.sqrt(np.where(variance > _STANDARD_ERRORS * error, variance, 0.0)))


def rounding_of(dataset: Dataset) -> Float[np.ndarray, " observation"]:
    """Deviation of the rounding of counts, a step over √12, in each channel's unit; 0 where no step is seen."""
    readings = np.asarray(dataset.transitions.observation)
    return np.array([resolution_of(column) for column in readings.T]) / np.sqrt(12.0)


def resolution_of(readings: Float[np.ndarray, " rows"]) -> float:
    """The step of which all differences of the readings are whole multiples, as of an encoder; 0 where none is seen."""
    values = np.unique(readings)
    fewest, most = _COUNTED
    if not fewest <= len(values) <= most * len(readings):
        return 0.0
    gaps, span = np.diff(values), float(values[-1] - values[0])
    gaps = gaps[gaps > 1e-7 * span]  # smaller ones are rounding errors
    least = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    step = span / max(1.0, np.round(span / least))
    counts = (values - values[0]) / step
    return step if np.abs(counts - np.round(counts)).max() < _WHOLE else 0.0


def consecutive_noise(
    first: Float[np.ndarray, "pairs observation"],
    second: Float[np.ndarray, "pairs observation"],
    slopes: Float[np.ndarray, "pairs observation"],
) -> Float[np.ndarray, " observation"]:
    """Noise from one-step residuals of consecutive rows, whose model errors do not alternate in sign.

    A step from a noisy state leaves r_t = A e_t - e_{t+1}, the next r_{t+1} = A e_{t+1} - e_{t+2}. They share one
    reading, with opposite signs: E[r_t r_{t+1}] = -A σ². A model error that does not alternate makes the estimate
    smaller, so it is never taken for noise. A channel that never depends on itself (A is 0 in all pairs), as a sensor
    of force that tells nothing of the state, leaves -e_{t+1} alone: there it is E[(r_{t+1} - r_t)²] / 2, in which a
    model error counts by how much it changes from row to row.

    `slopes` are A, the derivative of each channel by itself over a control step, as from `own_slopes`.
    """
    slope = np.clip(slopes, -SLOPE_LIMIT, SLOPE_LIMIT)
    weight = (slope**2).sum(0)
    shared = -(slope * first * second).sum(0) / np.where(weight > 0.0, weight, 1.0)
    alone = ((second - first) ** 2).mean(0) / 2.0
    return np.sqrt(np.maximum(np.where(weight > 0.0, shared, alone), 0.0))


def residual_noise(
    residuals: Float[np.ndarray, "windows readings channels"], unknowns: int
) -> Float[np.ndarray, " channels"]:
    """Noise from residuals of a fit that are nothing but noise: root of their mean square per degree of freedom.

    Windows that failed, with NaN, are left out; it is 0 if all did. `unknowns` were fitted to each window.
    """
    residuals = residuals[np.isfinite(residuals).all((1, 2))]
    values = residuals.shape[1] * residuals.shape[2]
    freedom = max(1, values - unknowns) / values
    return np.sqrt((residuals**2).mean((0, 1)) / freedom) if len(residuals) else np.zeros(residuals.shape[-1])


def channel_noise(
    residuals: Float[np.ndarray, "windows readings channels"], spare: Float[np.ndarray, "windows readings channels"]
) -> Float[np.ndarray, " channels"]:
    """Noise from residuals of a fit, most of which are noise: median |r| / √(1 - leverage), times 1.4826.

    A residual's variance is σ² (1 - leverage), whatever was fitted.

    Residuals are in typical changes of a stride, `spare` is 1 - leverage of each.
    """
    free = spare > _LEAST_SPARE
    scaled = np.where(free, residuals / np.sqrt(np.where(free, spare, 1.0)), np.nan)
    columns = np.abs(scaled).reshape(-1, scaled.shape[-1])
    finite = (column[np.isfinite(column)] for column in columns.T)
    deviation = np.array([robust_deviation(column) if column.size else 0.0 for column in finite])
    return np.maximum(deviation, max(_LEAST_SHARE * float(deviation.max()), _SMALLEST))


def clipped(residuals: Float[np.ndarray, "rows observation"]) -> Float[np.ndarray, "rows observation"]:
    """Residuals clipped at `OUTLIER` robust standard deviations of their channel; 0 in rows that failed."""
    finite = np.where(np.isfinite(residuals), residuals, 0.0)
    limit = OUTLIER * NORMAL_MAD * np.median(np.abs(finite), axis=0)
    return np.where(limit > 0.0, np.clip(finite, -limit, limit), finite)


def alternation(before: Float[np.ndarray, "pairs channels"], after: Float[np.ndarray, "pairs channels"]) -> float:
    """Minus the correlation of one-step residuals with the next row's, in the channel in which it is most negative.

    With noise e alone a residual is about e' - e, as the reading it starts at is noisy as well as the one it ends at.
    The next one is e'' - e', so the correlation is -1/2. A model error has the same sign in the next row. A speed that
    a servo or a contact holds forgets its noise in a row, so one channel is enough. Residuals are clipped at five
    robust standard deviations. It is 0 without pairs, and where chance may make as much.
    """
    if not len(before):
        return 0.0
    most = OUTLIER * NORMAL_MAD * np.maximum(np.median(np.abs(before), axis=0), _SMALLEST)
    first, second = (np.clip(part, -most, most) for part in (before, after))
    power = np.sqrt((first**2).mean(0) * (second**2).mean(0))
    largest = float((-(first * second).mean(0) / np.maximum(power, _SMALLEST**2)).max())
    return largest if largest > _BY_CHANCE / np.sqrt(len(before)) else 0.0


def own_slopes(
    simulator: Simulator,
    dataset: Dataset,
    point: Float[np.ndarray, " d"],
    rows: Int[np.ndarray, " rows"],
    scale: Float[np.ndarray, " observation"],
) -> Float[np.ndarray, "rows observation"]:
    """The derivative of each channel after a control step by the same channel before it; 0 where it is not computable.

    It is taken at parameters in [-1, 1] and rows with exact states. `scale` is a step's typical change of each channel.
    """
    moves = [np.zeros(len(scale)), *(STEP * np.diag(scale))]
    observation, attitudes = np.asarray(dataset.transitions.observation), simulator.task.attitudes
    readings = (moved(attitudes, observation, move) for move in moves)
    states = np.stack([states_observed_as(dataset, simulator.task, rows, each) for each in readings])
    action = np.asarray(dataset.transitions.action)[rows]
    system = simulator.bind(simulator.parameters.to_physical(point)[None])
    flat = states.reshape(1, -1, states.shape[-1])
    rebuilt = np.isfinite(flat).all(-1, keepdims=True)
    flat = np.where(rebuilt, flat, np.tile(states[:1], (len(moves), 1, 1)).reshape(flat.shape))
    after = system.observe(system.step(system.unbiased(flat), np.tile(action, (len(moves), 1))[None]))
    after = after.reshape(len(moves), len(rows), -1)
    change = differences(attitudes, after[1:], after[0])
    slopes = np.diagonal(change, axis1=0, axis2=2) / (STEP * scale)
    rebuilt = rebuilt.reshape(len(moves), len(rows))[1:].T
    return np.where(rebuilt & np.isfinite(slopes), slopes, 0.0)
