"""Actions, drives, gears, friction and conditions of a spec: what they put into the model, and what a log brings in."""

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from madoc.parameters import FIELDS, Parameter, ParameterSpace
from madoc.robots.document import Place
from madoc.robots.drive_spec import ConditionSpec, DriveSpec, FrictionSpec
from madoc.robots.model import AddedActuator, Draft, friction_numbers, is_slide
from madoc.robots.spec import SCALES, ActionSpec
from madoc.simulation.callbacks import DRIVE, MARK, MEANS, UNLIMITED
from madoc.simulation.joints import SUFFIX, by_own_elements, elements_of_drive, longest_timestep
from madoc.simulation.write import OF_A_JOINT, ONE_DOF
from madoc.tasks.base import ActionChannel

_WIDEST_SUPPLY = 2.0
"""Largest measured supply over the nominal one."""
_SHAPE = {"stribeck_speed": (0.1, 10.0), "stribeck_exponent": (0.5, 10.0)}
"""Ranges of how friction falls with the speed, in rad/s and 1: those of Rhoban/bam's fits of servos, and wider."""
_LOAD = {"load": 0.5, "stribeck_load": 1.0, "quadratic": 0.1}
"""Largest ratio of friction to load, as Rhoban/bam's fits have it, and the largest quadratic one in 1/(N·m), ten
times theirs."""

KNOWN_UNITS = (*SCALES, "N·m", "Nm", "N", "rad", "rad/s", "m", "m/s", "V", "A", "%", "1")
"""Units of an action. Those of `SCALES` are converted; in the others a value is the control itself."""


def drive_numbers(drive: DriveSpec, means: str, encoder: float) -> tuple[float, ...]:
    """The numbers of a drive in the model, in the order of `DRIVE`; what it takes from the log comes in later."""
    given = {"gain": 1.0, "current_limit": UNLIMITED} | drive.model_dump(exclude_none=True)
    own = DRIVE[DRIVE.index("supply") : DRIVE.index("enable")]
    return (MARK, float(MEANS.index(means)), *(given[name] for name in own), -1.0, -1.0, -1.0, encoder)


def with_inputs(
    draft: Draft, added: tuple[AddedActuator, ...]
) -> tuple[tuple[AddedActuator, ...], tuple[ActionChannel, ...]]:
    """The actuators, and behind them one for each number that a log brings in, without force; and their channels.

    A drive gets the numbers of those that it takes something from.
    """
    inputs: dict[str, AddedActuator] = {}
    channels: dict[str, ActionChannel] = {}
    taken: dict[str, list[float]] = {actuator.name: list(actuator.numbers) for actuator in added}
    named = {
        part.name: draft.document.line((kind, at, "name"))
        for kind in ("signals", "actions")
        for at, part in enumerate(getattr(draft.spec, kind))
    }
    first = len(draft.base.actuators) + len(added)
    conditions = {condition.name: condition for condition in draft.spec.conditions}
    for index, action in enumerate(draft.spec.actions):
        drive = action.drive
        for key in ("enable", "supply_from", "gain_from"):
            column = None if drive is None else getattr(drive, key)
            if drive is None or column is None:
                continue
            place: Place = ("actions", index, "drive", key)
            if key == "gain_from" and column not in conditions:
                raise draft.document.unknown(place, "the name of a condition", column, conditions)
            if column in named:
                raise draft.document.error(place, f"the name {column!r} is taken by line {named[column]}")
            channel = ActionChannel(column, column, 0.0, 1.0, "1", rest=1.0, command=False)
            if key == "supply_from":
                channel = replace(
                    channel, high=_WIDEST_SUPPLY * drive.supply, unit="V", rest=2.0 / _WIDEST_SUPPLY - 1.0
                )
            elif key == "gain_from":
                channel = _condition_channel(conditions[column])
            if channels.setdefault(column, channel) != channel:
                raise draft.document.error(place, f"the column {column!r} is used for something else already")
            inputs.setdefault(column, _input(channel, str(action.joint)))
            taken[action.name][DRIVE.index(key)] = float(first + list(inputs).index(column))
    loaded = {joint for friction in draft.spec.friction if friction_numbers(friction) for joint in friction.names}
    kept = any(len(other.userdata) for other in draft.base.actuators)
    if kept and (inputs or any(actuator.numbers for actuator in added)):
        raise draft.document.error(
            ("actions",), "the model keeps user data of its actuators (user=), where drives are kept"
        )
    joints = [joint.name for joint in draft.base.joints if joint.name]
    for index, parameter in enumerate(draft.spec.parameters):
        if parameter.by is not None and parameter.by not in channels:
            if parameter.by not in conditions or not joints:
                raise draft.document.unknown(
                    ("parameters", index, "by"), "the name of a condition", parameter.by, conditions
                )
            channels[parameter.by] = _condition_channel(conditions[parameter.by])
            inputs[parameter.by] = _input(channels[parameter.by], joints[0])
    drives = (
        _as_elements(replace(actuator, numbers=tuple(taken[actuator.name])), loaded=actuator.joint in loaded)
        for actuator in added
    )
    return (*drives, *inputs.values()), tuple(channels.values())


