"""Policies where the estimate is not sure, which parameter errors matter, and what the policies look like."""

import base64
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from madoc.report.reading import Evidence, Run, read_arrays
from madoc.report.sections.outcome import POLICIES


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
    if seen is None or run.evidence is None:
        return "No film was made: no held-out run could be replayed, or the robot has no shape."
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
