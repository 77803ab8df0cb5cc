"""What the hold-out looks like before and after calibration, as arrays for plots and films: `evidence.npz`."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from madoc.data import stride
from madoc.identification.replay import Readings
from madoc.identification.states import logged_states, states_of
from madoc.identification.windows import evenly
from madoc.runs.files import replacing
from madoc.runs.machine import one_blas_thread
from madoc.simulation.attitudes import differences, moved
from madoc.simulation.base import Simulator
from madoc.verdict.bench import Bench
from madoc.verdict.fitted_starts import FITTED, FittedReplays
from madoc.verdict.open_loop import as_given

SECONDS = 2.0
"""Time in s that simulating the runs may take, by what simulating took in the search."""
ROWS = (2_000, 20_000)
"""Least and largest number of rows that are simulated, whatever time they take; a longer run is cut."""
REPLAYED = 2_000
"""Number of rows over which the errors of other parameters are measured."""

Runs = tuple[Float[np.ndarray, "told state"], Int[np.ndarray, " runs"], Int[np.ndarray, " runs"]]
"""The state of each run at its first row, if the log tells states; that row, and the number of control steps."""


@one_blas_thread()
def evidence(
    bench: Bench, mean: Float[np.ndarray, " d"], *, control_step: float, fits_starts: bool = False
) -> dict[str, np.ndarray]:
    """Arrays of whole held-out runs by name, as many runs as there is time for; NaN behind the end of a run.

    There are always `signals` (names), `scale` (typical change in a stride, in each signal's unit), `time` (s) since
    the start of a run, `names` of the runs, `row` (where each begins in the hold-out) and `measured` (runs, times,
    signals). Where the log tells positions there are also `before` and `after`, the same runs simulated in the user's
    model as it was given and at the estimate under the logged actions, without another look at the log (NaN once a
    simulation has failed), `posture_measured`, `posture_before` and `posture_after` (runs, times, qpos); for replays
    with other parameters `start` (runs, state), at the estimate, and `actions` (runs, steps, action). Runs start at the
    first logged state, or at one fitted to the first `fitted` rows where velocities are hidden, or readings so noisy
    that the hold-out was judged from fitted states (`fits_starts`). Where states are known there are `residual_before`
    and `residual_after` (windows, signals), simulated minus measured observations after the shortest horizon. `mean` is
    the estimate in physical units, `control_step` the time between two rows in s.
    """
    held, simulator = bench.held_out, bench.simulator
    most = int(np.clip(SECONDS * bench.rate, *ROWS))
    fitted = 0 if bench.states_known and not fits_starts else FITTED * stride(bench.problem.dataset)
    states, first, lengths = _runs(bench, fitted, most)
    steps = int(lengths.max())
    kept = np.minimum(np.arange(steps), lengths[:, None] - 1)  # the last row again, behind the end of a run
    over = np.arange(steps + 1) > lengths[:, None]
    logged = held.transitions
    following = np.asarray(logged.next_observation)[first[:, None] + kept]
    measured = np.concatenate([np.asarray(logged.observation)[first][:, None], following], axis=1)
    named = held.names_of_runs
    arrays = {
        "signals": np.array(simulator.task.signal_names),
        "scale": bench.change,
        "time": control_step * np.arange(steps + 1),
        "names": np.array([named[episode] for episode in held.episode_of(first)]),
        "row": first,
        "measured": _until(over, measured),
    }
    if bench.states.kind == "unknown" or steps < 1 or not len(states):
        return arrays
    given, actions = as_given(simulator), np.asarray(logged.action, dtype=np.float64)[first[:, None] + kept]
    point = np.clip(simulator.parameters.to_unit(mean), -1.0, 1.0)
    for when, model, at in (("before", given, -np.ones(len(given.parameters))), ("after", simulator, point)):
        starts = states if not fitted else _fitted(bench, model, at, states, first, fitted)
        values = model.parameters.to_physical(at)[None]
        visited, seen = (found[0] for found in _simulated(model, values, starts, actions, exact=not fitted))
        seen = moved(simulator.task.attitudes, measured, differences(simulator.task.attitudes, seen, measured))
        arrays |= {when: _until(over, seen), f"posture_{when}": _until(over, visited[..., : simulator.task.model.nq])}
        if bench.states_known:
            replays = replace(bench.replays, simulator=model)
            residuals = replays.residuals(at[None], replays.single_steps())
            arrays[f"residual_{when}"] = residuals[0, :, 0] * bench.change
    arrays |= {"fitted": np.array(fitted), "start": starts, "actions": actions}
    arrays["posture_measured"] = _until(over, _posture(simulator, measured, visited))
    return arrays


def _runs(bench: Bench, fitted: int, most: int) -> Runs:
    """The held-out runs from the first state that can be rebuilt, of at most so many rows together.

    There are no states where the log tells none. Runs too short to fit a start to are left out, unless all are.
    """
    held, states = bench.held_out, np.zeros((0, 0))
    rows = held.episode_starts
    if bench.states_known:
        states, rows = logged_states(held, bench.simulator.task)
    elif bench.states.kind == "approximate":
        states, rows = states_of(held, bench.simulator).guesses()
    first = np.unique(held.episode_of(rows), return_index=True)[1]
    lengths = held.episode_ends[held.episode_of(rows[first])] - rows[first]
    enough = lengths > fitted
    if not enough.any():
        states = states[:0]
    elif len(states):
        first, lengths = first[enough], lengths[enough]
    count = max(1, int((np.cumsum(lengths) <= most).sum()))
    chosen = evenly(np.arange(len(first)), count)
    return states[first[chosen]] if len(states) else states, rows[first[chosen]], np.minimum(lengths[chosen], most)


def _fitted(
    bench: Bench,
    model: Simulator,
    point: Float[np.ndarray, " d"],
    states: Float[np.ndarray, "runs state"],
    first: Int[np.ndarray, " runs"],
    steps: int,
) -> Float[np.ndarray, "runs state"]:
    """The states from which a model comes nearest to the first readings of each run."""
    held = bench.held_out
    logged, moving, episodes = states_of(held, model), stride(bench.problem.dataset), held.episode_of(first)
    readings = Readings.at(held, logged, first, steps, bench.change)
    replays = FittedReplays(held, logged, model, readings, states, first, episodes, moving, ())
    return replays.starts(point[None])[0]


def replay_errors(
    arrays: Mapping[str, np.ndarray], simulator: Simulator, values: Float[np.ndarray, "systems d"]
) -> Float[np.ndarray, " systems"] | None:
    """How far held-out runs are from their simulation at other parameters, in physical units, from the same starts.

    It is the root mean square over all signals of whole runs, `REPLAYED` rows in all, in the unit of each signal's
    `scale`; infinite where a simulation fails. None where `evidence` has left no starts.
    """
    if "start" not in arrays:
        return None
    steps = min(arrays["actions"].shape[1], REPLAYED)
    runs = max(1, REPLAYED // steps)
    measured = np.asarray(arrays["measured"][:runs, : steps + 1], dtype=np.float64)
    given = arrays["start"][:runs], arrays["actions"][:runs, :steps]
    _, seen = _simulated(simulator, values, *given, exact=not arrays["fitted"])
    known = np.isfinite(measured)
    apart = differences(simulator.task.attitudes, seen, np.where(known, measured, 0.0)) / arrays["scale"]
    square = np.where(known, np.where(np.isfinite(apart), apart, np.inf) ** 2, 0.0)
    return np.sqrt(square.sum((1, 2, 3)) / max(1, known.sum()))


def _simulated(
    model: Simulator,
    values: Float[np.ndarray, "systems d"],
    states: Float[np.ndarray, "runs state"],
    actions: Float[np.ndarray, "runs steps action"],
    *,
    exact: bool,
) -> tuple[Float[np.ndarray, "systems runs times state"], Float[np.ndarray, "systems runs times signals"]]:
    """The states that models go through and what their sensors show; exact states are those that sensors told."""
    system, count = model.bind(values), len(values)
    start = np.repeat(states[None], count, 0)
    start = system.unbiased(start) if exact else start
    after = system.roll_out(start, np.repeat(actions[None], count, 0))
    visited = np.concatenate([start[:, :, None], after], axis=2)
    seen = system.observe(visited.reshape(count, -1, visited.shape[-1]))
    return visited, seen.reshape(*visited.shape[:3], -1)


def _posture(
    simulator: Simulator,
    measured: Float[np.ndarray, "runs times signals"],
    simulated: Float[np.ndarray, "runs times state"],
) -> Float[np.ndarray, "runs times qpos"]:
    """The positions that readings tell; those of the simulation where they tell none, as of a base that is not seen."""
    task = simulator.task
    told = task.state_from_observation or task.posture
    assert told is not None  # else the log's states are unknown
    positions = np.array(told(measured), dtype=np.float64)[..., : task.model.nq]
    unseen = np.isnan(positions).any((0, 1)) | (np.ptp(positions, axis=(0, 1)) == 0.0)
    return np.where(unseen, simulated[..., : task.model.nq], positions)


def _until(over: np.ndarray, values: Float[np.ndarray, "runs times values"]) -> Float[np.ndarray, "runs times values"]:
    """The values up to the end of each run, in single precision, which is enough to draw them."""
    return np.where(over[..., None], np.nan, values).astype(np.float32)


def save_evidence(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write the file, whole or not at all."""
    with replacing(path) as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)