def _condition_channel(condition: ConditionSpec) -> ActionChannel:
    """What brings in the value of a condition; at rest it is the first."""
    low, high = min(0.0, *condition.values), max(0.0, *condition.values)
    high = high if high > low else low + 1.0
    rest = 2.0 * (condition.values[0] - low) / (high - low) - 1.0
    return ActionChannel(condition.name, condition.name, low, high, "1", rest=rest, command=False)


def _input(channel: ActionChannel, joint: str) -> AddedActuator:
    """The actuator without force whose control is what a channel brings in."""
    numbers = (MARK, *(0.0 for _ in DRIVE[1:]))
    return AddedActuator(channel.name, joint, channel.low, channel.high, 0.0, numbers=numbers)


def _as_elements(actuator: AddedActuator, *, loaded: bool) -> AddedActuator:
    """A drive that MuJoCo's own elements say, as these; any other actuator as it is.

    So is one whose whole torque, with its back-EMF, the friction of its joint grows with.
    """
    if loaded or not actuator.numbers or not by_own_elements(actuator.numbers):
        return actuator
    gain, (position, speed), largest, drag = elements_of_drive(actuator.numbers)
    return replace(actuator, gain=gain, stiffness=-position, damping=-speed, limit=largest, drag=drag)


def joint_frictions(draft: Draft) -> tuple[tuple[str, FrictionSpec], ...]:
    """The joints of whose friction the spec says something, and what; each joint once."""
    found: dict[str, FrictionSpec] = {}
    for index, friction in enumerate(draft.spec.friction):
        for joint in friction.names:
            single_joint(draft, ("friction", index), joint)
            if any(len(other.userdata) for other in draft.base.joints):
                raise draft.document.error(
                    ("friction", index), "the model keeps user data of its joints (user=), where friction is kept"
                )
            if joint in found:
                raise draft.document.error(
                    ("friction", index), f"the friction of {joint!r} is said already; say it once"
                )
            found[joint] = friction
    return tuple(found.items())


def friction_parameters(draft: Draft, given: Sequence[Parameter]) -> list[Parameter]:
    """Parameters of the terms of friction that have neither a number nor one of the given parameters."""
    own, found = {(row.field, element) for row in given for element in row.elements}, []
    for index, friction in enumerate(draft.spec.friction):
        for term in (*friction.chosen, *friction.shape):
            field = {"coulomb": "dof_frictionloss", "viscous": "dof_damping"}.get(term, f"friction_{term}")
            for joint in friction.names:
                if getattr(friction, term) is None and (field, joint) not in own:
                    slides = int(draft.base.joint(joint).type) == int(mujoco.mjtJoint.mjJNT_SLIDE)
                    unit = FIELDS[field].slide_unit if slides else ""
                    found.append(Parameter(field, joint, *_range(draft, index, term), measured_in=unit))
    return found


