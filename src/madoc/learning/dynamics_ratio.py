"""Two discriminators classify rows as logged or simulated; their difference is the log dynamics ratio, the reward."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.learning.networks import Network, Observations, PerRow, Scalar

TARGET, SOURCE = 0, 1
"""Indices of the two logits: the target domain (logged rows) and the source domain (simulated rows)."""


class Discriminators(eqx.Module):
    """f_sa and f_sas, each two logits (target, source), bounded by a tanh (appendix C, Jiang et al. 2024: both by 2).

    A wider bound of f_sa keeps (s, a) out of the reward: where simulated (s, a) are far from logged ones, f_sas learns
    what a narrowly bounded f_sa cannot express, and the reward takes that for a difference in dynamics.

    Attributes:
        pair: Network of f_sa.
        triple: Network of f_sas.
        bound: Bound of each logit of f_sas; the reward is within ± twice this.
        pair_bound: Bound of each logit of f_sa.
    """

    pair: Network
    triple: Network
    bound: float = eqx.field(static=True)
    pair_bound: float = eqx.field(static=True)

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        hidden: tuple[int, ...],
        *,
        key: PRNGKeyArray,
        bound: float,
        pair_bound: float,
        dropout: float,
    ) -> None:
        of_pair, of_triple = jax.random.split(key)
        pair = observation_size + action_size
        self.pair = Network(pair, 2, hidden, key=of_pair, dropout=dropout)
        self.triple = Network(pair + observation_size, 2, hidden, key=of_triple, dropout=dropout)
        self.bound = bound
        self.pair_bound = pair_bound

    def __call__(
        self, pair: Array, following: Array, key: PRNGKeyArray | None = None
    ) -> tuple[Float[Array, "rows 2"], Float[Array, "rows 2"]]:
        """Log probabilities (target, source) given (s, a), and given (s, a, s')."""
        keys = (None, None) if key is None else jax.random.split(key)
        logits_pair = self.pair_logits(pair, keys[0])
        triple = jnp.concatenate([pair, following], axis=-1)
        logits_triple = self.bound * jnp.tanh(self.triple(triple, keys[1])) + logits_pair
        return jax.nn.log_softmax(logits_pair), jax.nn.log_softmax(logits_triple)

    def pair_logits(self, pair: Array, key: PRNGKeyArray | None = None) -> Float[Array, "rows 2"]:
        """f_sa: logits (target, source) given (s, a)."""
        return self.pair_bound * jnp.tanh(self.pair(pair, key))


def discriminator_loss(
    discriminators: Discriminators,
    logged: tuple[Array, Array],
    simulated: tuple[Array, Array],
    key: PRNGKeyArray | None = None,
) -> tuple[Scalar, dict[str, Array]]:
    """Eq. (6), Jiang et al. 2024: the sum of both cross-entropies; also each of them, and each accuracy.

    `logged` and `simulated` are features (pair, following) of as many rows. The key is that of dropout.
    """
    count = len(logged[0])
    joined = [jnp.concatenate(parts) for parts in zip(logged, simulated, strict=True)]
    pair, triple = discriminators(joined[0], joined[1], key)

    def cross_entropy(log_probability: Array) -> Array:
        return -log_probability[:count, TARGET].mean() - log_probability[count:, SOURCE].mean()

    def accuracy(log_probability: Array) -> Array:
        says_target = log_probability[:, TARGET] > log_probability[:, SOURCE]
        return 0.5 * (says_target[:count].mean() + (~says_target[count:]).mean())

    metrics = {
        "discriminator_loss_sa": cross_entropy(pair),
        "discriminator_loss_sas": cross_entropy(triple),
        "accuracy_sa": accuracy(pair),
        "accuracy_sas": accuracy(triple),
    }
    return metrics["discriminator_loss_sa"] + metrics["discriminator_loss_sas"], metrics


def log_dynamics_ratio(discriminators: Discriminators, pair: Array, following: Array) -> PerRow:
    """The reward below Eq. (5): log D_sas(target) - log D_sas(source) - log D_sa(target) + log D_sa(source).

    As f_sa enters both softmaxes, this is f_sas(target) - f_sas(source): within ±2 `bound`.
    """
    log_pair, log_triple = discriminators(pair, following)
    return log_triple[:, TARGET] - log_triple[:, SOURCE] - log_pair[:, TARGET] + log_pair[:, SOURCE]


def overlap(discriminators: Discriminators, pair: Array) -> PerRow:
    """4 p (1 - p) of D_sa's probability p: 1 where (s, a) is as likely in either domain, near 0 where in one only.

    Not in the paper. f_sas learns only where both domains have rows; elsewhere its ratio is an extrapolation. Rows are
    therefore weighted by their overlap.
    """
    logits = discriminators.pair_logits(pair)
    log_odds = logits[:, TARGET] - logits[:, SOURCE]
    return 4.0 * jax.nn.sigmoid(log_odds) * jax.nn.sigmoid(-log_odds)


def blur(following: tuple[Array, Array], scale: Scalar | float, key: PRNGKeyArray) -> tuple[Observations, Observations]:
    """Add independent normal noise of deviation `scale` to the s' features of logged and of simulated rows.

    Not in the paper. Under different parameters a simulator without noise never gives the same s', so that
    discriminators classify every row with certainty and the reward is at its bound, where it has no gradient. With
    noise the log ratio is about -|difference|² / (2 scale²), whose gradient points towards the target from anywhere
    (instance noise, Sønderby et al. 2017).
    """
    keys = jax.random.split(key)
    target, source = (
        rows + scale * jax.random.normal(key, rows.shape) for rows, key in zip(following, keys, strict=True)
    )
    return target, source
