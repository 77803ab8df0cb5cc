"""An ensemble Kalman filter (Evensen 2003) that predicts every reading of a window from all readings before it.

Where contacts are stiff, the noise of a reading is much deeper than they give way, and what follows from it is chance:
a foot that is half a millimetre too deep jumps. No single initial state explains such a window, and the gradient at one
says nothing of that around it. An ensemble of states that are all as likely as the reading predicts the mean, which is
smooth in the parameters, and what contacts forget of the first state it forgets as well.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.data.dataset import Dataset
from madoc.data.disturbing import hide_velocities
from madoc.data.timescale import stride
from madoc.data.velocities import moving_states
from madoc.identification.losses import Loss
from madoc.identification.noise import difference_noise
from madoc.identification.replay import Readings
from madoc.identification.settling import FAILED_WINDOW, settled_to_noise, window_costs
from madoc.identification.states import LoggedStates, completed
from madoc.simulation.attitudes import differences, moved
from madoc.simulation.base import Simulator

FARTHEST = 4.0
"""Standard deviations of an innovation, beyond which the states follow it no farther: a false reading says nothing."""
NOISE_CHANGE = (0.1, 4.0)
"""Smallest and largest factor of a channel's noise variance from a run of the filter to the next."""
CLIP, OF_CLIPPED = 3.0, 0.9950
"""Standard deviations at which errors are clipped, and the mean square of a normal value that is."""
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
_SMALLEST = 1e-100


class Correction(NamedTuple):
    """How an ensemble's states follow the readings of a step, with L Lᵀ = S the covariance of their predictions.

    Attributes:
        factor: Lower triangular L, in standard deviations of the sensors' noise, that noise included.
        inverse: L⁻¹.
        gain: P Hᵀ L⁻ᵀ, by which the mean moves: Kalman's gain is K = P Hᵀ S⁻¹.
        shrinking: P Hᵀ L⁻ᵀ (L + 1)⁻¹, by which deviations do: they then have the covariance (1 - K H) P (Andrews 1968).
        share: Share in [0, 1] of L⁻¹ (prediction - reading) that is followed: not what is farther than `FARTHEST`.
    """

    factor: Float[np.ndarray, "*rows channels channels"]
    inverse: Float[np.ndarray, "*rows channels channels"]
    gain: Float[np.ndarray, "*rows physical channels"]
    shrinking: Float[np.ndarray, "*rows physical channels"]
    share: Float[np.ndarray, "*rows channels"]

    @classmethod
    def of(
        cls,
        states: Float[np.ndarray, "*rows members physical"],
        apart: Float[np.ndarray, "*rows members channels"],
    ) -> "Correction":
        """That of an ensemble which is so far `apart` from a reading, in standard deviations of its noise."""
        around, observed = states - states.mean(-2, keepdims=True), apart.mean(-2, keepdims=True)
        shown, freedom, one = apart - observed, states.shape[-2] - 1, np.eye(apart.shape[-1])
        factor = np.linalg.cholesky(np.swapaxes(shown, -1, -2) @ shown / freedom + one)
        inverse = np.linalg.inv(factor)
        gain = np.swapaxes(around, -1, -2) @ shown / freedom @ np.swapaxes(inverse, -1, -2)
        far = np.abs(observed @ np.swapaxes(inverse, -1, -2))[..., 0, :]
        return cls(factor, inverse, gain, gain @ np.linalg.inv(factor + one), FARTHEST / np.maximum(far, FARTHEST))

    def follow(
        self,
        states: Float[np.ndarray, "*systems_and_rows members physical"],
        apart: Float[np.ndarray, "*systems_and_rows members channels"],
    ) -> Float[np.ndarray, "*systems_and_rows members physical"]:
        """The states after the reading from which they are so far `apart`."""
        observed = apart.mean(-2, keepdims=True)
        innovation = observed @ np.swapaxes(self.inverse, -1, -2) * self.share[..., None, :]
        middle = innovation @ np.swapaxes(self.gain, -1, -2)
        return states - middle - (apart - observed) @ np.swapaxes(self.shrinking, -1, -2)


@dataclass(frozen=True)
class Innovations:
    """Differences between predicted and measured readings, each predicted from the readings of its window before it.

    Attributes:
        mean: Predicted mean minus the reading, in standard deviations of the sensors' noise.
        corrections: How the states of all systems followed each reading.
        whole: Windows in which no simulation failed, by system.
        members: The ensembles' states after the last reading.
        first: The first step whose errors count.
    """

    mean: Float[np.ndarray, "systems windows steps channels"]
    corrections: Correction
    whole: Bool[np.ndarray, "systems windows"]
    members: Float[np.ndarray, "systems windows members state"]
    first: int

    @cached_property
    def whitened(self) -> Float[np.ndarray, "systems windows steps channels"]:
        """L⁻¹ (prediction - reading): of variance 1 if the model is right."""
        return (self.corrections.inverse @ self.mean[..., None])[..., 0]

    def surprise(self, loss: Loss) -> Float[np.ndarray, "systems windows"]:
        """Mean of the loss of each window's whitened values; `FAILED_WINDOW` where a simulation failed."""
        costs = window_costs(self.whitened.reshape(*self.whole.shape, -1), loss)
        return np.where(self.whole, costs, FAILED_WINDOW)

    def variances(self) -> Float[np.ndarray, "windows steps channels"]:
        """Variance of each reading's prediction, in those of the sensors' noise, at least 1."""
        return np.asarray((self.corrections.factor**2).sum(-1))

    def counted(self, errors: Float[np.ndarray, "windows steps channels"]) -> Float[np.ndarray, "windows values"]:
        """The errors that count, of all channels but those in which the first system's never differ from 0."""
        kept = (self.whitened[0, :, self.first :] != 0.0).any((0, 1))
        return errors[:, self.first :, kept].reshape(len(errors), -1)

    def alike(self) -> float:
        """The largest correlation of a channel's whitened errors with the next ones that is certain, outliers clipped.

        It is that of the first system; 0 for right predictions, as these use every reading before them. What is certain
        is what remains of a mean over windows less two standard errors.
        """
        errors = np.clip(self.whitened[0, self.whole[0], self.first :], -CLIP, CLIP)
        if len(errors) < 2:
            return 0.0
        pairs, squares = (errors[:, 1:] * errors[:, :-1]).mean(1), (errors**2).mean((0, 1))
        certain = pairs.mean(0) - 2.0 * pairs.std(0, ddof=1) / np.sqrt(len(pairs))
        return float((certain / np.maximum(squares, _SMALLEST)).max(initial=0.0))

    def noise_ratio(self) -> Float[np.ndarray, " channels"]:
        """Mean square of each channel's prediction errors over their variance, outliers clipped; 1 if they are all 0.

        It is that of the first system: Huber's (1964) second proposal for a scale, with a cut at three standard
        deviations.
        """
        relative = (self.mean[0] ** 2 / self.variances())[self.whole[0], self.first :].reshape(-1, self.mean.shape[-1])
        clipped = np.minimum(relative, CLIP**2).mean(0) / OF_CLIPPED if len(relative) else np.zeros(relative.shape[-1])
        return np.where(clipped == 0.0, 1.0, clipped)


