"""What came of it and what it took: policies, cost, what was asked."""

import numpy as np

from madoc.report.reading import MetricLog, Run
from madoc.report.sections.base import Section, Shown
from madoc.report.words import count, duration, number

_POLICIES = {
    "calibrated": ("calibrated", "after"),
    "midrange": ("mid-range, uncalibrated", "before"),
    "truth": ("truth, a yardstick", "truth"),
}
"""What a policy is called, and the class of its colour, by where it was learnt."""


def policies(run: Run) -> Section:
    """Policies in the target."""
    title = "Policies in the target"
    lede = "Mean return of learnt policies in the target, and its spread over episodes."
    if run.evaluation is None:
        return Section("policies", title, lede, None, "No policy of this run was evaluated in the target.")
    largest = max(abs(row.mean) + row.std for row in run.evaluation.policies.values()) or 1.0
    rows = []
    for name, row in run.evaluation.policies.items():
        words, colour = _POLICIES.get(name, (name, "measured"))
        rows.append(
            {
                "name": words,
                "colour": colour,
                "return": number(row.mean),
                "spread": number(row.std, 2),
                "at": round(100 * max(row.mean, 0) / largest, 2),
                "normalized": number(row.normalized, 3),
                "length": number(row.length, 3),
            }
        )
    return Section("policies", title, lede, {"rows": rows, "episodes": run.evaluation.episodes})


def cost(run: Run) -> Section:
    """What the calibration took."""
    title, lede = "Cost", "Where the time went."
    if run.result is not None:
        steps, seconds = float(run.result.control_steps), run.result.seconds
    elif run.log is not None:
        steps, seconds = float(run.log.spent[-1]), float(run.log.seconds[-1])
    else:
        return Section("cost", title, lede, None, "The run has not ended, and kept no log.")
    facts = [("control steps simulated", count(steps)), ("wall-clock time", duration(seconds))]
    if seconds > 0 and steps:
        facts.append(("control steps a second, all in", count(steps / seconds)))
    if run.log is not None:
        facts.append(("epochs", count(len(run.log))))
    return Section("cost", title, lede, {"facts": facts, "stages": [] if run.log is None else _stages(run.log)})


def _stages(log: MetricLog) -> list[Shown]:
    """Seconds and steps of each stage; what came before the first line of the log belongs to the first stage."""
    seconds, steps = np.diff(log.seconds, prepend=0.0), np.diff(log.spent, prepend=0.0)
    names = list(dict.fromkeys(log.stage))
    of_stage = {name: np.array([stage == name for stage in log.stage]) for name in names}
    total = float(seconds.sum()) or 1.0
    return [
        {
            "name": name,
            "share": round(100 * float(seconds[rows].sum()) / total, 2),
            "words": f"{duration(float(seconds[rows].sum()))}, {count(float(steps[rows].sum()))} {log.unit}",
            "colour": f"g{index % 8}",
        }
        for index, (name, rows) in enumerate(of_stage.items())
    ]


def asked(run: Run) -> Section:
    """What the run was asked, and with which versions."""
    spec = run.spec
    texts = [(f"The robot: {spec.robot.file}", spec.robot.spec)] if spec.robot else []
    data: Shown = {"texts": [*texts, ("The run's spec", spec.text)], "versions": list(spec.versions.items())}
    return Section("asked", "What was asked", "As the run's folder keeps it, and the versions that ran.", data)
