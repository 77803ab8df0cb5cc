"""An emulator of the next row given a window and parameters, and the moments by which rows tell parameters.

The emulator is linear in the parameters, y = m(w) + J(w) u + noise of variance v(w), and m, J and v are a network's.
What a set of rows says of u is then a few means over its rows, however many they are and in whatever order.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree
from sklearn.covariance import ledoit_wolf

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.free_rollouts import rows_compared
from madoc.learning import replay
from madoc.learning.networks import Network, Scalar, falling_adam, minimise, standardise

LOG_VARIANCE_RANGE = (-14.0, 6.0)
"""Range of the log variance of the standardised next row; values beyond it are clipped."""
Windows = Float[Array, "*rows window"]
Following = Float[Array, "*rows observation"]
Scaled = Float[Array, "*rows d"]
Moments = tuple[Float[Array, "*sets moments"], Float[Array, "*sets moments d"], Float[Array, "*sets"]]
"""Mean of each moment over a set of rows, its derivative by the parameters, and the number of rows."""

PRIOR_PRECISION = 3.0
"""Of a value that is uniform in [-1, 1], whose variance is a third."""
_LEAST_VARIANCE = 1e-12
"""Added to variances of what may not vary."""
Points = Float[np.ndarray, "draws d"]
_BLOCK = 2000
"""Logged windows whose moments are in memory at a time."""


class Emulator(eqx.Module):
    """The next row under parameters u = (ξ - middle) / half, ξ being scaled to [-1, 1] of the prior's box.

    Attributes:
        network: window, standardised -> m, J and the logarithm of v, one after another.
        offset: Offset of a window's features.
        scale: Scale of a window's features.
        unit: Scale of the next row's features.
        middle: Middle of the box of parameters in which it is trained.
        half: Half of the box's width.
    """

    network: Network
    offset: Float[Array, " window"]
    scale: Float[Array, " window"]
    unit: Float[Array, " observation"]
    middle: Float[Array, " d"]
    half: Float[Array, " d"]

    def parts(self, windows: Windows) -> tuple[Following, Float[Array, "*rows observation d"], Following]:
        """m, J and v at windows, in units of `unit`."""
        count, size = self.middle.shape[0], self.unit.shape[0]
        outputs = self.network(standardise(windows, self.offset, self.scale))
        mean, slopes, log_variance = jnp.split(outputs, [size, size * (count + 1)], axis=-1)
        variance = jnp.exp(jnp.clip(log_variance, *LOG_VARIANCE_RANGE))
        return mean, slopes.reshape(*slopes.shape[:-1], size, count), variance

    def point(self, scaled: Scaled) -> Scaled:
        """Parameters in [-1, 1] of the prior's box, in units of this emulator's box."""
        return standardise(scaled, self.middle, self.half)


def fresh_emulator(window: int, observation: int, count: int, hidden: tuple[int, ...], key: PRNGKeyArray) -> Emulator:
    """An untrained emulator on the whole box of `count` parameters."""
    network = Network(window, observation * (count + 2), hidden, key=key)
    return Emulator(
        network, jnp.zeros(window), jnp.ones(window), jnp.ones(observation), jnp.zeros(count), jnp.ones(count)
    )


def standardised(emulator: Emulator, rows: replay.Replay) -> Emulator:
    """The emulator with the offsets and scales of the rows that it is to be trained on."""
    written = np.arange(rows.capacity) < int(rows.written)
    window, following = (np.asarray(rows.rows[name], np.float64)[written] for name in ("window", "following"))
    parts = (window.mean(0), np.maximum(window.std(0), 1e-3), np.maximum(following.std(0), 1e-6))
    return eqx.tree_at(
        lambda net: (net.offset, net.scale, net.unit), emulator, tuple(jnp.asarray(part, jnp.float32) for part in parts)
    )


def moved(emulator: Emulator, middle: Float[np.ndarray, " d"], half: Float[np.ndarray, " d"]) -> Emulator:
    """The same emulator in units of another box: m takes what J says of the move, and J its new unit."""
    size, count = len(emulator.unit), len(middle)
    shift = (jnp.asarray(middle, jnp.float32) - emulator.middle) / emulator.half
    ratio = jnp.asarray(half, jnp.float32) / emulator.half

    def recentred(values: Array) -> Array:
        mean, slopes, rest = jnp.split(values, [size, size * (count + 1)])
        slopes = slopes.reshape(size, count, *values.shape[1:])
        mean = mean + jnp.tensordot(slopes, shift, axes=([1], [0]))
        scaled = slopes * ratio.reshape(1, count, *[1] * (values.ndim - 1))
        return jnp.concatenate([mean, scaled.reshape(size * count, *values.shape[1:]), rest])

    last = emulator.network.layers[-1]
    assert last.bias is not None
    box = (jnp.asarray(middle, jnp.float32), jnp.asarray(half, jnp.float32))
    return eqx.tree_at(
        lambda net: (net.network.layers[-1].weight, net.network.layers[-1].bias, net.middle, net.half),
        emulator,
        (recentred(last.weight), recentred(last.bias), *box),
    )


def emulation_loss(emulator: Emulator, window: Windows, following: Following, scaled: Scaled) -> Scalar:
    """Mean β-NLL (Seitzer et al. 2022, β = 0.5) of next rows; plain likelihood would give up rows that it errs in."""
    mean, slopes, variance = emulator.parts(window)
    unit = jnp.broadcast_to(jax.lax.stop_gradient(emulator.unit), following.shape)
    error = following / unit - mean - jnp.einsum("nod,nd->no", slopes, emulator.point(scaled))
    each = 0.5 * (error**2 / variance + jnp.log(variance))
    return (jax.lax.stop_gradient(jnp.sqrt(variance)) * each).sum(-1).mean()


@eqx.filter_jit
def train(
    emulator: Emulator,
    optimiser_state: PyTree,
    rows: replay.Replay,
    key: PRNGKeyArray,
    *,
    learning_rate: float,
    updates: int,
    horizon: int,
    batch: int,
) -> tuple[Emulator, PyTree, Scalar]:
    """`updates` updates on simulated rows, with a rate that falls to 0 over `horizon` of them; also the mean loss."""

    def loss_of(emulator: Emulator, key: PRNGKeyArray) -> Scalar:
        drawn = replay.sample(rows, key, batch)
        return emulation_loss(emulator, drawn["window"], drawn["following"], drawn["scaled"])

    optimiser = falling_adam(learning_rate, horizon)
    return minimise(loss_of, emulator, optimiser_state, key, optimiser=optimiser, count=updates)


class Cosines(eqx.Module):
    """Features of a standardised observation of which only the distribution is known: itself, and random cosines."""

    frequencies: Float[Array, "observation features"]
    phases: Float[Array, " features"]

    def __call__(self, observation: Following) -> Float[Array, "*rows moments"]:
        """Features of each row."""
        angles = observation @ self.frequencies + jnp.broadcast_to(
            self.phases, (*observation.shape[:-1], len(self.phases))
        )
        return jnp.concatenate([observation, jnp.sqrt(2.0) * jnp.cos(angles)], axis=-1)


def cosines(key: PRNGKeyArray, observation: int, count: int, widths: tuple[float, ...]) -> Cosines:
    """Random frequencies of Gaussian kernels of each width in turn, in units of √observation, and uniform phases."""
    of_frequencies, of_phases = jax.random.split(key)
    scales = jnp.sqrt(float(observation)) * jnp.asarray(np.resize(widths, count), jnp.float32)
    frequencies = jax.random.normal(of_frequencies, (observation, count)) / scales[None]
    return Cosines(frequencies, jax.random.uniform(of_phases, (count,), maxval=2.0 * np.pi))


@eqx.filter_jit
def moments(
    emulator: Emulator,
    window: Float[Array, "sets rows window"],
    following: Float[Array, "sets rows observation"],
    weight: Float[Array, "sets rows"],
    unpaired: tuple[Cosines, Float[Array, " observation"]] | None,
) -> Moments:
    """Weighted means over each set of rows of moments, which at the true u are their slopes times u, and of the slopes.

    Where windows and next rows belong together, moments are the score of the emulator's likelihood, Jᵀ (y - m) / v, and
    the standardised errors (y - m) / √v: they ask how the next row depends on the window, not where the policy goes.
    Where they do not (`unpaired`, with the scale of a next row in standardised observations), moments are the mean
    features of next observations less those that the emulator expects after the same windows. A mean over all rows
    knows no pairs.
    """

    def of_set(parts: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        windows, followings, weights = parts
        values, slopes = (
            _of_pairs(emulator, windows, followings)
            if unpaired is None
            else _of_marginals(emulator, windows, followings, *unpaired)
        )
        total = weights.sum()
        share = weights / jnp.maximum(total, 1e-9)
        return share @ values, jnp.tensordot(share, slopes, axes=([0], [0])), total

    return jax.lax.map(of_set, (window, following, weight))


def _of_pairs(emulator: Emulator, window: Windows, following: Following) -> tuple[Array, Array]:
    mean, slopes, variance = emulator.parts(window)
    error = following / jnp.broadcast_to(emulator.unit, following.shape) - mean
    deviation = jnp.sqrt(variance)
    whitened, of_slopes = error / deviation, slopes / deviation[..., None]
    score = jnp.einsum("nod,no->nd", of_slopes, whitened)
    information = jnp.einsum("nod,noe->nde", of_slopes, of_slopes)
    return jnp.concatenate([score, whitened], axis=-1), jnp.concatenate([information, of_slopes], axis=1)


def _of_marginals(
    emulator: Emulator, window: Windows, following: Following, features: Cosines, ratio: Float[Array, " observation"]
) -> tuple[Array, Array]:
    mean, slopes, _ = emulator.parts(window)
    seen = window[:, : len(ratio)]
    step = jnp.broadcast_to(emulator.unit * ratio, mean.shape)
    expected = seen + mean * step
    tangents = jnp.moveaxis(slopes * step[..., None], -1, 0)
    of_slopes = jax.vmap(lambda tangent: jax.jvp(features, (expected,), (tangent,))[1])(tangents)
    arrived = seen + following * jnp.broadcast_to(ratio, following.shape)
    return features(arrived) - features(expected), jnp.moveaxis(of_slopes, 0, -1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sets:
    """Moments of sets of rows: their means, the slopes of these by a point, and how many rows they are of."""

    values: Float[np.ndarray, "*sets moments"]
    slopes: Float[np.ndarray, "*sets moments d"]
    rows: Float[np.ndarray, "*sets"]

    def joined(self, axis: int) -> "Sets":
        """The sets along an axis as one."""
        total = np.asarray(self.rows.sum(axis))
        share = self.rows / np.maximum(np.expand_dims(total, axis), 1e-9)
        return Sets((share[..., None] * self.values).sum(axis), (share[..., None, None] * self.slopes).sum(axis), total)


def errors_of(sets: Sets, points: Float[np.ndarray, "*sets d"]) -> Float[np.ndarray, "*sets moments"]:
    """What moments differ by from what the points that their rows were simulated under make of them, T - J u."""
    return sets.values - (sets.slopes @ points[..., None])[..., 0]


@dataclass(frozen=True)
class Reader:
    """How moments are read: as a log's whose rows have these slopes would be.

    It is the generalised method of moments (Hansen 1982) with the prior's precision, (JᵀWJ + 3)⁻¹ JᵀW. Rows of a small
    set may have slopes that tell little or much; with the log's, all draws are read alike.

    Attributes:
        slopes: J, the slopes of the log's moments by a point.
        bias: Mean of the moments at the true point.
        precision: W, the inverse of their covariance about it.
    """

    slopes: Float[np.ndarray, "moments d"]
    bias: Float[np.ndarray, " moments"]
    precision: Float[np.ndarray, "moments moments"]

    @classmethod
    def of(cls, slopes: Float[np.ndarray, "moments d"], errors: Float[np.ndarray, "draws moments"]) -> "Reader":
        """The reader of a log, given how moments err at known points; the covariance is Ledoit and Wolf's (2004)."""
        bias, scale = errors.mean(0), np.sqrt(errors.var(0) + _LEAST_VARIANCE)
        covariance = ledoit_wolf((errors - bias) / scale, assume_centered=True)[0]
        covariance = covariance + _LEAST_VARIANCE * np.eye(len(scale))
        return cls(slopes, bias, np.linalg.inv(covariance) / scale / scale[:, None])

    def statistic(self, values: Float[np.ndarray, "*sets moments"]) -> Float[np.ndarray, "*sets d"]:
        """The point that a log with these moments is read as."""
        weighted = self.slopes.T @ self.precision
        information = weighted @ self.slopes + PRIOR_PRECISION * np.eye(self.slopes.shape[1])
        return (values - self.bias) @ np.linalg.solve(information, weighted).T

    def misfit(self, values: Float[np.ndarray, "*sets moments"]) -> Float[np.ndarray, "*sets"]:
        """Squared Mahalanobis distance of moments from those at the point that they are read as (Hansen's J)."""
        off = values - self.bias - self.statistic(values) @ self.slopes.T
        return np.asarray(np.einsum("...i,ij,...j->...", off, self.precision, off))


