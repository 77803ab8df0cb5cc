"""The networks and distributions that Madoc trains, and the updates that train them."""

from dataclasses import dataclass, replace
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from madoc.errors import MadocError
from madoc.learning import replay
from madoc.learning.dynamics_ratio import Discriminators, blur, discriminator_loss, log_dynamics_ratio, overlap
from madoc.learning.networks import (
    Network,
    Observations,
    PerRow,
    Scalar,
    adam,
    descend,
    moving_average,
    scan_updates,
    stack,
)
from madoc.learning.tanh_gaussian import sample
from madoc.types import BelowOne, Count, Layers, NotNegative, Positive, Share, check_hyperparameters

Mixing = Literal["dop", "sum", "independent"]
"""How values of groups are mixed into a draw's: by learnt weights (DOP), by a plain sum (VDN), or not at all (ISAC)."""
AT_BOUND = 0.95
"""Share of the reward's bound above which a reward counts as saturated."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Actors:
    """Means and log stds before squashing, both of shape (d,).

    They are a tanh-Gaussian for each group: groups are disjoint, and every Gaussian is diagonal.
    """

    mean: Float[Array | np.ndarray, " d"]
    log_std: Float[Array | np.ndarray, " d"]


def initial_actors(count: int) -> Actors:
    """Actors at N(0, 1) before squashing, where the prior starts too (appendix C)."""
    return Actors(jnp.zeros(count), jnp.zeros(count))


def squashed(actors: Actors) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """The actors' deterministic output in [-1, 1], and their deviations there, to first order."""
    mean = np.tanh(np.asarray(actors.mean, np.float64))
    return mean, (1.0 - mean**2) * np.exp(np.asarray(actors.log_std, np.float64))


def draw_parameters(
    actors: Actors, key: PRNGKeyArray, count: int
) -> tuple[Float[Array, "count d"], Float[Array, " count"]]:
    """Draws of all parameters in [-1, 1], and their log densities summed over groups."""
    shape = (count, len(actors.mean))
    mean, log_std = (jnp.broadcast_to(part, shape) for part in (actors.mean, actors.log_std))
    return sample(mean, log_std, key)


def divergence(actors: Actors, prior: Actors) -> Float[Array, " d"]:
    """KL(q || p) of each parameter, in closed form: squashing both by the same map leaves it as it is."""
    variance_ratio = jnp.exp(2.0 * (actors.log_std - prior.log_std))
    shift = ((actors.mean - prior.mean) * jnp.exp(-prior.log_std)) ** 2
    return 0.5 * (variance_ratio + shift - 1.0) - actors.log_std + prior.log_std


def prior_weight(updates: Int[Array, ""], *, time_constant: float, largest: float) -> Scalar:
    """λ_t = min(largest, exp(t / time_constant)) (appendix C: 10 and 2e5)."""
    return jnp.minimum(largest, jnp.exp(updates / time_constant))


def actor_loss(
    value: PerRow, log_density: PerRow, kl: Scalar, *, entropy_weight: float, prior_weight: Scalar | float
) -> Scalar:
    """Eq. (13): α log q - v + λ KL(q || p), averaged over draws; values, densities and KL are sums over groups."""
    return (entropy_weight * log_density - value).mean() + prior_weight * kl


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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Agents:
    """The networks and distributions that updates change, and the states of their optimisers.

    Attributes:
        discriminators: Classifiers of logged against simulated rows.
        judges: Moving average of the discriminators, which gives the reward: that of the latest networks is noisier.
        critics: One critic for each group.
        actors: The calibration distribution.
        prior: The p of Eq. (13): a moving average of the actors.
        average: Moving average of the actors from which the estimate is read.
        log_blur: Logarithm of the deviation of the noise on s' features that both discriminators see.
    """

    discriminators: Discriminators
    judges: Discriminators
    critics: GroupCritics
    actors: Actors
    prior: Actors
    average: Actors
    log_blur: Scalar
    updates: Int[Array, ""]
    discriminator_optimiser: PyTree
    critic_optimiser: PyTree
    actor_optimiser: PyTree


