"""Parameters that a first spec proposes: which, in what order, in what ranges, and with which joints alike.

Ranges of drives are those of a class of machines, or follow from how strong the drives are.
"""

import math
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from madoc.parameters import FIELDS, Parameter
from madoc.robots.model import is_single, is_slide
from madoc.robots.space import element_unit, gain_unit
from madoc.simulation.write import (
    OF_A_JOINT,
    element_names,
    find_elements,
    has_gain,
    heavy_bodies,
    nominal_values,
    single_joints,
)

Ends = tuple[float, float]
MOST = 40
"""Largest number of parameters proposed; further fields are written as comments, each with all of its lines."""
_MANY = 10
"""Largest number of lines of a field, where some of them may be one."""
_SIDES = frozenset(
    re.findall(r"\w+", "l r left right front rear back hind fl fr rl rr hl hr bl br lf rf lh rh lr")  # of legs, too
)
"""Words of a name that say which of several legs, arms or wheels something belongs to."""
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_ARMATURE, _FRICTION, _DAMPING = 0.01, 0.1, 0.03
"""Reflected inertia (s²), Coulomb friction (1) and damping (s) of a drive, as shares of its largest torque: at most
what the machines of `RECIPES` have."""
_SERVO = 3.0
"""Factor by which the stiffness of a servo may be off."""
_GUESS = 10.0
"""The same where the stiffness is a guess of `madoc init`."""
_KV = 0.1
"""Largest damping of a servo, as a share of its stiffness, s."""
FREE = 6
"""Degrees of freedom of a body that moves freely."""
_REACH = 10.0
"""rad/s² (of a slide m/s²) that a drive reaches at least, where the model does not say how strong it is."""
_WEAKEST = 0.2
"""Strength of the weakest drive of a robot as a share of the strongest's of its kind, where the model says of neither:
wrists carry little, and are driven by motors that are not as much smaller."""


@dataclass(frozen=True)
class Recipe:
    """Ranges of a hinge's drive, at the joint; None leaves what follows from the model.

    Attributes:
        about: The machines that the ranges are of, for the spec's comment.
        armature: Reflected inertia of the rotor, kg·m².
        friction: Coulomb friction, N·m.
        damping: Viscous friction, N·m·s/rad.
        kp: Stiffness of the position servo, N·m/rad.
        delay: From a command to its effect, s.
        means: What the log's action of a joint is that the model does not drive.
        limit: Torque limit of such a drive, N·m.
    """

    about: str
    armature: Ends | None = None
    friction: Ends | None = None
    damping: Ends | None = None
    kp: Ends | None = None
    delay: Ends | None = None
    means: str = "position"
    limit: float | None = None


_GEARMOTOR = Recipe(
    "Dynamixel XL330 and MX-64 (BAM)", (0.0005, 0.05), (0.0, 0.5), (0.0, 0.5), delay=(0.0, 0.02), means="torque"
)
RECIPES = {
    "hobby-servo": Recipe(
        "Feetech STS3215 and Dynamixel XL330 (BAM); kp of an STS3215 at 7.4 V is 0.556 times its firmware's P",
        (0.001, 0.05),
        (0.0, 0.6),  # 0.2 N·m, and a quarter of half of the largest torque, as friction grows with the load
        (0.0, 1.0),
        (4.0, 40.0),
        (0.0, 0.02),
        limit=3.25,
    ),
    "harmonic-arm": Recipe("eRob 80:50 (BAM), Franka's wrist", (0.05, 1.0), (0.0, 7.0), (0.0, 5.0), delay=(0.0, 0.01)),
    "direct-drive-leg": Recipe(
        "Unitree Go1, Go2 and G1, ANYmal (PACE)", (0.002, 0.1), (0.0, 1.0), (0.0, 1.0), delay=(0.0, 0.025)
    ),
    "dc-gearmotor": _GEARMOTOR,
    "wheeled": _GEARMOTOR,
    "drone": Recipe("none: mass, inertia and thrust within what a model's file is usually wrong by", delay=(0.0, 0.05)),
}
"""By name of the class. BAM is Rhoban/bam, PACE leggedrobotics/pace-sim2real; of Go1 and G1 the values are mjlab's, of
Go2 those of repeated identifications (iit-DLSLab/sim2real-robot-identification, issue 8)."""


