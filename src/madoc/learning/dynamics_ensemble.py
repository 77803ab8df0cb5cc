"""An ensemble of probabilistic dynamics models (Chua et al. 2018, arXiv 1805.12114; MOPO's, arXiv 2005.13239)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from madoc.learning.features import Features
from madoc.learning.networks import Network, descend, map_stack, scan_updates, stack

BOUNDS_WEIGHT = 0.01
"""How hard the learnt bounds of the variance are pulled together; the authors' (Chua et al., appendix A.1)."""
DECAY = (2.5e-5, 1e-4)
"""Of the first layer's weights and of the last's, as MOPO's code has them; evenly between."""


class Ensemble(eqx.Module):
    """Models of (s, a) -> mean and std of (change of s, reward), all standardised as `Features` has them.

    Attributes:
        networks: A stack, one network a model.
        largest: Upper ends of the log variance, learnt, one an output.
        smallest: Lower ends.
    """

    networks: Network
    largest: Float[Array, " outputs"]
    smallest: Float[Array, " outputs"]

    def __init__(
        self, observation: int, action: int, hidden: tuple[int, ...], *, models: int, key: PRNGKeyArray
    ) -> None:
        outputs = observation + 1
        self.networks = stack(
            models, lambda key: Network(observation + action, 2 * outputs, hidden, key=key, activation=jax.nn.silu), key
        )
        self.largest, self.smallest = jnp.full(outputs, 0.5), jnp.full(outputs, -10.0)

    @property
    def count(self) -> int:
        """How many models."""
        return len(self.networks.layers[0].weight)

    def __call__(
        self, pair: Float[Array, "rows pair"]
    ) -> tuple[Float[Array, "models rows outputs"], Float[Array, "models rows outputs"]]:
        """Mean and std of every model on the same rows."""
        mean, log_variance = self._bounded(map_stack(lambda network, _: network(pair), self.networks))
        return mean, jnp.exp(0.5 * log_variance)

    def each(
        self, pair: Float[Array, "models rows pair"]
    ) -> tuple[Float[Array, "models rows outputs"], Float[Array, "models rows outputs"]]:
        """Mean and log variance of every model on rows of its own."""
        return self._bounded(map_stack(lambda network, rows: network(rows), self.networks, pair))

    def only(self, model: Int[Array, ""]) -> "Ensemble":
        """One model of it, as an ensemble of one."""
        networks = jax.tree.map(lambda leaf: leaf[model][None], self.networks)
        return eqx.tree_at(lambda ensemble: ensemble.networks, self, networks)

    def _bounded(self, outputs: Array) -> tuple[Array, Array]:
        mean, free = jnp.split(outputs, 2, axis=-1)
        largest, smallest = jnp.broadcast_to(self.largest, free.shape), jnp.broadcast_to(self.smallest, free.shape)
        below = largest - jax.nn.softplus(largest - free)
        return mean, smallest + jax.nn.softplus(below - smallest)


def likelihood_loss(
    ensemble: Ensemble, pair: Float[Array, "models rows pair"], target: Float[Array, "models rows outputs"]
) -> Float[Array, ""]:
    """Eq. (1), Chua et al. 2018: squared error over variance plus log variance, averaged over rows and outputs.

    Summed over the models, with the learnt bounds of the variance pulled together.
    """
    mean, log_variance = ensemble.each(pair)
    error = (mean - target) ** 2 * jnp.exp(-log_variance) + log_variance
    return error.mean((1, 2)).sum() + BOUNDS_WEIGHT * (ensemble.largest - ensemble.smallest).sum()


def weight_decay(ensemble: Ensemble) -> Float[Array, ""]:
    """Half the squared norm of every layer's weights, each layer's times its `DECAY`, summed over layers and models."""
    weights = [layer.weight for layer in ensemble.networks.layers]
    return sum(
        (
            0.5 * decay * (weight**2).sum()
            for decay, weight in zip(np.linspace(*DECAY, len(weights)), weights, strict=True)
        ),
        start=jnp.zeros(()),
    )


def holdout_error(
    ensemble: Ensemble, pair: Float[Array, "rows pair"], target: Float[Array, "rows outputs"]
) -> Float[Array, " models"]:
    """Mean squared error of each model's mean on rows that it was not fitted to."""
    mean, _ = ensemble(pair)
    return ((mean - jnp.broadcast_to(target, mean.shape)) ** 2).mean((1, 2))


def uncertainty_penalty(std: Float[Array, "models rows outputs"], features: Features) -> Float[Array, " rows"]:
    """u(s, a) of MOPO, Yu et al. 2020: the largest norm over the models of the std, in physical units."""
    scale = jnp.append(features.change_scale, features.reward_scale)
    return jnp.linalg.norm(std * jnp.broadcast_to(scale, std.shape), axis=-1).max(0)


def training_rows(draws: Int[Array, "*rows"], holdout_every: int) -> Int[Array, "*rows"]:
    """The j-th of the rows that are fitted to: all but every `holdout_every`-th."""
    return draws + draws // (holdout_every - 1)


def fit(
    ensemble: Ensemble,
    optimiser_state: PyTree,
    rows: tuple[Float[Array, "rows pair"], Float[Array, "rows outputs"]],
    key: PRNGKeyArray,
    *,
    optimiser: optax.GradientTransformation,
    batch: int,
    count: int,
    holdout_every: int,
) -> tuple[Ensemble, PyTree, dict[str, Array]]:
    """`count` updates; every model draws batches of its own, which is what makes them differ."""
    size = len(rows[0]) - len(rows[0]) // holdout_every

    def update(carry: tuple, key: PRNGKeyArray) -> tuple[tuple, dict[str, Array]]:
        ensemble, optimiser_state = carry
        drawn = training_rows(jax.random.randint(key, (ensemble.count, batch), 0, size), holdout_every)
        loss, gradients = eqx.filter_value_and_grad(_fitting_loss)(ensemble, rows[0][drawn], rows[1][drawn])
        return descend(optimiser, gradients, optimiser_state, ensemble), {"model_loss": loss}

    (ensemble, optimiser_state), metrics = scan_updates(update, (ensemble, optimiser_state), key, count)
    return ensemble, optimiser_state, metrics


def _fitting_loss(ensemble: Ensemble, pair: Array, target: Array) -> Float[Array, ""]:
    return likelihood_loss(ensemble, pair, target) + weight_decay(ensemble)
