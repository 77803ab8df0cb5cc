"""Behaviour cloning by maximum likelihood: the clone must copy the behaviour's noise, not only its mean."""

from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np
import optax
from jaxtyping import PRNGKeyArray, PyTree

from madoc.learning.networks import Actions, Observations, Scalar, adam, minimise
from madoc.learning.tanh_gaussian import TanhGaussianPolicy, log_density
from madoc.types import Epoch, Metrics

Pairs = tuple[Observations, Actions]
"""What a policy saw in the log, observations or more, and its actions, on the device, float32."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Clone:
    """A policy in training to act as the one that recorded the log, its optimiser's state, and its epochs so far."""

    policy: TanhGaussianPolicy
    optimiser: PyTree
    epochs: int


def fresh_clone(logged: Pairs, hidden: tuple[int, ...], *, learning_rate: float, key: PRNGKeyArray) -> Clone:
    """An untrained clone that standardises what it sees by the logged mean and standard deviation, at least 0.001."""
    seen = np.asarray(logged[0], np.float64)
    policy = TanhGaussianPolicy(
        seen.shape[-1],
        logged[1].shape[-1],
        hidden,
        key=key,
        offset=seen.mean(0),
        scale=np.maximum(seen.std(0), 1e-3),
    )
    return Clone(policy, adam(learning_rate).init(eqx.filter(policy, eqx.is_array)), 0)


def cloning_loss(policy: TanhGaussianPolicy, observation: Observations, action: Actions) -> Scalar:
    """Mean negative log-likelihood of the data's actions under the policy."""
    return -log_density(action, *policy.distribution(observation)).mean()


def continue_cloning(
    clone: Clone, logged: Pairs, key: PRNGKeyArray, *, learning_rate: float, batch: int, updates: int
) -> tuple[Clone, Metrics]:
    """Train the clone for one epoch: `updates` updates on random batches of logged rows."""
    carried = clone.policy, clone.optimiser
    policy, optimiser, loss = _train(*carried, logged, key, adam(learning_rate), batch, updates)
    return Clone(policy, optimiser, clone.epochs + 1), {"cloning_loss": float(loss)}


def cloning_epoch(
    clone: Clone,
    logged: Pairs,
    key: PRNGKeyArray,
    *,
    learning_rate: float,
    batch: int,
    updates: int,
    epochs: int,
) -> tuple[Clone, PRNGKeyArray, Epoch]:
    """`continue_cloning` as an epoch of a method that clones for so many `epochs` before it calibrates.

    Also the key of what follows, and what the epoch did.
    """
    of_batches, key = jax.random.split(key)
    clone, metrics = continue_cloning(
        clone, logged, of_batches, learning_rate=learning_rate, batch=batch, updates=updates
    )
    return clone, key, Epoch(metrics, stage="cloning", fraction=clone.epochs / max(1, epochs))


@eqx.filter_jit
def _train(
    policy: TanhGaussianPolicy,
    optimiser_state: PyTree,
    logged: Pairs,
    key: PRNGKeyArray,
    optimiser: optax.GradientTransformation,
    batch: int,
    updates: int,
) -> tuple[TanhGaussianPolicy, PyTree, Scalar]:
    def loss_of(policy: TanhGaussianPolicy, key: PRNGKeyArray) -> Scalar:
        rows = jax.random.randint(key, (batch,), 0, len(logged[0]))
        return cloning_loss(policy, logged[0][rows], logged[1][rows])

    return minimise(loss_of, policy, optimiser_state, key, optimiser=optimiser, count=updates)
