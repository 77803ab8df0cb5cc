"""Signals of a spec: expressions checked against the model, with units.

As functions they are of a state, of the model's sensors, and back to a state where they determine it.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from madoc.errors import MadocError, nearest_hint
from madoc.robots.expressions import Expression, Read, parse
from madoc.robots.model import Draft, is_single, is_slide
from madoc.robots.spec import SCALES
from madoc.simulation.joints import SUFFIX, deflection_values
from madoc.simulation.probes import linear_sensors
from madoc.simulation.write import element_names
from madoc.tasks.base import Batch

Span = tuple[int, int]
"""Address of the first value, and number of values."""

_NOT_SI = re.compile(
    r"\b(deg\w*|grad|mrad|rev|revolutions?|rpm|turns?|mm|cm|km|inch(es)?|ft|feet|foot)\b|°|/min\b", re.IGNORECASE
)
"""Units of length, angle and speed that are not m, rad, m/s or rad/s."""
_FIRST_OF_QUATERNION = {int(mujoco.mjtJoint.mjJNT_FREE): 3, int(mujoco.mjtJoint.mjJNT_BALL): 0}
"""Index of the quaternion's first component among the positions of a joint of this type."""
_QUATERNION_SENSORS = (int(mujoco.mjtSensor.mjSENS_FRAMEQUAT), int(mujoco.mjtSensor.mjSENS_BALLQUAT))
_FRAMES = {
    mujoco.mjtObj.mjOBJ_XBODY: "xmat",
    mujoco.mjtObj.mjOBJ_BODY: "ximat",
    mujoco.mjtObj.mjOBJ_GEOM: "geom_xmat",
    mujoco.mjtObj.mjOBJ_SITE: "site_xmat",
    mujoco.mjtObj.mjOBJ_CAMERA: "cam_xmat",
}
"""The axes of what a sensor is fixed to, in MjData."""


@dataclass(frozen=True)
class Layout:
    """Where a joint's position and velocity are in a state, and a sensor's reading in sensordata, by name.

    Attributes:
        physical: Number of values of (qpos, qvel).
        accelerating: Sensors that depend on the control as well.
        behind: Joints whose encoder sits behind a gear, so that it shows the gear's deflection as well.
        deflections: Addresses of the deflections of gears and of their velocities.
        weights: By its address in sensordata, the weights of (qpos, qvel) in each value that is a weighted sum of them.
    """

    position: dict[str, Span]
    velocity: dict[str, Span]
    sensor: dict[str, Span]
    physical: int
    accelerating: frozenset[str]
    behind: frozenset[str]
    deflections: Int[np.ndarray, " values"]
    weights: Mapping[int, Float[np.ndarray, " physical"]]

    @classmethod
    def of(cls, model: mujoco.MjModel, behind: frozenset[str] = frozenset()) -> "Layout":
        """The layout of a model, and the joints whose encoder sits behind a gear."""
        joints = [model.joint(name) for name in element_names(model, "joint")]
        sensors = [model.sensor(name) for name in element_names(model, "sensor")]
        return cls(
            position={joint.name: (int(joint.qposadr[0]), len(joint.qpos0)) for joint in joints},
            velocity={joint.name: (int(model.nq + joint.dofadr[0]), len(joint.damping)) for joint in joints},
            sensor={sensor.name: (int(sensor.adr[0]), int(sensor.dim[0])) for sensor in sensors},
            physical=int(model.nq + model.nv),
            accelerating=frozenset(one.name for one in sensors if one.needstage[0] == mujoco.mjtStage.mjSTAGE_ACC),
            behind=behind,
            deflections=np.concatenate(deflection_values(model)),
            weights={
                first + step: row for first, rows in linear_sensors(model).items() for step, row in enumerate(rows)
            },
        )

    def of_state(self, read: Read) -> Float[np.ndarray, " physical"] | None:
        """The weights of (qpos, qvel) in a value; None for a sensor that is no weighted sum of them."""
        if read.kind == "sensor":
            return self.weights.get(self.address(read))
        return np.eye(self.physical)[[*self.addresses(read)]].sum(0)

    def addresses(self, read: Read) -> tuple[int, ...]:
        """Addresses of the values whose sum is read: of a joint whose encoder is behind a gear, its deflection too."""
        deflection = (getattr(self, read.kind)[f"{read.name}{SUFFIX}"][0],) if read.name in self.behind else ()
        return (self.address(read), *deflection)

    def look_up(self, read: Read, state: Batch) -> Batch:
        """The value of a position or a velocity in a state."""
        first, *others = (state[..., address] for address in self.addresses(read))
        return sum(others, first)

    def address(self, read: Read) -> int:
        """Address of a value in the state or in sensordata; what the model does not have is refused."""
        known: dict[str, Span] = getattr(self, read.kind)
        what = "sensor" if read.kind == "sensor" else "joint"
        if read.name not in known:
            hint = nearest_hint(read.name, known, none=f"it names no {what}")
            raise MadocError(f"the model has no {what} {read.name!r}; {hint}")
        start, count = known[read.name]
        if read.index is None and count > 1:
            raise MadocError(f"{read} has {count} values; pick one, as {read}[0]")
        if not 0 <= (read.index or 0) < count:
            raise MadocError(f"{read} does not exist: it has {count} value{'s' * (count > 1)}, counted from 0")
        return start + (read.index or 0)


