"""Signals as functions: of a state, of the model's sensors, and back to a state where they determine it."""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from madoc.robots.document import nearest
from madoc.robots.expressions import Expression, ExpressionError, Read
from madoc.robots.model import joint_kind, names_of
from madoc.tasks.base import Batch

_POSITIONS = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}
_VELOCITIES = {mujoco.mjtJoint.mjJNT_FREE: 6, mujoco.mjtJoint.mjJNT_BALL: 3}


@dataclass(frozen=True)
class Layout:
    """Where a model keeps what can be read.

    Attributes:
        position: Joint -> where its values stand in a state, and how many.
        velocity: The same of its speeds.
        sensor: Sensor -> where its values stand in sensordata, and how many.
        physical: Values of (qpos, qvel).
        accelerating: Sensors that depend on the control as well.
    """

    position: dict[str, tuple[int, int]]
    velocity: dict[str, tuple[int, int]]
    sensor: dict[str, tuple[int, int]]
    physical: int
    accelerating: frozenset[str]

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "Layout":
        """The layout of a model."""
        joints = {name: model.joint(name).id for name in names_of(model, mujoco.mjtObj.mjOBJ_JOINT, model.njnt)}
        sensors = {name: model.sensor(name).id for name in names_of(model, mujoco.mjtObj.mjOBJ_SENSOR, model.nsensor)}
        kinds = {name: joint_kind(model, index) for name, index in joints.items()}
        return cls(
            position={
                name: (int(model.jnt_qposadr[index]), _POSITIONS.get(kinds[name], 1)) for name, index in joints.items()
            },
            velocity={
                name: (int(model.nq + model.jnt_dofadr[index]), _VELOCITIES.get(kinds[name], 1))
                for name, index in joints.items()
            },
            sensor={
                name: (int(model.sensor_adr[index]), int(model.sensor_dim[index])) for name, index in sensors.items()
            },
            physical=int(model.nq + model.nv),
            accelerating=frozenset(
                name
                for name, index in sensors.items()
                if mujoco.mjtStage(int(model.sensor_needstage[index])) == mujoco.mjtStage.mjSTAGE_ACC
            ),
        )

    def address(self, read: Read) -> int:
        """Where a value stands, in the state or in sensordata.

        Raises:
            ExpressionError: The model has no such joint or sensor, or not so many values.
        """
        known: dict[str, tuple[int, int]] = getattr(self, read.kind)
        what = "sensor" if read.kind == "sensor" else "joint"
        if read.name not in known:
            near = nearest(read.name, list(known)) or list(known)[:12]
            listed = f"nearest: {', '.join(near)}" if near else f"it names no {what}"
            raise ExpressionError(f"the model has no {what} {read.name!r}; {listed}")
        start, count = known[read.name]
        if read.index is None and count > 1:
            raise ExpressionError(f"{read} has {count} values; pick one, as {read}[0]")
        if not 0 <= (read.index or 0) < count:
            raise ExpressionError(f"{read} does not exist: it has {count} value{'s' * (count > 1)}, counted from 0")
        return start + (read.index or 0)