@dataclass(frozen=True)
class Proposal:
    """A line of the spec's parameters: elements that share a value, its range, and whether it is worth calibrating."""

    field: str
    elements: tuple[str, ...]
    low: float
    high: float
    comment: str
    wanted: bool


def proposals(
    model: mujoco.MjModel, recipe: Recipe | None, kind: str, *, guessed: frozenset[str], step: float
) -> list[Proposal]:
    """The lines, those that matter most first, of a model that has the actuators that the spec adds.

    The recipe, whose name is `kind`, is that of a class of machines if the user named one; the stiffness of the
    `guessed` actuators is a guess; `step` is that of control, s.
    """
    joints = [joint for joint in element_names(model, "joint") if is_single(model, model.joint(joint).id)]
    servos = [actuator for actuator in element_names(model, "actuator") if is_servo(model, actuator)]
    driven = _driven(model, joints)
    chosen, drone, known = recipe or Recipe(""), kind == "drone", recipe is not None and kind != "drone"
    armature = _dissipation(model, "dof_armature", driven, chosen.armature, _ARMATURE, wanted=bool(servos) or known)
    friction = _dissipation(model, "dof_frictionloss", driven, chosen.friction, _FRICTION, wanted=bool(servos) or known)
    braking = [one for one in servos if nominal_values(model, Parameter("actuator_kv", one, 0.0, 1.0))[0] > 0.0]
    damped = [joint for joint in joints if model.joint(joint).damping[0] > 0.0 or joint in driven]
    damping = _dissipation(model, "dof_damping", damped, chosen.damping, _DAMPING, wanted=not braking and not drone)
    bases = [name for name in heavy_bodies(model) if _moves_freely(model, name)]
    limbs = [name for name in heavy_bodies(model) if name not in bases]
    light = drone or not (servos or known)
    masses = [*_scaled(model, "body_mass", bases, wanted=True), *_scaled(model, "body_mass", limbs, wanted=light)]
    springs = list(_scaled(model, "jnt_stiffness", joints, wanted=not drone))
    gains = list(_gains(model, servos, chosen.kp, guessed))
    brakes = list(_brakes(model, servos, wanted=bool(braking)))
    motors = [
        name
        for name in element_names(model, "actuator")
        if name not in servos and has_gain(model, model.actuator(name).id)
    ]
    thrust = list(_scaled(model, "actuator_gain", motors, wanted=drone))
    inertia = list(_scaled(model, "body_inertia", heavy_bodies(model), wanted=True)) if drone else []
    wheels = set(driven) if kind == "wheeled" else set()
    contacts = list(_contacts(model, wheels))
    late = chosen.delay or (0.0, max(0.02, step))
    delay = [Proposal("action_delay", (), *late, "s from an action to its effect", bool(servos) or known or drone)]
    if servos or known:
        fields = [armature, friction, gains, brakes, delay, damping, springs, masses, thrust, contacts]
    else:
        fields = [masses, inertia, springs, damping, thrust, friction, armature, contacts, delay]
    return _limited([list(field) for field in fields])


def rounded(value: float) -> float:
    """The value with two digits, which are enough for a range."""
    return float(np.format_float_positional(value, precision=2, fractional=False)) if value > 0 else value


def _limited(fields: list[list[Proposal]]) -> list[Proposal]:
    """All lines; those of a field that no longer fits whole are not wanted, unless there would be none."""
    found: list[Proposal] = []
    for lines in fields:
        fits = sum(line.wanted for line in found + lines) <= MOST or not any(line.wanted for line in found)
        found += [line if fits else replace(line, wanted=False) for line in lines]
    return found


def _moves_freely(model: mujoco.MjModel, body: str) -> bool:
    (index,) = find_elements(model, Parameter("body_mass", body, 0.0, 1.0))
    return bool(model.body_dofnum[index] == FREE)


def _driven(model: mujoco.MjModel, joints: list[str]) -> list[str]:
    """The joints that actuators drive; all where some act through tendons or sites."""
    if not model.nu or not np.isin(model.actuator_trntype, OF_A_JOINT).all():
        return joints
    return [joint for joint in joints if actuators_of(model, model.joint(joint).id)]


