"""Networks with chosen numbers, whose outputs can be worked out by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp

from madoc.learning.networks import Network


def affine(weight, bias, **settings) -> Network:
    """One layer: rows @ weight.T + bias; weight as (outputs, inputs)."""
    return layered((weight, bias), **settings)


def layered(*layers, dropout: float = 0.0) -> Network:
    """A network of the given (weight, bias) pairs, ReLU in between."""
    weights = [jnp.asarray(weight, jnp.float32) for weight, _ in layers]
    biases = [jnp.asarray(bias, jnp.float32) for _, bias in layers]
    hidden = [weight.shape[0] for weight in weights[:-1]]
    network = Network(weights[0].shape[1], weights[-1].shape[0], hidden, key=jax.random.key(0), dropout=dropout)
    return eqx.tree_at(
        lambda net: [part for layer in net.layers for part in (layer.weight, layer.bias)],
        network,
        [part for pair in zip(weights, biases, strict=True) for part in pair],
    )
