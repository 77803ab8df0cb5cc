"""What MuJoCo's elements cannot say of a drive or of friction, compiled and called inside each of MuJoCo's steps.

A d.c. drive is an actuator of bias type `user`; the friction of a joint that depends on its speed and load is written
over the friction loss of the joint's constraint before constraints are solved. Their numbers are user data of the
actuator and of the joint in the model itself, so that a copy of a model has its own. Nothing is kept between steps.

This file needs MuJoCo and Numba alone: an exported model comes with a copy, whose `install()` a program calls once.
"""

import ctypes
import math
from functools import cache
from typing import Any

import mujoco
import numpy as np
from mujoco.introspect import ast_nodes, structs

MARK = 5151.0
"""First number of user data that is ours."""

DRIVE = (
    "mark",
    "means",
    "supply",
    "kt",
    "resistance",
    "gain",
    "damping_gain",
    "duty_limit",
    "current_limit",
    "strength",
    "enable",
    "supply_from",
    "gain_from",
)
"""User data of an actuator: V, N·m/A, Ω, duty per rad (or per rad/s), duty per rad/s, 1, A, 1; the last three are the
numbers of other actuators, whose controls they are, or -1. An actuator that only brings in a number has MARK alone."""
MEANS = ("position", "velocity", "duty")
"""What the control of a d.c. drive is, by the number that is its `means`."""

FRICTION = (
    "mark",
    "stribeck",
    "stribeck_speed",
    "stribeck_exponent",
    "load_motor",
    "load_external",
    "stribeck_load_motor",
    "stribeck_load_external",
    "quadratic_motor",
    "quadratic_external",
)
"""User data of a joint: N·m, rad/s, 1; ratios; and 1/(N·m). Its Coulomb and viscous friction are MuJoCo's own."""

_FRICTION_DOF = int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)
_OF_A_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_USER = int(mujoco.mjtBias.mjBIAS_USER)
_AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)
_FIXED = int(mujoco.mjtGain.mjGAIN_FIXED)


def dc_torque(
    error: float,
    speed: float,
    supply: float,
    kt: float,
    resistance: float,
    gain: float,
    damping_gain: float,
    duty_limit: float,
    current_limit: float,
    strength: float,
) -> float:
    """Torque of a d.c. motor behind a position or speed loop that sets its duty, N·m.

    duty = clip(gain · error - damping_gain · ω), current = clip((duty · supply - kt · ω) / R), torque = strength · kt ·
    current: the voltage across the armature is what the supply leaves beside the back-EMF; inductance is neglected.
    """
    duty = min(max(gain * error - damping_gain * speed, -duty_limit), duty_limit)
    current = (duty * supply - kt * speed) / resistance
    return strength * kt * min(max(current, -current_limit), current_limit)


def friction_limit(
    coulomb: float,
    speed: float,
    motor: float,
    external: float,
    stribeck: float,
    stribeck_speed: float,
    stribeck_exponent: float,
    load_motor: float,
    load_external: float,
    stribeck_load_motor: float,
    stribeck_load_external: float,
    quadratic_motor: float,
    quadratic_external: float,
) -> float:
    """Largest dry friction of a gearbox between a motor's torque and an external one, N·m.

    Model M6 of Duclusaud et al. 2025 ("Extended Friction Models for the Physics Simulation of Servo Actuators"), which
    has M1 to M5 in it: coulomb + |load_external · e - load_motor · m| + s (stribeck + |stribeck_load_external · e -
    stribeck_load_motor · m| + q), where s = exp(-|ω / stribeck_speed|^stribeck_exponent), and q is quadratic_external ·
    e² where the motor drives against the load, quadratic_motor · m² where the load drives against the motor, else 0.
    """
    limit = coulomb + abs(load_external * external - load_motor * motor)
    rising = stribeck + abs(stribeck_load_external * external - stribeck_load_motor * motor)
    if motor * external < 0.0:
        if abs(external) < abs(motor):
            rising += quadratic_external * external * external
        elif abs(external) > abs(motor):
            rising += quadratic_motor * motor * motor
    if rising != 0.0:
        limit += rising * math.exp(-(abs(speed / stribeck_speed) ** stribeck_exponent))
    return limit


@cache
def install() -> None:
    """Have MuJoCo call the drives and the friction in every step of this process; a second call changes nothing.

    Raises:
        ImportError: Numba is not installed.
        RuntimeError: This version of MuJoCo keeps its numbers elsewhere than it says.
    """
    control, bias = _compiled()
    mujoco.set_mjcb_control(control.ctypes)
    mujoco.set_mjcb_act_bias(bias.ctypes)


