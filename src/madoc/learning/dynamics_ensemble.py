"""An ensemble of probabilistic dynamics models (Chua et al. 2018, arXiv 1805.12114; MOPO's, arXiv 2005.13239)."""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from madoc.learning.features import Features
from madoc.learning.networks import Network, PerRow, Scalar, map_stack, minimise, stack

BOUNDS_WEIGHT = 0.01
"""Weight in the loss of the distance between the learnt bounds of the log variance (Chua et al., appendix A.1)."""
LEAST_FALL = 0.01
"""Share by which an error on held-out rows must fall to count, from MOPO's code."""
DECAY = (2.5e-5, 1e-4)
"""Weight decay of the first layer and of the last, from MOPO's code; layers between are spaced evenly."""


class Ensemble(eqx.Module):
    """Models of (s, a) -> mean and std of (change of s, reward), all standardised by `Features`.

    Attributes:
        networks: A stack of networks, one for each model.
        largest: Learnt upper bound of the log variance of each output.
        smallest: Learnt lower bound of the same.
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
        """Number of models."""
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
        """An ensemble of a single one of the models."""
        networks = jax.tree.map(lambda leaf: leaf[model][None], self.networks)
        return eqx.tree_at(lambda ensemble: ensemble.networks, self, networks)

    def _bounded(self, outputs: Array) -> tuple[Array, Array]:
        mean, free = jnp.split(outputs, 2, axis=-1)
        largest, smallest = jnp.broadcast_to(self.largest, free.shape), jnp.broadcast_to(self.smallest, free.shape)
        below = largest - jax.nn.softplus(largest - free)
        return mean, smallest + jax.nn.softplus(below - smallest)


def likelihood_loss(
    ensemble: Ensemble, pair: Float[Array, "models rows pair"], target: Float[Array, "models rows outputs"]
) -> Scalar:
    """Eq. (1), Chua et al. 2018: squared error over variance plus log variance, averaged over rows and outputs.

    Summed over the models, with the learnt bounds of the variance pulled together.
    """
    mean, log_variance = ensemble.each(pair)
    error = (mean - target) ** 2 * jnp.exp(-log_variance) + log_variance
    return error.mean((1, 2)).sum() + BOUNDS_WEIGHT * (ensemble.largest - ensemble.smallest).sum()


def weight_decay(ensemble: Ensemble) -> Scalar:
    """Half the squared norm of the weights of each layer, times its `DECAY`, summed over layers and models."""
    layers = ensemble.networks.layers
    decays = np.linspace(*DECAY, len(layers))
    terms = (0.5 * decay * (layer.weight**2).sum() for decay, layer in zip(decays, layers, strict=True))
    return sum(terms, start=jnp.zeros(()))


def holdout_error(
    ensemble: Ensemble, pair: Float[Array, "rows pair"], target: Float[Array, "rows outputs"]
) -> Float[Array, " models"]:
    """Mean squared error of each model's mean on rows that it was not fitted to."""
    mean, _ = ensemble(pair)
    return ((mean - jnp.broadcast_to(target, mean.shape)) ** 2).mean((1, 2))


def keep_best(
    kept: Ensemble, smallest: Float[Array, " models"], latest: Ensemble, error: Float[Array, " models"]
) -> tuple[Ensemble, Float[Array, " models"], Bool[Array, ""]]:
    """Each model at its smallest error on held-out rows so far, those errors, and whether any has fallen.

    Falls of less than `LEAST_FALL` are none. The bounds of the variance, which models share, are the latest wherever
    one has fallen.
    """
    fell = error < (1.0 - LEAST_FALL) * smallest

    def chosen(old: Array, new: Array) -> Array:
        falls = fell.reshape(-1, *[1] * (old.ndim - 1))
        return jnp.where(jnp.broadcast_to(falls, old.shape), new, old)

    any_fell = fell.any()
    networks = jax.tree.map(chosen, kept.networks, latest.networks)
    bounds = (jnp.where(any_fell, latest.largest, kept.largest), jnp.where(any_fell, latest.smallest, kept.smallest))
    best = eqx.tree_at(lambda models: (models.networks, models.largest, models.smallest), kept, (networks, *bounds))
    return best, jnp.where(fell, error, smallest), any_fell


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Fitting:
    """Models that are fitted until their errors on held-out rows no longer fall.

    Attributes:
        models: The models after the last update.
        optimiser: The state of their optimiser.
        best: Each model as it was when its error on held-out rows was smallest.
        smallest: Those errors.
        stale: Updates since the error of any model last fell.
    """

    models: Ensemble
    optimiser: PyTree
    best: Ensemble
    smallest: Float[Array, " models"]
    stale: int

    @classmethod
    def of(cls, models: Ensemble, optimiser: optax.GradientTransformation) -> "Fitting":
        """Before the first update."""
        largest = jnp.full(models.count, jnp.finfo(jnp.float32).max)
        return cls(models, optimiser.init(eqx.filter(models, eqx.is_array)), models, largest, 0)

    def after(self, models: Ensemble, optimiser: PyTree, errors: Float[Array, " models"], count: int) -> "Fitting":
        """After `count` more updates, that lead to models of these errors on held-out rows."""
        best, smallest, fell = keep_best(self.best, self.smallest, models, errors)
        return Fitting(models, optimiser, best, smallest, 0 if bool(fell) else self.stale + count)

    def ended(self) -> "Fitting":
        """With each model as it was at its smallest error."""
        return replace(self, models=self.best)


def uncertainty_penalty(std: Float[Array, "models rows outputs"], features: Features) -> PerRow:
    """u(s, a) of MOPO, Yu et al. 2020: the largest norm over the models of the std, in physical units."""
    scale = jnp.append(features.change_scale, features.reward_scale)
    return jnp.linalg.norm(std * jnp.broadcast_to(scale, std.shape), axis=-1).max(0)


def bellman_inconsistency(value: Float[Array, "models rows"]) -> PerRow:
    """U(s, a) of MOBILE, Sun et al. 2023 (ICML): the standard deviation over models of the value of the next state.

    Without the discount and with n - 1 in the denominator, as in their code. They average the values of ten next states
    drawn from each model, and of actions drawn there, at every update; here a model's value is that of the state it
    expects and of the policy's action without noise, is 0 where the task has ended, and is not computed again later.
    """
    return value.std(0, ddof=1)


def training_rows(draws: Int[Array, "*rows"], holdout_every: int) -> Int[Array, "*rows"]:
    """Row numbers of the given draws from the training rows, which are all rows but every `holdout_every`-th."""
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
    """`count` updates. Every model draws its own batches, so that the models differ."""
    size = len(rows[0]) - len(rows[0]) // holdout_every

    def loss_of(ensemble: Ensemble, key: PRNGKeyArray) -> Scalar:
        drawn = training_rows(jax.random.randint(key, (ensemble.count, batch), 0, size), holdout_every)
        return likelihood_loss(ensemble, rows[0][drawn], rows[1][drawn]) + weight_decay(ensemble)

    ensemble, optimiser_state, loss = minimise(
        loss_of, ensemble, optimiser_state, key, optimiser=optimiser, count=count
    )
    return ensemble, optimiser_state, {"model_loss": loss}
