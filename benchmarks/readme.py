"""The measured tables of the README, made from kept results, between marks that name them."""

import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from kept import POLICIES, commits
from paper_cells import printed
from paper_errors import calibrations, error_cell
from pooling import OUR_LOGS

README = Path(__file__).parents[1] / "README.md"
NAMES = {"hopper": "Hopper", "halfcheetah": "HalfCheetah", "walker2d": "Walker2d", "ant": "Ant"}
COLUMNS = ("madoc", "least-squares", "cma-es", "droid", "dropo", "oted", "mid-range")
"""Methods of the table of errors; mid-range is no method."""
PLACES = ("calibrated", "truth", "midrange")
"""Parameters at which policies are learnt, in the order of the columns."""
_MARKED = re.compile(r"(<!-- measured: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def rewritten(text: str) -> str:
    """The README with its marked tables made anew.

    Raises:
        KeyError: A mark names no table.
    """
    tables: dict[str, Callable[[], str]] = {"errors": errors, "minutes": minutes}
    return _MARKED.sub(lambda found: found[1] + tables[found[2]]() + found[3], text)


def errors() -> str:
    """Error on medium data by method, beside what the paper prints of its own."""
    found = calibrations("table-10")
    lines = [f"| robot | {' | '.join(COLUMNS)} | paper's Madoc | commits |", "|---" * (len(COLUMNS) + 3) + "|"]
    for robot, name in NAMES.items():
        task = f"{robot}-medium"
        rows = [found.get((task, column), []) for column in COLUMNS]
        cells = [error_cell(each, None) for each in rows]
        theirs = printed("table-10", task, "madoc")
        cells += ["" if theirs is None else f"{theirs[0]:g}", commits(chain.from_iterable(rows))]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join([*lines, "", f"{OUR_LOGS} Means over logs, in raw units.", ""])


def minutes() -> str:
    """Median return of the default learner after the longest wall time it was given, by where it learnt."""
    cells = defaultdict[tuple[str, str], defaultdict[float, list[Mapping]]](lambda: defaultdict(list))
    rows = [row for row in POLICIES.rows() if (row["method"], row["set"]) == ("fast-sac", [])]
    whose = [row["calibrator"] for row in rows if row["at"] == "calibrated"][-1]
    for row in rows:
        if row["calibrator"] in (whose, None):
            cells[row["robot"], row["at"]][float(row["budget"].removesuffix("s"))].append(row)
    lines = [
        f"| robot | wall time | learnt at the estimate of `{whose.partition('-logged')[0]}` | at the truth "
        "| at mid-range | commits |",
        "|---" * 6 + "|",
    ]
    for robot, name in NAMES.items():
        longest = max(cells[robot, "calibrated"])
        found = [cells[robot, place][longest] for place in PLACES]
        earned = " | ".join(_earned([row["return"] for row in each]) for each in found)
        lines.append(f"| {name} | {longest:.0f} s | {earned} | {commits(chain.from_iterable(found))} |")
    return "\n".join(lines) + "\n"


def _earned(returns: Sequence[float]) -> str:
    """Median and range; of a single seed, its return."""
    if len(returns) == 1:
        return f"{returns[0]:.0f} (one seed)"
    return f"{np.median(returns):.0f} ({min(returns):.0f} to {max(returns):.0f})"
