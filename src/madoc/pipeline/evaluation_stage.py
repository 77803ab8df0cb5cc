"""Evaluation as a stage: learnt policies in the target, side by side."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from madoc.errors import MadocError
from madoc.evaluation import evaluate
from madoc.pipeline.data_stage import check_truth, make_target, task_of_spec
from madoc.pipeline.keys import stage_key
from madoc.policies import load_policy
from madoc.runs.files import read_json, write_json
from madoc.runs.progress import bar


def evaluate_folder(
    folder: Path,
    *,
    truth: Mapping[str, float] | None = None,
    episodes: int = 20,
    seed: int = 0,
    names: Sequence[str] = (),
    quiet: bool = True,
) -> dict[str, Any]:
    """Evaluate the policies of a run in the target, on the same starts, and leave `evaluation.json`.

    Args:
        folder: A run folder with policies in it, or the folder of one policy.
        truth: The target's physical values by name; None takes those the run remembers.
        episodes: How many.
        seed: Of the starts.
        names: Only the policies of these names; empty takes all.
        quiet: Show no progress.

    Returns:
        What `evaluation.json` holds: `policies` has, by name, the mean return, its spread over episodes, the
        normalized score and the mean length. `calibrated_percent_of_truth` is there when both are.

    Raises:
        MadocError: There is no policy, the truth is not known, or a number is out of range.
    """
    if episodes < 1:
        raise MadocError(f"expected at least 1 episode, got {episodes}")
    key = stage_key(seed, "evaluating")
    policies = find_policies(folder)
    policies = {name: policies[name] for name in names or policies}
    spec = _spec_with_truth(folder, policies)
    known = spec["truth"] if truth is None else dict(truth)
    if known is None:
        raise MadocError(f"the true parameters of {folder} are not known; pass --truth FILE.json")
    task = task_of_spec(spec)
    check_truth(known, task.with_parameters(list(spec["parameters"])), physics=task.physics)
    target = make_target(task, known)
    found: dict[str, Any] = {}
    total = len(policies) * task.max_episode_steps
    with bar(f"evaluating on {task.name}", total=total, unit="steps", quiet=quiet) as advance:
        for name, file in policies.items():
            returns = evaluate(
                load_policy(file),
                target.simulator,
                target.parameters,
                key=key,
                episodes=episodes,
                advance=advance,
            )
            found[name] = returns.summary()
    evaluation = {
        "task": task.name,
        "physics": task.physics,
        "episodes": episodes,
        "seed": seed,
        "policies": found,
    } | _share_of_truth(found)
    write_json(folder / "evaluation.json", evaluation)
    return evaluation


def find_policies(folder: Path) -> dict[str, Path]:
    """The policy files of a run by name: `calibrated`, `midrange`, `truth`, ...

    Raises:
        MadocError: There is none.
    """
    if not folder.is_dir():
        raise MadocError(f"there is no run folder {folder}; check the path")
    files = [folder / "policy.npz", *sorted(folder.glob("policy-*/policy.npz"))]
    found = {file.parent.resolve().name.removeprefix("policy-"): file for file in files if file.exists()}
    if not found:
        raise MadocError(f"there is no learnt policy in {folder}; learn one with: madoc learn {folder}")
    return found


def _spec_with_truth(folder: Path, policies: Mapping[str, Path]) -> dict[str, Any]:
    """The spec of a run that says robot, physics and parameters; of several, one that knows the truth."""
    places = [folder / "calibration", folder, *(file.parent for file in policies.values())]
    files = [place / "spec.json" for place in places]
    specs = [spec for spec in (read_json(file) for file in files if file.exists()) if "physics" in spec]
    specs = [spec for spec in specs if spec.get("command") in ("calibrate", "learn")]
    if not specs:
        raise MadocError(f"{folder} holds no run of madoc: there is no spec.json that names its robot")
    return next((spec for spec in specs if spec["truth"] is not None), specs[0])


def _share_of_truth(found: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    if not {"calibrated", "truth"} <= set(found) or found["truth"]["return"] <= 0:
        return {}
    return {"calibrated_percent_of_truth": 100.0 * found["calibrated"]["return"] / found["truth"]["return"]}
