"""Differences between readings, some of which are attitudes: what a unit quaternion differs by is a small rotation.

A quaternion's four components are bound to length 1, so neither noise nor an error of a model moves them independently:
near the identity the first hardly changes. A difference is therefore the rotation that leads from one attitude to
another, as 2 asin |v| about v for the three values v = n sin(θ/2) in the body's own frame (Sola 2017, "Quaternion
kinematics for the error-state Kalman filter", section 4). For small rotations these have the size of differences of
components; they stand in the places of the last three, with 0 in that of the first.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

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
