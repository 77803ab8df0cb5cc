"""The best policy so far: learning goes up and down, so what is handed back is the policy that did best when judged."""

from dataclasses import dataclass

import jax
from jaxtyping import PRNGKeyArray

from madoc.evaluation import evaluate
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.policies.base import PolicyProblem


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


def judge(
    problem: PolicyProblem, policy: TanhGaussianPolicy, judged: Judged, key: PRNGKeyArray, *, episodes: int, spent: int
) -> tuple[Judged, float, int]:
    """Let a policy act whole episodes without noise, and keep it if no earlier one's mean return was as high.

    Returns:
        What is kept, the policy's mean return, and the control steps of the episodes.
    """
    of_systems, of_episodes = jax.random.split(key)
    systems = problem.systems(of_systems, episodes)
    outcome = evaluate(policy, problem.simulator, systems, key=of_episodes, episodes=episodes)
    mean = float(outcome.returns.mean())
    better = not judged.last or mean > judged.best_return
    kept = Judged(policy, mean, spent) if better else Judged(judged.best, judged.best_return, spent)
    return kept, mean, int(outcome.lengths.sum())
