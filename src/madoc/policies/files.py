"""Policies as files: plain arrays in an npz, readable without JAX by `madoc.numpy_policy`."""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from madoc.errors import MadocError
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.numpy_policy import NumpyPolicy
from madoc.runs.files import replacing


def save_policy(policy: TanhGaussianPolicy, path: str | Path, *, task_name: str) -> None:
    """Write a policy as float32 arrays, with matrices of shape (inputs, outputs), whole or not at all."""
    layers = policy.network.layers
    arrays: dict[str, np.ndarray] = {"about": np.array(json.dumps({"task": task_name, "layers": len(layers)}))}
    for index, layer in enumerate(layers):
        arrays[f"weight_{index}"] = np.asarray(layer.weight.T)
        arrays[f"bias_{index}"] = np.asarray(layer.bias)
    arrays |= {"offset": np.asarray(policy.offset), "scale": np.asarray(policy.scale)}
    with replacing(Path(path)) as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def load_policy(path: str | Path) -> TanhGaussianPolicy:
    """Read a policy.

    Raises:
        MadocError: The file is missing or is not a policy that Madoc saved.
    """
    try:
        return policy_of(NumpyPolicy.load(path))
    except ValueError as error:
        raise MadocError(str(error)) from error


def policy_of(saved: NumpyPolicy) -> TanhGaussianPolicy:
    """A JAX policy with the weights of a saved one."""
    sizes = [weight.shape[1] for weight in saved.weights]
    policy = TanhGaussianPolicy(len(saved.offset), sizes[-1] // 2, tuple(sizes[:-1]), key=jax.random.key(0))
    layers = [
        eqx.tree_at(
            lambda linear: (linear.weight, linear.bias),
            layer,
            (jnp.asarray(weight.T, jnp.float32), jnp.asarray(bias, jnp.float32)),
        )
        for layer, weight, bias in zip(policy.network.layers, saved.weights, saved.biases, strict=True)
    ]
    return eqx.tree_at(
        lambda parts: (parts.network.layers, parts.offset, parts.scale),
        policy,
        (layers, jnp.asarray(saved.offset, jnp.float32), jnp.asarray(saved.scale, jnp.float32)),
    )
