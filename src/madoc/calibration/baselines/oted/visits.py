"""Which pairs (s, a) data and simulator visit, made comparable, and the discriminator that compares them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from madoc.data import Dataset
from madoc.identification.windows import first_rows
from madoc.learning import replay
from madoc.learning.networks import Network, descend, scan_updates
from madoc.types import Transitions


def comparable_starts(dataset: Dataset, rows: Int[np.ndarray, " states"], horizon: int) -> Int[np.ndarray, " starts"]:
    """Which of the given rows a rollout of `horizon` steps may start at: the record goes on as long, or to a fall.

    Args:
        dataset: The log.
        rows: Rows whose state can be rebuilt.
        horizon: Control steps of a rollout.

    Returns:
        Positions in `rows`.

    Raises:
        MadocError: No episode is long enough.
    """
    episode = dataset.episode_of(rows)
    falls = np.asarray(dataset.transitions.terminated)[dataset.episode_ends - 1][episode]
    whole = np.zeros(len(rows), dtype=bool)
    whole[first_rows(dataset, rows, horizon)] = True
    return np.flatnonzero(whole | falls)


def visits(dataset: Dataset, starts: Int[np.ndarray, " starts"], horizon: int) -> Int[np.ndarray, " rows"]:
    """How often each row of the log is visited 1 to `horizon` - 1 steps after one of the starts, in its episode.

    Rows drawn by these counts are what the true system visits from the starts; drawn evenly they are not, as the
    beginnings of episodes are seldom reached from within.
    """
    begun = np.zeros(len(dataset), dtype=np.int64)
    begun[starts] = 1
    episode = np.repeat(np.arange(len(dataset.episode_starts)), dataset.episode_ends - dataset.episode_starts)
    first = dataset.episode_starts[episode]
    before = np.append(0, np.cumsum(begun))
    row = np.arange(len(dataset))
    return before[row] - before[np.maximum(first, row - horizon + 1)]


def first_lives(seen: Transitions, valid: Bool[np.ndarray, "steps *rows"]) -> Bool[np.ndarray, "steps *rows"]:
    """Steps that a rollout took before anything ended in its row: after that the row stands at a fresh start."""
    ended = np.asarray(seen.terminated) | np.asarray(seen.truncated) | ~valid
    earlier = np.concatenate([np.zeros_like(ended[:1]), ended[:-1]])
    return valid & ~np.logical_or.accumulate(earlier, axis=0)


def discriminator_loss(
    discriminator: Network, logged: Float[Array, "batch pair"], simulated: Float[Array, "batch pair"]
) -> Float[Array, ""]:
    """Cross-entropy of logged (1) against simulated (0) pairs: its logit becomes log p_data(s, a) / p_sim(s, a)."""
    return jax.nn.softplus(-discriminator(logged)).mean() + jax.nn.softplus(discriminator(simulated)).mean()


@eqx.filter_jit
def log_ratio(discriminator: Network, pairs: Float[Array, "*rows pair"]) -> Float[Array, "*rows"]:
    """Log p_data(s, a) / p_sim(s, a), as the discriminator has it."""
    return discriminator(pairs)[..., 0]


@eqx.filter_jit
def learn(
    discriminator: Network,
    optimiser_state: PyTree,
    logged: Float[Array, "rows pair"],
    reached: Int[Array, " rows"],
    rows: replay.Replay,
    key: PRNGKeyArray,
    *,
    optimiser: optax.GradientTransformation,
    batch: int,
    count: int,
) -> tuple[Network, PyTree, dict[str, Array]]:
    """`count` updates of the discriminator on logged and simulated pairs.

    `reached` is the running sum of how often each logged pair is to be drawn.
    """

    def update(carry: tuple[Network, PyTree], key: PRNGKeyArray) -> tuple[tuple[Network, PyTree], dict[str, Array]]:
        of_logged, of_simulated = jax.random.split(key)
        drawn = jax.random.randint(of_logged, (batch,), 0, reached[-1])
        chosen = logged[jnp.searchsorted(reached, drawn, side="right")]
        simulated = replay.sample(rows, of_simulated, batch)["pair"]
        loss, gradients = eqx.filter_value_and_grad(discriminator_loss)(carry[0], chosen, simulated)
        return descend(optimiser, gradients, carry[1], carry[0]), {"discriminator_loss": loss}

    (discriminator, optimiser_state), metrics = scan_updates(update, (discriminator, optimiser_state), key, count)
    return discriminator, optimiser_state, metrics
