"""Evaluation as a stage: learnt policies in the target, side by side."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from madoc.errors import MadocError
from madoc.evaluation import evaluate
from madoc.pipeline.data_stage import Machine, read_truth
from madoc.pipeline.keys import stage_key
from madoc.pipeline.orders import EvaluationOrder
from madoc.policies import load_policy
from madoc.report.records import EvaluationRecord, SpecRecord, read_spec
from madoc.runs.files import write_json
from madoc.runs.progress import bar


def evaluate_folder(
    folder: Path, order: EvaluationOrder | None = None, *, names: Sequence[str] = (), quiet: bool = False
) -> EvaluationRecord:
    """Evaluate policies of a run in the target, on the same starts, and leave `evaluation.json`.

    The folder is that of a run or of one policy. Without `names` all its policies are evaluated; without a truth in
    the order, that of the run is taken.

    Raises:
        MadocError: There is no policy, the truth is not known, or a number is out of range.
    """
    order = order or EvaluationOrder()
    if order.episodes < 1:
        raise MadocError(f"expected at least 1 episode, got {order.episodes}")
    key = stage_key(order.seed, "evaluating")
    policies = find_policies(folder)
    policies = {name: policies[name] for name in names or policies}
    spec = _spec_with_truth(folder, policies)
    truth = read_truth(order.truth) or spec.truth
    if truth is None:
        raise MadocError(f"the true parameters of {folder} are not known; pass --truth FILE.json")
    machine = Machine.restored(spec)
    task = machine.task
    machine.check_truth(truth, task.with_parameters(list(spec.parameters)))
    simulator, parameters = machine.at(truth)
    summaries: dict[str, dict[str, float]] = {}
    total = len(policies) * task.max_episode_steps
    with bar(f"evaluating on {task.name}", total=total, unit="steps", quiet=quiet) as advance:
        for name, file in policies.items():
            policy = load_policy(file)
            returns = evaluate(policy, simulator, parameters, key=key, episodes=order.episodes, advance=advance)
            summaries[name] = returns.summary()
    share = _percent_of_truth(summaries)
    evaluation = EvaluationRecord(task.name, task.physics, order.episodes, order.seed, summaries, share)
    write_json(folder / "evaluation.json", evaluation.to_json())
    return evaluation


def find_policies(folder: Path) -> dict[str, Path]:
    """The policy files of a run by name: `calibrated`, `midrange`, `truth`, ...

    Raises:
        MadocError: There is none.
    """
    if not folder.is_dir():
        raise MadocError(f"there is no run folder {folder}; check the path")
    files = [folder / "policy.npz", *sorted(folder.glob("policy-*/policy.npz"))]
    policies = {file.parent.resolve().name.removeprefix("policy-"): file for file in files if file.exists()}
    if not policies:
        raise MadocError(f"there is no learnt policy in {folder}; learn one with: madoc learn {folder}")
    return policies


def _spec_with_truth(folder: Path, policies: Mapping[str, Path]) -> SpecRecord:
    """The spec of a run that says robot, physics and parameters; of several, one that knows the truth."""
    places = [folder / "calibration", folder, *(file.parent for file in policies.values())]
    specs = [spec for spec in map(read_spec, places) if spec.command in ("calibrate", "learn")]
    if not specs:
        raise MadocError(f"{folder} holds no run of madoc: there is no spec.json that names its robot")
    return next((spec for spec in specs if spec.truth is not None), specs[0])


def _percent_of_truth(summaries: Mapping[str, Mapping[str, float]]) -> float | None:
    """Return of the calibrated policy in percent of that learnt at the truth, where both are there."""
    if not {"calibrated", "truth"} <= set(summaries) or summaries["truth"]["return"] <= 0:
        return None
    return 100.0 * summaries["calibrated"]["return"] / summaries["truth"]["return"]