def _alike(
    names: Iterable[str], value: Callable[[str], object], coarse: Callable[[str], object] | None = None
) -> list[tuple[str, ...]]:
    """Elements by groups: those whose names differ by a side alone (`FL_hip`, `FR_hip`), and whose values do not.

    Where these are many, as of a hand, all of one `coarse` value are one group.
    """
    by_name: dict[object, list[str]] = {}
    by_value: dict[object, list[str]] = {}
    for name in names:
        words = [word.lower() for word in _WORDS.findall(name)]
        stem = tuple(word for word in words if word not in _SIDES)
        sided = stem and len(stem) < len(words)
        by_name.setdefault((stem, value(name)) if sided else name, []).append(name)
        by_value.setdefault(name if coarse is None else coarse(name), []).append(name)
    return [tuple(group) for group in (by_value if coarse and len(by_name) > _MANY else by_name).values()]


def _of_joint(model: mujoco.MjModel, joint: str) -> tuple[object, ...]:
    """What joints have in common that share their values."""
    index, dof = model.joint(joint).id, model.joint(joint).dofadr[0]
    held = (model.dof_armature[dof], model.dof_damping[dof], model.dof_frictionloss[dof], model.jnt_stiffness[index])
    return (int(model.jnt_type[index]), *(f"{number:.3g}" for number in held))


def _dissipation(
    model: mujoco.MjModel, field: str, joints: list[str], ends: Ends | None, share: float, *, wanted: bool
) -> Iterator[Proposal]:
    """A field of joints from 0 up, by the recipe or by a share of the drive's torque; the model's value is inside."""
    strong = strengths(model)

    def coarse(joint: str) -> tuple[object, ...]:
        return (*_of_joint(model, joint), round(math.log2(strong[joint][0] or 1.0)))

    for group in _alike(joints, lambda joint: _of_joint(model, joint), coarse):
        (value,) = nominal_values(model, Parameter(field, group[0], 0.0, 1.0))
        usual = share * max(strong[joint][0] for joint in group)
        if field == "dof_armature" and not strong[group[0]][1]:
            usual = max(usual, *(float(model.dof_M0[model.joint(joint).dofadr[0]]) for joint in group), 0.0)
        low, high = ends if ends and not is_slide(model, model.joint(group[0]).id) else (0.0, usual)
        low, high = min(low, rounded(value / 2)), max(high, 2 * value)
        unit = element_unit(model, field, group[0]) or FIELDS[field].unit
        yield Proposal(field, group, low, rounded(high), f"{unit}; the model has {value:.4g}", wanted)


def _scaled(model: mujoco.MjModel, field: str, names: Iterable[str], *, wanted: bool) -> Iterator[Proposal]:
    """A field of elements where the model's value is above 0, from half of it to twice."""
    values = {name: nominal_values(model, Parameter(field, name, 0.0, 1.0))[0] for name in names}
    units = {name: _unit(model, field, name) for name in values}
    about = {name: (f"{values[name]:.2g}", units[name]) for name in values}
    for group in _alike(values, about.__getitem__, None if FIELDS[field].element == "body" else about.__getitem__):
        if (value := values[group[0]]) > 0:
            unit = "" if units[group[0]] == "1" else f"{units[group[0]]}; "
            unit = "sliding, in contacts; " if field == "geom_friction" else unit
            yield Proposal(
                field, group, rounded(value / 2), rounded(value * 2), f"{unit}the model has {value:.4g}", wanted
            )


def _unit(model: mujoco.MjModel, field: str, element: str) -> str:
    """The unit of a field of an element; elements of different units share no value."""
    if field == "actuator_gain":
        return gain_unit(model, int(model.actuator(element).id)) or FIELDS[field].unit
    return element_unit(model, field, element) or FIELDS[field].unit


def _gains(model: mujoco.MjModel, servos: list[str], ends: Ends | None, guessed: frozenset[str]) -> Iterator[Proposal]:
    """Stiffness of servos; the ranges of a recipe are made wide enough for the model's."""
    values = {one: (float(model.actuator(one).gainprm[0]), _unit(model, "actuator_gain", one)) for one in servos}
    for group in _alike(servos, values.__getitem__, values.__getitem__):
        value, unit = values[group[0]]
        factor = _GUESS if group[0] in guessed else _SERVO
        low, high = (value / factor, value * factor) if ends is None else (min(ends[0], value), max(ends[1], value))
        yield Proposal(
            "actuator_gain", group, rounded(low), rounded(high), f"kp, {unit}; the model has {value:.4g}", True
        )


