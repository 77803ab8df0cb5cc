"""What the hold-out looks like before and after calibration, as arrays for plots: `evidence.npz`."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from madoc.identification.states import logged_states
from madoc.identification.windows import Windows, evenly, first_rows, windows_at
from madoc.runs.files import replacing
from madoc.verdict.bench import Bench, signal_names

TRACES = 6
"""Stretches to draw."""
TRACE_STEPS = 100
"""Their length in control steps, where an episode is as long."""


def evidence(bench: Bench, mean: Float[np.ndarray, " d"], *, control_step: float) -> dict[str, Any]:
    """Arrays of the hold-out.

    Always `signals` (names), `scale` (typical change in a step, in each signal's unit), `time` (s), `episode` and `row`
    (where each stretch begins in the hold-out) and `measured` (stretches, times, signals). Where states can be rebuilt
    also `before` and `after`, the same stretches simulated at mid-range and at the estimate from the first measured
    state under the logged actions (NaN once a simulation has failed), and `residual_before` and `residual_after`
    (windows, signals), simulated less measured after one step.

    Args:
        bench: The hold-out.
        mean: The estimate in physical units.
        control_step: Seconds.
    """
    held = bench.split.held
    names = {"signals": np.array(signal_names(bench.simulator.task)), "scale": bench.scaling.next_scale}
    if not bench.rebuilds:
        rows = np.arange(len(held))
        stretch, first = _stretches(bench, rows)
        measured = _measured(bench, first, stretch)
        return names | _placed(bench, first, stretch, control_step) | {"measured": measured}
    states, rows = logged_states(held, bench.simulator.task)
    steps, first = _stretches(bench, rows)
    windows = windows_at(held, states[np.searchsorted(rows, first)], first, steps)
    measured = _measured(bench, first, steps)
    unit = np.clip(bench.simulator.parameters.to_unit(mean), -1.0, 1.0)
    points = np.stack([np.zeros(len(unit)), unit])
    before, after = _simulated(bench, points, windows, measured)
    single = bench.replays.residuals(points, bench.replays.single_steps())[:, :, 0] * bench.scaling.next_scale
    return (
        names
        | _placed(bench, first, steps, control_step)
        | {"measured": measured, "before": before, "after": after}
        | {"residual_before": single[0], "residual_after": single[1]}
    )


def save_evidence(path: Path, arrays: dict[str, Any]) -> None:
    """Write the file, whole or not at all."""
    with replacing(path) as stream:
        np.savez_compressed(stream, **arrays)


def _stretches(bench: Bench, rows: np.ndarray) -> tuple[int, np.ndarray]:
    """How long the stretches are, and the rows of the hold-out they begin at."""
    held = bench.split.held
    ends = held.episode_ends[held.episode_of(rows)]
    steps = int(min(TRACE_STEPS, (ends - rows).max()))
    return steps, rows[evenly(first_rows(held, rows, steps), TRACES)]


def _placed(bench: Bench, first: np.ndarray, steps: int, control_step: float) -> dict[str, Any]:
    episode = bench.split.held.episode_of(first)
    return {"time": control_step * np.arange(steps + 1), "episode": episode, "row": first}


def _measured(bench: Bench, first: np.ndarray, steps: int) -> Float[np.ndarray, "stretches times observation"]:
    logged = bench.split.held.transitions
    following = np.asarray(logged.next_observation)[first[:, None] + np.arange(steps)]
    return np.concatenate([np.asarray(logged.observation)[first][:, None], following], axis=1)


def _simulated(
    bench: Bench, points: np.ndarray, windows: Windows, measured: np.ndarray
) -> Float[np.ndarray, "points stretches times observation"]:
    residuals = bench.replays.residuals(points, windows) * bench.scaling.next_scale
    start = np.broadcast_to(measured[:, :1], (len(points), *measured[:, :1].shape))
    return np.concatenate([start, measured[:, 1:] + residuals], axis=2)