@dataclass(frozen=True)
class Signals:
    """The observation of a robot, one expression a signal: pure functions, batched, on NumPy or JAX arrays."""

    expressions: tuple[Expression, ...]
    layout: Layout

    @property
    def read_sensors(self) -> frozenset[str]:
        """Names of the sensors that the signals read."""
        reads = (read for expression in self.expressions for read in expression.reads)
        return frozenset(read.name for read in reads if read.kind == "sensor")

    def observe(self, state: Batch, sensordata: Batch | None = None) -> Batch:
        """State, and sensordata where signals read sensors -> observation."""
        return self._stacked(self.expressions, state, sensordata)

    def value(self, index: int, state: Batch) -> Batch:
        """State -> one signal, which reads no sensor."""
        return self._stacked([self.expressions[index]], state, None)[..., 0]

    def undetermined(self) -> tuple[str, ...]:
        """A sentence for each joint position and velocity that is in no signal that is a weighted sum."""
        covered = set(np.flatnonzero(self._weights()[0].any(0)).tolist())
        return tuple(
            f"no signal is the {kind} of {joint}"
            for kind in ("position", "velocity")
            for joint, (start, count) in getattr(self.layout, kind).items()
            if not covered >= set(range(start, start + count))
        )

    def _stacked(self, expressions: Sequence[Expression], state: Batch, sensordata: Batch | None) -> Batch:
        """Values of expressions; where one has none it is NaN or infinite, without a warning of NumPy."""
        namespace = state.__array_namespace__()

        def look_up(read: Read) -> Batch:
            if read.kind == "sensor":
                return sensordata[..., self.layout.address(read)]  # type: ignore[index]
            return self.layout.look_up(read, state)

        with np.errstate(all="ignore"):
            return namespace.stack([expression.value(look_up, namespace) for expression in expressions], axis=-1)

    def rebuild(self) -> Callable[[Batch], Batch] | None:
        """Observation -> (qpos, qvel), where signals that are weighted sums determine them all; else None."""
        forward, constant = self._weights()
        backward = _inverse(forward)
        return None if backward is None else lambda observation: (observation - constant) @ backward

    def posture(self) -> Callable[[Batch], Batch] | None:
        """Observation -> (qpos, qvel), NaN for values not determined; None where no position is determined.

        Of a joint whose encoder alone shows the sum with the deflection of its gear it is the position without that.
        """
        forward, constant = self._weights()
        gears = self.layout.deflections
        forward[:, gears[~_partial_inverse(forward)[1][gears]]] = 0.0
        backward, determined = _partial_inverse(forward)
        positions = [start + step for start, count in self.layout.position.values() for step in range(count)]
        if not determined[positions].any():
            return None
        blank = np.where(determined, 0.0, np.nan)
        return lambda observation: (observation - constant) @ backward + blank

    def _weights(self) -> tuple[Float[np.ndarray, "signals state"], Float[np.ndarray, " signals"]]:
        """Weights of (qpos, qvel) and constant of each signal that is a weighted sum of them; 0 for others."""
        count = len(self.expressions)
        forward, constant = np.zeros((count, self.layout.physical)), np.zeros(count)
        for row, expression in enumerate(self.expressions):
            affine = expression.affine()
            parts = [] if affine is None else [(self.layout.of_state(read), by) for read, by in affine[0].items()]
            if affine is None or any(weights is None for weights, _ in parts):
                continue
            constant[row] = affine[1]
            forward[row] = sum(weights * by for weights, by in parts if weights is not None)
        return forward, constant


