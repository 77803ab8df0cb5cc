"""The hold-out predicted from logged states, where states can be rebuilt from what was logged."""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from madoc.calibration.holdout import Predicted, PredictionErrors
from madoc.data import stride
from madoc.identification import noise as sensors
from madoc.identification.fitted_windows import NEGLIGIBLE
from madoc.identification.losses import NORMAL_MAD
from madoc.identification.states import logged_states
from madoc.identification.systematic import explained
from madoc.identification.windows import consecutive_rows, evenly
from madoc.simulation.attitudes import differences
from madoc.verdict.bench import Bench
from madoc.verdict.prediction import Replays, nearby_best
from madoc.verdict.records import judged
from madoc.verdict.statistics import (
    best_of,
    hides_gain,
    independent_groups,
    prediction_errors,
    relative_to_first,
)

MOST_ROWS = 4000
"""Largest number of held-out rows whose residuals of single steps are looked at for noise and random forces."""
TOUCHING = 0.1
"""Share in [0, 1] of held-out windows in which bodies touch; with more, noise of a state is not small for motion."""
ROUNDED = 3.0
"""Standard deviations of the readings' rounding; residuals of single steps that are not larger tell of no noise."""


def predicted(bench: Bench, point: Float[np.ndarray, " d"], interval: Float[np.ndarray, "d 2"] | None) -> Predicted:
    """The errors of an estimate, in [-1, 1], of mid-range, of the best parameters nearby, and of noise alone."""
    found = _replayed(bench, point)
    best, single = found.best, found.single
    systems = {"the simulator at mid-range": np.zeros(len(point)), "the simulator at the best parameters nearby": best}
    return judged(
        partial(Predicted, errors=found.errors),
        bench,
        point,
        interval,
        at=best,
        residual=single.size,
        by_model=tuple(bench.against_chance(name, _simulated(bench, system)) for name, system in systems.items()),
        noise=single.noise,
        exact=True,
    )


def noise_hides_gain(bench: Bench) -> bool:
    """Whether the best parameters near mid-range predict no better than that, because all errors are those of noise."""
    return hides_gain(_replayed(bench, np.zeros(len(bench.simulator.parameters))).errors)


def noisy_contacts(bench: Bench, point: Float[np.ndarray, " d"]) -> bool:
    """Whether bodies touch in windows of the hold-out, and logged states are noisy.

    Replays from these then err by what contacts make of noise. It shows in residuals of single steps, larger than
    readings' rounding makes them, that alternate; those of an estimate with far larger errors do not. A delay that the
    model lacks alternates with the actions: the one before a row says nothing of noise, and what it explains does not
    count.
    """
    states, rows = logged_states(bench.held_out, bench.simulator.task)
    follows = consecutive_rows(bench.held_out, rows)
    first = rows[evenly(follows[np.isin(follows - 1, follows)], MOST_ROWS)]
    if not len(first):
        return False
    if _touching(bench, point, states, rows) < TOUCHING:
        return False
    pairs = np.stack([_residuals(bench, point, each) for each in (first, first + 1)])
    whole, actions = np.isfinite(pairs).all((0, 2)), np.asarray(bench.held_out.transitions.action)
    size = NORMAL_MAD * np.median(np.abs(pairs[0, whole]), axis=0) if whole.any() else np.zeros(len(bench.change))
    if not (size > np.maximum(sensors.NOISY_STRIDE, ROUNDED * bench.problem.rounding / bench.change)).any():
        return False
    left = [_without(pairs[each, whole], actions[first[whole] + each - 1]) for each in (0, 1)]
    return min(sensors.alternation(*pairs[:, whole]), sensors.alternation(*left)) > sensors.NOISY


