"""What the hold-out looks like before and after calibration, as arrays for plots: `evidence.npz`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from madoc.data import stride
from madoc.diagnosis.channels import signal_names
from madoc.identification.states import logged_states
from madoc.identification.windows import evenly, first_rows, longest_fit, readings_at, windows_at
from madoc.runs.files import replacing
from madoc.simulation.attitudes import moved
from madoc.verdict.bench import Bench
from madoc.verdict.open_loop import as_given

TRACES = 6
"""Largest number of stretches of the hold-out that are drawn."""
TRACE_STRIDES = 100
"""Largest length of a stretch of the hold-out in strides (`data.timescale`); shorter where no episode is as long."""


def evidence(bench: Bench, mean: Float[np.ndarray, " d"], *, control_step: float) -> dict[str, np.ndarray]:
    """Arrays of the hold-out by name.

    There are always `signals` (names), `scale` (typical change in a stride, in each signal's unit), `time` (s),
    `episode` and `row` (where each stretch begins in the hold-out) and `measured` (stretches, times, signals). Where
    states can be rebuilt there are also `before` and `after`, the same stretches simulated in the user's model as it
    was given and at the estimate from the first measured state under the logged actions (NaN once a simulation has
    failed), and `residual_before` and `residual_after` (windows, signals), simulated minus measured observations after
    the shortest horizon.
    `mean` is the estimate in physical units, `control_step` the time between two rows in s.
    """
    held, replays = bench.held_out, bench.replays if bench.states_known else None
    states, rows = logged_states(held, bench.simulator.task) if replays else (np.empty(0), np.arange(len(held)))
    steps = longest_fit(held, rows, TRACE_STRIDES * stride(bench.problem.dataset))
    chosen = evenly(first_rows(held, rows, steps), TRACES)
    first = rows[chosen]
    arrays = {
        "signals": np.array(signal_names(bench.simulator.task)),
        "scale": bench.change,
        "time": control_step * np.arange(steps + 1),
        "episode": held.episode_of(first),
        "row": first,
        "measured": readings_at(held, first, steps),
    }
    if replays is None:
        return arrays
    point = np.clip(bench.simulator.parameters.to_unit(mean), -1.0, 1.0)
    given = as_given(bench.simulator)
    models = (
        ("before", replace(replays, simulator=given), -np.ones((1, len(given.parameters)))),
        ("after", replays, point[None]),
    )
    start, windows = arrays["measured"][:, :1], windows_at(held, states[chosen], first, steps)
    for when, replayed, at in models:
        simulated = replayed.residuals(at, windows)[0] * bench.change
        seen = moved(bench.simulator.task.attitudes, arrays["measured"][:, 1:], simulated)
        arrays[when] = np.concatenate([start, seen], axis=1)
        arrays[f"residual_{when}"] = replayed.residuals(at, replays.single_steps())[0, :, 0] * bench.change
    return arrays


def save_evidence(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write the file, whole or not at all."""
    with replacing(path) as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)
