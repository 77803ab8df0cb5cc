"""Differences between readings, some of which are attitudes: what a unit quaternion differs by is a small rotation.

A quaternion's four components are bound to length 1, so neither noise nor an error of a model moves them independently:
near the identity the first hardly changes. A difference is therefore the rotation that leads from one attitude to
another, as 2 asin |v| about v for the three values v = n sin(θ/2) in the body's own frame (Sola 2017, "Quaternion
kinematics for the error-state Kalman filter", section 4). For small rotations these have the size of differences of
components; they stand in the places of the last three, with 0 in that of the first.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int

Attitudes = Sequence[tuple[int, int, int, int]]
"""For each quaternion of an observation the indices of its components w, x, y and z."""


def differences(
    attitudes: Attitudes, readings: Float[np.ndarray, "*#some values"], others: Float[np.ndarray, "*#some values"]
) -> Float[np.ndarray, "*some values"]:
    """The readings less the others; of attitudes the rotation from the others, the shorter way round."""
    found = readings - others
    for indices in attitudes:
        if max(indices) >= found.shape[-1]:  # of the first values of an observation
            continue
        there, here = _unit(readings[..., indices]), _unit(others[..., indices])
        turn = _product(here * (1.0, -1.0, -1.0, -1.0), there)
        found[..., indices] = np.where(turn[..., :1] < 0.0, -turn, turn) * (0.0, 1.0, 1.0, 1.0)
    return found


def moved(
    attitudes: Attitudes, readings: Float[np.ndarray, "*#some values"], by: Float[np.ndarray, "*#some values"]
) -> Float[np.ndarray, "*some values"]:
    """The readings whose `differences` from the given ones are `by`; of rotations by 180° and more half a turn."""
    found = readings + by
    for indices in attitudes:
        if max(indices) >= found.shape[-1]:
            continue
        turn = by[..., indices] * (0.0, 1.0, 1.0, 1.0)
        turn = turn / np.maximum(np.linalg.norm(turn, axis=-1, keepdims=True), 1.0)
        turn[..., 0] = np.sqrt(np.maximum(1.0 - (turn**2).sum(-1), 0.0))
        found[..., indices] = _product(_unit(readings[..., indices]), turn)
    return found


@dataclass(frozen=True)
class Tangent:
    """Small differences of states (qpos, qvel, ...) in the units of velocities, rotations in the body's own frame.

    Attributes:
        attitudes: Of each quaternion in qpos the indices of its components.
        places: Index in qpos of each degree of freedom; components x, y and z of a quaternion for its rotations.
        halves: By what a change there is multiplied to be one of the degree of freedom, 2 of a quaternion and else 1.
    """

    attitudes: tuple[tuple[int, int, int, int], ...]
    places: Int[np.ndarray, " dof"]
    halves: Float[np.ndarray, " dof"]

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "Tangent":
        """That of a model's states."""
        behind = {int(mujoco.mjtJoint.mjJNT_FREE): 3, int(mujoco.mjtJoint.mjJNT_BALL): 0}
        of_joints = zip(model.jnt_type.tolist(), model.jnt_qposadr.tolist(), strict=True)
        firsts = [address + behind[kind] for kind, address in of_joints if kind in behind]
        places = np.delete(np.arange(model.nq), firsts)
        halves = np.where(np.isin(places, [first + step for first in firsts for step in (1, 2, 3)]), 2.0, 1.0)
        return cls(tuple((first, first + 1, first + 2, first + 3) for first in firsts), places, halves)

    def differences(
        self, states: Float[np.ndarray, "rows state"], others: Float[np.ndarray, "rows state"]
    ) -> Float[np.ndarray, "rows both"]:
        """By how much positions and velocities differ from those of the others."""
        positions = self.halves * differences(self.attitudes, states, others)[:, self.places]
        velocities = slice(len(self.places) + len(self.attitudes), 2 * len(self.places) + len(self.attitudes))
        return np.concatenate([positions, states[:, velocities] - others[:, velocities]], axis=1)

    def moved(
        self, states: Float[np.ndarray, "rows state"], by: Float[np.ndarray, " both"]
    ) -> Float[np.ndarray, "rows state"]:
        """The states that differ from the given ones by this much."""
        count, change = len(self.places), np.zeros(states.shape[1])
        change[self.places] = by[:count] / self.halves
        change[count + len(self.attitudes) :][:count] = by[count:]
        return moved(self.attitudes, states, change)


def rotated(
    attitude: Float[np.ndarray, "*#some 4"], vector: Float[np.ndarray, "*#some 3"], *, back: bool = False
) -> Float[np.ndarray, "*some 3"]:
    """A vector of a body's frame in the world's by the body's attitude, or `back` from the world's in the body's."""
    turn = _unit(attitude)
    back_turn = turn * (1.0, -1.0, -1.0, -1.0)
    turn, back_turn = (back_turn, turn) if back else (turn, back_turn)
    pure = np.concatenate([np.zeros((*vector.shape[:-1], 1)), vector], axis=-1)
    return _product(_product(turn, pure), back_turn)[..., 1:]


def _unit(quaternion: Float[np.ndarray, "*some 4"]) -> Float[np.ndarray, "*some 4"]:
    length = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return quaternion / np.where(length > 0.0, length, 1.0)


def _product(
    first: Float[np.ndarray, "*#some 4"], second: Float[np.ndarray, "*#some 4"]
) -> Float[np.ndarray, "*some 4"]:
    """Hamilton's product of quaternions (w, x, y, z)."""
    (a, b, c, d), (e, f, g, h) = (np.moveaxis(each, -1, 0) for each in (first, second))
    return np.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ],
        axis=-1,
    )
