"""Behaviour cloning by maximum likelihood: the clone must copy the behaviour's noise, not only its mean."""

from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from madoc.learning.networks import adam, descend, scalars, scan_updates
from madoc.learning.tanh_gaussian import TanhGaussianPolicy, log_density
from madoc.types import Metrics, Transitions

Pairs = tuple[Float[Array, "rows observation"], Float[Array, "rows action"]]
"""Logged observations and actions on the device, float32."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Clone:
    """A policy that is learning to act as the log's, the state of its optimiser, and its epochs of learning so far."""

    policy: TanhGaussianPolicy
    optimiser: PyTree
    epochs: int


def fresh_clone(
    logged: Transitions,
    hidden: tuple[int, ...],
    *,
    learning_rate: float,
    key: PRNGKeyArray,
    scale: Float[np.ndarray, " observation"] | None = None,
) -> Clone:
    """An untrained clone that standardises observations as the log has them.

    Args:
        logged: The log's rows.
        hidden: Units per layer.
        learning_rate: Adam's.
        key: Of the weights.
        scale: What observations are divided by; None takes their standard deviation, 0.001 at least.
    """
    observation = np.asarray(logged.observation)
    policy = TanhGaussianPolicy(
        observation.shape[-1],
        logged.action.shape[-1],
        hidden,
        key=key,
        offset=observation.mean(0),
        scale=np.maximum(observation.std(0), 1e-3) if scale is None else scale,
    )
    return Clone(policy, adam(learning_rate).init(eqx.filter(policy, eqx.is_array)), 0)


def cloning_loss(
    policy: TanhGaussianPolicy, observation: Float[Array, "rows observation"], action: Float[Array, "rows action"]
) -> Float[Array, ""]:
    """Mean negative log-likelihood of the data's actions under the policy."""
    return -log_density(action, *policy.distribution(observation)).mean()


def continue_cloning(
    clone: Clone, logged: Pairs, key: PRNGKeyArray, *, learning_rate: float, batch: int, updates: int
) -> tuple[Clone, Metrics]:
    """One epoch: `updates` updates of the clone on batches of logged rows."""
    optimiser = adam(learning_rate)
    policy, state, metrics = _update(
        clone.policy, clone.optimiser, logged, key, optimiser=optimiser, batch=batch, count=updates
    )
    return Clone(policy, state, clone.epochs + 1), scalars(metrics)


@eqx.filter_jit
def _update(
    policy: TanhGaussianPolicy,
    optimiser_state: PyTree,
    logged: Pairs,
    key: PRNGKeyArray,
    *,
    optimiser: optax.GradientTransformation,
    batch: int,
    count: int,
) -> tuple[TanhGaussianPolicy, PyTree, dict[str, Array]]:
    def update(carry: tuple, key: PRNGKeyArray) -> tuple[tuple, dict[str, Array]]:
        policy, optimiser_state = carry
        rows = jax.random.randint(key, (batch,), 0, len(logged[0]))
        loss, gradients = eqx.filter_value_and_grad(cloning_loss)(policy, logged[0][rows], logged[1][rows])
        return descend(optimiser, gradients, optimiser_state, policy), {"cloning_loss": loss}

    (policy, optimiser_state), metrics = scan_updates(update, (policy, optimiser_state), key, count)
    return policy, optimiser_state, metrics
