"""Drives, friction and gears at joints of a model: numbers kept as user data, and joints and tendons that are gears.

A d.c. drive whose supply, gain and state never come from a log, whose torque is in proportion to a current without
limit, and whose encoder is on the motor, is said by MuJoCo's own elements: a servo whose largest force is that of its
largest duty, and damping by back-EMF. Other drives, and friction that depends on speed or load, need `callbacks`.

Of a joint with a gear, which has backlash and elasticity, the spec names that of the motor's shaft behind the
reduction, with armature, friction and actuators. A second one in the same body, about the same axis, adds the
deflection of the gear to it, so that the link stands at the sum. A fixed tendon over the second joint alone is as long
as the deflection; its spring has a dead band as wide as the backlash, and its damper acts inside it too (the dead-zone
model of Nordin and Gutman 2002, "Controlling mechanical systems with backlash"). Joint and tendon have the name of the
first joint with `SUFFIX`, by which they are found.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float, Int

from madoc.errors import MadocError
from madoc.simulation import callbacks
from madoc.simulation.callbacks import DRIVE, FRICTION, MARK, UNLIMITED

LEAST_FRICTION = 1e-9
"""Coulomb friction in N·m to which smaller values are raised at a joint whose friction depends on speed or load: MuJoCo
makes a constraint only of friction above 0."""

SUFFIX = "_gear"
"""What the names of a gear's joint and tendon end with, behind that of the joint it belongs to."""