def _inverse(forward: Float[np.ndarray, "signals state"]) -> Float[np.ndarray, "signals state"] | None:
    """Map from observations, less their constants, to states; a signal that reads one value alone gives that value."""
    alone = np.count_nonzero(forward, axis=1) == 1
    backward = np.zeros_like(forward)
    for column in range(forward.shape[1]):
        rows = np.flatnonzero(alone & (forward[:, column] != 0))
        if len(rows):
            backward[rows[0], column] = 1.0 / forward[rows[0], column]
    if backward.any(0).all():
        return backward
    even, scale = _scaled_rows(forward)
    return (np.linalg.pinv(even) / scale.T).T if np.linalg.matrix_rank(even) == forward.shape[1] else None


def _partial_inverse(
    forward: Float[np.ndarray, "signals state"],
) -> tuple[Float[np.ndarray, "signals state"], Bool[np.ndarray, " state"]]:
    """Map from observations, less their constants, to the values of a state they determine, and which these are."""
    even, scale = _scaled_rows(forward)
    inverse = np.linalg.pinv(even)
    determined = np.abs(inverse @ even - np.eye(forward.shape[1])).max(0) < 1e-9
    return (inverse / scale.T).T * determined, determined


def _scaled_rows(forward: Float[np.ndarray, "signals state"]) -> tuple[np.ndarray, np.ndarray]:
    """Rows divided by their largest coefficient, and these divisors (1 for a row of zeros)."""
    scale = np.abs(forward).max(1, initial=0.0, keepdims=True)
    even = np.divide(forward, scale, out=np.zeros_like(forward), where=scale > 0)
    return even, np.where(scale > 0, scale, 1.0)


@dataclass(frozen=True)
class Frame:
    """The body that something is fixed to, and its axes in that body, as a rotation."""

    body: int
    axes: Rotation


def read_signals(draft: Draft, model: mujoco.MjModel) -> Signals:
    """The signals of a spec, each with an expression that parses, has a value, and reads what the model has."""
    expressions = []
    layout = Layout.of(model, frozenset(gear.joint for gear in draft.spec.gears if gear.encoder == "link"))
    for index, signal in enumerate(draft.spec.signals):
        with draft.document.at("signals", index, "reads"):
            expression = parse(signal.reads)
            for read in expression.reads:
                layout.address(read)
        expressions.append(expression)
        _check_unit(draft, model, index, expression)
    return Signals(tuple(expressions), layout)


def _single_joint(model: mujoco.MjModel, expression: Expression) -> tuple[Read, float] | None:
    """What an expression reads of one hinge or slide, and its weight, where it reads nothing else and is linear."""
    affine = expression.affine()
    if affine is None or len(affine[0]) != 1:
        return None
    ((read, weight),) = affine[0].items()
    if read.kind == "sensor" or not is_single(model, int(model.joint(read.name).id)):
        return None
    return read, weight


def _plain_unit(model: mujoco.MjModel, expression: Expression) -> str:
    """The SI unit of an expression that is one joint's position or velocity, in either direction; else empty."""
    single = _single_joint(model, expression)
    if single is None or abs(single[1]) != 1.0:
        return ""
    read, _ = single
    slides = is_slide(model, int(model.joint(read.name).id))
    return ("m" if slides else "rad") + ("/s" if read.kind == "velocity" else "")


def turn_of(model: mujoco.MjModel, expression: Expression) -> float:
    """By how much an expression changes when the hinge whose position it is turns once; 0 where it is none."""
    single = _single_joint(model, expression)
    if single is None or single[0].kind != "position" or is_slide(model, int(model.joint(single[0].name).id)):
        return 0.0
    return 2.0 * math.pi * abs(single[1])


def quaternion_of(model: mujoco.MjModel, expression: Expression) -> str:
    """The free or ball joint, or the sensor, of whose quaternion an expression is one component; empty for others."""
    affine = expression.affine()
    if affine is None or affine[1] or list(affine[0].values()) != [1.0]:
        return ""
    (read,) = affine[0]
    if read.kind == "sensor":
        return f"sensor({read.name})" if int(model.sensor(read.name).type[0]) in _QUATERNION_SENSORS else ""
    if read.kind != "position" or read.index is None:
        return ""
    first = _FIRST_OF_QUATERNION.get(int(model.joint(read.name).type[0]), read.index + 1)
    return read.name if first <= read.index < first + 4 else ""


