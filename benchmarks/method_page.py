"""The table of the page on methods that is made from kept results, between marks that name it."""

import re
from collections.abc import Callable
from itertools import chain
from pathlib import Path

from kept import commits
from paper_cells import calibrations, error_cell, printed
from pooling import OUR_LOGS

PAGE = Path(__file__).parents[1] / "docs" / "concepts" / "which-method.md"
NAMES = {"hopper": "Hopper", "halfcheetah": "HalfCheetah", "walker2d": "Walker2d", "ant": "Ant"}
COLUMNS = ("madoc", "least-squares", "cma-es", "droid", "dropo", "oted", "mid-range")
"""Methods of the table of errors; mid-range is no method."""
_MARKED = re.compile(r"(<!-- measured: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def rewritten(text: str) -> str:
    """The page with its marked tables made anew.

    Raises:
        KeyError: A mark names no table.
    """
    tables: dict[str, Callable[[], str]] = {"errors": errors}
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
