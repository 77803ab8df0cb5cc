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
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from madoc.identification.losses import NORMAL_MAD
from madoc.identification.noise import clipped
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
"""Bound of the derivatives of s' by s; those of contacts are larger, and would count too much."""
TOLD = 0.25
"""Least ratio of noise to what the regression leaves of a channel: smaller noise is not told from its errors."""


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

    Returns:
        The regression, and the mean loss.
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
    expectation: Expectation,
    logged: tuple[Float[Array, "rows window"], Observations],
    consecutive: Bool[np.ndarray, " rows"],
    by_reading: Float[np.ndarray, " observation"],
) -> Float[np.ndarray, " observation"]:
    """Standard deviation of the sensor noise of each channel, in units of the features of s'; 0 where none is seen.

    A reading that is too high raises s' of one row and, by what the regression g makes of it, what is expected in the
    next: with noise e and G = ∂s'/∂s, residuals are r_t = e_{t+1} - G_t e_t, so that those of consecutive rows have
    E[r_{t+1} r_tᵀ] = -G_{t+1} Σ. For each channel j, σ_j² = -Σ w_i G_ij r_{t+1,i} r_{t,j} / Σ w_i G_ij², over rows t
    and channels i with the weight w of their inverse mean square. Errors of the regression have the same sign in
    consecutive rows and make it smaller.

    Args:
        expectation: A regression that has learnt the log's changes s' - s.
        logged: Features of (s, a), of which the first are those of s, and of s'.
        consecutive: Whether each row is the one after the row before it in the log.
        by_reading: Change of each feature of s by a change of 1 in the same feature of s'.
    """
    count = min(MOST_ROWS, len(consecutive))
    window, following = (part[:count] for part in logged)
    here = np.flatnonzero(consecutive[1:count]) + 1
    channels = following.shape[1]
    if not len(here):
        return np.zeros(channels)
    residual = clipped(np.asarray(following - expected(expectation.network, window), np.float64))
    size = np.maximum((residual**2).mean(0), LEAST_SPREAD**2)
    slopes = np.asarray(_slopes(expectation.network, window[here], channels), np.float64) * by_reading
    slopes = np.clip(slopes + np.eye(channels), -STEEPEST, STEEPEST)
    shared = np.einsum("tij,ti,tj->j", slopes, residual[here] / size, residual[here - 1])
    weight = np.einsum("tij,i->j", slopes**2, 1.0 / size)
    noise = np.sqrt(np.maximum(-shared, 0.0) / weight)
    return np.where(noise > TOLD * np.sqrt(size), noise, 0.0)


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
def _slopes(network: Network, window: Float[Array, "rows window"], channels: int) -> Float[Array, "rows out channels"]:
    """Derivatives of the expected features of s' by the first `channels` features of each row."""

    def of_row(row: Array) -> Array:
        return jax.jacfwd(lambda first: network(jnp.concatenate([first, row[channels:]])[None])[0])(row[:channels])

    return jax.lax.map(of_row, window, batch_size=256)
