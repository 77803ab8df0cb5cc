"""The dynamics reward of MOREC (Luo et al. 2024, arXiv 2310.05422): how real a transition looks, learnt adversarially.

The authors describe inverse reinforcement learning of a dynamics agent whose "policy" is the transition, in the manner
of GAIL (Ho & Ermon 2016, arXiv 1606.03476), with an ensemble of past discriminators; how they train it is unpublished.
Here the generator follows the gradient of the reward through its sample, as the reward of a next state is immediate.
Next states are blurred: without noise, a discriminator at once distinguishes a deterministic simulator from any model.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from madoc.learning.dynamics_ensemble import Ensemble
from madoc.learning.networks import Network, PerRow, Scalar, descend, map_stack, scan_updates, stack

SURE = 0.999
"""Largest mean probability of a real transition, to which larger ones are clipped; the authors'."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Opposition:
    """A generator of transitions, the discriminator against it, and past discriminators.

    Attributes:
        generator: A dynamics model, as an ensemble of one.
        discriminator: (s, a, change of s) -> logit that the transition is real.
        past: A stack of earlier discriminators, the latest last, which together give the reward.
        generator_optimiser: State of the generator's optimiser.
        discriminator_optimiser: State of the discriminator's optimiser.
    """

    generator: Ensemble
    discriminator: Network
    past: Network
    generator_optimiser: PyTree
    discriminator_optimiser: PyTree


def opposition(
    generator: Ensemble,
    pair: int,
    change: int,
    *,
    hidden: tuple[int, ...],
    members: int,
    optimiser: optax.GradientTransformation,
    key: PRNGKeyArray,
) -> Opposition:
    """The generator given, and an untrained discriminator that also stands for all past ones."""
    discriminator = Network(pair + change, 1, hidden, key=key)
    return Opposition(
        generator,
        discriminator,
        stack(members, lambda _: discriminator, key),
        *(optimiser.init(eqx.filter(net, eqx.is_array)) for net in (generator, discriminator)),
    )


def logit(
    discriminator: Network, pair: Float[Array, "*rows pair"], change: Float[Array, "*rows change"]
) -> Float[Array, "*rows"]:
    """Log D / (1 - D) that a transition is real."""
    return discriminator(jnp.concatenate([pair, change], axis=-1))[..., 0]


def discriminator_loss(real: PerRow, generated: PerRow) -> Scalar:
    """Loss of the discriminator: mean of -log D on real and of -log(1 - D) on generated transitions, from logits."""
    return jax.nn.softplus(-real).mean() + jax.nn.softplus(generated).mean()


def generator_loss(generated: PerRow) -> Scalar:
    """Loss of the generator: minus the mean reward -log(1 - D), from logits."""
    return -jax.nn.softplus(generated).mean()


def dynamics_reward(logits: Float[Array, " members *rows"]) -> Float[Array, "*rows"]:
    """R = -log(1 - mean D) over past discriminators; 0.69 where D is a half."""
    return -jnp.log1p(-jnp.minimum(jax.nn.sigmoid(logits).mean(0), SURE))


def reward_of(
    past: Network, pair: Float[Array, "*rows pair"], change: Float[Array, "*rows change"]
) -> Float[Array, "*rows"]:
    """Dynamics reward of transitions."""
    return dynamics_reward(map_stack(lambda member, _: logit(member, pair, change), past))


def remember(opposition: Opposition) -> Opposition:
    """Add the discriminator to the past ones, and drop the oldest of these."""

    def shifted(past: Array, newest: Array) -> Array:
        return jnp.concatenate([past[1:], newest[None]]) if eqx.is_array(past) else past

    return replace(opposition, past=jax.tree.map(shifted, opposition.past, opposition.discriminator))


def oppose(
    opposition: Opposition,
    rows: tuple[Float[Array, "rows pair"], Float[Array, "rows change"]],
    key: PRNGKeyArray,
    *,
    optimiser: optax.GradientTransformation,
    batch: int,
    count: int,
    noise: float,
) -> tuple[Opposition, dict[str, Array]]:
    """`count` alternating updates of discriminator and generator."""

    def update(carry: Opposition, key: PRNGKeyArray) -> tuple[Opposition, dict[str, Array]]:
        of_rows, of_sample, of_real, of_generated = jax.random.split(key, 4)
        drawn = jax.random.randint(of_rows, (batch,), 0, len(rows[0]))
        pair, change = rows[0][drawn], rows[1][drawn]
        blur = [noise * jax.random.normal(blur_key, change.shape) for blur_key in (of_real, of_generated)]

        def generated(generator: Ensemble) -> Array:
            mean, std = (part[0, :, :-1] for part in generator(pair))
            return mean + std * jax.random.normal(of_sample, mean.shape) + blur[1]

        def loss_of_discriminator(discriminator: Network) -> Array:
            fake = jax.lax.stop_gradient(generated(carry.generator))
            return discriminator_loss(logit(discriminator, pair, change + blur[0]), logit(discriminator, pair, fake))

        loss, gradients = eqx.filter_value_and_grad(loss_of_discriminator)(carry.discriminator)
        discriminator, discriminator_optimiser = descend(
            optimiser, gradients, carry.discriminator_optimiser, carry.discriminator
        )

        def loss_of_generator(generator: Ensemble) -> Array:
            return generator_loss(logit(discriminator, pair, generated(generator)))

        lost, gradients = eqx.filter_value_and_grad(loss_of_generator)(carry.generator)
        generator, generator_optimiser = descend(optimiser, gradients, carry.generator_optimiser, carry.generator)
        following = Opposition(generator, discriminator, carry.past, generator_optimiser, discriminator_optimiser)
        return following, {"discriminator_loss": loss, "generated_reward": -lost}

    return scan_updates(update, opposition, key, count)
