"""Run a policy learner on a problem and hand back its policy."""

from dataclasses import dataclass

from jaxtyping import PRNGKeyArray

from madoc import loop
from madoc.policies.base import PolicyLearner, PolicyProblem
from madoc.policies.files import save_policy
from madoc.run_folder import RunFolder
from madoc.types import Policy


@dataclass(frozen=True)
class LearnedPolicy:
    """A policy and how its learning ended.

    Attributes:
        policy: Acts; deterministic without a key.
        status: As `loop.Finished` has it.
        sentence: The status in words.
        control_steps: Simulated control steps spent.
        seconds: Wall-clock time.
    """

    policy: Policy
    status: str
    sentence: str
    control_steps: int
    seconds: float


def learn_policy(
    method: PolicyLearner,
    problem: PolicyProblem,
    *,
    key: PRNGKeyArray,
    budget: int,
    folder: RunFolder | None = None,
    resume: bool = False,
    quiet: bool = True,
    checkpoint_every: float = 60.0,
) -> LearnedPolicy:
    """Learn in the problem's systems until the budget of control steps is spent.

    With a folder, `policy.npz` is left there: `madoc.numpy_policy` acts from it without JAX.

    Raises:
        MadocError: The method refuses the problem, or `loop.run` refuses.
    """
    finished = loop.run(
        method,
        problem,
        key=key,
        budget=budget,
        folder=folder,
        resume=resume,
        quiet=quiet,
        description=f"{method.name} on {problem.simulator.task.name}",
        shown=method.shown,
        checkpoint_every=checkpoint_every,
    )
    policy = method.policy(finished.state)
    if folder is not None:
        save_policy(policy, folder.path / "policy.npz", task_name=problem.simulator.task.name)
    return LearnedPolicy(policy, finished.status, finished.sentence, finished.control_steps, round(finished.seconds, 3))
