"""What came of it and what it took: policies, cost, what was asked."""

from typing import Any

import numpy as np

from madoc.report.reading import MetricLog, Run
from madoc.report.sections.base import Section
from madoc.report.words import count, duration, number
from madoc.robots.document import yaml_text


def policies(run: Run) -> Section:
    """Policies in the target."""
    title = "Policies in the target"
    lede = "Mean return of learnt policies in the target, and its spread over episodes."
    evaluation = run.evaluation
    if not evaluation:
        return Section("policies", title, lede, None, "No policy of this run was evaluated in the target.")
    largest = max(abs(row["return"]) + row["return_std"] for row in evaluation["policies"].values()) or 1.0
    words = {"calibrated": "calibrated", "midrange": "mid-range, uncalibrated", "truth": "truth, a yardstick"}
    rows = [
        {
            "name": words.get(name, name),
            "colour": {"calibrated": "after", "midrange": "before", "truth": "truth"}.get(name, "measured"),
            "return": number(row["return"]),
            "spread": number(row["return_std"], 2),
            "at": round(100 * max(row["return"], 0) / largest, 2),
            "normalized": number(row["normalized"], 3),
            "length": number(row["length"], 3),
        }
        for name, row in evaluation["policies"].items()
    ]
    return Section("policies", title, lede, {"rows": rows, "episodes": evaluation["episodes"]})


def cost(run: Run) -> Section:
    """What it took."""
    title, lede = "Cost", "Where the time went."
    steps, seconds = run.result.get("control_steps"), run.result.get("seconds")
    if steps is None or seconds is None:
        if run.log is None:
            return Section("cost", title, lede, None, "The run has not ended, and kept no log.")
        steps, seconds = run.log.spent[-1], run.log.seconds[-1]
    stages = [] if run.log is None else _stages(run.log)
    total = sum(stage["seconds"] for stage in stages) or 1.0
    facts = [("control steps simulated", count(steps)), ("wall-clock time", duration(seconds))]
    if seconds > 0 and steps:
        facts.append(("control steps a second, all in", count(steps / seconds)))
    if run.log is not None:
        facts.append(("epochs", count(len(run.log))))
    shown = [
        {
            "name": stage["name"],
            "share": round(100 * stage["seconds"] / total, 2),
            "words": f"{duration(stage['seconds'])}, {count(stage['steps'])} {run.log.unit if run.log else ''}",
            "colour": f"g{index % 8}",
        }
        for index, stage in enumerate(stages)
    ]
    return Section("cost", title, lede, {"facts": facts, "stages": shown})


def _stages(log: MetricLog) -> list[dict[str, Any]]:
    """Seconds and steps of each stage; what came before the first line belongs to the first."""
    seconds, steps = np.diff(log.seconds, prepend=0.0), np.diff(log.spent, prepend=0.0)
    names = list(dict.fromkeys(log.stage))
    of_stage = {name: np.array([stage == name for stage in log.stage]) for name in names}
    return [
        {"name": name, "seconds": float(seconds[rows].sum()), "steps": float(steps[rows].sum())}
        for name, rows in of_stage.items()
    ]


def asked(run: Run) -> Section:
    """What the run was asked, and with which versions."""
    robot = run.spec.get("robot") or {}
    spec = {name: value for name, value in run.spec.items() if name not in ("versions", "robot")}
    texts = [("The run's spec", yaml_text(spec, width=80))]
    if robot:
        texts.insert(0, (f"The robot: {robot.get('file', 'its spec file')}", str(robot.get("spec", ""))))
    data = {"texts": texts, "versions": list(run.spec.get("versions", {}).items())}
    return Section("asked", "What was asked", "As the run's folder keeps it, and the versions that ran.", data)
