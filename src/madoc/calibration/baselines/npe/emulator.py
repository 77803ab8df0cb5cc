"""An emulator of the next row given a window and parameters, and the moments by which rows tell parameters.

The emulator is linear in the parameters, y = m(w) + J(w) u + noise of variance v(w), and m, J and v are a network's.
What a set of rows says of u is then a few means over its rows, however many they are and in whatever order.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from madoc.learning import replay
from madoc.learning.networks import Network, Scalar, falling_adam, minimise, standardise

LOG_VARIANCE_RANGE = (-14.0, 6.0)
"""Range of the log variance of the standardised next row; values beyond it are clipped."""
Windows = Float[Array, "*rows window"]
Following = Float[Array, "*rows observation"]
Scaled = Float[Array, "*rows d"]
Moments = tuple[Float[Array, "*sets moments"], Float[Array, "*sets moments d"], Float[Array, "*sets"]]
"""Mean of each moment over a set of rows, its derivative by the parameters, and the number of rows."""


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
