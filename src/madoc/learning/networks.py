"""Multilayer perceptrons, and the loops that train them."""

from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from madoc.types import Metrics

Carry = TypeVar("Carry")
Input = TypeVar("Input")

Scalar = Float[Array, ""]
PerRow = Float[Array, " rows"]
Observations = Float[Array, "rows observation"]
Actions = Float[Array, "rows action"]
"""Arrays of a batch on the device: one number, a number for each row, an observation and an action of each row."""


class Network(eqx.Module):
    """A multilayer perceptron on a batch, with optional dropout between layers."""

    layers: list[eqx.nn.Linear]
    dropout: float = eqx.field(static=True)
    activation: Callable[[Array], Array] = eqx.field(static=True)

    def __init__(
        self,
        inputs: int,
        outputs: int,
        hidden: Sequence[int],
        *,
        key: PRNGKeyArray,
        dropout: float = 0.0,
        activation: Callable[[Array], Array] = jax.nn.relu,
    ) -> None:
        sizes = (inputs, *hidden, outputs)
        keys = jax.random.split(key, len(sizes) - 1)
        self.layers = [eqx.nn.Linear(*ends, key=key) for ends, key in zip(pairwise(sizes), keys, strict=True)]
        self.dropout = dropout
        self.activation = activation

    def __call__(
        self, rows: Float[Array, "*rows inputs"], key: PRNGKeyArray | None = None
    ) -> Float[Array, "*rows outputs"]:
        """Outputs for a batch; dropout acts only where a key is given."""
        for index, layer in enumerate(self.layers):
            assert layer.bias is not None
            weight = layer.weight.T
            if len(layer.weight) > rows.shape[-1]:
                # The weight's gradient is a product of inputs and slopes, of which XLA would transpose the larger one,
                # the slopes, on a CPU.
                weight = jax.lax.optimization_barrier(weight)
            rows = rows @ weight
            # A product, whose gradient is one too: XLA shares long sums among cores, whose number decides the bits.
            rows = rows + jnp.ones((*rows.shape[:-1], 1)) @ layer.bias[None]
            if index + 1 < len(self.layers):
                rows = self.activation(rows)
                if self.dropout and key is not None:
                    rows = drop(rows, self.dropout, jax.random.fold_in(key, index))
        return rows


def standardise(
    rows: Float[Array, "*rows n"], offset: Float[Array, " n"], scale: Float[Array, " n"]
) -> Float[Array, "*rows n"]:
    """(rows - offset) / scale. No gradient reaches the offset or the scale, so neither is trained."""
    offset, scale = (jnp.broadcast_to(jax.lax.stop_gradient(part), rows.shape) for part in (offset, scale))
    return (rows - offset) / scale


def drop(rows: Float[Array, "*rows units"], rate: float, key: PRNGKeyArray) -> Float[Array, "*rows units"]:
    """Dropout that spends one random byte a unit, four of each 32-bit draw, so the rate is exact to within 1/512."""
    bound = min(round(256 * rate), 255)
    words = jax.random.bits(key, (-(-rows.size // 4),), jnp.uint32)
    draws = jax.lax.bitcast_convert_type(words, jnp.uint8).reshape(-1)[: rows.size].reshape(rows.shape)
    return jnp.where(draws >= bound, rows * (256 / (256 - bound)), 0.0)


def stack(count: int, make: Callable[[PRNGKeyArray], Carry], key: PRNGKeyArray) -> Carry:
    """`count` modules of one structure as a single module, whose arrays have a leading axis of that length."""
    return eqx.filter_vmap(make)(jax.random.split(key, count))


def map_stack(
    apply: Callable[[Carry, Array], Array], stacked: Carry, inputs: Float[Array, " members *rows"] | None = None
) -> Array:
    """Apply each module of a stack to its own inputs, one after the other: on a CPU faster than a batched product."""
    arrays, static = eqx.partition(stacked, eqx.is_array)
    return jax.lax.map(lambda parts: apply(eqx.combine(parts[0], static), parts[1]), (arrays, inputs))


def scan_updates(
    update: Callable[[Carry, PRNGKeyArray], tuple[Carry, dict[str, Array]]], carry: Carry, key: PRNGKeyArray, count: int
) -> tuple[Carry, dict[str, Array]]:
    """Run `count` updates in one `lax.scan`. Returns the last carry and the mean of each metric over the updates."""
    return scan_inputs(update, carry, jax.random.split(key, count))


def scan_inputs(
    update: Callable[[Carry, Input], tuple[Carry, dict[str, Array]]], carry: Carry, inputs: Input
) -> tuple[Carry, dict[str, Array]]:
    """One update for each leading index of `inputs`, in one `lax.scan`; the last carry and the mean of each metric."""
    arrays, static = eqx.partition(carry, eqx.is_array)

    def body(arrays: PyTree, given: Input) -> tuple[PyTree, dict[str, Array]]:
        following, metrics = update(eqx.combine(arrays, static), given)
        return eqx.filter(following, eqx.is_array), metrics

    arrays, metrics = jax.lax.scan(body, arrays, inputs)
    return eqx.combine(arrays, static), jax.tree.map(jnp.mean, metrics)


def minimise(
    loss_of: Callable[[Carry, PRNGKeyArray], Scalar],
    parameters: Carry,
    optimiser_state: PyTree,
    key: PRNGKeyArray,
    *,
    optimiser: optax.GradientTransformation,
    count: int,
) -> tuple[Carry, PyTree, Scalar]:
    """`count` steps down a loss that draws its own batch with the key given to it; also its mean over the steps."""

    def update(carry: tuple[Carry, PyTree], key: PRNGKeyArray) -> tuple[tuple[Carry, PyTree], dict[str, Array]]:
        loss, gradients = eqx.filter_value_and_grad(loss_of)(carry[0], key)
        return descend(optimiser, gradients, carry[1], carry[0]), {"loss": loss}

    (parameters, optimiser_state), metrics = scan_updates(update, (parameters, optimiser_state), key, count)
    return parameters, optimiser_state, metrics["loss"]


def scalars(metrics: dict[str, Array]) -> Metrics:
    """The metrics of a scan as Python floats."""
    return {name: float(value) for name, value in metrics.items()}


@cache
def adam(learning_rate: float) -> optax.GradientTransformation:
    """Optax's Adam. One object for each rate, so that JAX does not trace again a function that takes it."""
    return optax.adam(learning_rate)


@cache
def falling_adam(learning_rate: float, updates: int) -> optax.GradientTransformation:
    """Optax's Adam with a rate that falls to 0 over so many updates, along half a cosine (arXiv 1608.03983)."""
    return optax.adam(optax.cosine_decay_schedule(learning_rate, updates))


def descend(
    optimiser: optax.GradientTransformation, gradients: PyTree, optimiser_state: PyTree, parameters: Carry
) -> tuple[Carry, PyTree]:
    """One step of an Optax optimiser on the arrays of a module."""
    updates, optimiser_state = optimiser.update(gradients, optimiser_state)
    return eqx.apply_updates(parameters, updates), optimiser_state


def moving_average(slow: Carry, fast: Carry, rate: float | Array) -> Carry:
    """Polyak averaging: slow + rate (fast - slow), leaf by leaf."""

    def blend(old: Array | np.ndarray, new: Array | np.ndarray) -> Array | np.ndarray:
        return old + rate * (new - old) if eqx.is_inexact_array(old) else old

    return jax.tree.map(blend, slow, fast)
