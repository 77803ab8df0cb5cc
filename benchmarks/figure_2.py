"""Figure 2 of the paper: what the critic of gravity knows of the error of gravity, with groups and with one agent."""

from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from jaxtyping import PRNGKeyArray
from paper_cells import how_far, kept, planned, wanted
from scipy import stats

from madoc.calibration.madoc import grouping
from madoc.calibration.madoc.agents import draw_parameters
from madoc.calibration.madoc.state import MadocState
from madoc.parameters import ParameterSpace
from madoc.pipeline.calibration_stage import methods_for, prepare
from madoc.pipeline.orders import CalibrationOrder
from madoc.pipeline.refusals import seed_key
from madoc.runs import checkpoint
from madoc.suites.cells import Cell
from madoc.suites.planning import Plan
from madoc.suites.results import Result

TITLE = "Figure 2: correlation of the critic's value with the absolute error of gravity"
PARAMETER = "gravity"
COUNT = 2000
"""Draws that are correlated."""
DRAWS = {"actors": "drawn from the actors", "uniform": "uniform over the ranges"}


def cells(plan: Plan) -> list[Cell]:
    """The calibrations."""
    return wanted(plan)


def told(result: Result, folder: Path) -> dict:
    """What is kept of a result: correlations by the way of drawing, and the control steps before."""
    if result.calibration is None:
        return {"refusal": result.sentence}
    order = result.cell.read()
    assert isinstance(order, CalibrationOrder)
    paths = tuple(str(folder / "cells" / path) for path in order.source.paths)
    prepared = prepare(replace(order, source=replace(order.source, paths=paths)))
    (method,) = methods_for(order.method, order.search.set).values()
    like = method.init(prepared.problem, seed_key(prepared.seed))
    state, _ = checkpoint.load(result.cell.folder(folder) / "checkpoint.npz", like)
    assert prepared.calibrated_truth is not None
    found = correlations(
        state, prepared.simulator.parameters, prepared.calibrated_truth[PARAMETER], key=jax.random.key(0)
    )
    return {"correlations": found, "control_steps": result.calibration.control_steps}


def correlations(state: MadocState, space: ParameterSpace, truth: float, *, key: PRNGKeyArray) -> dict[str, float]:
    """Pearson's correlation of a draw's value to the critic of gravity's group, and gravity's absolute error.

    Of a critic that knows the error it is near -1.

    Args:
        state: Madoc at its end.
        space: The parameters.
        truth: True gravity.
        key: Of the draws.

    Returns:
        A correlation for each way to draw all parameters: from the last actors, and uniformly over the ranges.
    """
    agents, index = state.agents, space.names.index(PARAMETER)
    members = grouping.members(state.labels, len(agents.critics.weight))
    of_actors, of_ranges = jax.random.split(key)
    drawn, _ = draw_parameters(agents.actors, of_actors, COUNT)
    uniform = jax.random.uniform(of_ranges, drawn.shape, minval=-1.0, maxval=1.0)
    found = {}
    for name, draws in zip(DRAWS, (drawn, uniform), strict=True):
        value = np.asarray(agents.critics.values(draws, members)[:, state.labels[index]], np.float64)
        error = np.abs(space.to_physical(np.asarray(draws, np.float64))[:, index] - truth)
        found[name] = round(float(stats.pearsonr(value, error).statistic), 4)
    return found


def table(name: str) -> str:
    """The figure as a table, as Markdown without its title."""
    plan, found = planned(name), kept(name)
    by_method = defaultdict[str, dict[int, dict]](dict)
    for cell in wanted(plan):
        by_method[cell.asks["method"]][cell.asks.get("seed", 0)] = found.get(cell.name, {})
    seeds = sorted({seed for rows in by_method.values() for seed in rows})
    lines = [
        f"{how_far(name, wanted(plan))}.\n",
        f"Each correlation is over {COUNT:,} draws of all parameters, from the actors at the end or uniform over the "
        "ranges; of a critic that knows the error it is -1. The paper shows dots, and prints no number.\n",
        f"| calibrator | draws | {' | '.join(f'seed {seed}' for seed in seeds)} | mean | control steps |",
        "|---" * (4 + len(seeds)) + "|",
    ]
    for method, rows in by_method.items():
        steps = sorted({row["control_steps"] for row in rows.values() if "control_steps" in row})
        spent = " to ".join(f"{count:,}" for count in dict.fromkeys((steps[0], steps[-1]))) if steps else ""
        for way, words in DRAWS.items():
            values = {seed: row["correlations"][way] for seed, row in rows.items() if "correlations" in row}
            shown = [f"{values[seed]:.2f}" if seed in values else "not run" for seed in seeds]
            mean = f"{np.mean(list(values.values())):.2f}" if values else ""
            lines.append(f"| {method} | {words} | {' | '.join(shown)} | {mean} | {spent} |")
    return "\n".join(lines) + "\n"
