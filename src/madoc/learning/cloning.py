"""Behaviour cloning by maximum likelihood: the clone must copy the behaviour's noise, not only its mean."""

import equinox as eqx
import jax
import optax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from madoc.learning.networks import descend, scan_updates
from madoc.learning.tanh_gaussian import TanhGaussianPolicy, log_density


def cloning_loss(
    policy: TanhGaussianPolicy,
    observation: Float[Array, "rows observation"],
    action: Float[Array, "rows action"],
) -> Float[Array, ""]:
    """Mean negative log-likelihood of the data's actions under the policy."""
    return -log_density(action, *policy.distribution(observation)).mean()


@eqx.filter_jit
def clone(
    policy: TanhGaussianPolicy,
    optimiser_state: PyTree,
    logged: tuple[Float[Array, "rows observation"], Float[Array, "rows action"]],
    key: PRNGKeyArray,
    *,
    optimiser: optax.GradientTransformation,
    batch: int,
    count: int,
) -> tuple[TanhGaussianPolicy, PyTree, dict[str, Array]]:
    """`count` updates of the clone on batches of logged (observation, action)."""

    def update(carry: tuple, key: PRNGKeyArray) -> tuple[tuple, dict[str, Array]]:
        policy, optimiser_state = carry
        rows = jax.random.randint(key, (batch,), 0, len(logged[0]))
        loss, gradients = eqx.filter_value_and_grad(cloning_loss)(policy, logged[0][rows], logged[1][rows])
        return descend(optimiser, gradients, optimiser_state, policy), {"cloning_loss": loss}

    (policy, optimiser_state), metrics = scan_updates(update, (policy, optimiser_state), key, count)
    return policy, optimiser_state, metrics
