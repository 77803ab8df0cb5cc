"""Credit of each group: a critic for each, whose values are mixed into that of a draw.

They are mixed by learnt weights (DOP), by a plain sum (VDN), or not at all (ISAC).
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from madoc.learning.networks import Network, PerRow, Scalar, stack

Mixing = Literal["dop", "sum", "independent"]


class GroupCritics(eqx.Module):
    """A value network for each group, which sees the parameters of that group only.

    Attributes:
        networks: A stack of networks over groups.
        weight: k of Eq. (11), which starts at 1.
        bias: b of Eq. (11), which starts at 0.
        baseline: b(s, a), added to it: a network of the features of (s, a); None for the paper's b alone. How well
            discriminators judge a row differs from state to state far more than from draw to draw, and what b takes of
            it is no noise on the values of draws (DOP: Wang et al. 2021, where b depends on the state too).
    """

    networks: Network
    weight: Float[Array, " groups"]
    bias: Scalar
    baseline: Network | None

    def __init__(
        self, groups: int, parameters: int, hidden: tuple[int, ...], *, window: int = 0, key: PRNGKeyArray
    ) -> None:
        """Fresh critics; with a `window`, the number of features of (s, a), b depends on those."""
        self.networks = stack(groups, lambda key: Network(parameters, 1, hidden, key=key), key)
        self.weight = jnp.ones(groups)
        self.bias = jnp.zeros(())
        self.baseline = Network(window, 1, hidden, key=jax.random.fold_in(key, groups)) if window else None

    def values(
        self, parameters: Float[Array, "rows d"], members: Bool[Array, "groups d"]
    ) -> Float[Array, "rows groups"]:
        """v_g(ξ^g) of every group; the parameters of other groups are replaced by 0. That of an empty group is 0."""
        own = jnp.where(members[:, None], parameters[None], 0.0)
        values = eqx.filter_vmap(lambda network, rows: network(rows)[:, 0])(self.networks, own).T
        return jnp.where(members.any(-1), values, 0.0)

    def less_baseline(self, reward: PerRow, pair: Float[Array, "rows window"]) -> PerRow:
        """R - b(s, a), which the values are to explain; R without a baseline."""
        return reward if self.baseline is None else reward - self.baseline(pair)[:, 0]


def total_value(values: Float[Array, "rows groups"], weight: Float[Array, " groups"], bias: Scalar) -> PerRow:
    """Eq. (11): V_tot = Σ_g |k_g| v_g + b."""
    return values @ jnp.abs(weight) + bias


def value_loss(
    values: Float[Array, "rows groups"],
    weight: Float[Array, " groups"],
    bias: Scalar,
    reward: PerRow,
    share: PerRow,
    mixing: Mixing,
) -> Scalar:
    """Eq. (12): half the mean of (V_tot - R)². A bandit: there is no next value.

    Rows are weighted by `share`, whose mean is 1; in the paper every share is 1.
    `sum` (VDN) has k = 1 and b = 0; `independent` (ISAC) regresses every critic on the shared reward alone.
    """
    if mixing == "independent":
        return 0.5 * (share[:, None] * (values - reward[:, None]) ** 2).mean(0).sum()
    total = values.sum(-1) if mixing == "sum" else total_value(values, weight, bias)
    return 0.5 * (share * (total - reward) ** 2).mean()
