"""What a model is in the terms of those who configure robots for training: actuators, options, the start."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from madoc.simulation.callbacks import DRIVE, FRICTION, MEANS, UNLIMITED
from madoc.simulation.joints import deflections, has_speed_or_load_friction, is_drive
from madoc.simulation.write import OF_A_JOINT, ONE_DOF, has_gain


@dataclass(frozen=True)
class JointActuator:
    """An actuator, and the joint that it drives.

    Attributes:
        name: Its name in the model.
        joint: The hinge or slide that it drives; empty where it drives something else.
        servo: Whether it is a position servo without a gear ratio, whose force is
            stiffness · (command - position) - damping · velocity.
        stiffness: Its kp in N·m/rad, or in N/m of a slide; 0 of what is no position servo.
        damping: Its kd in N·m·s/rad, or in N·s/m of a slide; 0 of what is no position servo.
        effort_limit: Its largest force to either side in N·m or N; None where it has none, or another to each side.
        armature: Of the joint, kg·m² or kg.
        friction: Coulomb friction of the joint, N·m or N.
        viscous: Viscous damping of the joint, N·m·s/rad or N·s/m.
        means: What its command is: position, velocity or effort.
        tendon: The tendon that it pulls, if it does.
        site: The site at which it acts, if it does.
    """

    name: str
    joint: str
    servo: bool
    stiffness: float
    damping: float
    effort_limit: float | None
    armature: float
    friction: float
    viscous: float
    means: str = "effort"
    tendon: str = ""
    site: str = ""


@dataclass(frozen=True)
class JointDrive:
    """A d.c. drive, and the joint behind it.

    Attributes:
        name: Of its actuator.
        means: What its command is: position, velocity or duty.
        numbers: Its numbers by the names of `callbacks.DRIVE`, supply to strength.
        current_limit: In A; None where it has none.
        setting: What its gain is multiplied by, as set in a firmware; 1 where it is not.
        supply_from: Name of what brings in the measured supply; empty where the supply is constant.
        friction: Numbers of the joint by the names of `callbacks.FRICTION`; empty where its friction depends on
            neither speed nor load.
        coulomb: Coulomb friction of the joint, N·m.
        viscous: Viscous damping of the joint, N·m·s/rad.
        drag: Damping of the joint by the square of its speed, N·m·s²/rad².
        armature: Of the joint, kg·m².
        zero: What the joint reads where the model as drawn has its zero, rad.
        gives: Whether a gear with backlash and elasticity is behind the joint.
    """

    name: str
    means: str
    numbers: Mapping[str, float]
    current_limit: float | None
    setting: float
    supply_from: str
    friction: Mapping[str, float]
    coulomb: float
    viscous: float
    drag: float
    armature: float
    zero: float
    gives: bool = False


def joint_drives(model: mujoco.MjModel, controls: Mapping[str, float]) -> list[JointDrive]:
    """The d.c. drives of a model; `controls` are values of what brings in numbers of them, by actuator."""
    return [_joint_drive(model, each, controls) for each in range(model.nu) if is_drive(model, each)]


def _joint_drive(model: mujoco.MjModel, index: int, controls: Mapping[str, float]) -> JointDrive:
    own = dict(zip(DRIVE, model.actuator_user[index].tolist(), strict=True))
    joint = int(model.actuator_trnid[index, 0])
    dof, loaded = int(model.jnt_dofadr[joint]), has_speed_or_load_friction(model, joint)
    supply, gain = (
        "" if own[key] < 0.0 else model.actuator(int(own[key])).name for key in ("supply_from", "gain_from")
    )
    return JointDrive(
        name=model.actuator(index).name,
        means=MEANS[int(own["means"])],
        numbers={name: own[name] for name in DRIVE[DRIVE.index("supply") : DRIVE.index("enable")]},
        current_limit=own["current_limit"] if own["current_limit"] < UNLIMITED else None,
        setting=controls[gain] if gain else 1.0,
        supply_from=supply,
        friction=dict(zip(FRICTION[1:], model.jnt_user[joint, 1:].tolist(), strict=True)) if loaded else {},
        coulomb=float(model.dof_frictionloss[dof]),
        viscous=float(model.dof_damping[dof]),
        drag=float(model.dof_dampingpoly[dof, 0]),
        armature=float(model.dof_armature[dof]),
        zero=float(model.qpos0[model.jnt_qposadr[joint]]),
        gives=bool(joint + 1 in deflections(model)),  # a gear's joint follows that which it is behind
    )


def joint_actuators(model: mujoco.MjModel, names: Sequence[str]) -> list[JointActuator]:
    """The named actuators of a model, in the order given."""
    return [_joint_actuator(model, model.actuator(name).id) for name in names]


def _joint_actuator(model: mujoco.MjModel, index: int) -> JointActuator:
    name, joint = model.actuator(index).name, int(model.actuator_trnid[index, 0])
    through, means = int(model.actuator_trntype[index]), _means(model, index)
    if through not in OF_A_JOINT or int(model.jnt_type[joint]) not in ONE_DOF:
        tendon = model.tendon(joint).name if through == mujoco.mjtTrn.mjTRN_TENDON else ""
        site = model.site(joint).name if through == mujoco.mjtTrn.mjTRN_SITE else ""
        return JointActuator(name, "", False, 0.0, 0.0, None, 0.0, 0.0, 0.0, means, tendon, site)
    dof = int(model.jnt_dofadr[joint])
    gain, (offset, position, velocity) = (
        float(model.actuator_gainprm[index, 0]),
        model.actuator_biasprm[index, :3].tolist(),
    )
    servo = (
        has_gain(model, index)
        and int(model.actuator_biastype[index]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
        and int(model.actuator_dyntype[index]) == int(mujoco.mjtDyn.mjDYN_NONE)
        and gain > 0.0
        and position == -gain
        and offset == 0.0
        and np.array_equal(model.actuator_gear[index], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    )
    low, high = model.actuator_forcerange[index].tolist()
    limited = bool(model.actuator_forcelimited[index]) and low == -high
    return JointActuator(
        name=name,
        joint=model.joint(joint).name,
        servo=servo and (limited or not model.actuator_forcelimited[index]),
        stiffness=gain if servo else 0.0,
        damping=-velocity if servo else 0.0,
        effort_limit=high if limited else None,
        armature=float(model.dof_armature[dof]),
        friction=float(model.dof_frictionloss[dof]),
        viscous=float(model.dof_damping[dof]),
        means=means,
    )


def _means(model: mujoco.MjModel, index: int) -> str:
    """What an actuator's command is, by its bias: one of position makes it a position, else one of velocity that."""
    if int(model.actuator_biastype[index]) != int(mujoco.mjtBias.mjBIAS_AFFINE):
        return "effort"
    _, position, velocity = model.actuator_biasprm[index, :3].tolist()
    if int(model.actuator_dyntype[index]) == int(mujoco.mjtDyn.mjDYN_INTEGRATOR):  # of an intvelocity
        return "velocity"
    return "position" if position else "velocity" if velocity else "effort"


