"""An ensemble Kalman filter (Evensen 2003) that predicts every reading of a window from all readings before it.

Where contacts are stiff, the noise of a reading is much deeper than they give way, and what follows from it is chance:
a foot that is half a millimetre too deep jumps. No single initial state explains such a window, and the gradient at one
says nothing of that around it. An ensemble of states that are all as likely as the reading predicts the mean, which is
smooth in the parameters, and what contacts forget of the first state it forgets as well.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.data.dataset import Dataset
from madoc.identification.losses import Loss
from madoc.identification.replay import Readings
from madoc.identification.settling import FAILED_WINDOW, window_costs
from madoc.identification.states import LoggedStates, states_observed_as, states_of
from madoc.simulation.attitudes import differences, moved
from madoc.simulation.base import Simulator

FARTHEST = 4.0
"""Standard deviations of an innovation, beyond which the states follow it no farther: a false reading says nothing."""


@dataclass(frozen=True)
class Innovations:
    """Differences between predicted and measured readings, each predicted from the readings of its window before it.

    Attributes:
        mean: Predicted mean minus the reading, in standard deviations of the sensors' noise.
        factor: Lower triangular L with L Lᵀ the covariance of that, the sensors' noise included.
        whole: Windows in which no simulation failed.
    """

    mean: Float[np.ndarray, "systems windows steps channels"]
    factor: Float[np.ndarray, "systems windows steps channels channels"]
    whole: Bool[np.ndarray, " windows"]

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


def innovations(
    simulator: Simulator,
    readings: Readings,
    points: Float[np.ndarray, "systems d"],
    members: Float[np.ndarray, "windows members state"],
    noise: Float[np.ndarray, " channels"],
) -> Innovations:
    """Predict each reading after the first at every point, and move the members by it before the next one.

    The members are states as likely as the first reading; `noise` is that of the sensors in typical changes. Spends
    systems · windows · members · steps control steps.
    """
    (windows, count, size), physical = members.shape, len(readings.spread)
    system = simulator.bind(simulator.parameters.to_physical(np.clip(points, -1.0, 1.0)))
    every = (len(points), windows * count, size)
    states = system.unbiased(np.broadcast_to(members.reshape(every[1:]), every).copy())
    shape, channels = (len(points), windows, readings.steps, len(noise)), len(noise)
    mean, factor, whole = np.zeros(shape), np.zeros((*shape, channels)), np.ones(windows, bool)
    for step in range(readings.steps):
        actions = np.repeat(readings.actions[:, step], count, axis=0)
        after = system.step(states, np.broadcast_to(actions, (*every[:2], actions.shape[-1])))
        finite = np.isfinite(after).all(-1, keepdims=True)
        after = np.where(finite, after, states)
        seen = system.observe(after)[..., :channels].reshape(*shape[:2], count, channels)
        apart = differences(simulator.task.attitudes, seen, readings.observed[:, step + 1, None])
        apart = apart / (readings.scale * noise)
        whole &= finite.reshape(*shape[:2], count).all((0, 2)) & np.isfinite(apart).all((0, 2, 3))
        grouped = np.where(whole[:, None, None], after.reshape(*shape[:2], count, size), 0.0)
        apart = np.where(whole[:, None, None], apart, 0.0)
        mean[:, :, step], factor[:, :, step] = apart.mean(2), _covariance_factor(apart)
        grouped[..., :physical] = followed(grouped[..., :physical], apart, factor[:, :, step])
        states = np.where(whole[:, None, None], grouped, members).reshape(every)
    return Innovations(mean, factor, whole)


def _covariance_factor(
    apart: Float[np.ndarray, "*rows members channels"],
) -> Float[np.ndarray, "*rows channels channels"]:
    """L of the members' covariance and that of the noise, which is 1."""
    around = apart - apart.mean(-2, keepdims=True)
    covariance = np.swapaxes(around, -1, -2) @ around / (apart.shape[-2] - 1)
    return np.asarray(np.linalg.cholesky(covariance + np.eye(apart.shape[-1])))


def followed(
    states: Float[np.ndarray, "*rows members physical"],
    apart: Float[np.ndarray, "*rows members channels"],
    factor: Float[np.ndarray, "*rows channels channels"],
) -> Float[np.ndarray, "*rows members physical"]:
    """The states after a reading, from which theirs are so far `apart` in standard deviations of its noise.

    The mean moves by Kalman's gain K = P Hᵀ S⁻¹, the deviations from it by P Hᵀ L⁻ᵀ (L + 1)⁻¹, S = L Lᵀ, after which
    they have the covariance (1 - K H) P without further random numbers (Andrews 1968).
    """
    middle, observed = states.mean(-2, keepdims=True), apart.mean(-2, keepdims=True)
    around, shown = states - middle, apart - observed
    inverse = np.linalg.inv(factor)
    gain = np.swapaxes(around, -1, -2) @ shown / (states.shape[-2] - 1) @ np.swapaxes(inverse, -1, -2)
    innovation = np.clip(inverse @ np.swapaxes(observed, -1, -2), -FARTHEST, FARTHEST)
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
    states, task = logged.states[np.searchsorted(logged.rows, rows)], simulator.task
    physical, drawn = slice(0, logged.physical_size), []
    readings, following = (np.asarray(part, np.float64) for part in _both_readings(dataset))
    last = np.isin(np.arange(len(dataset)), dataset.episode_ends - 1)
    for _ in range(count):
        error = np.zeros((2, *readings.shape))
        error[..., : len(noise)] = random.standard_normal((*error.shape[:2], len(noise))) * noise
        here = moved(task.attitudes, readings, error[0])
        if logged.kind == "exact":
            drawn.append(states_observed_as(dataset, task, rows, here)[:, physical])
            continue
        there = moved(task.attitudes, following, np.where(last[:, None], error[1], np.roll(error[0], -1, axis=0)))
        noisy = replace(dataset.transitions, observation=here, next_observation=there)
        other = states_of(replace(dataset, transitions=noisy), simulator)
        drawn.append(other.states[np.searchsorted(other.rows, rows)][:, physical])
    members = np.repeat(states[:, None], count, axis=1)
    members[..., physical] = np.stack(drawn, axis=1)
    return members


def _both_readings(dataset: Dataset) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(dataset.transitions.observation), np.asarray(dataset.transitions.next_observation)
