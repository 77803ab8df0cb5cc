"""Actions of a spec: the actuators they add to the model, and the values that -1 and 1 stand for."""

import mujoco
import numpy as np

from madoc.robots.drives import drive_numbers, encoder_tendon, single_joint
from madoc.robots.model import AddedActuator, Draft, is_slide
from madoc.robots.spec import SCALES, ActionSpec
from madoc.simulation.write import OF_A_JOINT
from madoc.tasks.base import ActionChannel

KNOWN_UNITS = (*SCALES, "N·m", "Nm", "N", "rad", "rad/s", "m", "m/s", "V", "A", "%", "1")
"""Units of an action. Those of `SCALES` are converted; in the others a value is the control itself."""


def added_actuator(draft: Draft, index: int) -> AddedActuator | None:
    """The actuator that an action adds to the model; None where the action names one of the model's."""
    action, document = draft.spec.actions[index], draft.document
    actuators = [actuator.name for actuator in draft.base.actuators if actuator.name]
    if action.joint is None:
        if action.actuator not in actuators:
            place = ("actions", index, "actuator")
            raise document.unknown(place, "the name of an actuator", str(action.actuator), actuators)
        _check_free(draft, index)
        return None
    place = ("actions", index, "joint")
    slide = single_joint(draft, place, action.joint).type == mujoco.mjtJoint.mjJNT_SLIDE
    if action.drive is not None and slide:
        raise document.error(place, f"expected a hinge beside drive:, got {action.joint!r}, which is a slide")
    if action.means == ("torque" if slide else "force"):
        right, kind = ("force", "slide") if slide else ("torque", "hinge")
        raise document.error(("actions", index, "means"), f"expected means: {right} of the {kind} {action.joint!r}")
    if action.name in actuators:
        raise document.error(
            ("actions", index, "name"),
            f"the model has an actuator {action.name!r}; drive it with actuator: {action.name}, or choose another name",
        )
    _check_free(draft, index)
    scale = SCALES.get(action.unit or "", 1.0)
    assert action.low is not None and action.high is not None  # the spec requires both beside joint:
    ends = action.low * scale, action.high * scale
    if action.drive is not None:
        numbers = drive_numbers(action.drive, str(action.means), encoder_tendon(draft, action.joint))
        return AddedActuator(action.name, action.joint, *ends, 0.0, numbers=numbers)
    stiffness, damping = action.kp or 0.0, action.kd or 0.0
    gain = {"position": stiffness, "velocity": damping}.get(str(action.means), 1.0)
    return AddedActuator(action.name, action.joint, *ends, gain, stiffness, damping, action.limit)


def action_channel(draft: Draft, model: mujoco.MjModel, index: int) -> ActionChannel:
    """The channel of an action; one without limits, of an unknown unit or of a driven actuator is refused."""
    action = draft.spec.actions[index]
    name = action.actuator or action.name
    actuators = [model.actuator(number).name for number in range(model.nu)]
    if name not in actuators:  # MuJoCo leaves out an actuator whose target is missing
        raise draft.document.unknown(("actions", index, "actuator"), "the name of an actuator", name, actuators)
    actuator = actuators.index(name)
    unit = action.unit or _action_unit(action, model, actuator)
    if unit and unit not in KNOWN_UNITS:
        raise draft.document.unknown(("actions", index, "unit"), "a unit that is known", unit, KNOWN_UNITS)
    scale = SCALES.get(unit, 1.0)
    low, high = action.low, action.high
    if low is None or high is None:
        if not model.actuator_ctrllimited[actuator]:
            raise draft.document.error(
                ("actions", index), f"expected low: and high:, as the actuator {name!r} has no ctrlrange in the model"
            )
        low, high = (float(end) / scale for end in model.actuator_ctrlrange[actuator])
    gain, stiffness = model.actuator_gainprm[actuator, 0], -model.actuator_biasprm[actuator, 1]
    length = model.actuator_length0[actuator] if gain else 0.0
    held = length * stiffness / gain / scale if gain and stiffness else 0.0
    rest = float(np.clip((held - (low + high) / 2.0) / ((high - low) / 2.0), -1.0, 1.0))
    return ActionChannel(action.name, name, low, high, unit, scale, rest)


def _action_unit(action: ActionSpec, model: mujoco.MjModel, actuator: int) -> str:
    """The SI unit of a channel without a given unit, from its joint; empty where it drives one of the model's own."""
    if action.joint is None:
        return ""
    position = "m" if is_slide(model, int(model.actuator_trnid[actuator, 0])) else "rad"
    units = {"torque": "N·m", "force": "N", "position": position, "velocity": f"{position}/s", "duty": "1"}
    return units[str(action.means)]


def idle_actuators(model: mujoco.MjModel, actions: tuple[ActionChannel, ...]) -> tuple[str, ...]:
    """A sentence about the actuators that no action drives; empty where there are none."""
    driven = {channel.actuator for channel in actions}
    names = [model.actuator(index).name for index in range(model.nu)]
    idle = ", ".join(name or f"number {index}" for index, name in enumerate(names) if name not in driven)
    return (f"no action drives the model's actuators {idle}: their control is always 0",) if idle else ()


def _check_free(draft: Draft, index: int) -> None:
    """Refuse a joint or an actuator that another action or, for a joint, an actuator of the model drives already."""
    action = draft.spec.actions[index]
    key, driven = ("actuator", action.actuator) if action.joint is None else ("joint", action.joint)
    for actuator in draft.base.actuators:
        if int(actuator.trntype) in OF_A_JOINT and actuator.target == action.joint:
            name = actuator.name or "without a name"
            raise draft.document.error(
                ("actions", index, key),
                f"the joint {driven!r} has an actuator {name!r} in the model; drive that with actuator: {name}, "
                "or take it out of the model",
            )
    others = [getattr(row, key) for row in draft.spec.actions[:index]]
    if driven in others:
        line = draft.document.line(("actions", others.index(driven), key))
        raise draft.document.error(("actions", index, key), f"the {key} {driven!r} is driven by line {line} already")
