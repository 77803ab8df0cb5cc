"""Standardised descriptions of (s, a), s' and reward, for networks inside jitted updates."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from madoc.learning.dynamics_ratio import Scaling
from madoc.types import Transitions


class Features(eqx.Module):
    """`dynamics_ratio.Scaling` in float32 on the device: (s, a), s' as s' - s over its spread, rewards."""

    pair_offset: Float[Array, " pair"]
    pair_scale: Float[Array, " pair"]
    change_scale: Float[Array, " observation"]
    reward_offset: Float[Array, ""]
    reward_scale: Float[Array, ""]

    @classmethod
    def of(cls, rows: Transitions) -> "Features":
        """As these rows have it."""
        scaling = Scaling.standardised(rows)
        spread = np.std(rows.reward)
        reward = (np.mean(rows.reward), spread if spread > 1e-8 else 1.0)
        parts = (scaling.pair_offset, scaling.pair_scale, scaling.next_scale, *reward)
        return cls(*(jnp.asarray(part, jnp.float32) for part in parts))

    def pair(
        self, observation: Float[Array, "*rows observation"], action: Float[Array, "*rows action"]
    ) -> Float[Array, "*rows pair"]:
        """(s, a) with mean 0 and spread 1."""
        pair = jnp.concatenate([observation, action], axis=-1)
        return (pair - _like(self.pair_offset, pair)) / _like(self.pair_scale, pair)

    def change(
        self, observation: Float[Array, "*rows observation"], following: Float[Array, "*rows observation"]
    ) -> Float[Array, "*rows observation"]:
        """(s' - s) in units of its spread."""
        change = following - observation
        return change / _like(self.change_scale, change)

    def described(self, rows: dict[str, Array]) -> tuple[Float[Array, "rows pair"], Float[Array, "rows observation"]]:
        """(s, a) and s' - s of rows, as networks see them."""
        observation = rows["observation"]
        return self.pair(observation, rows["action"]), self.change(observation, rows["next_observation"])

    def following(
        self, observation: Float[Array, "*rows observation"], change: Float[Array, "*rows observation"]
    ) -> Float[Array, "*rows observation"]:
        """S' of a change: the inverse of `change`."""
        return observation + change * _like(self.change_scale, change)


def _like(part: Array, rows: Array) -> Array:
    return jnp.broadcast_to(part, rows.shape)