def _compiled() -> tuple[Any, Any]:
    """The callbacks of MuJoCo's control and of its actuators' bias, as Numba compiles them."""
    from numba import carray, cfunc, njit, types
    from numba.core import cgutils
    from numba.extending import intrinsic

    @intrinsic
    def _at(_: Any, address: Any) -> Any:
        """An address as a pointer."""
        return types.voidptr(types.int64), lambda _, builder, __, args: builder.inttoptr(args[0], cgutils.voidptr_t)

    dc, dry = njit(error_model="numpy")(dc_torque), njit(error_model="numpy")(friction_limit)
    of_model, of_data = _layout("mjModel"), _layout("mjData")
    _check(of_model, of_data)

    def size(name: str) -> int:
        return getattr(of_model, name).offset // 8

    def words(name: str) -> int:
        return (getattr(of_model, name, None) or getattr(of_data, name)).offset // 8

    model_words, data_words = ctypes.sizeof(of_model) // 8, ctypes.sizeof(of_data) // 8
    nu, nuser_jnt, nuser_actuator = size("nu"), size("nuser_jnt"), size("nuser_actuator")
    nv, njnt = size("nv"), size("njnt")
    jnt_user, actuator_user, dof_jntid = words("jnt_user"), words("actuator_user"), words("dof_jntid")
    dof_frictionloss = words("dof_frictionloss")
    trntype, trnid, gear = words("actuator_trntype"), words("actuator_trnid"), words("actuator_gear")
    gaintype, biastype = words("actuator_gaintype"), words("actuator_biastype")
    gainprm, biasprm = words("actuator_gainprm"), words("actuator_biasprm")
    limited, limits = words("actuator_forcelimited"), words("actuator_forcerange")
    bounded, bounds = words("actuator_ctrllimited"), words("actuator_ctrlrange")
    ctrl, length, velocity = words("ctrl"), words("actuator_length"), words("actuator_velocity")
    qvel, qfrc_bias, qfrc_spring = words("qvel"), words("qfrc_bias"), words("qfrc_spring")
    qfrc_applied = words("qfrc_applied")
    efc_type, efc_id, efc_frictionloss = words("efc_type"), words("efc_id"), words("efc_frictionloss")
    iefc_frictionloss, map_efc2iefc = words("iefc_frictionloss"), words("map_efc2iefc")
    ne, nf, nefc = (getattr(of_data, name).offset // 4 for name in ("ne", "nf", "nefc"))
    nisland = of_data.nisland.offset // 4
    drive_size, friction_size, prm = len(DRIVE), len(FRICTION), int(mujoco.mjNGAIN)
    prm_bias = int(mujoco.mjNBIAS)

    @njit(error_model="numpy")
    def drive_torque(m: Any, d: Any, actuator: int) -> float:
        """Torque of a d.c. drive; 0 of an actuator that is none."""
        count, width = m[nu], m[nuser_actuator]
        if width != drive_size:
            return 0.0
        block = carray(_at(m[actuator_user]), (count, width), np.float64)[actuator]
        if block[0] != MARK or block[3] == 0.0:
            return 0.0
        controls = carray(_at(d[ctrl]), count, np.float64)
        if block[10] >= 0.0 and controls[int(block[10])] < 0.5:
            return 0.0
        supply = block[2] if block[11] < 0.0 else controls[int(block[11])]
        gain = block[5] if block[12] < 0.0 else block[5] * controls[int(block[12])]
        span = carray(_at(m[bounds]), (count, 2), np.float64)[actuator]
        error = controls[actuator]
        if carray(_at(m[bounded]), count, np.bool_)[actuator]:
            error = min(max(error, span[0]), span[1])
        speed = carray(_at(d[velocity]), count, np.float64)[actuator]
        if block[1] == 0.0:
            error -= carray(_at(d[length]), count, np.float64)[actuator]
        elif block[1] == 1.0:
            error -= speed
        return dc(error, speed, supply, block[3], block[4], gain, block[6], block[7], block[8], block[9])

    @njit(error_model="numpy")
    def torque(m: Any, d: Any, actuator: int) -> float:
        """Torque of an actuator on its joint, as MuJoCo computes it of a fixed gain and an affine bias."""
        count = m[nu]
        force = 0.0
        if carray(_at(m[biastype]), count, np.int32)[actuator] == _USER:
            force = drive_torque(m, d, actuator)
        else:
            control = carray(_at(d[ctrl]), count, np.float64)[actuator]
            if carray(_at(m[bounded]), count, np.bool_)[actuator]:
                span = carray(_at(m[bounds]), (count, 2), np.float64)[actuator]
                control = min(max(control, span[0]), span[1])
            force = carray(_at(m[gainprm]), (count, prm), np.float64)[actuator, 0] * control
            if carray(_at(m[biastype]), count, np.int32)[actuator] == _AFFINE:
                bias = carray(_at(m[biasprm]), (count, prm_bias), np.float64)[actuator]
                force += bias[0] + bias[1] * carray(_at(d[length]), count, np.float64)[actuator]
                force += bias[2] * carray(_at(d[velocity]), count, np.float64)[actuator]
        if carray(_at(m[limited]), count, np.bool_)[actuator]:
            span = carray(_at(m[limits]), (count, 2), np.float64)[actuator]
            force = min(max(force, span[0]), span[1])
        return force * carray(_at(m[gear]), (count, 6), np.float64)[actuator, 0]

    def control(model: Any, data: Any) -> None:
        m = carray(model, model_words, np.int64)
        if m[nuser_jnt] != friction_size:
            return
        d, ints = carray(data, data_words, np.int64), carray(data, 2 * data_words, np.int32)
        rows, dofs, count = ints[nefc], m[nv], m[nu]
        blocks = carray(_at(m[jnt_user]), (m[njnt], friction_size), np.float64)
        for row in range(ints[ne], ints[ne] + ints[nf]):
            if carray(_at(d[efc_type]), rows, np.int32)[row] != _FRICTION_DOF:
                continue
            dof = carray(_at(d[efc_id]), rows, np.int32)[row]
            joint = carray(_at(m[dof_jntid]), dofs, np.int32)[dof]
            b = blocks[joint]
            if b[0] != MARK:
                continue
            motor = 0.0
            for actuator in range(count):
                kind = carray(_at(m[trntype]), count, np.int32)[actuator]
                if (kind == _OF_A_JOINT[0] or kind == _OF_A_JOINT[1]) and carray(
                    _at(m[trnid]), (count, 2), np.int32
                )[actuator, 0] == joint:
                    motor += torque(m, d, actuator)
            external = carray(_at(d[qfrc_spring]), dofs, np.float64)[dof]
            external += carray(_at(d[qfrc_applied]), dofs, np.float64)[dof]
            external -= carray(_at(d[qfrc_bias]), dofs, np.float64)[dof]
            speed = carray(_at(d[qvel]), dofs, np.float64)[dof]
            coulomb = carray(_at(m[dof_frictionloss]), dofs, np.float64)[dof]
            limit = dry(
                coulomb, speed, motor, external, b[1], b[2], b[3], b[4], b[5], b[6], b[7], b[8], b[9]
            )
            carray(_at(d[efc_frictionloss]), rows, np.float64)[row] = limit
            if ints[nisland] > 0:
                place = carray(_at(d[map_efc2iefc]), rows, np.int32)[row]
                carray(_at(d[iefc_frictionloss]), rows, np.float64)[place] = limit

    def bias(model: Any, data: Any, actuator: int) -> float:
        m, d = carray(model, model_words, np.int64), carray(data, data_words, np.int64)
        return drive_torque(m, d, actuator)

    pointers = types.voidptr, types.voidptr
    return (
        cfunc(types.void(*pointers), error_model="numpy")(control),
        cfunc(types.float64(*pointers, types.int32), error_model="numpy")(bias),
    )


@cache
def _layout(name: str) -> Any:
    """A C structure of MuJoCo by its own declaration, whose fields have the offsets that a compiler gives them."""
    return _structure(structs.STRUCTS[name])


def _structure(declared: Any) -> Any:
    fields = [(part.name, _type(part.type)) for part in declared.fields]
    return type("Declared", (ctypes.Structure,), {"_fields_": fields})


def _type(declared: Any) -> Any:
    plain = {"int": ctypes.c_int, "float": ctypes.c_float, "mjtNum": ctypes.c_double, "mjtSize": ctypes.c_int64}
    plain |= {"mjtBool": ctypes.c_bool, "mjtByte": ctypes.c_ubyte, "size_t": ctypes.c_size_t}
    plain |= {"uintptr_t": ctypes.c_size_t, "uint64_t": ctypes.c_uint64}
    if isinstance(declared, ast_nodes.PointerType):
        return ctypes.c_void_p
    if isinstance(declared, ast_nodes.ArrayType):
        return _type(declared.inner_type) * math.prod(declared.extents)
    if hasattr(declared, "fields"):
        return _structure(declared)
    return plain.get(declared.name) or _layout(declared.name)


_PROBE = """<mujoco><worldbody><body><joint name="a" frictionloss="1" user="1 2"/><geom size="1"/></body></worldbody>
<actuator><motor joint="a" user="1 2 3"/></actuator></mujoco>"""


def _check(of_model: Any, of_data: Any) -> None:
    """Refuse a layout in which a number or a pointer is elsewhere than MuJoCo's own views of a small model have it."""
    model = mujoco.MjModel.from_xml_string(_PROBE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for owner, layout in ((model, of_model), (data, of_data)):
        found = layout.from_address(owner._address)
        for name, _ in layout._fields_:
            view, value = getattr(owner, name, None), getattr(found, name)
            if isinstance(view, np.ndarray) and view.size and isinstance(value, int):  # None: not computed
                wrong = value != view.ctypes.data
            else:
                wrong = isinstance(view, int) and isinstance(value, int) and value != view
            if wrong:
                raise RuntimeError(f"MuJoCo {mujoco.__version__} keeps {name} elsewhere than it declares")
