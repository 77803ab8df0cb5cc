"""How far the simulator can be believed, in the user's units: held-out motion predicted without a look at it.

The simulator starts where the log does, gets the logged actions, and runs on. Its errors after a tenth of a second, a
second and whole runs stand beside those of the user's own model as it was given, and of mid-range. They also stand
beside those that chance and the timestep would make: the sensors' noise, random forces (those that are read off the
log where starts are logged, and else those that an ensemble filter found), the estimate's uncertainty, and what a
timestep of a quarter of the length changes, as a machine has none.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from madoc import simulation
from madoc.calibration.holdout import OpenLoop
from madoc.data import stride
from madoc.identification import random_forces
from madoc.identification.noise import residual_noise
from madoc.identification.replay import window_residuals
from madoc.identification.states import logged_states
from madoc.identification.windows import evenly, rows_that_fit, windows_at
from madoc.parameters import Parameter, ParameterSpace
from madoc.simulation import FINER
from madoc.simulation.attitudes import moved
from madoc.simulation.base import Simulator
from madoc.simulation.write import nominal_values
from madoc.verdict.bench import Bench
from madoc.verdict.fitted_starts import FITTED, FittedReplays, fitted_replays_of, replay_steps
from madoc.verdict.predicted import by_chance
from madoc.verdict.prediction import Replays
from madoc.verdict.statistics import beside_random, independent_groups, interval_of, resampled

SECONDS = (0.1, 0.3, 1.0)
"""Times in s over which motion is predicted, besides whole runs."""
MOST = 60
"""Largest number of windows of one length."""
SHARE = 0.3
"""Share in (0, 1) of the time left that predictions from starts which are fitted together may take."""
IMITATED = 4
"""Number of parameter vectors by which the hold-out is imitated."""
UNSURE = 2.0
"""Errors of these, root of the mean square along each axis, in standard errors: about what 95 % of estimates have."""
FAILED = 10.0
"""Least error, in typical changes of a stride, once a simulation has failed; it is the worst of any that has not."""


def open_loop(
    bench: Bench,
    point: Float[np.ndarray, " d"],
    *,
    fits_starts: bool = False,
    covariance: Float[np.ndarray, "d d"] | None = None,
    noise: Float[np.ndarray, " observation"] | None = None,
    forces: Float[np.ndarray, " dof"] | None = None,
) -> tuple[OpenLoop, ...]:
    """Errors of open-loop predictions of the hold-out at an estimate in [-1, 1], one record for each length of time.

    Predictions begin at logged states, or at fitted ones where these are not known or `fits_starts`, as they are noisy.
    There are none where the log tells no states to begin at, and none of a length that no held-out stretch has.
    From fitted states those of shorter times are the beginnings of one prediction where runs are long enough, so that
    starts are fitted once. With the estimate's `covariance`, in [-1, 1], it is also said how many times as large errors
    are as those of a hold-out that the model itself would make: from fitted states an imitated one (`_imitated`), on
    which random `forces` of these standard deviations, in N or N·m, have acted; from logged states what the sensors'
    `noise`, in typical changes of a stride, and random forces make, as these are read off the log there.
    """
    if bench.states.kind == "unknown" or bench.held_out.disturbance.shuffled != "none":
        return ()
    given, held, step = as_given(bench.simulator), bench.held_out, bench.simulator.control_step
    fits_starts = fits_starts or not bench.states_known
    before = FITTED * stride(bench.problem.dataset) if fits_starts else 0
    predicted = partial(_from_logged, bench, given, point, covariance, noise)
    if fits_starts:
        predicted = partial(_from_fitted, bench, given, point, covariance, np.zeros(0) if forces is None else forces)
    whole = int(np.median(held.episode_ends - held.episode_starts)) - before
    shorter = [steps for steps in sorted({max(1, round(seconds / step)) for seconds in SECONDS}) if steps < whole]
    begin = (held.episode_ends - held.episode_starts - before - max(shorter, default=0)).clip(min=0).sum()
    parts = [shorter] if fits_starts and shorter and begin >= MOST else [[steps] for steps in shorter]
    found: list[OpenLoop] = []
    for lengths in [*parts, *([[whole]] if whole > 0 else [])]:
        errors = predicted(lengths[-1])
        if errors is not None:
            residuals, rows = errors
            found += [_record(bench, residuals[:, :, :steps], rows, steps, whole=steps == whole) for steps in lengths]
    return tuple(found)


def as_given(simulator: Simulator) -> Simulator:
    """The simulator whose parameters at -1 are those of the user's model as it stands, each element with its own."""
    model, space = simulator.task.model, simulator.parameters
    own = [part for parameter in space.parameters for part in _own(parameter, nominal_values(model, parameter))]
    return simulation.make(replace(simulator.task, parameters=ParameterSpace(tuple(own))))


