"""How noisy the sensors are, told from the log and a simulator near it, and what noise alone makes of predictions."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from madoc.data import Dataset, logged_states
from madoc.identification.windows import evenly
from madoc.simulation.base import Simulator
from madoc.verdict.prediction import MOST_WINDOWS, Replays

PROBE = 1e-3
"""Of a step's typical change: how far an observation is moved to see how much of it is left after a step."""
SLOPE_LIMIT = 2.0
"""Past this a signal's slope by itself is that of a contact, where noise is not carried on in proportion."""
OUTLIER = 5.0
"""Robust deviations that a larger residual counts as: a contact makes of small noise a large residual."""
NORMAL_MAD = 1.4826
"""Standard deviations in a median absolute deviation, for normal noise."""
_SHORTEST = 5
"""Rows of an episode that has next neighbours of second differences."""
_SURE = 3.0
"""Standard errors."""


def clipped(residuals: Float[np.ndarray, "rows observation"]) -> Float[np.ndarray, "rows observation"]:
    """Residuals of at most `OUTLIER` robust deviations of their signal; rows that failed count as 0."""
    finite = np.where(np.isfinite(residuals), residuals, 0.0)
    limit = OUTLIER * NORMAL_MAD * np.median(np.abs(finite), axis=0)
    return np.where(limit > 0.0, np.clip(finite, -limit, limit), finite)


def noise_deviation(
    first: Float[np.ndarray, "pairs observation"],
    second: Float[np.ndarray, "pairs observation"],
    slopes: Float[np.ndarray, "pairs observation"],
) -> Float[np.ndarray, " observation"]:
    """σ of each signal's noise e, from residuals of steps that follow each other.

    A step from a noisy state leaves r_t = A e_t - e_{t+1}, the next r_{t+1} = A e_{t+1} - e_{t+2}. They share one
    reading, with opposite signs: E[r_t r_{t+1}] = -A σ², A the signal's slope by itself. A model that is wrong adds to
    both what does not alternate, so it makes the estimate smaller and never hides as noise.
    """
    slope = np.clip(slopes, -SLOPE_LIMIT, SLOPE_LIMIT)
    weight = (slope**2).sum(0)
    shared = -(slope * first * second).sum(0) / np.where(weight > 0.0, weight, 1.0)
    return np.sqrt(np.maximum(shared, 0.0))


def difference_noise(dataset: Dataset) -> Float[np.ndarray, " observation"]:
    """σ of each signal's noise without any simulator, in the signal's unit: from how second differences alternate.

    Noise gives those of neighbouring rows the covariance -4 σ² and those of next neighbours σ². Motion gives both the
    same while it is smooth, and less than nothing to (c₂ - c₁) / 5 where a force that is held for a step makes it not
    so. What cannot be told from 0 counts as 0.
    """
    observation = np.asarray(dataset.transitions.observation)
    parts = [
        np.diff(observation[start:end], 2, axis=0)
        for start, end in zip(dataset.episode_starts, dataset.episode_ends, strict=True)
        if end - start >= _SHORTEST
    ]
    if not parts:
        return np.zeros(observation.shape[1])
    limited = np.split(clipped(np.concatenate(parts)), np.cumsum([len(part) for part in parts[:-1]]))
    first = np.concatenate([part[1:-1] * part[:-2] for part in limited])
    second = np.concatenate([part[2:] * part[:-2] for part in limited])
    variance = (second - first).mean(0) / 5.0
    error = (second - first).std(0) / 5.0 / np.sqrt(len(first))
    return np.asarray(np.sqrt(np.where(variance > _SURE * error, variance, 0.0)))


def consecutive(held: Dataset, rows: Int[np.ndarray, " states"]) -> Int[np.ndarray, " pairs"]:
    """Rows whose following row can be rebuilt too, spread evenly."""
    starts = set(held.episode_starts.tolist())
    following = rows[1:][np.diff(rows) == 1]
    return evenly(np.array([row - 1 for row in following if row not in starts], dtype=np.int64), MOST_WINDOWS)


def own_slopes(
    simulator: Simulator,
    held: Dataset,
    unit: Float[np.ndarray, " d"],
    rows: Int[np.ndarray, " rows"],
    scale: Float[np.ndarray, " observation"],
) -> Float[np.ndarray, "rows observation"]:
    """How far each signal is moved after a step from where it alone was moved before; 0 where that cannot be told."""
    moves = [np.zeros(len(scale)), *(PROBE * np.diag(scale))]
    states = np.stack([_states(held, simulator, rows, held.transitions.observation + move) for move in moves])
    action = np.asarray(held.transitions.action)[rows]
    system = simulator.bind(simulator.parameters.to_physical(unit)[None])
    flat = states.reshape(1, -1, states.shape[-1])
    known = np.isfinite(flat).all(-1, keepdims=True)
    flat = np.where(known, flat, np.tile(states[:1], (len(moves), 1, 1)).reshape(flat.shape))
    after = system.observe(system.step(system.unbiased(flat), np.tile(action, (len(moves), 1))[None]))
    after = after.reshape(len(moves), len(rows), -1)
    moved = np.diagonal(after[1:] - after[0], axis1=0, axis2=2) / (PROBE * scale)
    known = known.reshape(len(moves), len(rows))[1:].T
    return np.where(known & np.isfinite(moved), moved, 0.0)


def noise_floor(
    replays: Replays, held: Dataset, unit: Float[np.ndarray, " d"], deviation: Float[np.ndarray, " observation"]
) -> Float[np.ndarray, "1 windows steps observation"]:
    """What predictions would miss by at the given parameters if noise were all: of the start, and of what follows.

    Args:
        replays: The windows.
        held: Where they are from.
        unit: Parameters in [-1, 1].
        deviation: Of the noise, in steps' changes.
    """
    shape = (len(replays.windows), replays.windows.steps, len(deviation))
    if not deviation.any():
        return np.zeros((1, *shape))
    rng = np.random.default_rng(0)
    noise = deviation * replays.scale
    observation = np.asarray(held.transitions.observation)
    noisy = _states(held, replays.simulator, replays.rows, observation + noise * rng.standard_normal(observation.shape))
    starts = np.where(np.isfinite(noisy), noisy, replays.windows.states)
    moved, still = (
        replays.residuals(unit[None], replace(replays.windows, states=states))
        for states in (starts, replays.windows.states)
    )
    return moved - still + deviation * rng.standard_normal(shape)


def _states(
    held: Dataset, simulator: Simulator, rows: Int[np.ndarray, " rows"], observation: np.ndarray
) -> Float[np.ndarray, "rows state"]:
    """States rebuilt from other observations of the same rows; NaN where that cannot be."""
    moved = replace(held, transitions=replace(held.transitions, observation=observation))
    states, known = logged_states(moved, simulator.task)
    place = np.minimum(np.searchsorted(known, rows), len(known) - 1)
    return np.where((known[place] == rows)[:, None], states[place], np.nan)