def _touching(
    bench: Bench,
    point: Float[np.ndarray, " d"],
    states: Float[np.ndarray, "rows state"],
    rows: Int[np.ndarray, " rows"],
) -> float:
    """The share of windows of the hold-out, as they are replayed, in a row of which bodies touch."""
    steps = bench.replays.windows.steps
    windows = evenly(bench.replays.rows, max(1, MOST_ROWS // steps))[:, None] + np.arange(steps)
    seen = np.isin(rows, windows)
    contacts = bench.simulator.contacts(states[seen], bench.simulator.parameters.to_physical(point.clip(-1.0, 1.0)))
    return float(np.isin(windows, rows[seen][contacts > 0]).any(1).mean())


def _without(
    residuals: Float[np.ndarray, "rows observation"], actions: Float[np.ndarray, "rows action"]
) -> Float[np.ndarray, "rows observation"]:
    """What a linear regression on actions leaves of residuals, clipped as `alternation` clips them."""
    inputs, values = np.column_stack([np.ones(len(actions)), actions]), sensors.clipped(residuals)
    return values - inputs @ np.linalg.lstsq(inputs, values, rcond=None)[0]


class _Replayed(NamedTuple):
    """What replays of the hold-out leave at an estimate, and at the `best` parameters nearby."""

    errors: PredictionErrors
    best: Float[np.ndarray, " d"]
    single: "_SingleSteps"


def _replayed(bench: Bench, point: Float[np.ndarray, " d"]) -> _Replayed:
    replays = bench.replays
    points = np.concatenate([np.zeros((1, len(point))), point[None], nearby_best(replays, point)])
    sizes = replays.magnitudes(replays.residuals(points))
    best = best_of(sizes)
    single = _single_steps(bench, points[best])
    noisy = replays.noise_floor(bench.held_out, points[best], single.noise)
    groups = independent_groups(replays.episodes, replays.rows, replays.windows.steps)
    errors = prediction_errors(
        sizes,
        replays.magnitudes(noisy)[:, 0],
        best,
        groups=groups,
        horizons=replays.horizons,
        stride=stride(bench.problem.dataset),
    )
    return _Replayed(errors, points[best], single)


def by_chance(
    bench: Bench,
    replays: Replays,
    point: Float[np.ndarray, " d"],
    noisy: Float[np.ndarray, "1 windows steps observation"],
) -> Float[np.ndarray, "1 windows steps observation"]:
    """Residuals of windows that sensor noise, which makes `noisy` ones, and random forces would cause together."""
    pushes = _pushes(bench, replays, point, np.nan_to_num(np.nanmean(noisy[0, :, 0] ** 2, axis=0)))
    return replays.random_floor(point, noisy, pushes)


def _pushes(
    bench: Bench, replays: Replays, point: Float[np.ndarray, " d"], by_noise: Float[np.ndarray, " observation"]
) -> Float[np.ndarray, "windows steps observation"]:
    """What random forces may have changed in each row of the windows.

    That is the row's residual, less the share of all their mean square that sensor noise makes (`by_noise`). Rows whose
    state cannot be rebuilt have the residual of another one.
    """
    wanted = replays.rows[:, None] + np.arange(replays.windows.steps)
    rows = evenly(np.intersect1d(logged_states(bench.held_out, bench.simulator.task)[1], wanted), MOST_ROWS)
    residuals = np.nan_to_num(_residuals(bench, point, rows))
    square = np.maximum((residuals**2).mean(0), np.finfo(float).tiny)
    share = np.sqrt(np.maximum(1.0 - by_noise / square, 0.0)) * (square > NEGLIGIBLE**2)
    return (residuals * share)[np.minimum(np.searchsorted(rows, wanted), len(rows) - 1)]


def sensor_noise(bench: Bench) -> Float[np.ndarray, " observation"]:
    """Standard deviation of the sensors' noise in their units, without an estimate.

    Where states can be rebuilt, it is computed from the residuals at the best parameters near mid-range.
    """
    if not bench.states_known:
        return bench.problem.noise_by_differences
    mid_range = np.zeros((1, len(bench.simulator.parameters)))
    points = np.concatenate([mid_range, nearby_best(bench.replays, mid_range[0])])
    sizes = bench.replays.magnitudes(bench.replays.residuals(points)).mean((0, -1))
    best = points[int(np.argmin(relative_to_first(sizes)))]
    return _single_steps(bench, best).noise * bench.change


class _SingleSteps(NamedTuple):
    """Of single steps: residuals' root mean square, and the standard deviation of the sensors' noise in them."""

    size: Float[np.ndarray, " observation"]
    noise: Float[np.ndarray, " observation"]


def _single_steps(bench: Bench, point: Float[np.ndarray, " d"]) -> _SingleSteps:
    held, rows, scale = bench.held_out, bench.judged_rows, bench.change
    residuals = sensors.clipped(_residuals(bench, point, rows))
    first = np.flatnonzero((np.diff(rows) == 1) & ~np.isin(rows[1:], held.episode_starts))
    noise = np.zeros(len(scale))
    if len(first):
        slopes = sensors.own_slopes(bench.simulator, held, point, rows[first], scale)
        unexplained = residuals - explained(bench.scaling.features(held.transitions.take(rows))[0], residuals)
        # Both are lower bounds: what is explained of a channel at rest is its own noise in the reading before.
        parts = (sensors.consecutive_noise(part[first], part[first + 1], slopes) for part in (unexplained, residuals))
        noise = np.maximum(*parts)
    return _SingleSteps(np.sqrt((residuals**2).mean(0)), noise)


def _residuals(
    bench: Bench, point: Float[np.ndarray, " d"], rows: Int[np.ndarray, " rows"]
) -> Float[np.ndarray, "rows observation"]:
    """Simulated minus logged next observations of some rows, in typical changes of a stride."""
    followed = np.asarray(bench.held_out.transitions.next_observation)[rows]
    return differences(bench.simulator.task.attitudes, _simulated(bench, point, rows), followed) / bench.change


def _simulated(
    bench: Bench, point: Float[np.ndarray, " d"], rows: Int[np.ndarray, " rows"] | None = None
) -> Float[np.ndarray, "rows observation"]:
    """Next observations of some rows, by default of the judged ones, in the simulator."""
    held, simulator = bench.held_out, bench.simulator
    rows = bench.judged_rows if rows is None else rows
    states, known = logged_states(held, simulator.task)
    states = states[np.searchsorted(known, rows)]
    system = simulator.bind(simulator.parameters.to_physical(point)[None])
    action = np.asarray(held.transitions.action)[rows]
    return np.asarray(system.observe(system.step(system.unbiased(states[None]), action[None]))[0])