def less_noisy(statistics: Points, points: Points, noise: Float[np.ndarray, "d d"], share: float) -> Points:
    """Statistics of small sets as those of a set with `share` of their sampling noise would be.

    A log has many more rows than one draw: what is left of its statistic's error is what the emulator does wrong. The
    error about a linear regression on the points is scaled until its covariance C is C - (1 - share) `noise`. Draws do
    not tell C any better than to one part in their number's square root, so no variance shrinks to less than that.
    """
    design = np.concatenate([np.ones((len(points), 1)), points], axis=1)
    fitted = design @ np.linalg.lstsq(design, statistics, rcond=None)[0]
    errors = statistics - fitted
    covariance = errors.T @ errors / max(1, len(errors) - design.shape[1]) + _LEAST_VARIANCE * np.eye(points.shape[1])
    root = np.linalg.cholesky(covariance)
    inverse = np.linalg.inv(root)
    parts, axes = np.linalg.eigh(inverse @ noise @ inverse.T)
    left = np.sqrt(np.clip(1.0 - (1.0 - share) * parts, 1.0 / np.sqrt(len(points)), 1.0))
    return fitted + errors @ inverse.T @ (axes * left) @ axes.T @ root.T


def unpaired(problem: CalibrationProblem) -> bool:
    """Whether it is not known which next observation belongs to which row."""
    return problem.dataset.disturbance.shuffled == "next_observations"


