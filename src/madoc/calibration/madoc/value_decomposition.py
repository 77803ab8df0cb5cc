"""Credit: one critic a group, mixed into one value of the whole draw (DOP, VDN), or each on its own (ISAC)."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from madoc.learning.networks import Network

Mixing = Literal["dop", "sum", "independent"]


class GroupCritics(eqx.Module):
    """One value network a group, each seeing its own parameters; the groups' axis is vectorised.

    Attributes:
        networks: Leaves stacked over groups.
        weight: k of Eq. (11), shape (groups,); 1 at first.
        bias: b of Eq. (11).
    """

    networks: Network
    weight: Float[Array, " groups"]
    bias: Float[Array, ""]

    def __init__(self, groups: int, parameters: int, hidden: tuple[int, ...], *, key: PRNGKeyArray) -> None:
        keys = jax.random.split(key, groups)
        self.networks = eqx.filter_vmap(lambda key: Network(parameters, 1, hidden, key=key))(keys)
        self.weight = jnp.ones(groups)
        self.bias = jnp.zeros(())

    def values(
        self, parameters: Float[Array, "rows d"], members: Bool[Array, "groups d"]
    ) -> Float[Array, "rows groups"]:
        """v_g(ξ^g) of every group; a parameter of another group is shown as 0."""
        own = jnp.where(members[:, None], parameters[None], 0.0)
        return eqx.filter_vmap(lambda network, rows: network(rows)[:, 0])(self.networks, own).T


def total_value(
    values: Float[Array, "rows groups"], weight: Float[Array, " groups"], bias: Float[Array, ""]
) -> Float[Array, " rows"]:
    """Eq. (11): V_tot = Σ_g |k_g| v_g + b."""
    return values @ jnp.abs(weight) + bias


def value_loss(
    values: Float[Array, "rows groups"],
    weight: Float[Array, " groups"],
    bias: Float[Array, ""],
    reward: Float[Array, " rows"],
    share: Float[Array, " rows"],
    mixing: Mixing,
) -> Float[Array, ""]:
    """Eq. (12): half the mean of (V_tot - R)². A bandit: there is no next value.

    Each row counts by its `share`, of mean 1; the paper's are all 1.
    `sum` (VDN) has k = 1 and b = 0; `independent` (ISAC) regresses every critic on the shared reward alone.
    """
    if mixing == "independent":
        return 0.5 * (share[:, None] * (values - reward[:, None]) ** 2).mean(0).sum()
    total = total_value(values, weight, bias) if mixing == "dop" else values.sum(-1)
    return 0.5 * (share * (total - reward) ** 2).mean()
