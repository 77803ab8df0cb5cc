"""Run a policy learner on a problem."""

from dataclasses import dataclass

from jaxtyping import PRNGKeyArray

from madoc.policies.base import PolicyLearner, PolicyProblem, require_reward
from madoc.policies.files import save_policy
from madoc.policies.registry import LEARNERS
from madoc.runs import loop
from madoc.runs.budget import Budget
from madoc.runs.run_folder import RunFolder
from madoc.types import Policy, State, Unit, entry_of


@dataclass(frozen=True)
class LearnedPolicy:
    """A policy, and how its learning ended: see `madoc.runs.loop.Finished`; `spent` is counted in `unit`."""

    policy: Policy
    status: str
    sentence: str
    control_steps: int
    updates: int
    spent: int
    unit: Unit
    seconds: float


def learn_policy(
    method: PolicyLearner[State],
    problem: PolicyProblem,
    *,
    key: PRNGKeyArray,
    budget: Budget | str,
    folder: RunFolder | None = None,
    resume: bool = False,
    quiet: bool = False,
    checkpoint_every: float = 60.0,
) -> LearnedPolicy:
    """Learn until the budget is spent.

    The budget counts simulated control steps for a learner that simulates and gradient updates for one that does not;
    its entry in `LEARNERS` says which. At one update per control step, the number of updates is the same for both.
    Or it is a time: `Seconds(300)`, or `300s` or `5min` as text.

    With a folder, the policy is saved there as `policy.npz`, which `madoc.numpy_policy` reads without JAX.

    Raises:
        MadocError: The robot has no reward, the method refuses the problem, or `loop.run` refuses.
    """
    require_reward(problem.simulator.task)
    entry = entry_of(method, LEARNERS)
    finished = loop.run(
        method,
        problem,
        key=key,
        budget=budget,
        folder=folder,
        resume=resume,
        quiet=quiet,
        description=f"{entry.name} on {problem.simulator.task.name}",
        shown=entry.shown,
        checkpoint_every=checkpoint_every,
        unit=entry.unit,
    )
    policy = method.policy(finished.state)
    if folder is not None:
        save_policy(policy, folder.policy, task_name=problem.simulator.task.name)
    seconds = round(finished.seconds, 3)
    counts = finished.control_steps, finished.updates, finished.spent, entry.unit, seconds
    return LearnedPolicy(policy, finished.status, finished.sentence, *counts)
