"""Acting in simulated systems, storing the transitions, and judging policies there, for all learners that simulate.

Learning goes up and down, so what is handed back is the policy that did best when judged. One rule for all learners:
what has something to judge in, a simulator or learnt models, hands back its best there; what has nothing (`bc`, `cql`)
hands back its last.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.errors import MadocError
from madoc.evaluation import evaluate
from madoc.learning import replay
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.policies.base import PolicyProblem
from madoc.simulation.rollout import Rollout, Walkers, begin, reset_states, roll
from madoc.types import Epoch, Policy

COLUMNS: Sequence[str] = ("observation", "action", "reward", "next_observation", "terminated")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Moments:
    """Number of rows so far, their mean, and the sum of their squared distances to the mean."""

    count: int
    mean: Float[np.ndarray, " n"]
    squares: Float[np.ndarray, " n"]

    @classmethod
    def none(cls, size: int) -> "Moments":
        """The moments before the first row, for rows of `size` values."""
        return cls(0, np.zeros(size), np.zeros(size))

    @property
    def deviation(self) -> Float[np.ndarray, " n"]:
        """Standard deviation of each value; 1 before the first row."""
        return np.sqrt(self.squares / self.count) if self.count else np.ones_like(self.squares)

    def including(self, rows: Float[np.ndarray, "rows n"]) -> "Moments":
        """The moments once more rows have come in (Chan et al. 1979, pairwise update of mean and variance)."""
        if not len(rows):
            return self
        count, mean = self.count + len(rows), rows.mean(0)
        difference = mean - self.mean
        squares = ((rows - mean) ** 2).sum(0) + difference**2 * self.count * len(rows) / count
        return Moments(count, self.mean + difference * len(rows) / count, self.squares + squares)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Interaction:
    """The replay buffer, the present state and return of every row, and the control steps and failures so far."""

    replay: replay.Replay
    observed: Moments
    walkers: Walkers
    episode_return: Float[np.ndarray, "systems rows"]
    control_steps: int
    failures: int


def start_acting(problem: PolicyProblem, key: PRNGKeyArray, *, environments: int, capacity: int) -> Interaction:
    """An empty replay buffer, and rows at reset states, spread evenly over the systems.

    Raises:
        MadocError: The number of environments is not a multiple of that of the systems.
    """
    simulator = problem.simulator
    systems = len(problem.systems(key, environments))
    if environments % systems:
        raise MadocError(f"expected a multiple of {systems} environments for {systems} systems, got {environments}")
    observation, action = (simulator.task.observation_size,), (simulator.action_size,)
    columns = dict(zip(COLUMNS, (observation, action, (), observation, ()), strict=True))
    ring = replay.empty(capacity, **columns)
    walkers = begin(reset_states(simulator), key, systems=systems, rows=environments // systems)
    return Interaction(ring, Moments.none(simulator.task.observation_size), walkers, np.zeros(walkers.age.shape), 0, 0)


def roll_on(
    problem: PolicyProblem, state: Interaction, policy: Policy, key: PRNGKeyArray, *, control_steps: int
) -> tuple[Rollout, Walkers]:
    """Act for `control_steps` in all. Where parameters are distributed, all systems are drawn anew first.

    A row goes on in its new system from where it stood in the old one, as the paper's own rollouts do when
    parameters change inside an episode. The state does not change.
    """
    of_systems, of_action, of_restart = jax.random.split(key, 3)
    simulator = problem.simulator
    return roll(
        simulator.bind(problem.systems(of_systems, state.walkers.age.size)),
        simulator.task,
        policy,
        state.walkers,
        steps=control_steps // state.walkers.age.size,
        starts=reset_states(simulator),
        key=of_action,
        restart_key=of_restart,
    )


def remember(state: Interaction, rollout: Rollout, walkers: Walkers) -> tuple[Interaction, dict[str, float]]:
    """Add the transitions of a rollout to the replay buffer, whose old arrays are consumed.

    Returns:
        The interaction, and as metrics the failures and the mean return of the episodes that ended, if any did.
    """
    rows = {name: replay.flatten_rows(getattr(rollout.transitions, name), 3) for name in COLUMNS}
    finished, episode_return = _episode_returns(rollout, state.episode_return)
    following = Interaction(
        replay.add(state.replay, rows, rollout.valid.reshape(-1)),
        state.observed.including(rows["observation"].astype(np.float64)),
        walkers,
        episode_return,
        state.control_steps + rollout.valid.size,
        state.failures + rollout.failures,
    )
    metrics = {"failures": float(following.failures)}
    return following, metrics | ({"return_in_simulator": float(finished.mean())} if len(finished) else {})


def explore_or_act(
    problem: PolicyProblem,
    state: Interaction,
    policy: Policy,
    key: PRNGKeyArray,
    *,
    control_steps: int,
    warmup_steps: int,
    updates_per_step: float,
) -> tuple[Interaction, Epoch, int]:
    """Act for `control_steps` in all, and store the transitions; random actions until `warmup_steps` have been taken.

    Returns:
        The interaction, the epoch so far, and how many updates are due.
    """
    explores = state.control_steps < warmup_steps
    acting = UniformPolicy(problem.simulator.action_size) if explores else policy
    rolled = roll_on(problem, state, acting, key, control_steps=control_steps)
    following, metrics = remember(state, *rolled)
    taken = following.control_steps - state.control_steps
    due = round(updates_per_step * taken) if following.control_steps >= warmup_steps else 0
    stage = "exploring" if explores else "learning"
    return following, Epoch(metrics, control_steps=taken, updates=due, stage=stage), due


def check_epoch(epoch_steps: int, *, environments: int, updates_per_step: float) -> None:
    """Refuse an epoch in which some environment takes no control step, or no update is due.

    Raises:
        MadocError: `epoch_steps` or `updates_per_step` is too small.
    """
    if epoch_steps < environments:
        raise MadocError(f"expected epoch_steps of at least the {environments} environments, got {epoch_steps}")
    taken = epoch_steps // environments * environments
    if round(updates_per_step * taken) < 1:
        raise MadocError(
            f"expected at least one update in an epoch of {taken} control steps, got updates_per_step of "
            f"{updates_per_step:g}; raise it, or epoch_steps"
        )


class UniformPolicy(eqx.Module):
    """The policy of the exploration before the first update: uniform random actions in [-1, 1]; 0 without a key."""

    action_size: int = eqx.field(static=True)

    def __call__(self, observation: Array, key: PRNGKeyArray | None = None) -> Array:
        """Actions for a batch of observations."""
        shape = (*observation.shape[:-1], self.action_size)
        return jnp.zeros(shape) if key is None else jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


def _episode_returns(rollout: Rollout, running: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns of the episodes that ended in a rollout, and the running sums of those that did not."""
    finished = []
    seen = rollout.transitions
    for reward, ended, valid in zip(seen.reward, seen.terminated | seen.truncated, rollout.valid, strict=True):
        running = running + np.where(valid, reward, 0.0)
        finished.append(running[ended])
        running = np.where(ended | ~valid, 0.0, running)
    return np.concatenate(finished), running


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Judged:
    """The best policy that was judged.

    Attributes:
        best: That policy; the untrained one before the first judgement.
        best_return: Its mean return then.
        last: What the learner had spent at the last judgement; 0 before the first.
    """

    best: TanhGaussianPolicy
    best_return: float
    last: int

    @classmethod
    def none(cls, policy: TanhGaussianPolicy) -> "Judged":
        """Before the first judgement."""
        return cls(policy, 0.0, 0)

    def due(self, spent: int, every: int) -> bool:
        """Whether so much was spent since the last judgement that there is to be another; never if `every` is 0."""
        return bool(every) and spent >= self.last + every

    def handed_back(self, latest: TanhGaussianPolicy) -> TanhGaussianPolicy:
        """The best policy, the latest where none was judged."""
        return self.best if self.last else latest

    def including(self, policy: TanhGaussianPolicy, mean: float, spent: int) -> "Judged":
        """After a policy was judged at this mean return: it is kept if no earlier one's was as high."""
        better = not self.last or mean > self.best_return
        return Judged(policy, mean, spent) if better else replace(self, last=spent)


def judge(
    problem: PolicyProblem,
    policy: TanhGaussianPolicy,
    judged: Judged,
    epoch: Epoch,
    key: PRNGKeyArray,
    *,
    episodes: int,
    spent: int,
) -> tuple[Judged, Epoch]:
    """Let a policy act whole episodes without noise, and keep it if no earlier one's mean return was as high.

    Returns:
        What is kept, and the epoch with the policy's mean return and the control steps of the episodes, which the
        budget does not count.
    """
    of_systems, of_episodes = jax.random.split(key)
    systems = problem.systems(of_systems, episodes)
    outcome = evaluate(policy, problem.simulator, systems, key=of_episodes, episodes=episodes)
    mean, acted = float(outcome.returns.mean()), int(outcome.lengths.sum())
    metrics = epoch.metrics | {"judged_return": mean}
    return judged.including(policy, mean, spent), replace(
        epoch, metrics=metrics, control_steps=epoch.control_steps + acted, unbudgeted=epoch.unbudgeted + acted
    )
