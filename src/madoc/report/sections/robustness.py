"""Policies where the estimate is not sure, which parameter errors matter, and what the policies look like."""

from madoc.report.film import read_film, rendered, strip
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


def film(run: Run) -> dict[str, object] | str:
    """An episode of each policy, as a strip of pictures; else as one of outlines, those of the truth in grey beside."""
    seen = read_film(run.whole)
    if seen is None:
        return "No policy of this run was filmed."
    names = seen.names
    beside = names.index("truth") if "truth" in names else None
    shown = rendered(seen)
    strips = [
        {
            "title": POLICIES.get(name, (name, ""))[0],
            "chart": shown[index] if shown else strip(seen, index, beside=beside),
        }
        for index, name in enumerate(names)
    ]
    known = run.evaluation is not None and bool(run.evaluation.policies)
    where = "the target" if known else "the calibrated simulator"
    return {"strips": strips, "where": where, "ghost": not shown and len(names) > 1 and beside is not None}
