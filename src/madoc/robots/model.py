"""The MuJoCo spec that is made of the files of a robot's model."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import mujoco
import numpy as np

from madoc.errors import MadocError
from madoc.robots.document import Document
from madoc.robots.drive_spec import FrictionSpec, GearSpec
from madoc.robots.functions import PythonFile
from madoc.robots.model_files import ModelFiles
from madoc.robots.spec import RobotSpec
from madoc.simulation.callbacks import DRIVE, FRICTION, MARK
from madoc.simulation.joints import LEAST_FRICTION, SUFFIX
from madoc.simulation.write import OF_A_JOINT, ONE_DOF
from madoc.tasks.base import compiled_model
from madoc.tasks.physics import refuse_unfit_mujoco

REFERRING = ("sensors", "equalities", "excludes", "pairs", "tendons", "actuators")
"""Parts of a model that refer to others by name."""


def read_model(files: ModelFiles) -> mujoco.MjSpec:
    """A MuJoCo spec of a model, in which joints and actuators without a name are named by what they belong to.

    A joint takes the name of its body, where it is the only one there, and an actuator that of its joint.
    """
    refuse_unfit_mujoco()
    text, includes, assets = files.parts()
    try:
        spec = mujoco.MjSpec.from_string(text, include=includes, assets=assets)
        copy = spec.copy()  # which leaves out, without a word, what refers to an element that is not there
        if any(len(getattr(copy, kind)) < len(getattr(spec, kind)) for kind in REFERRING):
            mujoco.MjSpec.from_string(text, include=includes, assets=assets).compile()  # which says what that is
    except (ValueError, mujoco.FatalError) as error:
        raise MadocError(f"model {files.main} cannot be read: {_one_line(error)}") from error
    _name_by_owner([(joint, joint.parent.name) for joint in spec.joints if len(joint.parent.joints) == 1], spec.joints)
    of_joint = [part for part in spec.actuators if int(part.trntype) in OF_A_JOINT]
    _name_by_owner([(actuator, actuator.target) for actuator in of_joint], spec.actuators)
    return spec


@dataclass(frozen=True)
class Draft:
    """A spec with its lines, and the MuJoCo spec of its model file, without the actuators that it adds.

    The Python file is that which the spec names, allowed to be run.
    """

    spec: RobotSpec
    document: Document
    base: mujoco.MjSpec
    python: PythonFile | None = None


@dataclass(frozen=True)
class AddedActuator:
    """An actuator that a spec adds to a joint: force = gain · control - stiffness · position - damping · velocity.

    Attributes:
        name: Name of the action channel.
        joint: The joint it drives.
        low: Smallest control; MuJoCo clips controls to the range, in an exported model too.
        high: Largest control.
        gain: Force per control.
        stiffness: Force per position, in SI units.
        damping: Force per velocity, in SI units.
        limit: Largest force; None is unlimited.
        drag: Damping that no limit cuts off, as by back-EMF.
        numbers: Those of a drive (`callbacks.DRIVE`), whose equation is its force where there is no limit; or MARK
            and zeros, of an actuator that only brings a logged number in.
    """

    name: str
    joint: str
    low: float
    high: float
    gain: float = 1.0
    stiffness: float = 0.0
    damping: float = 0.0
    limit: float | None = None
    drag: float = 0.0
    numbers: tuple[float, ...] = ()


def friction_numbers(friction: FrictionSpec) -> tuple[float, ...]:
    """The numbers of a joint's friction in the model, in the order of `FRICTION`; empty where MuJoCo's own say it."""
    if set(friction.chosen) <= {"coulomb", "viscous"}:
        return ()

    def number(name: str) -> float:
        both = name.removesuffix("_motor").removesuffix("_external")
        given = (getattr(friction, name, None), getattr(friction, both, None))
        otherwise = 1.0 if name in ("stribeck_speed", "stribeck_exponent") else 0.0
        return next((value for value in given if value is not None), otherwise)

    return (MARK, *(number(name) for name in FRICTION[1:]))


def make_model(
    base: mujoco.MjSpec,
    added: tuple[AddedActuator, ...] = (),
    timestep: float | None = None,
    frictions: tuple[tuple[str, FrictionSpec], ...] = (),
    gears: tuple[GearSpec, ...] = (),
) -> mujoco.MjSpec:
    """A copy of a spec with added actuators, frictions and gears, and with another timestep if one is given."""
    spec = base.copy()
    for gear in gears:
        _insert_gear(spec, gear)
    for name, friction in frictions:
        joint, numbers = spec.joint(name), friction_numbers(friction)
        if friction.viscous is not None:
            joint.damping[0] = friction.viscous
        if friction.coulomb is not None:
            joint.frictionloss = friction.coulomb
        if numbers:
            joint.userdata = numbers
            joint.frictionloss = max(joint.frictionloss, LEAST_FRICTION)
    if timestep is not None:
        spec.option.timestep = timestep
    for actuator in added:
        new = spec.add_actuator(name=actuator.name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=actuator.joint)
        new.gainprm[0] = actuator.gain
        new.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
        new.ctrlrange = np.array([actuator.low, actuator.high])
        if actuator.stiffness or actuator.damping:
            new.biastype = mujoco.mjtBias.mjBIAS_AFFINE
            new.biasprm[1:3] = -actuator.stiffness, -actuator.damping
        if actuator.limit is not None:
            new.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            new.forcerange = np.array([-actuator.limit, actuator.limit])
        if actuator.numbers:
            new.userdata = actuator.numbers
            new.damping[0] = actuator.drag
            if actuator.limit is None and actuator.numbers[DRIVE.index("kt")]:
                new.biastype = mujoco.mjtBias.mjBIAS_USER
    return spec


def _insert_gear(spec: mujoco.MjSpec, gear: GearSpec) -> None:
    """Insert the joint and the tendon of a gear; keyframes, which would be too short then, are taken out."""
    joint, name, off = spec.joint(gear.joint), f"{gear.joint}{SUFFIX}", mujoco.mjtLimited.mjLIMITED_FALSE
    joint.armature = joint.armature if gear.armature is None else gear.armature
    half, nothing = gear.backlash / 2.0, np.zeros(3)
    plain = {"armature": 0.0, "frictionloss": 0.0, "damping": nothing, "stiffness": nothing, "ref": 0.0}
    joint.parent.add_joint(
        name=name, type=joint.type, axis=joint.axis, pos=joint.pos, limited=off, actfrclimited=off, **plain
    )
    tendon = spec.add_tendon(name=name, limited=off, actfrclimited=off, armature=0.0, frictionloss=0.0)
    tendon.springlength, tendon.stiffness, tendon.damping = (-half, half), nothing, nothing
    tendon.stiffness[0], tendon.damping[0] = gear.stiffness, gear.damping
    tendon.wrap_joint(name, 1.0)
    for key in spec.keys:
        spec.delete(key)


def with_whole_inertia(spec: Callable[[], mujoco.MjSpec], bodies: tuple[str, ...]) -> mujoco.MjSpec:
    """A spec in which MuJoCo keeps the whole mass matrix of bodies that move freely by themselves, for loads off them.

    A body, named by itself or by its joint, gets an empty one on it: one without any has a diagonal mass matrix.
    """
    changed = spec()
    for name in bodies:
        (changed.body(name) or changed.joint(name).parent).add_body()
    return changed


def compiled(spec: Callable[[], mujoco.MjSpec], file: str) -> mujoco.MjModel:
    """The shared model of a spec (`tasks.base.compiled_model`); an error of MuJoCo is passed on as a refusal."""
    try:
        return compiled_model(spec)
    except (ValueError, mujoco.FatalError) as error:
        raise MadocError(f"model {file} does not compile: {_one_line(error)}") from error


def is_slide(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a joint slides; a joint that turns has other units."""
    return int(model.jnt_type[joint]) == mujoco.mjtJoint.mjJNT_SLIDE


def is_single(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a joint is a hinge or a slide, with one position and one velocity."""
    return int(model.jnt_type[joint]) in ONE_DOF


def _name_by_owner(
    owned: list[tuple[mujoco.MjsJoint | mujoco.MjsActuator, str]],
    everything: Iterable[mujoco.MjsJoint | mujoco.MjsActuator],
) -> None:
    """Name parts without a name by their owner, unless that name is taken or would be given twice."""
    taken = [part.name for part in everything]
    wanted = [owner for part, owner in owned if not part.name]
    for part, owner in owned:
        if not part.name and owner and owner not in taken and wanted.count(owner) == 1:
            part.name = owner


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
