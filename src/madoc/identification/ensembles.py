"""An ensemble Kalman filter (Evensen 2003) that predicts every reading of a window from all readings before it.

Where contacts are stiff, the noise of a reading is much deeper than they give way, and what follows from it is chance:
a foot that is half a millimetre too deep jumps. No single initial state explains such a window, and the gradient at one
says nothing of that around it. An ensemble of states that are all as likely as the reading predicts the mean, which is
smooth in the parameters, and what contacts forget of the first state it forgets as well.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from madoc.data.dataset import Dataset, stride
from madoc.data.disturbing import hide_velocities
from madoc.data.velocities import moving_states
from madoc.identification.innovations import Innovations, innovations
from madoc.identification.noise import difference_noise
from madoc.identification.random_forces import by_dof, opposed
from madoc.identification.replay import Readings
from madoc.identification.settling import settled_to_noise, window_costs
from madoc.identification.states import LoggedStates, completed
from madoc.simulation.attitudes import moved
from madoc.simulation.base import Simulator

NOISE_CHANGE = (0.1, 4.0)
"""Smallest and largest factor of a channel's noise variance from a run of the filter to the next."""
OF_BASES = (0.003, 0.05)
"""Standard deviations in m and m/s of the places and speeds that contacts give bases which no sensor shows."""
BEFORE, MOST_BEFORE = 8, 30
"""Number of strides before a window, by whose readings a filter finds states at its first row; so many rows at most."""
DRAWN = 16
"""Number of states that are tried at the first row of a window."""
NOISE_ROUNDS = 2
"""Number of runs of a filter before a window; each tells the sensors' noise better."""
LEAST_NOISE = 1e-3
"""Smallest noise of a channel before windows, in its typical changes, and later relative to that of any channel."""
SPOILT = 3
"""Number of first steps whose errors do not count. States are drawn about single readings, in which noise decides what
touches, and velocities that are differences hold the next position; some steps of the filter put that right."""


def next_noise(
    noise: Float[np.ndarray, " channels"],
    ratio: Float[np.ndarray, " channels"],
    rounding: Float[np.ndarray, " channels"],
) -> Float[np.ndarray, " channels"]:
    """The sensors' noise by `Innovations.noise_ratio`, at least that of rounding, all in typical changes."""
    changed = noise * np.sqrt(np.clip(ratio, *NOISE_CHANGE))
    return np.maximum(changed, np.maximum(rounding, LEAST_NOISE * changed.max()))


class FilteredWindows(NamedTuple):
    """Windows that a filter follows: the log, what it says of states, the model, readings, and the first rows."""

    dataset: Dataset
    logged: LoggedStates
    simulator: Simulator
    readings: Readings
    rows: Int[np.ndarray, " windows"]

    def of(self, kept: Int[np.ndarray, " some"]) -> "FilteredWindows":
        """These windows alone."""
        return self._replace(readings=self.readings.of(kept), rows=self.rows[kept])


def with_noise(
    windows: FilteredWindows,
    point: Float[np.ndarray, " d"],
    noise: Float[np.ndarray, " channels"],
    rounding: Float[np.ndarray, " channels"],
    count: int,
    rounds: int,
    random: np.random.Generator,
    force: float = 0.0,
) -> tuple[Innovations, Float[np.ndarray, " channels"]]:
    """Innovations of so many members at one point, and the sensors' noise, estimated by them in several rounds.

    It begins at a given one, in typical changes; `force` is the size of random forces (`random_forces`). Spends
    rounds · windows · members · steps control steps.
    """
    dataset, logged, simulator, readings, rows = windows
    (of_forces,) = random.spawn(1)  # members are the same with any forces
    for _ in range(rounds):
        members = members_at(dataset, logged, simulator, rows, noise * readings.scale, count, random)
        forces = opposed(by_dof(simulator, force), len(rows), count, readings.steps, of_forces)
        found = innovations(simulator, readings, point[None], members, noise, first=SPOILT, forces=forces)
        noise = next_noise(noise, found.noise_ratio(), rounding)
    return found, noise


