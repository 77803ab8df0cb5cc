"""Prediction errors of an ensemble Kalman filter (Evensen 2003): every reading of a window from all before it."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from madoc.identification.losses import Loss
from madoc.identification.replay import Readings
from madoc.identification.settling import FAILED_WINDOW, window_costs
from madoc.identification.systematic import explained_each, folds_of
from madoc.simulation.attitudes import differences
from madoc.simulation.base import Simulator

FARTHEST = 4.0
"""Standard deviations of an innovation, beyond which the states follow it no farther: a false reading says nothing."""
CLIP, OF_CLIPPED = 3.0, 0.9950
"""Standard deviations at which errors are clipped, and the mean square of a normal value that is."""
FEWEST_EXPLAINED = 200
"""Least number of readings of which it is asked whether state and action explain errors; by chance they explain a few
percent of as many."""
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

    def of_others(
        self,
        values: Float[np.ndarray, "*rows members others"],
        apart: Float[np.ndarray, "*rows members channels"],
    ) -> "Correction":
        """The correction of other values than the states, of mean 0, as the forces on them, that are as far `apart`."""
        shown = apart - apart.mean(-2, keepdims=True)
        gain = np.swapaxes(values, -1, -2) @ shown / (shown.shape[-2] - 1) @ np.swapaxes(self.inverse, -1, -2)
        return self._replace(gain=gain)

    def follow(
        self,
        states: Float[np.ndarray, "*systems_and_rows members physical"],
        apart: Float[np.ndarray, "*systems_and_rows members channels"],
    ) -> Float[np.ndarray, "*systems_and_rows members physical"]:
        """The states after the reading from which they are so far `apart`."""
        around = apart - apart.mean(-2, keepdims=True)
        return states + self.of_mean(apart)[..., None, :] - around @ np.swapaxes(self.shrinking, -1, -2)

    def of_mean(
        self, apart: Float[np.ndarray, "*systems_and_rows members channels"]
    ) -> Float[np.ndarray, "*systems_and_rows physical"]:
        """By how much the mean of the states changes."""
        innovation = apart.mean(-2, keepdims=True) @ np.swapaxes(self.inverse, -1, -2) * self.share[..., None, :]
        return -(innovation @ np.swapaxes(self.gain, -1, -2))[..., 0, :]


@dataclass(frozen=True)
class Innovations:
    """Differences between predicted and measured readings, each predicted from the readings of its window before it.

    Attributes:
        mean: Predicted mean minus the reading, in standard deviations of the sensors' noise.
        corrections: How the states of all systems followed each reading.
        whole: Windows in which no simulation failed, by system.
        members: The ensembles' states after the last reading.
        first: The first step whose errors count.
        noise: That of the sensors, in typical changes.
        before: The first system's mean state before each step, by the readings until then.
        pushed: What each reading tells of random forces in the step before it, their mean given that reading, in N or
            N·m; of no degree of freedom where there are none, or where states follow other innovations.
    """

    mean: Float[np.ndarray, "systems windows steps channels"]
    corrections: Correction
    whole: Bool[np.ndarray, "systems windows"]
    members: Float[np.ndarray, "systems windows members state"]
    first: int
    noise: Float[np.ndarray, " channels"]
    before: Float[np.ndarray, "windows steps physical"]
    pushed: Float[np.ndarray, "windows steps dof"]

    @cached_property
    def whitened(self) -> Float[np.ndarray, "systems windows steps channels"]:
        """L⁻¹ (prediction - reading): of variance 1 if the model is right."""
        return (self.corrections.inverse @ self.mean[..., None])[..., 0]

    def surprise(self, loss: Loss) -> Float[np.ndarray, "systems windows"]:
        """Mean of the loss of each window's whitened values; `FAILED_WINDOW` where a simulation failed."""
        costs = window_costs(self.whitened.reshape(*self.whole.shape, -1), loss)
        return np.where(self.whole, costs, FAILED_WINDOW)

    def misfit(self) -> Float[np.ndarray, " windows"]:
        """Mean of -log p of each window's readings under the first system, but for a constant; NaN where it failed.

        Outliers are clipped, and channels do not count whose errors are all 0.
        """
        if not self.whole[0].any():
            return np.full(len(self.whole[0]), np.nan)
        deviations = np.diagonal(self.corrections.factor, axis1=-2, axis2=-1) * self.noise
        values = np.log(deviations) + np.minimum(self.whitened[0] ** 2, CLIP**2) / 2.0
        return np.where(self.whole[0], self.counted(values).mean(1), np.nan)

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

    def explained_by(
        self, actions: Float[np.ndarray, "windows steps action"], kept: Bool[np.ndarray, " windows"]
    ) -> float:
        """The largest share of a channel's whitened errors, or of a random force, that state and action explain.

        It is that of the first system in the windows kept, outliers clipped; 0 for right predictions, whose errors
        depend on nothing that was known before, and where windows are too few to tell. Of random forces it is what
        readings tell of them: errors are of all noise, which hides a force.
        """
        kept, first = kept & self.whole[0], self.first
        errors = np.clip(self.whitened[0], -CLIP, CLIP)
        values = np.concatenate([errors, self.pushed], axis=-1)[kept, first:]
        inputs = np.concatenate([self.before, actions], axis=-1)[kept, first:]
        rows = inputs.shape[0] * inputs.shape[1]
        if rows < FEWEST_EXPLAINED:
            return 0.0
        columns = values.reshape(rows, values.shape[-1])
        columns = columns[:, columns.std(0) > 0.0]
        columns = np.clip(columns / columns.std(0), -CLIP, CLIP)
        folds = folds_of(np.repeat(np.arange(len(inputs)), inputs.shape[1]))
        return float(explained_each(inputs.reshape(rows, -1), columns, folds).max(initial=0.0))

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
    forces: Float[np.ndarray, "windows members steps dof"] | None = None,
) -> Innovations:
    """Predict each reading after the first at every point, and move the members by it before the next one.

    All systems follow readings as the first one's ensemble does, or as those of other innovations did, so that they
    differ in their parameters alone, and few members may do where a larger ensemble is at hand. An error of the gain
    hardly changes an estimate, as right predictions leave errors that are uncorrelated with all readings before.

    The members are states as likely as the first reading, `forces` what acts on each from outside in every step, in N
    or N·m; `noise` is that of the sensors in typical changes. Errors count from the step `first` on. Spends systems ·
    windows · members · steps control steps.
    """
    (windows, count, size), physical = members.shape, len(readings.spread)
    system = simulator.bind(simulator.parameters.to_physical(np.clip(points, -1.0, 1.0)))
    every = (len(points), windows * count, size)
    states = system.unbiased(np.broadcast_to(members.reshape(every[1:]), every).copy())
    shape, channels, corrections = (len(points), windows, readings.steps, len(noise)), len(noise), []
    mean, whole = np.zeros(shape), np.ones(shape[:2], bool)
    before, forced = np.zeros((*shape[1:3], physical)), forces is not None and like is None
    pushed = np.zeros((*shape[1:3], forces.shape[-1] if forces is not None and forced else 0))
    if like is not None:
        whole &= like.whole[0]
    for step in range(readings.steps):
        actions = np.repeat(readings.actions[:, step], count, axis=0)
        pushes = forces if forces is None else np.tile(forces[:, :, step].reshape(1, every[1], -1), (len(points), 1, 1))
        after = system.step(states, np.broadcast_to(actions, (*every[:2], actions.shape[-1])), pushes)
        before[:, step] = states[0].reshape(windows, count, size)[..., :physical].mean(1)
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
            if forces is not None:
                pushed[:, step] = correction.of_others(forces[:, :, step], apart[0]).of_mean(apart[0])
        else:
            correction = Correction(*(each[:, step] for each in like.corrections))
        grouped[..., :physical] = correction.follow(moving, apart)
        states = np.where(whole[..., None, None], grouped, members).reshape(every)
    every_step = (np.stack(each, axis=1) for each in zip(*corrections, strict=True))
    followed = Correction(*every_step) if like is None else like.corrections
    ends = states.reshape(*shape[:2], count, size)
    return Innovations(mean, followed, whole, ends, first, noise, before, pushed)