def has_numbers(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator is a d.c. drive, or brings in a number of one."""
    return bool(model.nuser_actuator == len(DRIVE) and model.actuator_user[actuator, 0] == MARK)


def is_drive(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator is a d.c. drive."""
    return has_numbers(model, actuator) and bool(model.actuator_user[actuator, DRIVE.index("kt")])


def has_speed_or_load_friction(model: mujoco.MjModel, joint: int) -> bool:
    """Whether the friction of a joint depends on its speed or its load."""
    return bool(model.nuser_jnt == len(FRICTION) and model.jnt_user[joint, 0] == MARK)


def needs_callbacks(model: mujoco.MjModel) -> bool:
    """Whether a model has a drive or friction that MuJoCo's own elements do not say."""
    drives = (each for each in range(model.nu) if is_drive(model, each))
    by_callback = any(model.actuator_biastype[each] == mujoco.mjtBias.mjBIAS_USER for each in drives)
    return by_callback or any(has_speed_or_load_friction(model, joint) for joint in range(model.njnt))


def install_callbacks() -> None:
    """Have MuJoCo compute drives and friction that its elements cannot say.

    Raises:
        MadocError: Numba is not installed, or this MuJoCo is laid out otherwise than it declares.
    """
    try:
        callbacks.install()
    except ImportError as error:
        raise MadocError(
            "a drive with inputs from the log, a current limit, saturation or an encoder behind a gear, and friction "
            "by speed or load, need Numba; install it: pip install 'madoc-calibration[drives]'"
        ) from error
    except RuntimeError as error:
        raise MadocError(f"{error}; install another version of it") from error


def drive_number(model: mujoco.MjModel, actuator: int, name: str) -> np.ndarray:
    """A number of a drive, as a view of one value; an actuator without it is refused."""
    if not is_drive(model, actuator):
        raise MadocError(
            f"drive_{name}: actuator {model.actuator(actuator).name!r} is no such drive; say drive: of its action"
        )
    found = model.actuator_user[actuator, DRIVE.index(name) :][:1]
    if name == "current_limit" and found[0] >= UNLIMITED:
        raise MadocError(
            f"drive_{name}: the current of {model.actuator(actuator).name!r} is not limited; give it a current_limit:"
        )
    if name == "saturation" and model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_USER:
        raise MadocError(
            f"drive_{name}: the torque of {model.actuator(actuator).name!r} is in proportion to its current; give it a "
            "saturation: of more than 0"
        )
    return found


def friction_numbers(model: mujoco.MjModel, joint: int, name: str) -> np.ndarray:
    """The numbers of a term of friction; of one for the motor's and the external torque, which are neighbours, both."""
    if not has_speed_or_load_friction(model, joint):
        raise MadocError(
            f"friction_{name}: joint {model.joint(joint).name!r} has no friction of this kind; say it under friction:"
        )
    both = name not in FRICTION
    first = FRICTION.index(f"{name}_motor" if both else name)
    return model.jnt_user[joint, first : first + 1 + both]


def by_own_elements(numbers: Sequence[float]) -> bool:
    """Whether MuJoCo's own elements say a drive of these numbers (`DRIVE`), where its torque causes no friction."""
    of = dict(zip(DRIVE, numbers, strict=True))
    proportional = of["current_limit"] >= UNLIMITED and of["saturation"] == 0.0
    return proportional and max(numbers[DRIVE.index("enable") :]) < 0.0


def elements_of_drive(numbers: Sequence[float]) -> tuple[float, tuple[float, float], float, float]:
    """A drive as an actuator of MuJoCo: its gain, its bias by position and speed, its largest force and its damping.

    Its torque is duty · stall - strength · kt²/R · ω, where stall = strength · kt · supply / R: the first part is that
    of a servo of gain · stall, cut off at duty_limit · stall, the second damping.
    """
    of = dict(zip(DRIVE, numbers, strict=True))
    stall = of["strength"] * of["kt"] * of["supply"] / of["resistance"]
    gain, braking = of["gain"] * stall, of["damping_gain"] * stall
    on_position, on_speed = ((gain, 0.0), (0.0, gain), (0.0, 0.0))[int(of["means"])]  # MEANS
    damping = of["strength"] * of["kt"] ** 2 / of["resistance"]
    return gain, (-on_position, -on_speed - braking), of["duty_limit"] * stall, damping


def write_elements(model: mujoco.MjModel) -> None:
    """Bring the numbers of MuJoCo's own elements in line with those of the drives that they stand for."""
    for actuator in range(model.nu if model.nuser_actuator == len(DRIVE) else 0):
        numbers = model.actuator_user[actuator].tolist()
        if is_drive(model, actuator) and model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_USER:
            gain, bias, largest, damping = elements_of_drive(numbers)
            model.actuator_gainprm[actuator, 0] = gain
            model.actuator_biasprm[actuator, 1:3] = bias
            model.actuator_forcerange[actuator] = -largest, largest
            model.actuator_damping[actuator] = damping


def scale_forces(model: mujoco.MjModel, factor: float) -> None:
    """Multiply the torques of d.c. drives, and those of friction that are not in proportion to others.

    A current limit is multiplied, and saturation divided, as the resistance is divided.
    """
    for actuator in range(model.nu):
        if is_drive(model, actuator):
            model.actuator_user[actuator, [DRIVE.index("resistance"), DRIVE.index("saturation")]] /= factor
            if model.actuator_user[actuator, DRIVE.index("current_limit")] < UNLIMITED:
                model.actuator_user[actuator, DRIVE.index("current_limit")] *= factor
    for joint in range(model.njnt):
        if has_speed_or_load_friction(model, joint):
            model.jnt_user[joint, FRICTION.index("stribeck")] *= factor
            model.jnt_user[joint, FRICTION.index("quadratic_motor") :] /= factor


def deflections(model: mujoco.MjModel) -> Int[np.ndarray, " gears"]:
    """The joints that are deflections of gears."""
    names = [model.joint(joint).name for joint in range(model.njnt)]
    return np.array([joint for joint, name in enumerate(names) if name and _tendon(model, name) >= 0], np.int64)


def deflection_values(model: mujoco.MjModel) -> tuple[Int[np.ndarray, " gears"], Int[np.ndarray, " gears"]]:
    """Places in (qpos, qvel) of the deflections of gears, and of their velocities."""
    joints = deflections(model)
    return model.jnt_qposadr[joints].astype(np.int64), model.nq + model.jnt_dofadr[joints].astype(np.int64)


def loaded_deflections(
    model: mujoco.MjModel,
    states: Float[np.ndarray, "rows physical"],
    acceleration: Float[np.ndarray, "rows velocity"],
) -> Float[np.ndarray, "rows gears"]:
    """Deflections at which gears carry what accelerates and holds their links, in states without any.

    That torque follows from inverse dynamics. Where it pushes tells on which side of the backlash the teeth touch.
    """
    data, joints = mujoco.MjData(model), deflections(model)
    dofs, carried = model.jnt_dofadr[joints], np.zeros((len(states), len(joints)))
    for row, (state, change) in enumerate(zip(states, acceleration, strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = state[: model.nq], state[model.nq :], change
        mujoco.mj_inverse(model, data)
        carried[row] = data.qfrc_inverse[dofs]
    tendons = [_tendon(model, model.joint(joint).name) for joint in joints.tolist()]
    half = model.tendon_lengthspring[tendons, 1]
    deflected: np.ndarray = -(carried / model.tendon_stiffness[tendons] + half * np.sign(carried))
    return deflected


def longest_timestep(model: mujoco.MjModel, tendon: int, stiffness: float, damping: float) -> float:
    """Longest timestep that resolves the motor and the link swinging against each other in a gear, s.

    With it a swing takes 2π steps; with one of twice the length the integration, explicit in springs, diverges.
    """
    mobility = float(model.tendon_invweight0[tendon])
    return 1.0 / max(np.sqrt(stiffness * mobility), damping * mobility, 1e-12)


def gear_numbers(model: mujoco.MjModel, joint: int, name: str) -> np.ndarray:
    """The stiffness or damping of the gear behind a joint as a view of one value, or the ends of its dead band."""
    tendon = _tendon(model, f"{model.joint(joint).name}{SUFFIX}")
    if tendon < 0:
        raise MadocError(f"gear_{name}: joint {model.joint(joint).name!r} has no gear; say it under gears:")
    array: np.ndarray = {
        "stiffness": model.tendon_stiffness[tendon : tendon + 1],
        "damping": model.tendon_damping[tendon : tendon + 1],
        "backlash": model.tendon_lengthspring[tendon],
    }[name]
    return array


def backlash(model: mujoco.MjModel, joint: int) -> np.ndarray:
    """The whole width of the dead band of the gear behind a joint, shape (1,); a copy."""
    return np.diff(gear_numbers(model, joint, "backlash"))


def write_backlash(model: mujoco.MjModel, joint: int, value: float) -> None:
    """Half of the backlash lies to either side."""
    gear_numbers(model, joint, "backlash")[:] = -value / 2.0, value / 2.0


def _tendon(model: mujoco.MjModel, name: str) -> int:
    """The tendon of a gear's joint; -1 where there is none, or the name is no gear's."""
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TENDON, name) if name.endswith(SUFFIX) else -1
