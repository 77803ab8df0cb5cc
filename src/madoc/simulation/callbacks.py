"""What MuJoCo's elements cannot say of a drive or of friction, compiled and called inside each of MuJoCo's steps.

A d.c. drive is an actuator of bias type `user`; the friction of a joint that depends on its speed and load is written
over the friction loss of the joint's constraint before constraints are solved. Their numbers are user data of the
actuator and of the joint in the model itself, so that a copy of a model has its own. Nothing is kept between steps.

This file needs MuJoCo and Numba alone. An exported model comes with a copy, which loads it: `drives.load("model.xml")`.
MuJoCo by itself refuses that file, as it would simulate a drive without torque.
"""

import ctypes
import math
from collections import namedtuple
from functools import cache
from inspect import unwrap
from pathlib import Path
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
    "saturation",
    "enable",
    "supply_from",
    "gain_from",
    "encoder",
)
"""User data of an actuator: V, N·m/A, Ω, duty per rad (or per rad/s), duty per rad/s, 1, A, 1, 1/A; three numbers of
other actuators, whose controls they are, or -1; and the number of the tendon that is as long as the deflection of the
gear behind which the loop's encoder sits, or -1. One that only brings in a number has MARK and zeros."""
UNLIMITED = 1e12
"""Current limit in A of a drive that has none."""
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

GUARD = '  <extension><plugin plugin="madoc.drives"/></extension>\n'
"""What makes MuJoCo refuse an exported model whose drives or friction it would leave out: no plugin has that name."""
_FRICTION_DOF = int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)


def dc_torque(
    error: float,
    rate: float,
    speed: float,
    supply: float,
    kt: float,
    resistance: float,
    gain: float,
    damping_gain: float,
    duty_limit: float,
    current_limit: float,
    strength: float,
    saturation: float,
) -> float:
    """Torque of a d.c. motor behind a position or speed loop that sets its duty, N·m.

    duty = clip(gain · error - damping_gain · rate), current = clip((duty · supply - kt · ω) / R), torque = strength ·
    kt · current / (1 + saturation · |current|): the voltage across the armature is what the supply leaves beside the
    back-EMF; inductance is neglected. `rate` is the speed that the encoder shows, ω that of the motor. `saturation` in
    1/A is the curvature of torque over current, as where iron saturates: at a current of 1/saturation half of the
    torque is left (Froelich's equation of magnetisation).
    """
    duty = min(max(gain * error - damping_gain * rate, -duty_limit), duty_limit)
    current = (duty * supply - kt * speed) / resistance
    current = min(max(current, -current_limit), current_limit)
    return strength * kt * current / (1.0 + saturation * abs(current))


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
    from numba import cfunc, types

    friction, drive = (unwrap(function) for function in _callbacks(_Places.found()))
    both = types.voidptr, types.voidptr
    mujoco.set_mjcb_control(cfunc(types.void(*both), error_model="numpy")(friction).ctypes)
    mujoco.set_mjcb_act_bias(cfunc(types.float64(*both, types.int32), error_model="numpy")(drive).ctypes)


def load(path: str | Path) -> mujoco.MjModel:
    """An exported model, whose drives and friction MuJoCo computes from then on in this process."""
    install()
    spec = mujoco.MjSpec.from_string(Path(path).read_text(encoding="utf-8").replace(GUARD, ""))
    spec.modelfiledir = str(Path(path).resolve().parent)
    return spec.compile()


