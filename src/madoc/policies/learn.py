"""Run a policy learner on a problem and hand back its policy."""

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
    """A policy and how its learning ended.

    Attributes:
        policy: Acts; deterministic without a key.
        status: As `loop.Finished` has it.
        sentence: The status in words.
        control_steps: Simulated control steps spent.
        updates: Gradient updates spent.
        spent: How much of the budget, in `unit`.
        unit: What the budget counted: control steps of a learner that simulates, updates of one that does not.
        seconds: Wall-clock time.
    """

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

    The budget is simulated control steps for a learner that simulates and gradient updates for one that does not:
    the entry in `LEARNERS` says which. With one update per control step, a budget means as many updates for either.
    Or it is a time: `Seconds(300)`, or `300s` or `5min` as text.

    With a folder, `policy.npz` is left there: `madoc.numpy_policy` acts from it without JAX.

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
        save_policy(policy, folder.path / "policy.npz", task_name=problem.simulator.task.name)
    return LearnedPolicy(
        policy,
        finished.status,
        finished.sentence,
        finished.control_steps,
        finished.updates,
        finished.spent,
        entry.unit,
        round(finished.seconds, 3),
    )