def set_moments(
    problem: CalibrationProblem,
    emulator: Emulator,
    features: Cosines,
    window: Float[np.ndarray, "*sets rows window"],
    following: Float[np.ndarray, "*sets rows observation"],
    counted: Bool[np.ndarray, "*sets rows"],
) -> Sets:
    """Moments of sets of rows, of the rows that are `counted`."""
    scaling, _ = problem.features.windows("standardised", rows_compared(problem))
    ratio = jnp.asarray(scaling.next_scale / scaling.scaling.pair_scale[: following.shape[-1]], jnp.float32)
    sets = counted.shape[:-1]
    windows, followings, weights = (
        jnp.asarray(part.reshape(-1, *part.shape[len(sets) :]), jnp.float32) for part in (window, following, counted)
    )
    marginals = (features, ratio) if unpaired(problem) else None
    means = moments(emulator, windows, followings, weights, marginals)
    return Sets(*(np.asarray(part, np.float64).reshape(*sets, *part.shape[1:]) for part in means))


def logged_moments(problem: CalibrationProblem, emulator: Emulator, features: Cosines) -> Sets:
    """Moments of the whole log. Where pairs are unknown, all of its rows still have all of its next observations."""
    window, following = map(np.asarray, problem.features.windows("standardised", rows_compared(problem))[1])
    count, block = len(window), min(_BLOCK, len(window))
    index = np.arange(count + -count % block).reshape(-1, block)
    rows = np.minimum(index, count - 1)
    return set_moments(problem, emulator, features, window[rows], following[rows], index < count).joined(0)


def by_halves(part: np.ndarray) -> np.ndarray:
    """(steps, draws, rows, ...) as (draws, 2, steps of half of the rows, ...); an odd row is left out."""
    steps, draws, rows = part.shape[:3]
    half = rows // 2
    return np.moveaxis(part, 0, 2)[:, : 2 * half].reshape(draws, 2, half * steps, *part.shape[3:])