def physics_options(model: mujoco.MjModel) -> tuple[dict[str, str], list[str]]:
    """A model's options by their names in mjlab's `MujocoCfg`, as source, and what these names cannot say."""
    option = model.opt
    names = {
        "integrator": mujoco.mjtIntegrator(option.integrator).name.removeprefix("mjINT_").lower(),
        "cone": mujoco.mjtCone(option.cone).name.removeprefix("mjCONE_").lower(),
        "jacobian": mujoco.mjtJacobian(option.jacobian).name.removeprefix("mjJAC_").lower(),
        "solver": mujoco.mjtSolver(option.solver).name.removeprefix("mjSOL_").lower(),
    }
    lost = []
    if names["integrator"] not in _INTEGRATORS:
        lost.append(f"the integrator is {names['integrator']} and mjlab has {' and '.join(_INTEGRATORS)}")
        names["integrator"] = "implicitfast"
    numbers = ("timestep", "impratio", "iterations", "tolerance", "ls_iterations", "ls_tolerance", "ccd_iterations")
    source = {name: repr(getattr(option, name)) for name in numbers} | {name: repr(it) for name, it in names.items()}
    source["gravity"] = repr(tuple(option.gravity.tolist()))
    for flags, kind, prefix in (
        ("disableflags", mujoco.mjtDisableBit, "mjDSBL_"),
        ("enableflags", mujoco.mjtEnableBit, "mjENBL_"),
    ):
        known = {name: int(bit) for name, bit in kind.__members__.items() if name.startswith(prefix)}
        held = tuple(name.removeprefix(prefix).lower() for name, bit in known.items() if getattr(option, flags) & bit)
        source |= {flags: repr(held)} if held else {}
    lost += [
        f"the option {name} is {getattr(option, name)!r} and mjlab has none"
        for name in ("density", "viscosity")
        if getattr(option, name)
    ]
    return source, lost


def start_position(model: mujoco.MjModel) -> dict[str, float]:
    """Where the hinges and slides that have a name are in a model's reference pose, rad or m."""
    joints = [(model.joint(index).name, index) for index in range(model.njnt) if int(model.jnt_type[index]) in ONE_DOF]
    return {name: float(model.qpos0[model.jnt_qposadr[index]]) for name, index in joints if name}


def base_pose(model: mujoco.MjModel) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Where a floating base is in the reference pose, m, and its attitude, a unit quaternion; None of a fixed base."""
    floats = model.njnt > 0 and int(model.jnt_type[0]) == int(mujoco.mjtJoint.mjJNT_FREE)
    return (tuple(model.qpos0[:3].tolist()), tuple(model.qpos0[3:7].tolist())) if floats else None


def floating_beside(model: mujoco.MjModel) -> list[str]:
    """Bodies that float freely besides the one of the model's first joint, by their names or else their numbers."""
    others = model.jnt_bodyid[1:][model.jnt_type[1:] == mujoco.mjtJoint.mjJNT_FREE]
    return [model.body(body).name or f"body {body}" for body in others]


_INTEGRATORS = ("euler", "implicitfast")
