"""An ensemble Kalman filter (Evensen 2003) that predicts every reading of a window from all readings before it.

Where contacts are stiff, the noise of a reading is much deeper than they give way, and what follows from it is chance:
a foot that is half a millimetre too deep jumps. No single initial state explains such a window, and the gradient at one
says nothing of that around it. An ensemble of states that are all as likely as the reading predicts the mean, which is
smooth in the parameters, and what contacts forget of the first state it forgets as well.
"""

from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.data.dataset import Dataset
from madoc.data.timescale import stride
from madoc.identification.losses import Loss
from madoc.identification.noise import difference_noise
from madoc.identification.replay import Readings
from madoc.identification.settling import (
    ANEW,
    FAILED_WINDOW,
    WIDTHS,
    settled,
    window_costs,
    with_bases_settled,
)
from madoc.identification.states import LoggedStates, states_of
from madoc.simulation.attitudes import differences, moved
from madoc.simulation.base import Simulator

FARTHEST = 4.0
"""Standard deviations of an innovation, beyond which the states follow it no farther: a false reading says nothing."""
AGREEING = 1e-3
"""Smallest share in [0, 1] of the squares of an ensemble's derivatives that the other counts as agreeing on."""
NOISE_CHANGE = (0.1, 4.0)
"""Smallest and largest factor of a channel's noise variance from a run of the filter to the next."""
CLIP, OF_CLIPPED = 3.0, 0.9950
"""Standard deviations at which errors are clipped, and the mean square of a normal value that is."""
BEFORE, MOST_BEFORE = 8, 30
"""Number of strides before a window, by whose readings a filter finds states at its first row; so many rows at most."""
DRAWN = 32
"""Number of states that are tried at the first row of a window."""
NOISE_ROUNDS = 2
"""Number of runs of a filter before a window; each tells the sensors' noise better."""
LEAST_NOISE = 1e-3
"""Smallest noise of a channel in its typical changes at the start: differences of rows may hide it."""
SPOILT = 3
"""Number of first steps whose errors do not count where velocities are differences, which hold the next position."""
_SMALLEST, _ROUNDING = 1e-100, 1e-12


@dataclass(frozen=True)
class Innovations:
    """Differences between predicted and measured readings, each predicted from the readings of its window before it.

    Attributes:
        mean: Predicted mean minus the reading, in standard deviations of the sensors' noise.
        factor: Lower triangular L with L Lᵀ the covariance of that, the sensors' noise included.
        whole: Windows in which no simulation failed, by system.
        members: The ensembles' states after the last reading.
    """

    mean: Float[np.ndarray, "systems windows steps channels"]
    factor: Float[np.ndarray, "systems windows steps channels channels"]
    whole: Bool[np.ndarray, "systems windows"]
    members: Float[np.ndarray, "systems windows members state"]

    @cached_property
    def whitened(self) -> Float[np.ndarray, "systems windows steps channels"]:
        """L⁻¹ (prediction - reading), all with the L of the first system: of variance 1 there if the model is right."""
        return np.linalg.solve(self.factor[0], self.mean[..., None])[..., 0]

    def surprise(self, loss: Loss) -> Float[np.ndarray, "systems windows"]:
        """Mean of the loss of each window's values, each system whitening its own, and of log det S per value.

        For squares it is -2 log p of the readings, but for a constant and a factor; `FAILED_WINDOW` where one failed.
        """
        own = np.linalg.solve(self.factor, self.mean[..., None])[..., 0]
        sizes = np.log(np.diagonal(self.factor, axis1=-2, axis2=-1)).mean((-1, -2))
        costs = window_costs(own.reshape(*own.shape[:2], -1), loss) + 2.0 * sizes
        return np.where(self.whole, costs, FAILED_WINDOW)

    def variances(self) -> Float[np.ndarray, "windows steps channels"]:
        """Variance of each reading's prediction under the first system, in those of the sensors' noise, at least 1."""
        return np.asarray((self.factor[0] ** 2).sum(-1))

    def alike(self, first: int = 0) -> float:
        """The largest certain correlation of a channel's whitened errors with the next ones, outliers clipped.

        It is that of the first system, from the step `first` on; 0 for right predictions, as these use every reading.
        A correlation is certain where windows agree on it, by two standard errors.
        """
        errors = np.clip(self.whitened[0, self.whole[0], first:], -CLIP, CLIP)
        if len(errors) < 2:
            return 0.0
        pairs, squares = (errors[:, 1:] * errors[:, :-1]).mean(1), (errors**2).mean((0, 1))
        certain = pairs.mean(0) > 2.0 * pairs.std(0, ddof=1) / np.sqrt(len(pairs))
        return float((certain * pairs.mean(0) / np.maximum(squares, _SMALLEST)).max(initial=0.0))

    def noise_ratio(self, first: int = 0) -> Float[np.ndarray, " channels"]:
        """Mean square of each channel's prediction errors over their variance, outliers clipped; 1 if they are all 0.

        It is that of the first system, from the step `first` on: Huber's (1964) second proposal for a scale, with a cut
        at three standard deviations.
        """
        relative = (self.mean[0] ** 2 / self.variances())[self.whole[0], first:].reshape(-1, self.mean.shape[-1])
        clipped = np.minimum(relative, CLIP**2).mean(0) / OF_CLIPPED if len(relative) else np.zeros(relative.shape[-1])
        return np.where(clipped == 0.0, 1.0, clipped)