@dataclass(frozen=True)
class AgentSettings:
    """Hyperparameters of discriminators, critics and actors.

    Attributes:
        hidden: Units per layer of the discriminators.
        critic_hidden: Units per layer of each group's critic.
        bound: Bound of the logits of f_sas.
        pair_bound: Bound of the logits of f_sa. With the paper's 2, the reward of free-running rows depends on (s, a).
        weigh_overlap: Whether rows are weighted by the overlap of logged and simulated (s, a); not in the paper.
        dropout: Dropout rate of the discriminators.
        batch: Logged rows, and as many simulated rows, in an update.
        actor_batch: Draws in an update of the actors.
        discriminator_rate: Adam's learning rate of the discriminators.
        critic_rate: Adam's learning rate of the critics.
        actor_rate: Adam's learning rate of the actors.
        judge_rate: Rate of the judges' moving average; with 1 the discriminators themselves give the reward, as in the
            paper.
        entropy_weight: α of Eq. (13).
        prior_time: Number of updates in which λ of Eq. (13) grows by the factor e.
        prior_largest: Largest λ of Eq. (13).
        prior_rate: Rate of the prior's moving average. The actors move as fast as the prior follows them.
        prior_every: Updates between two moves of the prior.
        average_rate: Rate of the moving average from which the estimate is read.
        baseline: Whether b of Eq. (11) depends on (s, a), wherever credit is that of DOP; in the paper it does not.
        reward_size: Mean |reward| to which the blur is steered; 0 for no blur, as in the paper.
        blur_rate: Change of the logarithm of the blur in an update, for an error of the mean |reward| of 1.
        first_blur: The first blur, in units of the features of s'.
        smallest_blur: Lower limit of the blur, below which networks cannot resolve differences in s'.
        largest_blur: Upper limit of the blur.
    """

    hidden: Layers = (128, 128)
    critic_hidden: Layers = (64, 64)
    bound: NotNegative = 2.0
    pair_bound: NotNegative = 10.0
    weigh_overlap: bool = True
    dropout: BelowOne = 0.0
    batch: Count = 256
    actor_batch: Count = 64
    discriminator_rate: NotNegative = 1e-3
    critic_rate: NotNegative = 1e-3
    actor_rate: NotNegative = 3e-3
    judge_rate: Share = 0.01
    entropy_weight: NotNegative = 0.01
    prior_time: Positive = 2e5
    prior_largest: NotNegative = 10.0
    prior_rate: Share = 0.3
    prior_every: Count = 10
    average_rate: Share = 3e-4
    baseline: bool = True
    reward_size: NotNegative = 1.0
    blur_rate: NotNegative = 3e-3
    first_blur: Positive = 10.0
    smallest_blur: Positive = 0.3
    largest_blur: Positive = 30.0

    def __post_init__(self) -> None:
        check_hyperparameters(self)
        if not self.smallest_blur <= self.first_blur <= self.largest_blur:
            raise MadocError(
                f"expected agents.smallest_blur ≤ agents.first_blur ≤ agents.largest_blur, got {self.smallest_blur}, "
                f"{self.first_blur} and {self.largest_blur}"
            )

    def init(self, *, window: int, observation: int, parameters: int, groups: int, key: PRNGKeyArray) -> Agents:
        """Fresh networks; actors, prior and average at N(0, 1). `window` is the number of features of (s, a)."""
        of_discriminators, of_critics = jax.random.split(key)
        bounds = {"bound": self.bound, "pair_bound": self.pair_bound, "dropout": self.dropout}
        discriminators = Discriminators(observation, window - observation, self.hidden, key=of_discriminators, **bounds)
        size = window if self.baseline else 0
        critics = GroupCritics(groups, parameters, self.critic_hidden, window=size, key=of_critics)
        actors = initial_actors(parameters)
        return Agents(
            discriminators=discriminators,
            judges=jax.tree.map(lambda leaf: leaf.copy() if eqx.is_array(leaf) else leaf, discriminators),
            critics=critics,
            actors=actors,
            prior=actors,
            average=actors,
            log_blur=jnp.full((), np.log(self.first_blur), jnp.float32),
            updates=jnp.zeros((), jnp.int32),
            discriminator_optimiser=adam(self.discriminator_rate).init(eqx.filter(discriminators, eqx.is_array)),
            critic_optimiser=adam(self.critic_rate).init(eqx.filter(critics, eqx.is_array)),
            actor_optimiser=adam(self.actor_rate).init(actors),
        )

    @eqx.filter_jit
    def update(
        self,
        agents: Agents,
        simulated: replay.Replay,
        logged: tuple[Float[Array, "rows pair"], Observations],
        members: Bool[Array, "groups d"],
        key: PRNGKeyArray,
        *,
        mixing: Mixing,
        count: int,
    ) -> tuple[Agents, dict[str, Array]]:
        """`count` updates, Algorithm 1, lines 13 to 19, and the mean of each metric.

        The discriminators learn from blurred s'; the reward is computed at s' without blur, where it is least noisy.
        Simulated rows are columns `pair`, `following` and `parameters` (in [-1, 1]), logged rows are (pair, following).
        """

        def update(agents: Agents, key: PRNGKeyArray) -> tuple[Agents, dict[str, Array]]:
            of_logged, of_simulated, of_blur, of_dropout, of_actors = jax.random.split(key, 5)
            rows = jax.random.randint(of_logged, (self.batch,), 0, len(logged[0]))
            drawn = replay.sample(simulated, of_simulated, self.batch)
            scale, unit = self._blur(agents)
            target, source = (part / unit for part in blur((logged[1][rows], drawn["following"]), scale, of_blur))
            agents, metrics = self._update_discriminators(
                agents, (logged[0][rows], target), (drawn["pair"], source), of_dropout
            )
            reward = self.reward(agents, drawn["pair"], drawn["following"])
            common = overlap(agents.judges, drawn["pair"])
            share = common / common.mean() if self.weigh_overlap else jnp.ones_like(reward)
            agents, reward_metrics = self._steer_blur(agents, reward, share)
            agents, value_metrics = self._update_critics(agents, drawn, reward, share, members, mixing)
            agents, actor_metrics = self._update_actors(agents, members, of_actors)
            return agents, metrics | reward_metrics | value_metrics | actor_metrics | {"overlap": common.mean()}

        return scan_updates(update, agents, key, count)

    def _update_discriminators(
        self, agents: Agents, target: tuple[Array, Array], source: tuple[Array, Array], key: PRNGKeyArray
    ) -> tuple[Agents, dict[str, Array]]:
        (_, metrics), gradients = eqx.filter_value_and_grad(discriminator_loss, has_aux=True)(
            agents.discriminators, target, source, key
        )
        discriminators, optimiser = descend(
            adam(self.discriminator_rate), gradients, agents.discriminator_optimiser, agents.discriminators
        )
        judges = moving_average(agents.judges, discriminators, self.judge_rate)
        return replace(agents, discriminators=discriminators, judges=judges, discriminator_optimiser=optimiser), metrics

    def reward(self, agents: Agents, pair: Float[Array, "rows pair"], following: Observations) -> PerRow:
        """The reward of rows by the judges, at s' without blur."""
        return log_dynamics_ratio(agents.judges, pair, following / self._blur(agents)[1])

    def _blur(self, agents: Agents) -> tuple[Scalar, Scalar]:
        """The blur, and the unit of s' with it, in which networks see numbers of order one."""
        scale = jnp.exp(agents.log_blur) if self.reward_size else jnp.zeros(())
        return scale, jnp.sqrt(1.0 + scale**2)

    def _steer_blur(self, agents: Agents, reward: PerRow, share: PerRow) -> tuple[Agents, dict[str, Array]]:
        """Widen the blur where the mean |reward| is above `reward_size`, and narrow it where it is below.

        Without a blur, with `reward_size` 0, nothing is steered.
        """
        size = (share * jnp.abs(reward)).mean()
        metrics = {
            "reward": (share * reward).mean(),
            "reward_size": size,
            "reward_at_bound": (share * (jnp.abs(reward) > AT_BOUND * 2 * self.bound)).mean(),
        }
        if not self.reward_size:
            return agents, metrics
        surplus = jnp.clip(size - self.reward_size, -1.0, 1.0)
        limits = np.log([self.smallest_blur, self.largest_blur])
        log_blur = jnp.clip(agents.log_blur + self.blur_rate * surplus, *limits)
        return replace(agents, log_blur=log_blur), metrics | {"blur": jnp.exp(log_blur)}

    def _update_critics(
        self,
        agents: Agents,
        rows: dict[str, Array],
        reward: PerRow,
        share: PerRow,
        members: Bool[Array, "groups d"],
        mixing: Mixing,
    ) -> tuple[Agents, dict[str, Array]]:
        def loss_of(critics: GroupCritics) -> Scalar:
            left = critics.less_baseline(reward, rows["pair"]) if mixing == "dop" else reward
            values = critics.values(rows["parameters"], members)
            return value_loss(values, critics.weight, critics.bias, left, share, mixing)

        loss, gradients = eqx.filter_value_and_grad(loss_of)(agents.critics)
        critics, optimiser = descend(adam(self.critic_rate), gradients, agents.critic_optimiser, agents.critics)
        return replace(agents, critics=critics, critic_optimiser=optimiser), {"value_loss": loss}

    def _update_actors(self, agents: Agents, members: Array, key: PRNGKeyArray) -> tuple[Agents, dict[str, Array]]:
        of_prior = prior_weight(agents.updates, time_constant=self.prior_time, largest=self.prior_largest)

        def loss_of(actors: Actors) -> Array:
            draws, density = draw_parameters(actors, key, self.actor_batch)
            return actor_loss(
                agents.critics.values(draws, members).sum(-1),
                density,
                divergence(actors, agents.prior).sum(),
                entropy_weight=self.entropy_weight,
                prior_weight=of_prior,
            )

        loss, gradients = jax.value_and_grad(loss_of)(agents.actors)
        actors, optimiser = descend(adam(self.actor_rate), gradients, agents.actor_optimiser, agents.actors)
        due = (agents.updates + 1) % self.prior_every == 0
        following = replace(
            agents,
            actors=actors,
            prior=moving_average(agents.prior, actors, jnp.where(due, self.prior_rate, 0.0)),
            average=moving_average(agents.average, actors, self.average_rate),
            actor_optimiser=optimiser,
            updates=agents.updates + 1,
        )
        return following, {"actor_loss": loss, "actor_std": jnp.exp(actors.log_std).mean()}