def _brakes(model: mujoco.MjModel, servos: list[str], *, wanted: bool) -> Iterator[Proposal]:
    """Damping of servos; where no servo has any, that of the joints stands for it."""
    values = {
        one: (
            float(0.0 - model.actuator(one).biasprm[2]),
            float(model.actuator(one).gainprm[0]),
            _unit(model, "actuator_kv", one),
        )
        for one in servos
    }
    for group in _alike(servos, values.__getitem__, values.__getitem__):
        value, kp, _ = values[group[0]]
        high = rounded(max(_SERVO * value, _KV * kp))
        yield Proposal("actuator_kv", group, 0.0, high, f"kv; the model has {value:.4g}", wanted)


def _contacts(model: mujoco.MjModel, wheels: set[str]) -> Iterator[Proposal]:
    """Friction of geoms that can touch; that of wheels is wanted."""
    geoms = [model.geom(name) for name in element_names(model, "geom")]
    touching = [geom for geom in geoms if geom.contype[0] or geom.conaffinity[0]]
    bodies = {int(model.joint(wheel).bodyid[0]) for wheel in wheels}
    rolling = [geom.name for geom in touching if int(geom.bodyid[0]) in bodies]
    others = [geom.name for geom in touching if geom.name not in rolling]
    yield from _scaled(model, "geom_friction", rolling, wanted=True)
    yield from _scaled(model, "geom_friction", others, wanted=False)


def is_servo(model: mujoco.MjModel, actuator: str) -> bool:
    """Whether an actuator holds a position: it pulls with a gain times the difference to its command."""
    index = model.actuator(actuator).id
    gain = float(model.actuator_gainprm[index, 0])
    return has_gain(model, index) and gain > 0.0 and float(model.actuator_biasprm[index, 1]) == -gain


def actuators_of(model: mujoco.MjModel, joint: int) -> list[int]:
    """The actuators that act on a joint."""
    on_joint = np.isin(model.actuator_trntype, OF_A_JOINT) & (model.actuator_trnid[:, 0] == joint)
    return [int(actuator) for actuator in np.flatnonzero(on_joint)]


def strengths(model: mujoco.MjModel) -> dict[str, tuple[float, bool]]:
    """By hinge and slide, the largest torque or force of its drive, N·m or N, and whether the model says it.

    Where it does not, that which holds what hangs on the joint and accelerates it.
    """
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    joints = [(joint.name, int(joint.id), hinge) for joint, hinge in single_joints(model)]
    needed = {name: _needed(model, data, index) for name, index, _ in joints}
    found = {}
    for name, index, hinge in joints:
        largest = max(needed[other] for other, _, alike in joints if alike == hinge)
        limit = _limit(model, index)
        found[name] = (limit, True) if limit else (max(needed[name], _WEAKEST * largest), False)
    return found


def _limit(model: mujoco.MjModel, joint: int) -> float:
    """The limit that the model gives a joint's drive; 0 where it gives none."""
    limits = [abs(model.jnt_actfrcrange[joint]).max()] if model.jnt_actfrclimited[joint] else []
    for actuator in actuators_of(model, joint):
        gear = abs(float(model.actuator_gear[actuator, 0]))
        if model.actuator_forcelimited[actuator]:
            limits.append(gear * abs(model.actuator_forcerange[actuator]).max())
        elif model.actuator_ctrllimited[actuator] and not model.actuator_biasprm[actuator].any():
            limits.append(gear * abs(model.actuator_gainprm[actuator, 0] * model.actuator_ctrlrange[actuator]).max())
    return min((float(limit) for limit in limits if limit > 0.0), default=0.0)


def _needed(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> float:
    """Torque or force that holds and accelerates what hangs on a joint; the legs of a free body carry all of it."""
    body = int(model.jnt_bodyid[joint])
    root = int(model.body_rootid[body])
    carried = root if model.body_dofnum[root] == FREE else body
    weight = float(model.body_subtreemass[carried]) * float(np.linalg.norm(model.opt.gravity))
    lever = 1.0 if is_slide(model, joint) else float(np.linalg.norm(data.subtree_com[body] - data.xanchor[joint]))
    return max(weight * lever, _REACH * float(model.dof_M0[model.jnt_dofadr[joint]]))