def _of_one_row(logged: LoggedStates, simulator: Simulator) -> bool:
    """Whether what sensors measured in a row determines its state, so that no other row's noise is in it."""
    return logged.kind == "exact" and logged.measured == simulator.task.observation_size


def few_of(
    members: Float[np.ndarray, "windows members state"], count: int, physical: int
) -> Float[np.ndarray, "windows few state"]:
    """The first so many members, their physical values with the mean of all and, as expected, their variance."""
    few, total = members[:, :count].copy(), members.shape[1]
    middle = members.mean(1, keepdims=True)[..., :physical]
    around = few[..., :physical] - few.mean(1, keepdims=True)[..., :physical]
    few[..., :physical] = middle + around * np.sqrt((1.0 - 1.0 / total) * count / max(1, count - 1))
    return few


def members_at(
    dataset: Dataset,
    logged: LoggedStates,
    simulator: Simulator,
    rows: Int[np.ndarray, " windows"],
    noise: Float[np.ndarray, " channels"],
    count: int,
    random: np.random.Generator,
) -> Float[np.ndarray, "windows members state"]:
    """States that are as likely as those of the log at some rows: rebuilt from its readings with further noise.

    `noise` is the sensors', in the units of the channels. Where velocities are differences of positions, they are those
    of the positions with noise. Bases that no sensor shows are about where contacts have placed them (`OF_BASES`).
    """
    assert np.isin(rows, logged.rows).all()
    states = logged.states[np.searchsorted(logged.rows, rows)]
    physical = slice(0, logged.physical_size)
    draw = _rebuilt if _of_one_row(logged, simulator) else _rebuilt_from_neighbours
    drawn = [draw(dataset, simulator, rows, noise, random)[:, physical] for _ in range(count)]
    members = np.repeat(states[:, None], count, axis=1)
    members[..., physical] = np.stack(drawn, axis=1)
    if (bases := np.flatnonzero(logged.placed)).size:
        spread = np.where(bases < simulator.task.model.nq, *OF_BASES)
        members[..., bases] = states[:, None, bases] + spread * random.standard_normal((*members.shape[:2], len(bases)))
    return members


def _rebuilt(
    dataset: Dataset,
    simulator: Simulator,
    rows: Int[np.ndarray, " windows"],
    noise: Float[np.ndarray, " channels"],
    random: np.random.Generator,
) -> Float[np.ndarray, "windows state"]:
    """States that readings of a row determine."""
    readings = np.asarray(dataset.transitions.observation, np.float64)[rows]
    rebuild = simulator.task.state_from_observation
    assert rebuild is not None  # else they are not exact
    error = random.standard_normal(readings.shape) * noise
    return np.asarray(rebuild(moved(simulator.task.attitudes, readings, error)))


def _rebuilt_from_neighbours(
    dataset: Dataset,
    simulator: Simulator,
    rows: Int[np.ndarray, " windows"],
    noise: Float[np.ndarray, " channels"],
    random: np.random.Generator,
) -> Float[np.ndarray, "windows physical"]:
    """(qpos, qvel) whose velocities, but those that sensors measured, are differences of positions in rows around."""
    task = simulator.task if len(noise) == simulator.task.observation_size else hide_velocities(simulator.task)
    attitudes, episode = task.attitudes, dataset.episode_of(rows)
    first = np.maximum(rows - 1, dataset.episode_starts[episode])
    count = np.minimum(rows + 2, dataset.episode_ends[episode]) - first
    starts = np.cumsum(count) - count
    near = dataset.take(np.arange(count.sum()) + np.repeat(first - starts, count), starts)
    here, there = (
        np.asarray(part, np.float64)[:, : len(noise)]
        for part in (near.transitions.observation, near.transitions.next_observation)
    )
    error = random.standard_normal((2, *here.shape)) * noise
    last = np.isin(np.arange(len(near)), near.episode_ends - 1)
    following = np.where(last[:, None], error[1], np.roll(error[0], -1, axis=0))
    noisy = replace(
        near.transitions,
        observation=moved(attitudes, here, error[0]),
        next_observation=moved(attitudes, there, following),
    )
    before, after = moving_states(replace(near, transitions=noisy), task)
    place = starts + rows - first
    return completed(simulator, before[place], (after - before)[place])[0]