def innovations(
    simulator: Simulator,
    readings: Readings,
    points: Float[np.ndarray, "systems d"],
    members: Float[np.ndarray, "windows members state"],
    noise: Float[np.ndarray, " channels"],
    *,
    first: int = 0,
    like: Innovations | None = None,
) -> Innovations:
    """Predict each reading after the first at every point, and move the members by it before the next one.

    All systems follow readings as the first one's ensemble does, or as those of other innovations did, so that they
    differ in their parameters alone, and few members may do where a larger ensemble is at hand. An error of the gain
    hardly changes an estimate, as right predictions leave errors that are uncorrelated with all readings before.

    The members are states as likely as the first reading; `noise` is that of the sensors in typical changes. Errors
    count from the step `first` on. Spends systems · windows · members · steps control steps.
    """
    (windows, count, size), physical = members.shape, len(readings.spread)
    system = simulator.bind(simulator.parameters.to_physical(np.clip(points, -1.0, 1.0)))
    every = (len(points), windows * count, size)
    states = system.unbiased(np.broadcast_to(members.reshape(every[1:]), every).copy())
    shape, channels, corrections = (len(points), windows, readings.steps, len(noise)), len(noise), []
    mean, whole = np.zeros(shape), np.ones(shape[:2], bool)
    if like is not None:
        whole &= like.whole[0]
    for step in range(readings.steps):
        actions = np.repeat(readings.actions[:, step], count, axis=0)
        after = system.step(states, np.broadcast_to(actions, (*every[:2], actions.shape[-1])))
        finite = np.isfinite(after).all(-1, keepdims=True)
        after = np.where(finite, after, states)
        seen = system.observe(after)[..., :channels].reshape(*shape[:2], count, channels)
        apart = differences(simulator.task.attitudes, seen, readings.observed[:, step + 1, None])
        apart = apart / (readings.scale * noise)
        whole &= finite.reshape(*shape[:2], count).all(2) & np.isfinite(apart).all((2, 3))
        grouped = np.where(whole[..., None, None], after.reshape(*shape[:2], count, size), 0.0)
        apart = np.where(whole[..., None, None], apart, 0.0)
        mean[:, :, step], moving = apart.mean(2), grouped[..., :physical]
        if like is None:
            correction = Correction.of(moving[0], apart[0])
            corrections.append(correction)
        else:
            correction = Correction(*(each[:, step] for each in like.corrections))
        grouped[..., :physical] = correction.follow(moving, apart)
        states = np.where(whole[..., None, None], grouped, members).reshape(every)
    every_step = (np.stack(each, axis=1) for each in zip(*corrections, strict=True))
    followed = Correction(*every_step) if like is None else like.corrections
    return Innovations(mean, followed, whole, states.reshape(*shape[:2], count, size), first)


def next_noise(
    noise: Float[np.ndarray, " channels"],
    ratio: Float[np.ndarray, " channels"],
    rounding: Float[np.ndarray, " channels"],
) -> Float[np.ndarray, " channels"]:
    """The sensors' noise by `Innovations.noise_ratio`, at least that of rounding, all in typical changes."""
    changed = noise * np.sqrt(np.clip(ratio, *NOISE_CHANGE))
    return np.maximum(changed, np.maximum(rounding, LEAST_NOISE * changed.max()))


def with_noise(
    dataset: Dataset,
    logged: LoggedStates,
    simulator: Simulator,
    readings: Readings,
    rows: Int[np.ndarray, " windows"],
    point: Float[np.ndarray, " d"],
    noise: Float[np.ndarray, " channels"],
    rounding: Float[np.ndarray, " channels"],
    count: int,
    rounds: int,
    random: np.random.Generator,
) -> tuple[Innovations, Float[np.ndarray, " channels"]]:
    """Innovations of so many members at one point, and the sensors' noise, estimated by them in several rounds.

    It begins at a given one, in typical changes. Spends rounds · windows · members · steps control steps.
    """
    for _ in range(rounds):
        members = members_at(dataset, logged, simulator, rows, noise * readings.scale, count, random)
        found = innovations(simulator, readings, point[None], members, noise, first=SPOILT)
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
        how = np.zeros_like(noise), DRAWN, NOISE_ROUNDS, random
        found, noise = with_noise(dataset, logged, simulator, earlier, first[begun], point, noise, *how)
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
