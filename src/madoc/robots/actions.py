"""Actions of a spec: actuators added to the model, and what -1 and 1 mean to each."""

import mujoco
import numpy as np

from madoc.robots.draft import SCALES, Draft
from madoc.robots.model import AddedActuator, is_single, is_slide, names_of
from madoc.robots.spec import ActionSpec
from madoc.tasks.base import ActionChannel

KNOWN_UNITS = (*SCALES, "N·m", "Nm", "N", "rad", "rad/s", "m", "m/s", "V", "A", "%", "1")
"""Those of `SCALES` are converted; the others are the control's own, and only said."""


def _joint(draft: Draft, index: int) -> int:
    """The joint that an action names; a hinge or a slide."""
    action, joints = draft.spec.actions[index], names_of(draft.plain, mujoco.mjtObj.mjOBJ_JOINT, draft.plain.njnt)
    place = ("actions", index, "joint")
    if action.joint not in joints:
        raise draft.document.unknown(place, "the name of a joint", str(action.joint), joints)
    joint = int(draft.plain.joint(action.joint).id)
    if not is_single(draft.plain, joint):
        raise draft.document.error(place, f"expected a hinge or a slide, got {action.joint!r}, which is a ball or free")
    return joint


def added_actuator(draft: Draft, index: int) -> AddedActuator | None:
    """The actuator that an action needs; None where it names one of the model's."""
    action, model, document = draft.spec.actions[index], draft.plain, draft.document
    actuators = names_of(model, mujoco.mjtObj.mjOBJ_ACTUATOR, model.nu)
    if action.joint is None:
        if action.actuator not in actuators:
            place = ("actions", index, "actuator")
            raise document.unknown(place, "the name of an actuator", str(action.actuator), actuators)
        return None
    joint = _joint(draft, index)
    slide = is_slide(model, joint)
    if action.means == ("torque" if slide else "force"):
        right, kind = ("force", "slide") if slide else ("torque", "hinge")
        raise document.error(("actions", index, "means"), f"expected means: {right} of the {kind} {action.joint!r}")
    if action.name in actuators:
        raise document.error(
            ("actions", index, "name"),
            f"the model has an actuator {action.name!r}; drive it with actuator: {action.name}, or choose another name",
        )
    _check_free(draft, index, joint)
    scale = SCALES.get(action.unit or "", 1.0)
    assert action.low is not None and action.high is not None  # the spec has seen to it
    ends = action.low * scale, action.high * scale
    if action.means in ("torque", "force"):
        return AddedActuator(action.name, action.joint, *ends)
    gain = action.kp if action.means == "position" else action.kd
    assert gain is not None  # the spec has seen to it
    return AddedActuator(
        action.name, action.joint, *ends, gain, stiffness=action.kp or 0.0, damping=action.kd or 0.0, limit=action.limit
    )


def action_channel(draft: Draft, model: mujoco.MjModel, index: int) -> ActionChannel:
    """What an action's values mean to its actuator."""
    action = draft.spec.actions[index]
    name = action.actuator or action.name
    actuator = int(model.actuator(name).id)
    low, high = action.low, action.high
    if low is None or high is None:
        if not model.actuator_ctrllimited[actuator]:
            raise draft.document.error(
                ("actions", index), f"expected low: and high:, as the actuator {name!r} has no ctrlrange in the model"
            )
        low, high = (float(end) for end in model.actuator_ctrlrange[actuator])
    first = [row.actuator for row in draft.spec.actions[:index]]
    if action.actuator is not None and action.actuator in first:
        line = draft.document.line(("actions", first.index(action.actuator), "actuator"))
        raise draft.document.error(
            ("actions", index, "actuator"), f"the actuator {name!r} is driven by line {line} already"
        )
    unit = action.unit or _action_unit(action, model, actuator)
    if unit and unit not in KNOWN_UNITS:
        raise draft.document.unknown(("actions", index, "unit"), "a unit that is known", unit, KNOWN_UNITS)
    scale = SCALES.get(unit, 1.0)
    gain, stiffness = model.actuator_gainprm[actuator, 0], -model.actuator_biasprm[actuator, 1]
    length = model.actuator_length0[actuator] if gain else 0.0
    held = length * stiffness / gain / scale if gain and stiffness else 0.0
    rest = float(np.clip((held - (low + high) / 2.0) / ((high - low) / 2.0), -1.0, 1.0))
    return ActionChannel(action.name, name, low, high, unit, scale, rest)


def _action_unit(action: ActionSpec, model: mujoco.MjModel, actuator: int) -> str:
    """The unit of a channel that names none: SI's, where the joint tells."""
    if action.joint is None:
        return ""
    slide = is_slide(model, int(model.actuator_trnid[actuator, 0]))
    units = {
        "torque": "N·m",
        "force": "N",
        "position": "m" if slide else "rad",
        "velocity": "m/s" if slide else "rad/s",
    }
    return units[str(action.means)]


def idle_actuators(model: mujoco.MjModel, actions: tuple[ActionChannel, ...]) -> tuple[str, ...]:
    """A sentence on the actuators that no action drives."""
    driven = {int(model.actuator(channel.actuator).id) for channel in actions}
    idle = [actuator for actuator in range(model.nu) if actuator not in driven]
    if not idle:
        return ()
    names = [
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, actuator) or f"number {actuator}" for actuator in idle
    ]
    return (f"no action drives the model's actuators {', '.join(names)}: their control is always 0",)


def _check_free(draft: Draft, index: int, joint: int) -> None:
    """Refuse a joint that another actuator drives already."""
    action, model, place = draft.spec.actions[index], draft.plain, ("actions", index, "joint")
    for actuator in range(model.nu):
        if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_trnid[actuator, 0] == joint:
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, actuator) or "without a name"
            raise draft.document.error(
                place,
                f"the joint {action.joint!r} has an actuator {name!r} in the model; drive that with actuator: {name}, "
                "or take it out of the model",
            )
    others = [row.joint for row in draft.spec.actions[:index]]
    if action.joint in others:
        first = draft.document.line(("actions", others.index(action.joint), "joint"))
        raise draft.document.error(place, f"the joint {action.joint!r} is driven by line {first} already")
