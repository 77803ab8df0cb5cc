"""What is to be expected of s' given (s, a), learnt from the log alone, and the sensor noise that it tells.

The change s' - s is mostly the robot's own motion, of which a parameter moves a few hundredths. A discriminator that
sees s' - s has to learn all of that motion as exactly as a parameter changes it. A regression learns the motion from
logged rows beforehand; what is left of s' is small where a row is as logged ones are, and of the size of the
parameters' effects where it is not. What the regression misses is the same function of (s, a) for logged and for
simulated rows, so it tells no parameters. Neither the simulator nor the order of rows is needed.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree
from scipy.optimize import nnls

from madoc.data import Dataset
from madoc.identification.losses import NORMAL_MAD
from madoc.identification.noise import clipped
from madoc.learning.features import LoggedFeatures, WindowScaling, last_rows
from madoc.learning.networks import Network, Observations, Scalar, falling_adam, minimise

LEAST_SPREAD = 1e-3
"""Smallest spread of what is left of s', in units of its features: finer differences are rounding."""
TURN = 0.1
"""Error in units of the features of s' from which on the loss is linear: contacts leave errors with long tails."""
LEARNING_RATE = 1e-3
"""Adam's learning rate at the start; it falls to 0."""
MOST_ROWS = 20_000
"""Largest number of logged rows from which spreads and noise are measured; more would hardly change them."""
STEEPEST = 3.0
"""Bound of the regression's derivatives; those at contacts are larger, and would count too much."""
SLOPE_ROWS = 6_000
"""Largest number of logged windows whose derivatives are computed for the noise."""
NOISE_HIDDEN = (256, 256)
"""Units per layer of a regression that is trained for the noise alone."""
NOISE_EPOCHS, NOISE_UPDATES, NOISE_BATCH = 20, 200, 256
"""Epochs of its training, updates in each, and windows in an update."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Expectation:
    """A regression of the features of s' on those of (s, a), in training.

    Attributes:
        network: The regression.
        spread: Robust standard deviation, over logged rows, of what it leaves of each feature of s'; 1 while it trains.
        logged: What it leaves of logged rows, in units of that spread; 0 while it trains.
        optimiser: State of its optimiser.
        epochs: Epochs of training so far.
    """

    network: Network
    spread: Float[np.ndarray, " observation"]
    logged: Observations
    optimiser: PyTree
    epochs: int

    def left(
        self, window: Float[np.ndarray, "*rows window"], following: Float[np.ndarray, "*rows observation"]
    ) -> Float[np.ndarray, "*rows observation"]:
        """What s' differs by from what is expected, in units of its spread over logged rows; float32."""
        return np.asarray((following - np.asarray(expected(self.network, window))) / self.spread, np.float32)


def fresh_expectation(
    logged: tuple[Float[Array, "rows window"], Observations],
    hidden: tuple[int, ...],
    *,
    updates: int,
    key: PRNGKeyArray,
) -> Expectation:
    """Before its training of so many `updates`, from logged features of (s, a) to those of s'."""
    window, following = logged
    network = Network(window.shape[1], following.shape[1], hidden, key=key, activation=jax.nn.gelu)
    optimiser = falling_adam(LEARNING_RATE, updates).init(eqx.filter(network, eqx.is_array))
    return Expectation(network, np.ones(following.shape[1]), jnp.zeros_like(following), optimiser, 0)


