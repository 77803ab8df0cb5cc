"""How rows of calibrations are put together: those of one method, over logs, seeds of a log averaged first."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from kept import is_time
from scipy import stats

METHODS = (
    *("madoc", "madoc-s", "madoc-vdn", "madoc-isac", "madoc-grouped", "madoc-paper"),
    *("least-squares", "npe", "oted", "dropo", "e-dropo", "droid", "cma-es", "cma-es-distribution"),
    *("nominal", "uniform"),
)
"""Calibrators in the order in which tables show them; another one is an error."""
NAMES = {"nominal": "mid-range"}
"""What tables call a method, where that is not its name."""
OUR_LOGS = (
    "Logs recorded by us in the same simulator at planted truths; the paper used D4RL's and NeoRL's files, so a figure "
    "beside a printed one says little."
)
"""Stands wherever a figure of ours stands beside one of the paper's."""
FEWEST_LOGS = 3
"""Of a ratio with an interval."""

Rows = Sequence[Mapping[str, Any]]
Log = tuple[str, ...]


class MixedError(ValueError):
    """What was to be put together are results of different methods."""


def label(row: Mapping[str, Any]) -> str:
    """The method of a row, with its settings where they are not its own."""
    return " ".join([NAMES.get(row["method"], row["method"]), *row.get("set", ())])


def order(name: str) -> tuple[int, str]:
    """The place of a method's label among the columns of a table."""
    plain = {NAMES.get(method, method): index for index, method in enumerate(METHODS)}
    return plain[name.partition(" ")[0]], name


def log_of(row: Mapping[str, Any]) -> Log:
    """Which log a row was calibrated to."""
    return tuple(str(row.get(name, "")) for name in ("robot", "quality", "data", "transitions", "log"))


def by_log(rows: Iterable[Mapping[str, Any]], measure: str = "mean_absolute") -> dict[Log, float]:
    """The error of one method on each log, the mean over optimiser seeds where a log has several.

    Args:
        rows: Calibrations with the same method, settings and kind of budget; refused ones do not count.
        measure: `mean_absolute` or `mean_percent_of_range`.

    Raises:
        MixedError: Rows are of different methods, or differ in their settings or parameters.
    """
    listed = list(rows)
    kinds = {(label(row), str(row.get("calibrated")), str(row.get("level")), is_time(row["budget"])) for row in listed}
    if len(kinds) > 1:
        raise MixedError(f"different methods share no mean: {', '.join(sorted(map(str, kinds)))}")
    logs: dict[Log, list[float]] = {}
    for row in listed:
        if "error" in row:
            logs.setdefault(log_of(row), []).append(row["error"][measure])
    return {log: float(np.mean(errors)) for log, errors in logs.items()}


def ratio(ours: Mapping[Log, float], theirs: Mapping[Log, float]) -> str:
    """Geometric mean of the ratio of errors on the same logs, with its 95 % interval over them; empty of too few."""
    pairs = [(error, theirs[log]) for log, error in ours.items() if log in theirs]
    if len(pairs) < FEWEST_LOGS:
        return ""
    ratios = np.log([first / second for first, second in pairs])
    low, high = np.exp(stats.ttest_1samp(ratios, 0.0).confidence_interval())
    return f"{np.exp(ratios.mean()):.2f} ({low:.2f} to {high:.2f}, {len(pairs)} logs)"


def shown(errors: Mapping[Log, float]) -> str:
    """Mean over logs, and lowest to highest where there are several."""
    values = list(errors.values())
    spread = f" ({min(values):.2g} to {max(values):.2g})" if len(values) > 1 else ""
    return f"{np.mean(values):.2g}{spread}"


def logs(count: int) -> str:
    """A number of logs in words."""
    return f"{count} log{'s' * (count != 1)}"
