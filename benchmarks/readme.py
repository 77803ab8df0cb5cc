"""The measured tables of the README, made from committed results, between marks that name them."""

import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import paper
from scipy import stats

README = Path(__file__).parents[1] / "README.md"
NAMES = {"hopper": "Hopper", "halfcheetah": "HalfCheetah", "walker2d": "Walker2d", "ant": "Ant"}
PLACES = ("calibrated", "truth", "midrange")
"""Parameters at which policies are learnt, in the order of the columns."""
_MARKED = re.compile(r"(<!-- measured: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def rewritten(text: str, policies: Sequence[dict]) -> str:
    """The README with its marked tables made anew.

    Args:
        text: The README.
        policies: Every policy that was learnt and evaluated.

    Raises:
        KeyError: A mark names no table.
    """
    tables: dict[str, Callable[[], str]] = {
        "errors": errors,
        "minutes": lambda: minutes(policies),
        "returns": lambda: returns(policies),
        "tasks": tasks,
    }
    return _MARKED.sub(lambda found: found[1] + tables[found[2]]() + found[3], text)


def errors() -> str:
    """Madoc's error on medium data by who its agents are, beside the printed ones, and whether groups pay."""
    found = paper.by_seed("groups")
    columns = {"madoc": "groups", "madoc-s": "one agent", "madoc-ungrouped": "one agent a parameter"}
    lines = [
        f"| robot | {' | '.join(f'{told} (`{name}`)' for name, told in columns.items())} | paper, groups | one agent |",
        "|---" * (len(columns) + 3) + "|",
    ]
    for robot, name in NAMES.items():
        task = f"{robot}-medium"
        ours = " | ".join(_mean(list(found[task, column].values())) for column in columns)
        theirs = [paper.printed("table-10", task, column) for column in ("madoc", "madoc-s")]
        lines.append(f"| {name} | {ours} | {' | '.join(f'{each[0]:.2f}' for each in theirs if each)} |")
    return "\n".join(lines) + "\n" + _comparison(found)


def _comparison(found: Mapping[tuple[str, str], Mapping[int, float]]) -> str:
    """How groups do beside one agent, over pairs of runs with the same log and seed."""
    pairs = [
        (error, one_agent[seed])
        for (task, method), errors in found.items()
        if method == "madoc"
        for seed, error in errors.items()
        if seed in (one_agent := found[task, "madoc-s"])
    ]
    if len(pairs) < 2:
        return ""
    ratios = stats.ttest_1samp(np.log([ours / theirs for ours, theirs in pairs]), 0.0)
    low, high = np.exp(ratios.confidence_interval())
    middle = np.exp(np.mean(np.log([ours / theirs for ours, theirs in pairs])))
    return (
        f"\nOf {len(pairs)} pairs of runs with the same log and seed, groups err less than one agent in "
        f"{sum(ours < theirs for ours, theirs in pairs)}, and {middle:.2f}\ntimes as much in the geometric mean "
        f"(95 % interval over seeds {low:.2f} to {high:.2f}).\n"
    )


def _mean(errors: Sequence[float]) -> str:
    """Mean and number of seeds; nothing of none."""
    return f"{np.mean(errors):.3f} ({len(errors)} seed{'s' * (len(errors) > 1)})" if errors else "not run"


def minutes(rows: Sequence[dict]) -> str:
    """Median return of the default learner after the longest wall time it was given, by where it learnt."""
    cells = defaultdict[tuple[str, str], defaultdict[float, list[float]]](lambda: defaultdict(list))
    for row in rows:
        if (row["method"], row["set"]) == ("fast-sac", []):
            cells[row["robot"], row["at"]][float(row["budget"].removesuffix("s"))].append(row["return"])
    lines = [
        "| robot | wall time | learnt at the calibrated parameters | at the truth | at mid-range |",
        "|---|---|---|---|---|",
    ]
    for robot, name in NAMES.items():
        longest = max(cells[robot, "calibrated"])
        ours = " | ".join(_earned(cells[robot, place][longest]) for place in PLACES)
        lines.append(f"| {name} | {longest:.0f} s | {ours} |")
    return "\n".join(lines) + "\n"


def returns(rows: Sequence[dict]) -> str:
    """Median return of SAC with 300 000 control steps, by the parameters it learnt at."""
    cells = defaultdict[tuple[str, str], list[float]](list)
    for row in rows:
        if (row["method"], row["budget"]) == ("sac", 300_000):
            cells[row["robot"], row["at"]].append(row["return"])
    lines = ["| robot | learnt at the calibrated parameters | at the truth | at mid-range |", "|---|---|---|---|"]
    for robot in ("hopper", "halfcheetah"):
        ours = " | ".join(_earned(cells[robot, place]) for place in PLACES)
        lines.append(f"| {NAMES[robot]} | {ours} |")
    return "\n".join(lines) + "\n"


def tasks() -> str:
    """Madoc's error on the paper's 21 tasks beside the printed one, as far as its cells were run."""
    rows = paper.beside_printed("madoc")
    ours, theirs = (np.mean([row[index] for row in rows]) for index in (1, 2))
    above = [row[0] for row in rows if row[1] > row[2]]
    counts = sorted({row[3] for row in rows})
    seeds = f"{counts[0]} to {counts[-1]} seeds" if counts[1:] else f"{counts[0]} seed{'s' * (counts[0] > 1)}"
    within = f"{len(rows) - len(above)}, all but {' and '.join(above)}" if above else "each of them"
    return (
        f"On {len(rows)} of the paper's 21 tasks, {seeds} each, `madoc` errs by {ours:.2f} on "
        f"average where the paper prints {theirs:.2f},\nand by no more than printed in {within}. It learns from "
        "300 000 control steps.\n"
    )


def _earned(returns: Sequence[float]) -> str:
    """Median and range; of a single seed, its return."""
    if len(returns) == 1:
        return f"{returns[0]:.0f} (one seed)"
    return f"{np.median(returns):.0f} ({min(returns):.0f} to {max(returns):.0f})"