def _own(parameter: Parameter, values: tuple[float, ...]) -> list[Parameter]:
    """A parameter for each element of a shared one, whose range begins at the element's value in the model."""
    width = parameter.high - parameter.low
    if not parameter.kind.in_model or not parameter.elements:
        return [replace(parameter, low=values[0], high=values[0] + width)]
    pairs = zip(parameter.elements, values, strict=True)
    return [
        replace(parameter, element=one, label=f"{parameter.name} of {one}", low=value, high=value + width)
        for one, value in pairs
    ]


def _record(
    bench: Bench,
    residuals: Float[np.ndarray, "models windows steps channels"],
    rows: Int[np.ndarray, " windows"],
    steps: int,
    *,
    whole: bool,
) -> OpenLoop:
    """The errors over windows of so many control steps, which begin at the rows.

    Residuals are those of the model as given, of mid-range, of the estimate and, where there are some, of the imitated
    hold-out.
    """
    known = np.isfinite(residuals)
    worst = np.maximum(np.abs(np.where(known, residuals, 0.0)).max((0, 1, 2)), FAILED)
    size, units = np.where(known, residuals, worst), bench.change[: residuals.shape[-1]]
    squares = (size**2).mean((1, 2))
    of_signals = np.sqrt(squares) * units
    of_windows = np.sqrt((size**2 * beyond_imitated(squares)).mean((2, 3)))  # then means: a few may run away
    groups = independent_groups(bench.held_out.episode_of(rows), rows, steps)
    before, _, after = of_windows[:3].mean(1)
    beside = {}
    if len(residuals) > 3:
        found, imitated = np.sqrt((size[2:] ** 2).mean(2))
        ratios = beside_random(found, imitated, groups)
        beside = dict(zip(bench.simulator.task.signal_names, ratios.tolist(), strict=False))
    draws = resampled(of_windows.T, groups)
    low, high = interval_of(draws[:, 2] / np.maximum(draws[:, 0], np.finfo(float).tiny))
    named = [dict(zip(bench.simulator.task.signal_names, row, strict=False)) for row in of_signals.tolist()]
    return OpenLoop(
        seconds=steps * bench.simulator.control_step,
        whole=whole,
        windows=len(rows),
        as_given=named[0],
        mid_range=named[1],
        estimate=named[2],
        relative=float(after / max(before, np.finfo(float).tiny)),
        relative_interval=(float(low), float(high)),
        beside_noise=beside,
    )


def beyond_imitated(squares: Float[np.ndarray, "models channels"]) -> Float[np.ndarray, " channels"]:
    """The share in [0, 1] of each channel's squared error, as given or at the estimate, that chance does not make.

    Channels count by it: of an object that does not turn all errors of its turning are noise. It is 1 where nothing
    was imitated, or all is chance.
    """
    if len(squares) <= 3:
        return np.ones(squares.shape[1])
    largest = np.maximum(np.maximum(squares[0], squares[2]), np.finfo(float).tiny)
    beyond = np.clip(1.0 - squares[3] / largest, 0.0, 1.0)
    return beyond if beyond.any() else np.ones_like(beyond)


def _from_logged(
    bench: Bench,
    given: Simulator,
    point: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"] | None,
    noise: Float[np.ndarray, " observation"] | None,
    steps: int,
) -> tuple[Float[np.ndarray, "models windows steps channels"], Int[np.ndarray, " windows"]] | None:
    """Residuals from logged states as given, at mid-range and at the estimate, and the rows where windows begin.

    Those that chance would make follow, over the times in `SECONDS` and where noise is known. None where the hold-out
    has no run as long.
    """
    held = bench.held_out
    states, rows = logged_states(held, bench.simulator.task)
    possible = rows_that_fit(held, rows, steps)
    if not len(possible):
        return None
    chosen = evenly(possible, MOST)
    windows = windows_at(held, states[chosen], rows[chosen], steps)
    flat = np.concatenate(
        [
            window_residuals(simulator, windows, points, bench.change)
            for simulator, points in _models(bench, given, point)
        ]
    )
    residuals, rows = flat.reshape(*flat.shape[:2], steps, -1), rows[chosen]
    if covariance is None or noise is None or steps > max(SECONDS) / bench.simulator.control_step + 1:
        return residuals, rows
    observation, episodes = np.asarray(held.transitions.observation)[rows], held.episode_of(rows)
    replays = Replays(bench.simulator, windows, observation, rows, episodes, (steps,), bench.change)
    chance = by_chance(bench, replays, point, replays.noise_floor(held, point, noise))
    drawn = replays.residuals(_drawn(point, covariance))
    of_parameters = drawn[np.arange(len(rows)) % IMITATED, np.arange(len(rows))] - residuals[-1]
    finer = replace(replays, simulator=_finer(bench)).residuals(point[None])[0]
    return np.concatenate(
        [residuals, chance + _where_finite(of_parameters) + _where_finite(finer - residuals[-1])]
    ), rows