def _range(draft: Draft, index: int, term: str) -> tuple[float, float]:
    """The range of a term of friction."""
    if term in _SHAPE:
        return _SHAPE[term]
    ratio = next((most for begin, most in _LOAD.items() if term.startswith(begin)), None)
    if ratio is not None:
        return 0.0, ratio
    up_to = draft.spec.friction[index].up_to
    if up_to is None:
        raise draft.document.error(
            ("friction", index), f"expected up_to:, the largest friction in N·m, as {term} is to be calibrated"
        )
    return 0.0, up_to


def single_joint(draft: Draft, place: Place, name: str) -> mujoco.MjsJoint:
    """The joint of the model file with a name; one that is no hinge and no slide is refused at a place of the spec."""
    joint = draft.base.joint(name)
    if joint is None:
        names = [joint.name for joint in draft.base.joints if joint.name]
        raise draft.document.unknown(place, "the name of a joint", name, names)
    if int(joint.type) not in ONE_DOF:
        raise draft.document.error(place, f"expected a hinge or a slide, got {name!r}, which is a ball or free")
    return joint


def check_gears(draft: Draft) -> None:
    """Refuse a gear of a joint that cannot have one."""
    taken = {part.name for part in (*draft.base.joints, *draft.base.tendons)}
    for index, gear in enumerate(draft.spec.gears):
        place, joint = ("gears", index), single_joint(draft, ("gears", index), gear.joint)
        name = f"{gear.joint}{SUFFIX}"
        if name in taken:
            raise draft.document.error(place, f"the name {name!r} of what a gear inserts is taken; say a gear once")
        if gear.armature is None and joint.armature <= 0.0:
            raise draft.document.error(
                place, f"expected armature:, the inertia of the motor, as the model says none of {gear.joint!r}"
            )
        if joint.parent.joints[-1].name != gear.joint:
            raise draft.document.error(
                place, f"expected the last joint of its body, got {gear.joint!r}; give its link a body of its own"
            )
        if gear.encoder == "link" and _has_servo(draft, gear.joint):
            raise draft.document.error(
                (*place, "encoder"),
                f"a servo of MuJoCo reads the motor's shaft; give the action of {gear.joint!r} a drive:, which reads "
                "the encoder, or say encoder: motor",
            )
        taken.add(name)


def check_timestep(draft: Draft, model: mujoco.MjModel, space: ParameterSpace) -> None:
    """Refuse a timestep that is too long for a gear at the largest stiffness or damping that it may have."""
    for index, gear in enumerate(draft.spec.gears):
        largest = {"gear_stiffness": gear.stiffness, "gear_damping": gear.damping}
        for row in space.parameters:
            if row.field in largest and gear.joint in row.elements:
                largest[row.field] = max(row.high, largest[row.field])
        tendon = model.tendon(f"{gear.joint}{SUFFIX}").id
        longest = longest_timestep(model, tendon, largest["gear_stiffness"], largest["gear_damping"])
        if model.opt.timestep > longest:
            raise draft.document.error(
                ("gears", index),
                f"the gear of {gear.joint!r} is too stiff or too damped for a timestep of {model.opt.timestep:g} s; "
                f"give timestep: of at most {0.95 * longest:.2g} s, or a smaller stiffness or damping",
            )


def encoder_tendon(draft: Draft, joint: str) -> float:
    """Number of the tendon whose length the encoder of a joint shows besides; -1 where it is on the motor's shaft."""
    behind = [index for index, gear in enumerate(draft.spec.gears) if (gear.joint, gear.encoder) == (joint, "link")]
    return float(len(draft.base.tendons) + behind[0]) if behind else -1.0


def _has_servo(draft: Draft, joint: str) -> bool:
    """Whether an actuator of MuJoCo's own reads the position or speed of a joint that it drives."""
    own = any(
        action.joint == joint and action.drive is None and action.means in ("position", "velocity")
        for action in draft.spec.actions
    )
    return own or any(
        int(actuator.trntype) in OF_A_JOINT and actuator.target == joint and any(actuator.biasprm[1:3])
        for actuator in draft.base.actuators
    )


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