def innovations(
    simulator: Simulator,
    readings: Readings,
    points: Float[np.ndarray, "systems d"],
    members: Float[np.ndarray, "windows members state"],
    noise: Float[np.ndarray, " channels"],
) -> Innovations:
    """Predict each reading after the first at every point, and move the members by it before the next one.

    What is too far from the first point's prediction to be followed is followed as little at the others, so that they
    differ from it in their parameters alone.

    The members are states as likely as the first reading; `noise` is that of the sensors in typical changes. Spends
    systems · windows · members · steps control steps.
    """
    (windows, count, size), physical = members.shape, len(readings.spread)
    system = simulator.bind(simulator.parameters.to_physical(np.clip(points, -1.0, 1.0)))
    every = (len(points), windows * count, size)
    states = system.unbiased(np.broadcast_to(members.reshape(every[1:]), every).copy())
    shape, channels = (len(points), windows, readings.steps, len(noise)), len(noise)
    mean, factor, whole = np.zeros(shape), np.zeros((*shape, channels)), np.ones(shape[:2], bool)
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
        mean[:, :, step], factor[:, :, step] = apart.mean(2), _covariance_factor(apart)
        grouped[..., :physical] = followed(grouped[..., :physical], apart, factor[:, :, step])
        states = np.where(whole[..., None, None], grouped, members).reshape(every)
    return Innovations(mean, factor, whole, states.reshape(*shape[:2], count, size))


def _covariance_factor(
    apart: Float[np.ndarray, "*rows members channels"],
) -> Float[np.ndarray, "*rows channels channels"]:
    """L of the members' covariance and that of the noise, which is 1."""
    around = apart - apart.mean(-2, keepdims=True)
    covariance = np.swapaxes(around, -1, -2) @ around / (apart.shape[-2] - 1)
    return np.asarray(np.linalg.cholesky(covariance + np.eye(apart.shape[-1])))


