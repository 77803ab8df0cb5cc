"""Numbers of drives and of friction that a model keeps as user data of its actuators and joints.

A d.c. drive whose supply, gain and state never come from a log, whose torque is in proportion to a current without
limit, and whose encoder is on the motor, is said by MuJoCo's own elements: a servo whose largest force is that of its
largest duty, and damping by back-EMF. Other drives, and friction that depends on speed or load, need `callbacks`.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from madoc.errors import MadocError
from madoc.simulation import callbacks
from madoc.simulation.callbacks import DRIVE, FRICTION, MARK, UNLIMITED

LEAST_FRICTION = 1e-9
"""Coulomb friction in N·m to which smaller values are raised at a joint whose friction depends on speed or load: MuJoCo
makes a constraint only of friction above 0."""


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