def attitudes_of(model: mujoco.MjModel, expressions: Sequence[Expression]) -> tuple[tuple[int, int, int, int], ...]:
    """Of each quaternion that signals show whole, as it is, the places of its values w, x, y and z."""
    joints = [quaternion_of(model, expression) for expression in expressions]
    found = []
    for joint in filter(None, dict.fromkeys(joints)):
        of_component: dict[int, int] = {}
        for place, expression in enumerate(expressions):
            if joints[place] == joint:
                ((read, _),) = (expression.affine() or ({}, 0.0))[0].items()
                of_component.setdefault(read.index or 0, place)
        if len(of_component) == 4:
            w, x, y, z = (of_component[index] for index in sorted(of_component))
            found.append((w, x, y, z))
    return tuple(found)


def signal_unit(draft: Draft, model: mujoco.MjModel, expression: Expression, index: int) -> str:
    """The unit of a signal: the spec's, else the one that follows from its joint; empty where neither gives one."""
    return draft.spec.signals[index].unit or _plain_unit(model, expression)


def _check_unit(draft: Draft, model: mujoco.MjModel, index: int, expression: Expression) -> None:
    """Refuse `position(JOINT)` in deg: the unit converts nothing, the expression has to."""
    plain, given = _plain_unit(model, expression), draft.spec.signals[index].unit or ""
    if not plain or not _NOT_SI.search(given):
        return
    factor = "180 / pi" if "deg" in given.lower() or "°" in given else f"{1.0 / SCALES.get(given, 1.0):g}"
    convertible = (given in SCALES or "deg" in given.lower()) and (factor == "180 / pi") == plain.startswith("rad")
    converted = f"reads: ({expression.text}) * {factor}, or " if convertible else ""
    raise draft.document.error(
        ("signals", index, "unit"),
        f"{expression.text} is in {plain}, not in {given}; write {converted}unit: {plain}",
    )


def is_gyroscope(model: mujoco.MjModel, sensor: str) -> bool:
    """Whether a sensor shows the rate at which its site turns, in the axes of the site."""
    return _kind(model, sensor) == mujoco.mjtSensor.mjSENS_GYRO


def is_accelerometer(model: mujoco.MjModel, sensor: str) -> bool:
    """Whether a sensor shows the acceleration of its site, gravity included."""
    return _kind(model, sensor) == mujoco.mjtSensor.mjSENS_ACCELEROMETER


def _kind(model: mujoco.MjModel, sensor: str) -> int:
    return int(model.sensor(sensor).type[0])


def frame_of_attitude(model: mujoco.MjModel, source: str) -> Frame | None:
    """The frame whose attitude a joint or `sensor(NAME)` tells in the world; None where that is another's."""
    if source.startswith("sensor("):
        sensor = source.removeprefix("sensor(").removesuffix(")")
        world = _kind(model, sensor) == mujoco.mjtSensor.mjSENS_FRAMEQUAT and model.sensor(sensor).refid[0] < 0
        return frame_of(model, sensor) if world else None
    joint = model.joint(source)
    free = int(joint.type[0]) == mujoco.mjtJoint.mjJNT_FREE
    return Frame(int(joint.bodyid[0]), Rotation.identity()) if free else None


def frame_of(model: mujoco.MjModel, sensor: str) -> Frame | None:
    """The frame that a sensor is fixed to; None for kinds of frames that have no axes."""
    kind, index = mujoco.mjtObj(int(model.sensor(sensor).objtype[0])), int(model.sensor(sensor).objid[0])
    if kind not in _FRAMES:
        return None
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    owners = {
        mujoco.mjtObj.mjOBJ_GEOM: model.geom_bodyid,
        mujoco.mjtObj.mjOBJ_SITE: model.site_bodyid,
        mujoco.mjtObj.mjOBJ_CAMERA: model.cam_bodyid,
    }
    body = int(owners[kind][index]) if kind in owners else index
    own, of_body = (
        Rotation.from_matrix(each[row].reshape(3, 3))
        for each, row in (
            (getattr(data, _FRAMES[kind]), index),
            (data.xmat, body),
        )
    )
    return Frame(body, of_body.inv() * own)
