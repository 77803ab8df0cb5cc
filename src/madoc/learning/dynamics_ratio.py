"""Two discriminators classify rows as logged or simulated; their difference is the log dynamics ratio, the reward."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.data.dataset import spread_of
from madoc.learning.networks import Network
from madoc.types import Transitions

TARGET, SOURCE = 0, 1


@dataclass(frozen=True)
class Scaling:
    """How (s, a, s') become features of order one; computed in float64, handed on in float32.

    Attributes:
        pair_offset: Of (s, a), shape (observation + action,).
        pair_scale: Of (s, a).
        next_scale: Of what describes s', shape (observation,).
        difference: Whether s' is described by s' - s, else by s' itself.
    """

    pair_offset: Float[np.ndarray, " pair"]
    pair_scale: Float[np.ndarray, " pair"]
    next_scale: Float[np.ndarray, " observation"]
    difference: bool

    @classmethod
    def standardised(cls, rows: Transitions) -> "Scaling":
        """(s, a) standardised, s' - s divided by its spread; channels that never move are left alone."""
        pair = np.concatenate([rows.observation, rows.action], axis=-1)
        change = np.asarray(rows.next_observation) - rows.observation
        return cls(pair.mean(0), spread_of(pair), spread_of(change), difference=True)

    @classmethod
    def raw(cls, rows: Transitions) -> "Scaling":
        """(s, a, s') as they are: the paper's."""
        pair, size = rows.observation.shape[-1] + rows.action.shape[-1], rows.observation.shape[-1]
        return cls(np.zeros(pair), np.ones(pair), np.ones(size), difference=False)

    def features(
        self, rows: Transitions
    ) -> tuple[Float[np.ndarray, "*rows pair"], Float[np.ndarray, "*rows observation"]]:
        """Features of (s, a) and of s', float32."""
        pair = np.concatenate([rows.observation, rows.action], axis=-1)
        following = np.asarray(rows.next_observation)
        if self.difference:
            following = following - rows.observation
        return (
            ((pair - self.pair_offset) / self.pair_scale).astype(np.float32),
            (following / self.next_scale).astype(np.float32),
        )


class Discriminators(eqx.Module):
    """f_sa and f_sas, each two logits (target, source), bounded by a tanh (appendix C, Jiang et al. 2024: both by 2).

    A wider bound of f_sa keeps the reward clean: where simulated (s, a) are far from logged ones, f_sas makes up for
    what a narrowly bounded f_sa cannot express, and that looks like a difference in dynamics.

    Attributes:
        pair: f_sa's network.
        triple: f_sas's network.
        bound: Of f_sas, and so of half the reward.
        pair_bound: Of f_sa.
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
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Eq. (6), Jiang et al. 2024: both cross-entropies, logged rows against simulated ones.

    Args:
        discriminators: The two networks.
        logged: Features (pair, following) of logged rows.
        simulated: The same of as many simulated rows.
        key: For dropout.

    Returns:
        The sum of the two losses, and how often each discriminator is right.
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


def log_dynamics_ratio(discriminators: Discriminators, pair: Array, following: Array) -> Float[Array, " rows"]:
    """The reward below Eq. (5): log D_sas(target) - log D_sas(source) - log D_sa(target) + log D_sa(source).

    As f_sa enters both softmaxes, this is f_sas(target) - f_sas(source): within ±2 `bound`.
    """
    log_pair, log_triple = discriminators(pair, following)
    return log_triple[:, TARGET] - log_triple[:, SOURCE] - log_pair[:, TARGET] + log_pair[:, SOURCE]


def overlap(discriminators: Discriminators, pair: Array) -> Float[Array, " rows"]:
    """4 p (1 - p) of D_sa's p: 1 where (s, a) is as likely in either domain, 0 where only one domain has it.

    Never quite 0. Not in the paper. f_sas learns only where D_sa is unsure; elsewhere its ratio is a guess, and rows
    count by this.
    """
    logits = discriminators.pair_logits(pair)
    log_odds = logits[:, TARGET] - logits[:, SOURCE]
    return 4.0 * jax.nn.sigmoid(log_odds) * jax.nn.sigmoid(-log_odds)


def blur(
    following: tuple[Array, Array], scale: Float[Array, ""] | float, key: PRNGKeyArray
) -> tuple[Float[Array, "rows observation"], Float[Array, "rows observation"]]:
    """Add the same kind of normal noise to logged and simulated s' features.

    Not in the paper. Noise-free simulators have disjoint s', so discriminators soon are sure of every row and
    the reward stands at its bound, without a slope. Blurred by `scale`, the log ratio is about
    -|difference|² / (2 scale²): a slope towards the target from anywhere (instance noise, Sønderby et al. 2017).
    """
    keys = jax.random.split(key)
    target, source = (
        rows + scale * jax.random.normal(key, rows.shape) for rows, key in zip(following, keys, strict=True)
    )
    return target, source
