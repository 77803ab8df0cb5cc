"""A tanh-Gaussian actor, twin critics and a learnt temperature, and one gradient step of each."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from madoc.learning import sac_losses
from madoc.learning.features import Features
from madoc.learning.networks import Observations, PerRow, Scalar, adam, descend, moving_average
from madoc.learning.sac_losses import TwinCritic
from madoc.learning.tanh_gaussian import Noise, TanhGaussianPolicy, sample

Batch = dict[str, Array]
"""Rows as `replay.sample` gives them: observation, action, reward, next_observation, terminated."""

STILL = 1e-3
"""Constant added to the standard deviation of each observation channel, as in TD3+BC. Without it, a channel that hardly
moved in the data would reach the networks as a huge value once it moves in a simulator."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ActorCritic:
    """The networks, the temperature, and the states of their optimisers."""

    policy: TanhGaussianPolicy
    critic: TwinCritic
    target_critic: TwinCritic
    log_temperature: Scalar
    policy_optimiser: PyTree
    critic_optimiser: PyTree
    temperature_optimiser: PyTree


@dataclass(frozen=True)
class Descent:
    """The optimisers of the policy (and its temperature) and of the critics, and the target critics' rate τ."""

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
    """New networks for so many values of an observation and of an action, temperature 1.

    Without `critic_hidden`, critics have the layers of the policy. With `features`, networks see observations
    standardised as those of the data, as in TD3+BC (Fujimoto & Gu 2021, section 5).
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
    changed = (eqx.tree_at(lambda net: (net.offset, net.scale), network, (offset, scale)) for network in networks)
    return replace(learner, **dict(zip(("policy", "critic", "target_critic"), changed, strict=True)))


def bellman_target(
    learner: ActorCritic, batch: Batch, noise: Noise, *, discount: float | Array, entropy: bool = True
) -> PerRow:
    """Target of the critics for each row of a batch; without `entropy`, it leaves out the term -α log π.

    `discount` is one number, or one for each row where rows span several control steps.
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
) -> tuple[ActorCritic, tuple[Scalar, Scalar]]:
    """One gradient step of the critics; the target critics then move towards them.

    `loss_of` gives the loss of a critic and a part of it to report. Both are returned as they were before the step.
    """
    (loss, part), gradients = eqx.filter_value_and_grad(loss_of, has_aux=True)(learner.critic)
    critic, optimiser = descend(descent.critic, gradients, learner.critic_optimiser, learner.critic)
    target_critic = moving_average(learner.target_critic, critic, descent.target_rate)
    return replace(learner, critic=critic, target_critic=target_critic, critic_optimiser=optimiser), (loss, part)


def actor_step(
    learner: ActorCritic,
    observation: Observations,
    noise: Noise,
    descent: Descent,
    combine: Callable[[TanhGaussianPolicy, Array, Array], Array] = lambda policy, loss, value: loss,
) -> tuple[ActorCritic, dict[str, Array]]:
    """One gradient step of the policy and of the temperature, on actions sampled with the noise.

    `combine` makes the policy's loss of (policy, SAC's loss, value of each row); by default it is SAC's loss.
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
    learner = replace(
        learner,
        policy=policy,
        policy_optimiser=policy_optimiser,
        log_temperature=log_temperature,
        temperature_optimiser=temperature_optimiser,
    )
    return learner, {"actor_loss": loss, "entropy": -density.mean(), "temperature": jnp.exp(log_temperature)}


def soft_critic_step(
    learner: ActorCritic,
    batch: Batch,
    noise: Noise,
    descent: Descent,
    *,
    discount: float | Array,
    least: Scalar | None = None,
) -> tuple[ActorCritic, dict[str, Array]]:
    """One gradient step of the critics down SAC's loss; targets are not below `least`."""
    target = bellman_target(learner, batch, noise, discount=discount)
    target = target if least is None else jnp.maximum(target, jnp.broadcast_to(least, target.shape))

    def loss_of(critic: TwinCritic) -> tuple[Array, Array]:
        return sac_losses.critic_loss(critic, batch["observation"], batch["action"], target), target.mean()

    learner, (loss, mean) = critic_step(learner, loss_of, descent)
    return learner, {"critic_loss": loss, "value_target": mean}
