"""What the run led to and what it took: policies in the target and where the estimate is not sure, films, cost."""

import base64
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from madoc.report.reading import Evidence, MetricLog, Run, read_arrays
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


@dataclass(frozen=True)
class Film:
    """Panels that play together, each a sheet of pictures.

    Attributes:
        sheets: The sheet of each panel by its name: a WebP in base64, its pictures row after row.
        time: Time of each picture, s.
        size: Width and height of a picture in pixels.
        columns: Pictures in a row of a sheet.
        still: The picture that is shown until the film is played.
    """

    sheets: dict[str, str]
    time: Float[np.ndarray, " frames"]
    size: tuple[int, int]
    columns: int
    still: int = 0

    @property
    def rows(self) -> int:
        """Rows of a sheet."""
        return -(-len(self.time) // self.columns)


def read_film(path: Path) -> Film | None:
    """The film in a file of `pipeline.film_stage`; None where there is none."""
    arrays = read_arrays(path, "names", "time", "size", "columns")
    if arrays is None:
        return None
    names = [str(name) for name in arrays["names"]]
    sheets = {name: base64.b64encode(arrays[f"sheet_{index}"].tobytes()).decode() for index, name in enumerate(names)}
    width, height = arrays["size"].tolist()
    return Film(sheets, np.asarray(arrays["time"], float), (width, height), int(arrays["columns"]))


def robustness(run: Run) -> dict[str, object] | str:
    """Returns over draws of the estimate, and what an error of each parameter costs."""
    if run.evaluation is None or not run.evaluation.over_draws:
        return "No policy of this run was evaluated over draws of the estimate."
    costs = {
        name: sorted(rows.items(), key=lambda item: -item[1].largest)
        for name, rows in run.evaluation.error_costs.items()
    }
    largest = max((abs(end) for rows in costs.values() for _, row in rows for end in (row.below, row.above)), default=0)
    titles = {name: POLICIES.get(name, (name, ""))[0] for name in run.evaluation.over_draws}
    return {"draws": run.evaluation.over_draws, "titles": titles, "costs": costs, "largest": largest or 1.0}


def motion(run: Run) -> dict[str, object] | str:
    """A held-out run, measured over simulated."""
    seen = read_film(run.folder / "motion.npz")
    if run.evidence is None or run.evidence.after is None:
        return "No film was made: no held-out run could be replayed from a known or fitted state."
    if seen is None:
        return "No film was made: nothing of the model can be drawn, or its pictures could not be made."
    whole = np.isfinite(run.evidence.measured).all(-1).sum(1)
    longest, shown = float(run.evidence.time[whole.max() - 1]), float(seen.time[-1])
    cut = shown if shown < longest - 1e-9 else None
    still = farthest_apart(run.evidence, int(whole.argmax()), seen.time)
    return {"film": replace(seen, still=still), "name": run.evidence.names[int(whole.argmax())], "cut": cut}


def farthest_apart(evidence: Evidence, run: int, time: Float[np.ndarray, " frames"]) -> int:
    """The picture in which the model as given is farthest from what was measured: at the start all are alike."""
    if evidence.before is None:
        return 0
    rows = np.searchsorted(evidence.time, time - 1e-9).clip(max=len(evidence.time) - 1)
    missed = (evidence.before - evidence.measured)[run, rows] / np.where(evidence.scale > 0, evidence.scale, 1.0)
    return int(np.nan_to_num((missed**2).sum(-1)).argmax())


def film(run: Run) -> dict[str, object] | str:
    """An episode of each policy."""
    seen = read_film(run.whole / "film.npz")
    if seen is None:
        return "No policy of this run was filmed."
    known = run.evaluation is not None and bool(run.evaluation.policies)
    named = replace(seen, sheets={POLICIES.get(name, (name, ""))[0]: sheet for name, sheet in seen.sheets.items()})
    return {"film": named, "where": "the target" if known else "the calibrated simulator"}


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
