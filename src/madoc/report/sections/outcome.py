"""What the run led to and what it took: policies, cost, and what was asked."""

from collections.abc import Mapping

from madoc.report.reading import MetricLog, Run
from madoc.report.words import count, duration, memory

POLICIES = {
    "calibrated": ("calibrated", "after"),
    "midrange": ("mid-range, uncalibrated", "g3"),
    "truth": ("truth, a yardstick", "truth"),
    "distribution": ("over the calibrated distribution", "after"),
}
"""What a policy is called, and the class of its colour, by where it was learnt."""


def policies(run: Run) -> dict[str, object] | str:
    """Returns of policies in the target."""
    if run.evaluation is None or not run.evaluation.policies:
        return "No policy of this run was evaluated in the target."
    returns = run.evaluation.policies
    largest = max(abs(row["return"]) + row["return_std"] for row in returns.values()) or 1.0
    rows = [(*POLICIES.get(name, (name, "measured")), row) for name, row in returns.items()]
    return {"rows": rows, "largest": largest, "episodes": run.evaluation.episodes}


def cost(run: Run) -> dict[str, object] | str:
    """What the calibration took."""
    if run.result is not None:
        steps, seconds = float(run.result.control_steps), run.result.seconds
        judging = run.result.judging_seconds
    elif run.log is not None:
        steps, seconds, judging = float(run.log.spent[-1]), float(run.log.seconds[-1]), 0.0
    else:
        return "The run has not ended, and kept no log."
    facts = [("control steps simulated", count(steps)), ("time of the search", duration(seconds))]
    if judging:
        facts.append(("time of judging on held-out rows", duration(judging)))
    if seconds > 0 and steps:
        facts.append(("control steps a second, all in", count(steps / seconds)))
    if run.log is not None:
        facts.append(("epochs", count(len(run.log))))
    if run.result is not None:
        facts.append(("most memory held", "not known" if run.peak_memory is None else memory(run.peak_memory)))
    return {"facts": facts, "stages": [] if run.log is None else _stages(run.log, judging)}


def _stages(log: MetricLog, judging: float) -> list[dict[str, object]]:
    """Seconds and steps of each stage, and the seconds of judging."""
    costs = log.by_stage()
    words = {name: f"{duration(cost.seconds)}, {count(cost.spent)} {log.unit}" for name, cost in costs.items()}
    seconds = {name: cost.seconds for name, cost in costs.items()}
    if judging:
        words["judging"], seconds["judging"] = duration(judging), judging
    total = sum(seconds.values()) or 1.0
    return [{"name": name, "share": seconds[name] / total, "words": words[name]} for name in words]


def asked(run: Run) -> dict[str, object] | str:
    """What the run was asked, and with which versions."""
    robot = run.spec.robot
    texts = [(f"The robot: {robot.get('file', 'its spec file')}", robot.get("spec", ""))] if robot else []
    kept = robot.get("model") if robot else None
    if isinstance(kept, Mapping) and isinstance(kept.get("contents"), Mapping):
        texts.append(("Files of the model that this folder keeps", "\n".join(map(str, kept["contents"]))))
    return {"texts": [*texts, ("The run's spec", run.spec_text)], "versions": run.spec.versions}
