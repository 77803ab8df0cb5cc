"""A tanh-Gaussian actor, twin critics and a learnt temperature, and one gradient step of each."""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from madoc.learning import sac_losses
from madoc.learning.features import Features
from madoc.learning.networks import adam, descend, moving_average
from madoc.learning.sac_losses import TwinCritic
from madoc.learning.tanh_gaussian import Noise, TanhGaussianPolicy, sample

Batch = dict[str, Array]
"""Rows as `replay.sample` gives them: observation, action, reward, next_observation, terminated."""


STILL = 1e-3
"""Added to the spread of an observation, as TD3+BC does: what hardly moved in the data may move far in a simulator."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ActorCritic:
    """Everything that gradient updates change."""

    policy: TanhGaussianPolicy
    critic: TwinCritic
    target_critic: TwinCritic
    log_temperature: Float[Array, ""]
    policy_optimiser: PyTree
    critic_optimiser: PyTree
    temperature_optimiser: PyTree


@dataclass(frozen=True)
class Descent:
    """The optimisers of an actor-critic.

    Attributes:
        policy: Of the policy, and of the temperature.
        critic: Of the critics.
        target_rate: τ of the target critics.
    """

    policy: optax.GradientTransformation
    critic: optax.GradientTransformation
    target_rate: float

    @classmethod
    def by_adam(cls, *, policy: float, critic: float, target_rate: float) -> "Descent":
        """Adam with these learning rates."""
        return cls(adam(policy), adam(critic), target_rate)


def fresh(
    observation: int,
    action: int,
    *,
    hidden: tuple[int, ...],
    critic_hidden: tuple[int, ...] | None = None,
    descent: Descent,
    features: Features | None = None,
    key: PRNGKeyArray,
) -> ActorCritic:
    """New networks, temperature 1.

    Args:
        observation: Values of an observation.
        action: Values of an action.
        hidden: Units per layer.
        critic_hidden: Those of the critics; None is `hidden`.
        descent: How they will change.
        features: How the data's observations are standardised, as TD3+BC has it (Fujimoto & Gu 2021, section 5); None
            where there is no data, and networks see observations as they are.
        key: Of the weights.
    """
    of_policy, of_critic = jax.random.split(key)
    seen = {}
    if features is not None:
        scale = features.pair_scale[:observation] + STILL
        seen = {"offset": features.pair_offset[:observation], "scale": scale}
    policy = TanhGaussianPolicy(observation, action, hidden, key=of_policy, **seen)
    critic = TwinCritic(observation, action, hidden if critic_hidden is None else critic_hidden, key=of_critic, **seen)
    log_temperature = jnp.zeros(())
    return ActorCritic(
        policy,
        critic,
        jax.tree.map(lambda leaf: leaf.copy() if eqx.is_array(leaf) else leaf, critic),
        log_temperature,
        descent.policy.init(eqx.filter(policy, eqx.is_array)),
        descent.critic.init(eqx.filter(critic, eqx.is_array)),
        descent.policy.init(log_temperature),
    )


def standardising(
    learner: ActorCritic, offset: Float[Array, " observation"], scale: Float[Array, " observation"]
) -> ActorCritic:
    """The same weights, for observations that are standardised with this offset and scale."""
    networks = learner.policy, learner.critic, learner.target_critic
    changed = [eqx.tree_at(lambda net: (net.offset, net.scale), network, (offset, scale)) for network in networks]
    return eqx.tree_at(lambda parts: (parts.policy, parts.critic, parts.target_critic), learner, tuple(changed))


def bellman_target(
    learner: ActorCritic, batch: Batch, noise: Noise, *, discount: float | Array, entropy: bool = True
) -> Float[Array, " rows"]:
    """What the critics should say of a batch; without `entropy`, the backup leaves out -α log π.

    `discount` is one number, or one a row where rows span several control steps.
    """
    following = batch["next_observation"]
    action, density = sample(*learner.policy.distribution(following), noise)
    return sac_losses.soft_target(
        batch["reward"],
        batch["terminated"],
        jnp.minimum(*learner.target_critic(following, action)),
        density,
        temperature=jnp.exp(learner.log_temperature) if entropy else jnp.zeros(()),
        discount=discount,
    )


def critic_step(
    learner: ActorCritic, loss_of: Callable[[TwinCritic], tuple[Array, Array]], descent: Descent
) -> tuple[ActorCritic, tuple[Float[Array, ""], Float[Array, ""]]]:
    """One step of the critics down a loss, and of the target critics behind them.

    Args:
        learner: What to improve.
        loss_of: critic -> its loss, and a part of it worth watching.
        descent: How.

    Returns:
        The learner, and both numbers as they were before the step.
    """
    (loss, part), gradients = eqx.filter_value_and_grad(loss_of, has_aux=True)(learner.critic)
    critic, optimiser = descend(descent.critic, gradients, learner.critic_optimiser, learner.critic)
    target_critic = moving_average(learner.target_critic, critic, descent.target_rate)
    learner = eqx.tree_at(
        lambda parts: (parts.critic, parts.target_critic, parts.critic_optimiser),
        learner,
        (critic, target_critic, optimiser),
    )
    return learner, (loss, part)


def actor_step(
    learner: ActorCritic,
    observation: Float[Array, "rows observation"],
    noise: Noise,
    descent: Descent,
    combine: Callable[[TanhGaussianPolicy, Array, Array], Array] = lambda policy, loss, value: loss,
) -> tuple[ActorCritic, dict[str, Array]]:
    """One step of the policy and of the temperature.

    Args:
        learner: What to improve.
        observation: Where to improve it.
        noise: Of the sampled actions.
        descent: How.
        combine: (policy, SAC's loss, value of each row) -> what the policy descends. SAC's loss alone by default.
    """

    def loss_of(policy: TanhGaussianPolicy) -> tuple[Array, tuple[Array, Array]]:
        loss, (value, density) = sac_losses.actor_loss(
            policy, learner.critic, observation, temperature=jnp.exp(learner.log_temperature), noise=noise
        )
        return combine(policy, loss, value), (loss, density)

    (_, (loss, density)), gradients = eqx.filter_value_and_grad(loss_of, has_aux=True)(learner.policy)
    policy, policy_optimiser = descend(descent.policy, gradients, learner.policy_optimiser, learner.policy)
    target_entropy = -float(len(policy.network.layers[-1].weight) // 2)
    slope = jax.grad(sac_losses.temperature_loss)(learner.log_temperature, density, target_entropy)
    log_temperature, temperature_optimiser = descend(
        descent.policy, slope, learner.temperature_optimiser, learner.log_temperature
    )
    learner = eqx.tree_at(
        lambda parts: (parts.policy, parts.policy_optimiser, parts.log_temperature, parts.temperature_optimiser),
        learner,
        (policy, policy_optimiser, log_temperature, temperature_optimiser),
    )
    return learner, {"actor_loss": loss, "entropy": -density.mean(), "temperature": jnp.exp(log_temperature)}


def soft_critic_step(
    learner: ActorCritic, batch: Batch, noise: Noise, descent: Descent, *, discount: float | Array
) -> tuple[ActorCritic, dict[str, Array]]:
    """SAC's own step of the critics."""
    target = bellman_target(learner, batch, noise, discount=discount)

    def loss_of(critic: TwinCritic) -> tuple[Array, Array]:
        loss = sac_losses.critic_loss(critic, batch["observation"], batch["action"], target)
        return loss, loss

    learner, (loss, _) = critic_step(learner, loss_of, descent)
    return learner, {"critic_loss": loss, "value_target": target.mean()}
