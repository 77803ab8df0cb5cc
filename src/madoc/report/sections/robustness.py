"""Policies where the estimate is not sure, which parameter errors matter, and what the policies look like."""

from dataclasses import replace

import numpy as np

from madoc.report.film import read_film
from madoc.report.reading import Run
from madoc.report.sections.outcome import POLICIES


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
    return {"film": seen, "name": run.evidence.names[int(whole.argmax())], "cut": cut}


def film(run: Run) -> dict[str, object] | str:
    """An episode of each policy."""
    seen = read_film(run.whole / "film.npz")
    if seen is None:
        return "No policy of this run was filmed."
    known = run.evaluation is not None and bool(run.evaluation.policies)
    named = replace(seen, sheets={POLICIES.get(name, (name, ""))[0]: sheet for name, sheet in seen.sheets.items()})
    return {"film": named, "where": "the target" if known else "the calibrated simulator"}
