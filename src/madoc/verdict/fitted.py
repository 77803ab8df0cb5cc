"""The hold-out predicted from fitted states: where velocities are hidden, and positions are not."""

import jax
import numpy as np
from jaxtyping import Float

from madoc.calibration.holdout import AgainstChance, Fitted
from madoc.diagnosis.channels import signal_names
from madoc.identification.gauss_newton import damped_step, eliminate, triangular_factors
from madoc.identification.losses import loss_slope, scale_of
from madoc.identification.replay import slopes_at
from madoc.verdict.bench import Bench, common_fields
from madoc.verdict.fitted_starts import FITTED, FittedReplays
from madoc.verdict.statistics import best_of, better_than_chance, prediction_errors
from madoc.verdict.systematic import explained_at_end

NEARBY_STEPS = 6
"""Number of Gauss-Newton steps from an estimate, at least 1: enough to reach the nearest minimum."""
_CANDIDATES = 2
"""Number of last steps whose predictions are compared: an earlier one may be better where the last went too far."""
_DAMPING = 1e-6
"""Marquardt's damping of a step, relative to the squared lengths of the columns; 0 is none."""


def fitted(
    bench: Bench, replays: FittedReplays, unit: Float[np.ndarray, " d"], interval: Float[np.ndarray, "d 2"] | None
) -> Fitted:
    """Prediction errors behind fitted stretches at mid-range, at the estimate, nearby, and of noise alone.

    Args:
        bench: The hold-out.
        replays: Its windows.
        unit: The estimate in [-1, 1].
        interval: Its 95 % intervals in physical units, if known.
    """
    nearby, searching = _nearby_best(replays, unit)
    points = np.concatenate([np.zeros((1, len(unit))), unit[None], nearby])
    residuals = replays.residuals(points, replays.starts(points))
    sizes = replays.magnitudes(residuals)
    best = best_of(sizes)
    noise = replays.deviation(residuals[best])
    alone = replays.with_noise_alone(points[best], residuals[best], noise, jax.random.fold_in(bench.key, 2))
    fitting = (len(points) + 1) * replays.fit_cost
    predicting = residuals[:, :, 1:, 0].size + alone[:, :, 1:, 0].size
    observed, actions = replays.readings.observed, replays.readings.actions
    start_and_actions = np.concatenate([observed[:, 0], observed[:, 1], actions.reshape(len(actions), -1)], axis=1)
    return Fitted(
        **common_fields(
            bench,
            unit,
            interval,
            at=points[best],
            residual=noise,
            by_model=(_against_chance(replays, residuals[best]),),
            noise=noise,
            control_steps=searching + fitting + predicting,
        ),
        errors=prediction_errors(
            sizes,
            replays.magnitudes(alone)[:, 0],
            best,
            episodes=replays.episodes,
            horizons=replays.horizons,
            signals=signal_names(bench.simulator.task)[: len(noise)],
            failed=int((~np.isfinite(residuals[1]).all((1, 2))).sum()),
        ),
        explained=explained_at_end(start_and_actions, residuals[best]),
        fitted_steps=FITTED,
    )


def _nearby_best(replays: FittedReplays, unit: Float[np.ndarray, " d"]) -> tuple[Float[np.ndarray, "points d"], int]:
    """Where Gauss-Newton steps on whole windows of the hold-out lead from an estimate, and their control steps.

    Starting states are unknowns too. The steps look at the rows held out, so none of the points is an estimate: they
    show what parameters could explain at best.
    """
    simulator, readings = replays.simulator, replays.readings
    states, points = replays.starts(unit[None])[0], []
    for _ in range(NEARBY_STEPS):
        slopes = slopes_at(simulator, readings, unit[None], states[None])[0]
        if not slopes.whole.any():
            break
        scale = scale_of(slopes.residuals[slopes.whole], "cauchy")
        weights = loss_slope((slopes.residuals / scale) ** 2, "cauchy")
        left = eliminate(slopes, weights, np.full(len(readings), _DAMPING))
        step = damped_step(*triangular_factors(left.reduced, 1.0, "linear"), unit, _DAMPING)
        states = states + readings.in_state_units(left.states_step(step), states.shape[1])
        unit = unit + step
        points.append(unit)
    columns = 1 + 2 * len(unit) + len(readings.spread)
    spent = replays.fit_cost + len(points) * columns * len(readings) * readings.steps
    return np.array(points[-_CANDIDATES:]).reshape(-1, len(unit)), spent


def _against_chance(replays: FittedReplays, residuals: Float[np.ndarray, "windows readings channels"]) -> AgainstChance:
    """The readings right behind the fitted stretches, as the simulator predicts them, compared with chance."""
    observed, scale = replays.readings.observed, replays.readings.scale
    spread = np.maximum(observed.std((0, 1)), 1e-8)
    followed = observed[:, FITTED + 1]
    ahead = residuals[:, FITTED + 1]
    guess = np.where(np.isfinite(ahead), followed + ahead * scale, observed[:, FITTED])
    skill, p_value = better_than_chance(guess / spread, followed / spread, replays.episodes)
    return AgainstChance("the simulator at the best parameters nearby, from fitted states", skill, p_value)