def followed(
    states: Float[np.ndarray, "systems windows members physical"],
    apart: Float[np.ndarray, "systems windows members channels"],
    factor: Float[np.ndarray, "systems windows channels channels"],
) -> Float[np.ndarray, "systems windows members physical"]:
    """The states after a reading, from which theirs are so far `apart` in standard deviations of its noise.

    The mean moves by Kalman's gain K = P Hᵀ S⁻¹, the deviations from it by P Hᵀ L⁻ᵀ (L + 1)⁻¹, S = L Lᵀ, after which
    they have the covariance (1 - K H) P without further random numbers (Andrews 1968).
    """
    middle, observed = states.mean(-2, keepdims=True), apart.mean(-2, keepdims=True)
    around, shown = states - middle, apart - observed
    inverse = np.linalg.inv(factor)
    gain = np.swapaxes(around, -1, -2) @ shown / (states.shape[-2] - 1) @ np.swapaxes(inverse, -1, -2)
    innovation = inverse @ np.swapaxes(observed, -1, -2)
    innovation = innovation * np.minimum(1.0, FARTHEST / np.maximum(np.abs(innovation[:1]), FARTHEST))
    of_deviations = gain @ np.linalg.inv(factor + np.eye(factor.shape[-1]))
    return middle - np.swapaxes(gain @ innovation, -1, -2) + around - shown @ np.swapaxes(of_deviations, -1, -2)


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
    of the positions with noise.
    """
    assert np.isin(rows, logged.rows).all()
    states = logged.states[np.searchsorted(logged.rows, rows)]
    physical = slice(0, logged.physical_size)
    draw = _rebuilt if logged.kind == "exact" else _rebuilt_from_neighbours
    drawn = [draw(dataset, simulator, rows, noise, random)[:, physical] for _ in range(count)]
    members = np.repeat(states[:, None], count, axis=1)
    members[..., physical] = np.stack(drawn, axis=1)
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
) -> Float[np.ndarray, "windows state"]:
    """States whose velocities are differences of positions in the rows around."""
    logged, attitudes = dataset.transitions, simulator.task.attitudes
    here, there = (np.asarray(part, np.float64) for part in (logged.observation, logged.next_observation))
    error = np.zeros((2, *here.shape))
    error[..., : len(noise)] = random.standard_normal((*error.shape[:2], len(noise))) * noise
    last = np.isin(np.arange(len(dataset)), dataset.episode_ends - 1)
    following = np.where(last[:, None], error[1], np.roll(error[0], -1, axis=0))
    noisy = replace(
        logged, observation=moved(attitudes, here, error[0]), next_observation=moved(attitudes, there, following)
    )
    states = states_of(replace(dataset, transitions=noisy), simulator)
    return states.states[np.searchsorted(states.rows, rows)]


def agreed(products: Float[np.ndarray, "d d"], squares: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """The products, in no direction less than `AGREEING` of the squares: by chance they may be negative."""
    size = np.sqrt(np.maximum(np.diag(squares), _SMALLEST))
    relative = [each / np.outer(size, size) for each in (products, squares)]
    values, vectors = np.linalg.eigh(relative[1])
    root = vectors * np.sqrt(np.maximum(values, _ROUNDING))
    inverse = np.linalg.inv(root)
    shares, axes = np.linalg.eigh(inverse @ relative[0] @ inverse.T)
    whole = size[:, None] * (root @ axes * np.sqrt(np.maximum(shares, AGREEING)))
    return whole @ whole.T


def with_contacts_settled(
    dataset: Dataset,
    logged: LoggedStates,
    simulator: Simulator,
    readings: Readings,
    rows: Int[np.ndarray, " windows"],
    point: Float[np.ndarray, " d"],
    guesses: Float[np.ndarray, "windows state"],
) -> tuple[Float[np.ndarray, "windows state"], int]:
    """Initial states from near which those of single windows can be fitted, and the control steps that it took.

    Where windows begin in contact, the best of many states that are as likely as the readings before each window is
    taken, and settles by differences of all `WIDTHS` until residuals of nearly all are noise, and anew where they are
    not: what states in wrong minima leave would pass for what the model lacks.
    """
    if readings.placed.any():
        states, simulations = with_bases_settled(simulator, readings, point, guesses)
        return states, simulations * readings.steps
    known = guesses[np.isfinite(guesses).all(-1)]
    if not len(known) or not simulator.contacts(known, simulator.parameters.to_physical(point.clip(-1.0, 1.0))).any():
        return guesses, 0
    spent = 0
    if logged.starts_known and can_be_drawn(logged, simulator):
        guesses, spent = _likeliest(dataset, logged, simulator, readings, rows, point, guesses)
    after = settled(simulator, readings, point, guesses, WIDTHS, ANEW, until_noise=True)
    return after.states, spent + after.simulations * readings.steps


def can_be_drawn(logged: LoggedStates, simulator: Simulator) -> bool:
    """Whether `members_at` can draw states: not where a log has derived velocities that states are rebuilt from."""
    return simulator.task.state_from_observation is None or logged.measured == simulator.task.observation_size


def _likeliest(
    dataset: Dataset,
    logged: LoggedStates,
    simulator: Simulator,
    readings: Readings,
    rows: Int[np.ndarray, " windows"],
    point: Float[np.ndarray, " d"],
    guesses: Float[np.ndarray, "windows state"],
) -> tuple[Float[np.ndarray, "windows state"], int]:
    """The guess of each window's first state, or that of an ensemble's states there which fits the window better.

    The ensemble has followed the readings before the window, where its episode has as many. Also the control steps.
    """
    before = min(BEFORE * stride(dataset), MOST_BEFORE)
    random, first, least = np.random.default_rng(0), rows - before, np.full(logged.measured, LEAST_NOISE)
    noise = np.maximum(difference_noise(dataset)[: logged.measured] / readings.scale, least)
    tried, physical = np.repeat(guesses[:, None], 1 + DRAWN, axis=1), slice(0, logged.physical_size)
    follows = np.isin(first, logged.rows) & (dataset.episode_starts[dataset.episode_of(rows)] <= first)
    begun, others = np.flatnonzero(follows), np.flatnonzero(~follows)
    draw = partial(members_at, dataset, logged, simulator, count=DRAWN, random=random)
    if len(begun):
        earlier = Readings.at(dataset, logged, first[begun], before, readings.scale)
        for _ in range(NOISE_ROUNDS):
            members = draw(rows=first[begun], noise=noise * readings.scale)
            found = innovations(simulator, earlier, point[None], members, noise)
            ratio = found.noise_ratio(0 if logged.kind == "exact" else SPOILT)
            noise = np.maximum(noise * np.sqrt(np.clip(ratio, *NOISE_CHANGE)), least)
        whole = found.whole[0]
        tried[begun[whole], 1:, physical] = found.members[0, whole][..., physical]
    if len(others):
        system = simulator.bind(simulator.parameters.to_physical(np.clip(point, -1.0, 1.0))[None])
        tried[others, 1:] = system.unbiased(draw(rows=rows[others], noise=noise * readings.scale))
    starts = np.swapaxes(tried, 0, 1).reshape(1, -1, guesses.shape[1])
    residuals = readings.residuals(simulator, point[None], starts)[0] / np.tile(noise, readings.steps + 1)
    best = window_costs(residuals, "cauchy").argmin(0)
    spent = NOISE_ROUNDS * len(begun) * DRAWN * before + len(rows) * (1 + DRAWN) * readings.steps
    return tried[np.arange(len(rows)), best], spent
