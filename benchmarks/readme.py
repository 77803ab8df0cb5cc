"""The measured tables of the README, made from committed results, between marks that name them."""

import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import paper

README = Path(__file__).parents[1] / "README.md"
NAMES = {"hopper": "Hopper", "halfcheetah": "HalfCheetah", "walker2d": "Walker2d", "ant": "Ant"}
PLACES = ("calibrated", "truth", "midrange")
"""Parameters at which policies are learnt, in the order of the columns."""
_MARKED = re.compile(r"(<!-- measured: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def rewritten(text: str, calibrations: Sequence[dict], policies: Sequence[dict]) -> str:
    """The README with its marked tables made anew.

    Args:
        text: The README.
        calibrations: Every calibration that was run.
        policies: Every policy that was learnt and evaluated.

    Raises:
        KeyError: A mark names no table.
    """
    tables: dict[str, Callable[[], str]] = {
        "errors": lambda: errors(calibrations),
        "minutes": lambda: minutes(policies),
        "returns": lambda: returns(policies),
        "tasks": tasks,
    }
    return _MARKED.sub(lambda found: found[1] + tables[found[2]]() + found[3], text)


def errors(rows: Sequence[dict]) -> str:
    """Error of Madoc on clean medium data with 300 000 control steps, beside medians of it on changes s' - s alone."""
    cells = defaultdict[tuple[str, str, str], list[float]](list)
    for row in rows:
        if (row["quality"], row["data"], row["budget"]) == ("medium", "clean", 300_000) and "error" in row:
            cells[row["robot"], row["method"], row["starts"]].append(row["error"]["mean_absolute"])
    columns = {
        "`madoc` on changes": ("madoc-changes", "policy"),
        "the same, groups by a VAE": ("madoc-vae-changes", "policy"),
        "the same, one group": ("madoc-s-changes", "policy"),
    }
    now = {task: error for task, error, _, _ in paper.beside_printed("madoc")}
    lines = [f"| robot | `madoc` | {' | '.join(columns)} | paper |", "|---" * (len(columns) + 3) + "|"]
    for robot, name in NAMES.items():
        before = " | ".join(f"{np.median(cells[robot, *column]):.3f}" for column in columns.values())
        printed = paper.printed("table-10", f"{robot}-medium", "madoc")
        assert printed is not None
        lines.append(f"| {name} | {now[f'{robot}-medium']:.3f} | {before} | {printed[0]:.2f} |")
    return "\n".join(lines) + "\n"


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
    seeds = min(row[3] for row in rows)
    within = f"{len(rows) - len(above)}, all but {' and '.join(above)}" if above else "each of them"
    return (
        f"On {len(rows)} of the paper's 21 tasks, {seeds} seed{'s' * (seeds > 1)} each, `madoc` errs by {ours:.2f} on "
        f"average where the paper prints {theirs:.2f},\nand by no more than printed in {within}. It learns from "
        "300 000 control steps.\n"
    )


def _earned(returns: Sequence[float]) -> str:
    """Median and range; of a single seed, its return."""
    if len(returns) == 1:
        return f"{returns[0]:.0f} (one seed)"
    return f"{np.median(returns):.0f} ({min(returns):.0f} to {max(returns):.0f})"