def learn_expectation(
    expectation: Expectation,
    logged: tuple[Float[Array, "rows window"], Observations],
    key: PRNGKeyArray,
    *,
    batch: int,
    updates: int,
    epochs: int,
) -> tuple[Expectation, Scalar]:
    """One of `epochs` epochs of `updates` updates on logged rows, of which the last measures what is left of them.

    Also returns the mean loss.
    """
    network, optimiser, loss = _train(
        expectation.network,
        expectation.optimiser,
        logged,
        key,
        transform=falling_adam(LEARNING_RATE, updates * epochs),
        batch=batch,
        count=updates,
    )
    trained = replace(expectation, network=network, optimiser=optimiser, epochs=expectation.epochs + 1)
    if trained.epochs < epochs:
        return trained, loss
    left = np.concatenate([np.asarray(part[1] - expected(network, part[0])) for part in _blocks(logged)])
    some = left[:: -(-len(left) // MOST_ROWS)]
    spread = np.maximum(NORMAL_MAD * np.median(np.abs(some), axis=0).astype(np.float64), LEAST_SPREAD)
    return replace(trained, spread=spread, logged=jnp.asarray(left / spread, jnp.float32)), loss


def _blocks(logged: tuple[Array, Array]) -> Iterator[tuple[Array, Array]]:
    """Blocks of `MOST_ROWS` rows, so that layers of the network fit into memory."""
    for first in range(0, len(logged[0]), MOST_ROWS):
        yield logged[0][first : first + MOST_ROWS], logged[1][first : first + MOST_ROWS]


def regression_loss(error: Float[Array, "rows observation"]) -> Scalar:
    """Huber's loss with its turn at `TURN`, over `TURN`: about |error| where that is large."""
    size = jnp.abs(error)
    return jnp.where(size < TURN, 0.5 * error**2 / TURN, size - 0.5 * TURN).mean()


def noise_of_log(
    dataset: Dataset, features: LoggedFeatures, length: int, expectation: Expectation | None = None
) -> Float[np.ndarray, " observation"]:
    """Standard deviation of the sensor noise of each channel, estimated from the log alone; 0 where none is seen.

    A reading that is too high enters up to `length` + 1 residuals of a regression on windows: with noise e they are
    r_t = Σ_k H_k(t) e_{t+1-k}, and those of consecutive windows have E[r_{t+1} r_tᵀ] = Σ_k H_{k+1}(t+1) Σ H_k(t)ᵀ. That
    is linear in the variances, which are solved for by least squares without negative ones. Errors of the regression
    have the same sign in consecutive windows; they make the estimate smaller.

    Of rows without an order, or whose next observations are shuffled, no noise is told. `length` is in rows. Without an
    expectation that has been trained on these windows, one is trained.
    """
    nothing = np.zeros(dataset.transitions.observation.shape[-1])
    last = last_rows(dataset, length)[:SLOPE_ROWS]
    episode = dataset.episode_of(last)
    here = np.flatnonzero((np.diff(last) == 1) & (np.diff(episode) == 0)) + 1
    if dataset.disturbance.shuffled == "next_observations" or not len(here):
        return nothing
    scaling, logged = features.windows("standardised", length)
    network = (expectation or _trained(logged)).network
    window, following = (part[: len(last)] for part in logged)
    residual = clipped(np.asarray(following - expected(network, window), np.float64))
    weight = 1.0 / np.maximum(np.sqrt((residual**2).mean(0)), LEAST_SPREAD)
    slopes = np.clip(np.asarray(_slopes(network, window), np.float64), -STEEPEST, STEEPEST)
    by_reading = derivatives_by_readings(scaling, slopes) * weight[:, None]
    shared = sum(np.einsum("til,tjl->ijl", by_reading[k + 1, here], by_reading[k, here - 1]) for k in range(length + 1))
    seen = np.einsum("ti,tj->ij", residual[here] * weight, residual[here - 1] * weight)
    unit = scaling.scaling.next_scale  # variances in units of a step's change are of one order
    return np.sqrt(nnls(np.reshape(shared * unit**2, (-1, len(unit))), seen.ravel())[0]) * unit


def derivatives_by_readings(
    scaling: WindowScaling, slopes: Float[np.ndarray, "rows out window"]
) -> Float[np.ndarray, "lags rows out observation"]:
    """H_k of `noise_of_log`: derivatives of residuals by the reading of k rows before s', for k from 0 to length + 1.

    `slopes` are derivatives of what is expected by the features of each window.
    """
    channels, row, pairs = len(scaling.next_scale), scaling.scaling, len(scaling.scaling.pair_scale)
    by_reading = np.zeros((scaling.length + 2, len(slopes), channels, channels))
    described = np.diag(1.0 / scaling.next_scale)
    for lag, factor in enumerate((1.0, -1.0) if scaling.length == 1 else (1.0, -2.0, 1.0)):
        by_reading[lag] += factor * described
    by_reading[1] -= slopes[..., :channels] / row.pair_scale[:channels]
    for back in range(1, scaling.length):
        earlier = slopes[..., back * pairs : back * pairs + channels] / row.next_scale
        by_reading[back] -= earlier
        by_reading[back + 1] += earlier
    return by_reading


def _trained(logged: tuple[Float[Array, "rows window"], Observations]) -> Expectation:
    """A regression that is trained for the noise alone; the same log gives the same bits."""
    expectation = fresh_expectation(logged, NOISE_HIDDEN, updates=NOISE_EPOCHS * NOISE_UPDATES, key=jax.random.key(0))
    for key in jax.random.split(jax.random.key(1), NOISE_EPOCHS):
        expectation, _ = learn_expectation(
            expectation, logged, key, batch=NOISE_BATCH, updates=NOISE_UPDATES, epochs=NOISE_EPOCHS
        )
    return expectation


@eqx.filter_jit
def _train(
    network: Network,
    optimiser: PyTree,
    logged: tuple[Array, Array],
    key: PRNGKeyArray,
    *,
    transform: optax.GradientTransformation,
    batch: int,
    count: int,
) -> tuple[Network, PyTree, Scalar]:
    def loss_of(network: Network, key: PRNGKeyArray) -> Scalar:
        rows = jax.random.randint(key, (batch,), 0, len(logged[0]))
        return regression_loss(network(logged[0][rows]) - logged[1][rows])

    return minimise(loss_of, network, optimiser, key, optimiser=transform, count=count)


@eqx.filter_jit
def expected(network: Network, window: Float[Array | np.ndarray, "*rows window"]) -> Float[Array, "*rows observation"]:
    """The expected features of s', jitted."""
    return network(jnp.asarray(window))


@eqx.filter_jit
def _slopes(network: Network, window: Float[Array, "rows window"]) -> Float[Array, "rows out window"]:
    """Derivatives of what is expected by the features of each window."""
    return jax.lax.map(jax.jacfwd(lambda row: network(row[None])[0]), window, batch_size=256)