def _from_fitted(
    bench: Bench,
    given: Simulator,
    point: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"] | None,
    forces: Float[np.ndarray, " dof"],
    steps: int,
) -> tuple[Float[np.ndarray, "models windows steps channels"], Int[np.ndarray, " windows"]] | None:
    """The same from starts that are fitted under each model to the strides before, and of the imitated hold-out."""
    moving, of_models, rows = stride(bench.problem.dataset), [], np.empty(0, np.int64)
    of_window = replay_steps(bench.states, moving, 0) * 4 // 5 + (4 + IMITATED + FINER) * steps
    most = bench.windows_in_time(of_window, SHARE, MOST)
    most_steps = bench.steps_in_time(most * of_window, SHARE)
    for simulator, points in _models(bench, given, point):
        replays = fitted_replays_of(
            bench.held_out, simulator, bench.change, moving, ahead=(steps,), fewest=1, most=most
        )
        if replays is None:
            return None
        replays = replace(replays, most_steps=most_steps)
        states = replays.starts(points)
        parts = [replays.residuals_from(points, states)]
        if simulator is bench.simulator and covariance is not None:
            parts.append(_imitated(bench, replays, point, covariance, forces, states[-1], parts[0][-1]))
        of_models += [part[:, :, replays.fitted + 1 :] for part in parts]
        rows = replays.rows
    return np.concatenate(of_models), rows


def _imitated(
    bench: Bench,
    replays: FittedReplays,
    point: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    forces: Float[np.ndarray, " dof"],
    states: Float[np.ndarray, "windows state"],
    residuals: Float[np.ndarray, "windows readings channels"],
) -> Float[np.ndarray, "1 windows readings channels"]:
    """Residuals at the estimate of a hold-out as the model itself would make it (a posterior predictive check).

    Its windows begin where the log's do, at `states`. Its parameters are a few for all windows (`_drawn`), random
    `forces` act on it, and its sensors have the noise that the estimate's `residuals` of fitted readings have. What is
    missing in the model then shows in errors of the log that are larger than these (Gelman, Meng and Stern 1996). It is
    made with a timestep of a quarter of the length, to first order.
    """
    random, readings, windows = np.random.default_rng(0), replays.readings, np.arange(len(replays.readings))
    drawn = _drawn(point, covariance)
    pushes = random_forces.forces(forces, (IMITATED, len(windows), readings.steps), np.random.default_rng(1))
    begun = np.repeat(states[None], IMITATED, axis=0)
    made = replays.residuals_from(drawn, begun, pushes)[windows % IMITATED, windows]
    left = residuals[np.isfinite(residuals).all((1, 2)), : replays.fitted + 1]
    noise = residual_noise(left, made.shape[-1])
    if forces.any() and len(left):
        # What forces did to the fitted readings lasts; noise alone is in the differences of consecutive ones.
        noise = np.minimum(noise, np.sqrt((np.diff(left, axis=1) ** 2).mean((0, 1)) / 2.0))
    finer = replace(replays, simulator=_finer(bench)).residuals_from(point[None], states[None])[0] - residuals
    made = _where_finite(made) + _where_finite(finer) + noise * random.standard_normal(made.shape)
    observed = moved(bench.simulator.task.attitudes, readings.observed, made * readings.scale)
    return replace(replays, readings=replace(readings, observed=observed)).residuals(point[None])


def _finer(bench: Bench) -> Simulator:
    """The calibrated model with a timestep of a quarter of the length, where a spec makes it."""
    own = bench.simulator
    return own if own.task.source is None else simulation.with_shorter_timestep(own)


def _where_finite(values: np.ndarray) -> np.ndarray:
    """The values, and 0 where a simulation has failed."""
    return np.where(np.isfinite(values), values, 0.0)


def _drawn(point: Float[np.ndarray, " d"], covariance: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "systems d"]:
    """A few parameter vectors in [-1, 1] around an estimate, whose errors are `UNSURE`."""
    variances, axes = np.linalg.eigh(covariance)
    errors = np.random.default_rng(2).standard_normal((IMITATED, len(point)))
    errors *= UNSURE / np.sqrt((errors**2).mean(0))
    return np.clip(point + errors * np.sqrt(np.maximum(variances, 0.0)) @ axes.T, -1.0, 1.0)


def _models(
    bench: Bench, given: Simulator, point: Float[np.ndarray, " d"]
) -> tuple[tuple[Simulator, Float[np.ndarray, "systems d"]], ...]:
    """The user's model as given, then mid-range and the estimate."""
    at_given = -np.ones((1, len(given.parameters)))
    return (given, at_given), (bench.simulator, np.stack([np.zeros(len(point)), point]))