def with_contacts_settled(
    dataset: Dataset,
    logged: LoggedStates,
    simulator: Simulator,
    readings: Readings,
    rows: Int[np.ndarray, " windows"],
    point: Float[np.ndarray, " d"],
    guesses: Float[np.ndarray, "windows state"],
) -> Float[np.ndarray, "windows state"]:
    """Initial states from near which those of single windows can be fitted.

    Where windows begin in contact, the best of many states that are as likely as the readings before each window is
    taken, and settles (`settled_to_noise`): what states in wrong minima leave would pass for what the model lacks.
    """
    (likely,) = likely_states(dataset, logged, simulator, readings, rows, point[None], guesses)
    if not _touch(simulator, point, guesses):
        return likely
    return settled_to_noise(simulator, readings, point, likely).states


def _touch(simulator: Simulator, point: Float[np.ndarray, " d"], states: Float[np.ndarray, "windows state"]) -> bool:
    """Whether bodies touch in any of the states."""
    known = states[np.isfinite(states).all(-1)]
    values = simulator.parameters.to_physical(point.clip(-1.0, 1.0))
    return bool(len(known) and simulator.contacts(known, values).any())


def likely_states(
    dataset: Dataset,
    logged: LoggedStates,
    simulator: Simulator,
    readings: Readings,
    rows: Int[np.ndarray, " windows"],
    points: Float[np.ndarray, "systems d"],
    guesses: Float[np.ndarray, "windows state"],
) -> Float[np.ndarray, "systems windows state"]:
    """The guess of each window's first state, or that of an ensemble's states there which fits the window better.

    Each system takes the states that fit best under its parameters, of one ensemble for all: it is the last system's,
    and has followed the readings before the window, where its episode has as many. Guesses are left as they are where
    nothing touches, and where states are unknown.
    """
    point = points[-1]
    if not (logged.starts_known and _touch(simulator, point, guesses)):
        return np.repeat(guesses[None], len(points), axis=0)
    before = min(BEFORE * stride(dataset), MOST_BEFORE)
    random, first = np.random.default_rng(0), rows - before
    noise = np.maximum(difference_noise(dataset)[: logged.measured] / readings.scale, LEAST_NOISE)
    tried, physical = np.repeat(guesses[:, None], 1 + DRAWN, axis=1), slice(0, logged.physical_size)
    follows = np.isin(first, logged.rows) & (dataset.episode_starts[dataset.episode_of(rows)] <= first)
    begun, others = np.flatnonzero(follows), np.flatnonzero(~follows)
    if len(begun):
        earlier = Readings.at(dataset, logged, first[begun], before, readings.scale)
        windows = FilteredWindows(dataset, logged, simulator, earlier, first[begun])
        found, noise = with_noise(windows, point, noise, np.zeros_like(noise), DRAWN, NOISE_ROUNDS, random)
        whole = found.whole[0]
        tried[begun[whole], 1:, physical] = found.members[0, whole][..., physical]
    if len(others):
        system = simulator.bind(simulator.parameters.to_physical(np.clip(point, -1.0, 1.0))[None])
        drawn = members_at(dataset, logged, simulator, rows[others], noise * readings.scale, DRAWN, random)
        tried[others, 1:] = system.unbiased(drawn)
    starts = np.swapaxes(tried, 0, 1).reshape(1, -1, guesses.shape[1])
    residuals = readings.residuals(simulator, points, np.repeat(starts, len(points), axis=0))
    best = window_costs(residuals / np.tile(noise, readings.steps + 1), "cauchy").argmin(1)
    return tried[np.arange(len(rows)), best]
