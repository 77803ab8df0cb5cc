"""The best policy so far: learning goes up and down, so what is handed back is the policy that did best when judged.

One rule for all learners: what has something to judge in, a simulator or learnt models, hands back its best there; what
has nothing (`bc`, `cql`) hands back its last.
"""

from dataclasses import dataclass, replace

import jax
from jaxtyping import PRNGKeyArray

from madoc.evaluation import evaluate
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.policies.base import PolicyProblem
from madoc.types import Epoch


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
