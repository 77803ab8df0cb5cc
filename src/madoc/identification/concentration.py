"""Where in a log, and in which of its signals, most of what the model leaves is, and whether it is noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from madoc.data.dataset import Dataset
from madoc.identification.fitted_windows import Fit, LoggedWindows
from madoc.identification.replay import Readings

MOST = 0.5
"""Share in (0, 1) of the squared residuals that a place must hold to be told."""
SHORT = 0.1
"""Largest share in (0, 1) of the windows that a stretch may have to be told; a run may have `MOST` of `MOST`."""


LEAST = 1e-3
"""Residual in typical changes of a stride; no sensor is more precise, so smaller ones are alike by chance."""


@dataclass(frozen=True)
class Concentration:
    """A stretch of a run, or a whole run, and a signal that hold more than half of the squared residuals.

    Attributes:
        share: Share in [0, 1] of the squared residuals that the stretch holds; 0 where no place stands out.
        run: The run that it is in.
        signal: The signal, of three or more; empty where none has so much.
        seconds: Where it begins and ends, in s from the start of the run; None for the whole run.
    """

    share: float
    run: str
    signal: str
    seconds: tuple[float, float] | None = None


def concentration(
    dataset: Dataset, windows: LoggedWindows, fit: Fit, signals: Sequence[str], control_step: float
) -> Concentration | None:
    """Where most of what neither parameters nor initial states explain of the residuals is; None if it is all over.

    Args:
        dataset: The log.
        windows: Its windows, in the order of its rows, of residuals in typical changes of a stride.
        fit: What they were fitted by.
        signals: Names of an observation's values, those that were measured first.
        control_step: Time between two rows in s.
    """
    whole, shape = fit.slopes.whole, windows.readings.observed.shape[1:]
    square = fit.left[whole].reshape(-1, *shape) ** 2
    total = float(square.sum())
    if not total > 0.0:
        return None
    by_signal, by_window = square.sum((0, 1)) / total, square.sum((1, 2)) / total
    leading = int(np.argmax(by_signal))
    signal = signals[leading] if len(by_signal) > 2 and by_signal[leading] > MOST else ""
    rows, runs = windows.rows[whole], windows.runs[whole]
    first, last = _shortest(by_window, runs)
    run = int(runs[first])
    in_run, name = float(by_window[runs == run].sum()), dataset.names_of_runs[run]
    pieces = (dataset.run_names or ()).count(name)  # times in a piece of a run are not those of the run
    if last - first <= SHORT * len(by_window) and pieces <= 1:
        begin = dataset.episode_starts[run]
        ends = rows[first] - begin, rows[last - 1] + windows.readings.steps - begin
        seconds = float(control_step * ends[0]), float(control_step * ends[1])
        return Concentration(float(by_window[first:last].sum()), name, signal, seconds)
    if in_run > MOST and (runs == run).mean() <= MOST * MOST:
        return Concentration(in_run, name, signal)
    return Concentration(0.0, "", signal) if signal else None


def alike(fit: Fit, readings: Readings) -> float:
    """Correlation of what a fit leaves of a reading with what it leaves of the next, all signals in typical changes.

    It is about 0 for noise. What is smaller than `LEAST` counts as 0.
    """
    left = fit.left[fit.counted & fit.slopes.whole].reshape(-1, *readings.observed.shape[1:])
    square = max(float((left**2).sum()), LEAST**2 * max(1, left.size))
    return float((left[:, 1:] * left[:, :-1]).sum()) / square


def _shortest(share: Float[np.ndarray, " windows"], runs: Int[np.ndarray, " windows"]) -> tuple[int, int]:
    """First and last (exclusive) of the fewest successive windows of one run that hold `MOST`; else of the best run."""
    best, size = (0, len(share)), len(share) + 1
    for run in np.unique(runs).tolist():
        own = np.flatnonzero(runs == run)
        sums = np.concatenate([[0.0], np.cumsum(share[own])])
        ends = np.searchsorted(sums, sums[:-1] + MOST)
        for begin, end in enumerate(ends.tolist()):
            if end <= len(own) and end - begin < size:
                best, size = (int(own[begin]), int(own[end - 1]) + 1), end - begin
    return best
