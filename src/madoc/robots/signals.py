"""Signals of a spec: their expressions, checked against the model, and their units."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
from scipy.spatial.transform import Rotation

from madoc.robots.expressions import Expression, Read
from madoc.robots.grammar import parse
from madoc.robots.model import Draft, is_single, is_slide
from madoc.robots.sensing import Layout, Signals
from madoc.robots.spec import SCALES

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
