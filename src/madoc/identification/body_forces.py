"""Forces on a body that moves freely, and of all drives together, that no parameter of a spec adds.

Each is a function of the body's motion and of what the drives exert, along the windows' motion without it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from madoc.identification.causes import (
    BENT_ALL,
    CUBIC_ALL,
    DEAD_ALL,
    DRAGGED,
    NEAR_GROUND,
    OFF_CENTRE,
    PUSH,
    SLOWED,
    WEAKENING_ALL,
    WIND,
)
from madoc.identification.responses import Responses
from madoc.simulation.attitudes import rotated
from madoc.simulation.base import Simulator
from madoc.simulation.write import free_joints

SMALL = 0.1
"""Force of a drive relative to its root mean square, beyond which it is out of a dead zone."""
LOWEST = 0.05
"""m, height of a body that counts at least for what grows near the ground."""
_SMALLEST = 1e-9
"""Root mean square of a speed or a force below which there is none."""


def of_all_drives(
    drives: Float[np.ndarray, "windows steps actuator dof"],
    speed: Float[np.ndarray, "windows steps dof"],
    height: Float[np.ndarray, "windows steps"] | None,
) -> dict[str, Float[np.ndarray, "windows steps dof"]]:
    """Each of `OF_DRIVES`, as generalised forces of about the size of what the drives exert.

    `drives` are generalised forces of each actuator, `height` is that of a free body above the world's origin.
    """
    strong = np.sqrt((drives**2).sum(-1))
    usual = np.maximum(np.sqrt(np.nanmean(strong**2, axis=(0, 1))), _SMALLEST)
    share = (strong / usual)[..., None]
    pace = (drives * speed[:, :, None]).sum(-1) / np.maximum(strong, _SMALLEST)
    pace = (pace / max(float(np.sqrt(np.nanmean(pace**2))), _SMALLEST))[..., None]
    least = np.maximum(share, _SMALLEST)
    found = {
        BENT_ALL: -drives * share,
        CUBIC_ALL: -drives * share**2,
        DEAD_ALL: -drives * np.tanh(least / SMALL) / least,
        WEAKENING_ALL: -drives * pace,
    }
    if height is not None:
        near = np.maximum(height, LOWEST) ** -2.0
        found[NEAR_GROUND] = drives * (near / np.nanmean(near))[..., None, None]
    return {cause: force.sum(2) for cause, force in found.items()}


@dataclass(frozen=True)
class FreeBody:
    """The motion of a free joint's body along windows, in its own frame, and what the drives exert on it there.

    Attributes:
        name: Of the joint.
        dof: Its first degree of freedom: three of the world's axes, then three rotations about the body's.
        quaternion: Its attitude.
        velocity: Of its origin, m/s.
        turning: Its angular velocity, rad/s.
        force: Of all drives, N.
        torque: Of all drives, N·m.
        height: Of its origin above the world's, m.
    """

    name: str
    dof: int
    quaternion: Float[np.ndarray, "windows steps 4"]
    velocity: Float[np.ndarray, "windows steps 3"]
    turning: Float[np.ndarray, "windows steps 3"]
    force: Float[np.ndarray, "windows steps 3"]
    torque: Float[np.ndarray, "windows steps 3"]
    height: Float[np.ndarray, "windows steps"]

    @property
    def typical_force(self) -> float:
        """Root mean square of what drives exert, N; 1 where they exert nothing."""
        return _size(self.force)

    @property
    def typical_torque(self) -> float:
        """The same, N·m."""
        return _size(self.torque)

    def generalised(
        self, force: Float[np.ndarray, "windows steps 3"], torque: Float[np.ndarray, "windows steps 3"], dofs: int
    ) -> Float[np.ndarray, "windows steps dof"]:
        """A force and a torque in the body's frame as forces on the degrees of freedom of the whole model."""
        found = np.zeros((*force.shape[:2], dofs))
        found[..., self.dof : self.dof + 3] = rotated(self.quaternion, force)
        found[..., self.dof + 3 : self.dof + 6] = torque
        return found

    def axes(self) -> Float[np.ndarray, "3 windows steps 3"]:
        """The world's axes in the body's frame."""
        return np.stack(
            [rotated(self.quaternion, np.broadcast_to(axis, self.force.shape), back=True) for axis in np.eye(3)]
        )


def free_bodies(simulator: Simulator, responses: Responses) -> Iterator[FreeBody]:
    """Every free joint of a model."""
    model, motion, exerted = simulator.task.model, responses.motion, responses.drives.sum(2)
    for joint in free_joints(model):
        place, dof = int(joint.qposadr[0]), int(joint.dofadr[0])
        attitude, moving = motion[..., place + 3 : place + 7], motion[..., model.nq + dof : model.nq + dof + 6]
        yield FreeBody(
            name=joint.name or model.body(int(joint.bodyid[0])).name,
            dof=dof,
            quaternion=attitude,
            velocity=rotated(attitude, moving[..., :3], back=True),
            turning=moving[..., 3:],
            force=rotated(attitude, exerted[..., dof : dof + 3], back=True),
            torque=exerted[..., dof + 3 : dof + 6],
            height=motion[..., place + 2],
        )


def on_body(
    body: FreeBody,
) -> Iterator[tuple[str, Float[np.ndarray, "windows steps 3"], Float[np.ndarray, "windows steps 3"]]]:
    """Each of `OF_BODIES` as a force (m/s² or N, of about 1) and a torque in the body's frame."""
    nothing, thrust = np.zeros_like(body.force), np.linalg.norm(body.force, axis=-1, keepdims=True)
    thrust = thrust / max(float(np.sqrt(np.nanmean(thrust**2))), _SMALLEST)
    for axis in body.axes():
        yield WIND, axis, nothing
    for axis in np.eye(3):
        for cause, along in ((PUSH, nothing + axis), (OFF_CENTRE, thrust * axis)):
            yield cause, along, nothing
            yield cause, nothing, along
    for given, turning in ((body.velocity, False), (body.turning, True)):
        fast = np.linalg.norm(given, axis=-1, keepdims=True)
        usual = max(float(np.sqrt(np.nanmean(fast**2))), _SMALLEST)
        for cause, along in ((SLOWED, -given / usual), (DRAGGED, -given * fast / usual**2)):
            yield (cause, nothing, along) if turning else (cause, along, nothing)


def _size(vector: Float[np.ndarray, "windows steps 3"]) -> float:
    """Root mean square length; 1 of vectors that are nothing."""
    size = float(np.sqrt(np.nanmean((vector**2).sum(-1))))
    return size if size > _SMALLEST else 1.0