@dataclass(frozen=True)
class Signals:
    """What a robot observes: pure functions, batched, on NumPy or JAX arrays.

    Attributes:
        expressions: One a signal, in order.
        layout: Of the model.
    """

    expressions: tuple[Expression, ...]
    layout: Layout

    @property
    def read_sensors(self) -> frozenset[str]:
        """Names of the sensors they read."""
        return frozenset(
            read.name for expression in self.expressions for read in expression.reads if read.kind == "sensor"
        )

    def observe(self, state: Batch) -> Batch:
        """State -> observation."""
        return self._stacked(self.expressions, state, None)

    def sense(self, state: Batch, sensordata: Batch) -> Batch:
        """State and sensordata -> observation."""
        return self._stacked(self.expressions, state, sensordata)

    def undetermined(self) -> tuple[str, ...]:
        """Joint positions and velocities that no signal, as a weighted sum of such, has a part in."""
        sums = [affine[0] for expression in self.expressions if (affine := expression.affine()) is not None]
        told = {self.layout.address(read) for reads in sums for read in reads if read.kind != "sensor"}
        return tuple(
            f"no signal is the {kind} of {joint}"
            for kind in ("position", "velocity")
            for joint, (start, count) in getattr(self.layout, kind).items()
            if not told >= set(range(start, start + count))
        )

    def _stacked(self, expressions: Sequence[Expression], state: Batch, sensordata: Batch | None) -> Batch:
        namespace: Any = state.__array_namespace__()

        def look_up(read: Read) -> Batch:
            source: Any = sensordata if read.kind == "sensor" else state
            return source[..., self.layout.address(read)]

        with quiet_arithmetic():
            return namespace.stack([expression.value(look_up, namespace) for expression in expressions], axis=-1)

    def rebuild(self) -> Callable[[Batch], Batch] | None:
        """Observation -> (qpos, qvel), where weighted sums of single reads determine them all; else None."""
        forward, constant = self._weights()
        backward = _inverse(forward)
        return None if backward is None else lambda observation: (observation - constant) @ backward

    def posture(self) -> Callable[[Batch], Batch] | None:
        """Observation -> (qpos, qvel) as far as weighted sums tell, NaN elsewhere; None where they tell no position."""
        forward, constant = self._weights()
        backward, told = _partial_inverse(forward)
        positions = [start + step for start, count in self.layout.position.values() for step in range(count)]
        if not told[positions].any():
            return None
        blank = np.where(told, 0.0, np.nan)
        return lambda observation: (observation - constant) @ backward + blank

    def _weights(self) -> tuple[Float[np.ndarray, "signals state"], Float[np.ndarray, " signals"]]:
        """Of (qpos, qvel) in every signal that is a weighted sum of them, and its constant; others are 0."""
        size = self.layout.physical
        forward, constant = np.zeros((len(self.expressions), size)), np.zeros(len(self.expressions))
        for row, expression in enumerate(self.expressions):
            affine = expression.affine()
            if affine is None or any(read.kind == "sensor" for read in affine[0]):
                continue
            constant[row] = affine[1]
            for read, weight in affine[0].items():
                forward[row, self.layout.address(read)] += weight
        return forward, constant


def _inverse(forward: Float[np.ndarray, "signals state"]) -> Float[np.ndarray, "signals state"] | None:
    """From observations, less their constants, to states; each value from a signal that is it alone if there is one."""
    alone = np.count_nonzero(forward, axis=1) == 1
    backward = np.zeros_like(forward)
    for column in range(forward.shape[1]):
        rows = np.flatnonzero(alone & (forward[:, column] != 0))
        if len(rows):
            backward[rows[0], column] = 1.0 / forward[rows[0], column]
    if backward.any(0).all():
        return backward
    scale = np.abs(forward).max(1, initial=0.0, keepdims=True)
    even = np.divide(forward, scale, out=np.zeros_like(forward), where=scale > 0)
    if np.linalg.matrix_rank(even) < forward.shape[1]:
        return None
    return (np.linalg.pinv(even) / np.where(scale > 0, scale, 1.0).T).T


def _partial_inverse(
    forward: Float[np.ndarray, "signals state"],
) -> tuple[Float[np.ndarray, "signals state"], Bool[np.ndarray, " state"]]:
    """From observations, less their constants, to those values of a state that they determine, and which these are."""
    scale = np.abs(forward).max(1, initial=0.0, keepdims=True)
    even = np.divide(forward, scale, out=np.zeros_like(forward), where=scale > 0)
    inverse = np.linalg.pinv(even)
    told = np.abs(inverse @ even - np.eye(forward.shape[1])).max(0) < 1e-9
    return (inverse / np.where(scale > 0, scale, 1.0).T).T * told, told


@contextlib.contextmanager
def quiet_arithmetic() -> Any:
    """What has no value is NaN or infinite, and found as such; NumPy needs to say no more."""
    with np.errstate(all="ignore"):
        yield
