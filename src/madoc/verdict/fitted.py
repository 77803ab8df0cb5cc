"""The hold-out predicted from fitted initial states, where velocities are hidden or readings very noisy."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
from jaxtyping import Float

from madoc.calibration.holdout import AgainstChance, Fitted
from madoc.data import stride
from madoc.identification.fitted_windows import LINEARISATIONS, fit_windows
from madoc.identification.noise import residual_noise
from madoc.simulation.attitudes import moved
from madoc.verdict.bench import Bench
from madoc.verdict.fitted_starts import FittedReplays
from madoc.verdict.prediction import magnitudes
from madoc.verdict.records import judged
from madoc.verdict.statistics import best_of, better_than_chance, independent_groups, prediction_errors


def fitted(
    bench: Bench, replays: FittedReplays, point: Float[np.ndarray, " d"], interval: Float[np.ndarray, "d 2"] | None
) -> Fitted:
    """The errors of an estimate, in [-1, 1], of mid-range, of the best parameters nearby, and of noise alone.

    Those nearby have been fitted to whole windows of the hold-out itself, so they are no estimate: they show what
    parameters could reach.
    """
    given = np.stack([np.zeros(len(point)), point])
    starts = replays.starts(given)
    most = min(LINEARISATIONS, replays.most_steps)
    nearby = fit_windows(replays.simulator, replays.readings, starts[1], point, most).point[None]
    points = np.concatenate([given, nearby])
    residuals = np.concatenate([replays.residuals_from(given, starts), replays.residuals(nearby, starts[1])])
    sizes = magnitudes(replays.at_horizons(residuals))
    best = best_of(sizes)
    noise = residual_noise(residuals[best][:, : replays.fitted + 1], len(replays.readings.spread))
    alone = _with_noise_alone(bench, replays, points[best], residuals[best], noise)
    record = partial(
        Fitted,
        errors=prediction_errors(
            sizes,
            magnitudes(replays.at_horizons(alone))[:, 0],
            best,
            groups=independent_groups(replays.episodes, replays.rows, replays.readings.steps),
            horizons=replays.ahead,
            stride=stride(bench.problem.dataset),
        ),
    )
    return judged(
        record,
        bench,
        point,
        interval,
        at=points[best],
        residual=noise,
        by_model=(_against_chance(replays, residuals[best]),),
        noise=noise,
    )


def _with_noise_alone(
    bench: Bench,
    replays: FittedReplays,
    point: Float[np.ndarray, " d"],
    residuals: Float[np.ndarray, "windows readings channels"],
    deviation: Float[np.ndarray, " channels"],
) -> Float[np.ndarray, "1 windows readings channels"]:
    """Residuals of the same windows had the system at `point` been the robot, its sensors' noise of `deviation`."""
    key, readings = jax.random.fold_in(bench.key, 2), replays.readings
    noise = np.asarray(jax.random.normal(key, residuals.shape), np.float64) * deviation
    simulated = np.where(np.isfinite(residuals), residuals, 0.0) + noise
    observed = moved(bench.simulator.task.attitudes, readings.observed, simulated * readings.scale)
    drawn = replace(readings, observed=observed)
    return replace(replays, readings=drawn).residuals(point[None])


def _against_chance(replays: FittedReplays, residuals: Float[np.ndarray, "windows readings channels"]) -> AgainstChance:
    """The simulator's predictions of the first observations after the fitted steps, compared with chance."""
    observed, scale = replays.readings.observed, replays.readings.scale
    spread = np.maximum(observed.std((0, 1)), 1e-8)
    followed = observed[:, replays.fitted + replays.stride]
    ahead = residuals[:, replays.fitted + replays.stride]
    guess = moved(replays.simulator.task.attitudes, followed, ahead * scale)
    guess = np.where(np.isfinite(ahead), guess, observed[:, replays.fitted])
    skill, p_value = better_than_chance(guess / spread, followed / spread, replays.episodes)
    return AgainstChance("the simulator at the best parameters nearby, from fitted states", skill, p_value)