def _callbacks(at: "_Places") -> tuple[Any, Any]:
    """The friction of all joints, called before actuators and the solver, and the torque of one drive, to compile."""
    from numba import carray, njit  # type: ignore[attr-defined]

    dc, dry = (njit(error_model="numpy")(unwrap(function)) for function in (dc_torque, friction_limit))
    pointer = _pointer()
    actuate, marked, drive_size, friction_size = _function("mj_fwdActuation"), MARK, len(DRIVE), len(FRICTION)
    model_words, data_words = (ctypes.sizeof(_layout(name)) // 8 for name in ("mjModel", "mjData"))

    numbers = njit(lambda words, place, count: carray(pointer(words[place]), count, np.float64))
    wholes = njit(lambda words, place, count: carray(pointer(words[place]), count, np.int32))

    def friction(model: Any, data: Any) -> None:
        m = carray(model, model_words, np.int64)
        if m[at.nuser_jnt] != friction_size:
            return
        actuate(model, data)
        d, counts = carray(data, data_words, np.int64), carray(data, 2 * data_words, np.int32)
        first, last, rows, dofs = counts[at.ne], counts[at.ne] + counts[at.nf], counts[at.nefc], m[at.nv]
        for row in range(first, last):
            dof = wholes(d, at.efc_id, rows)[row]
            joint = wholes(m, at.dof_jntid, dofs)[dof]
            own = numbers(m, at.jnt_user, m[at.njnt] * friction_size)[joint * friction_size :][:friction_size]
            if wholes(d, at.efc_type, rows)[row] != _FRICTION_DOF or own[0] != marked:
                continue
            external = numbers(d, at.qfrc_spring, dofs)[dof] + numbers(d, at.qfrc_applied, dofs)[dof]
            external -= numbers(d, at.qfrc_bias, dofs)[dof]
            coulomb, speed = numbers(m, at.dof_frictionloss, dofs)[dof], numbers(d, at.qvel, dofs)[dof]
            motor = numbers(d, at.qfrc_actuator, dofs)[dof]
            limit = dry(
                coulomb, speed, motor, external, own[1], own[2], own[3], own[4], own[5], own[6], own[7], own[8], own[9]
            )
            numbers(d, at.efc_frictionloss, rows)[row] = limit
            if counts[at.nisland] > 0:
                numbers(d, at.iefc_frictionloss, rows)[wholes(d, at.map_efc2iefc, rows)[row]] = limit

    def drive(model: Any, data: Any, actuator: int) -> float:
        m, d = carray(model, model_words, np.int64), carray(data, data_words, np.int64)
        count = m[at.nu]
        if m[at.nuser_actuator] != drive_size:
            return 0.0
        own = numbers(m, at.actuator_user, count * drive_size)[actuator * drive_size :][:drive_size]
        controls = numbers(d, at.ctrl, count)
        if own[0] != marked or own[3] == 0.0 or (own[11] >= 0.0 and controls[int(own[11])] < 0.5):
            return 0.0
        supply = own[2] if own[12] < 0.0 else controls[int(own[12])]
        gain = own[5] if own[13] < 0.0 else own[5] * controls[int(own[13])]
        low, high = numbers(m, at.actuator_ctrlrange, 2 * count)[2 * actuator :][:2]
        error, speed = min(max(controls[actuator], low), high), numbers(d, at.actuator_velocity, count)[actuator]
        deflection, rate, tendon = 0.0, speed, int(own[14])
        if tendon >= 0:
            deflection = numbers(d, at.ten_length, tendon + 1)[tendon]
            rate += numbers(d, at.ten_velocity, tendon + 1)[tendon]
        if own[1] == 0.0:
            error -= numbers(d, at.actuator_length, count)[actuator] + deflection
        elif own[1] == 1.0:
            error -= rate
        return dc(error, rate, speed, supply, own[3], own[4], gain, own[6], own[7], own[8], own[9], own[10])

    return friction, drive


def _pointer() -> Any:
    """What makes a pointer of an address, for Numba."""
    from numba import types
    from numba.core import cgutils
    from numba.extending import intrinsic

    def pointer(_: Any, address: Any) -> Any:
        return types.voidptr(types.int64), lambda _, builder, __, args: builder.inttoptr(args[0], cgutils.voidptr_t)

    return intrinsic(unwrap(pointer))


def _function(name: str) -> Any:
    """A function of MuJoCo of a model and its data, from the library that is loaded."""
    folder = Path(mujoco.__file__).parent
    library = ctypes.CDLL(str(sorted([*folder.glob(f"*mujoco*{mujoco.__version__}*"), *folder.glob("mujoco*.dll")])[0]))
    function = getattr(library, name)
    function.argtypes, function.restype = [ctypes.c_void_p, ctypes.c_void_p], None
    return function


class _Places(
    namedtuple(
        "_Places",
        "nu nv njnt nuser_jnt nuser_actuator jnt_user dof_jntid dof_frictionloss actuator_user actuator_ctrlrange "
        "ne nf nefc nisland ctrl qvel qfrc_spring qfrc_applied qfrc_bias qfrc_actuator actuator_length "
        "actuator_velocity ten_length ten_velocity efc_type efc_id efc_frictionloss iefc_frictionloss "
        "map_efc2iefc",
    )
):
    """Where the sizes and pointers that are used here lie in mjModel and mjData, in words of their own size."""

    @classmethod
    def found(cls) -> "_Places":
        """The places by MuJoCo's own declarations; where its views of a small model contradict, RuntimeError."""
        model, data = _layout("mjModel"), _layout("mjData")
        _check(model, data)
        parts = {name: (layout, kind) for layout in (data, model) for name, kind in layout._fields_}
        return cls(
            **{name: getattr(parts[name][0], name).offset // ctypes.sizeof(parts[name][1]) for name in cls._fields}
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
