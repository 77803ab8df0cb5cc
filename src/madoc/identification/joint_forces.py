"""Forces at a joint that no parameter of a spec adds: what each stands for, and its effect on simulated windows.

Each is a function of the joint's position, its speed and what its drive exerts, or of another joint's motion. To first
order the motion under a small force is that under its values along the motion without it. During a control step a force
has its value at the start of that.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from madoc.identification.body_forces import free_bodies, of_all_drives, on_body
from madoc.identification.candidate_terms import Candidate, references_of
from madoc.identification.causes import (
    BENT,
    BUILT_UP,
    CONSTANT,
    COUPLED,
    DEAD_ZONE,
    FORCES,
    LOADED,
    PLACED,
    RIPPLE,
    SLOW,
    UNEVEN,
    WEAKENING,
)
from madoc.identification.responses import Responses
from madoc.identification.states import LoggedStates
from madoc.simulation.base import Simulator
from madoc.simulation.write import single_joints

RESISTING = (LOADED, SLOW)
"""Those that take energy out, so that no machine has a value below 0."""
USUAL = 5
"""Number of `FORCES` that are tried at every joint; the others only at robots of few joints."""
FEW_JOINTS = 4
"""Largest number of joints of such a robot."""
TURNING = 0.1
"""Speed relative to the joint's root mean square, at which friction has turned to the direction of motion."""
LOW_SPEED = 0.3
"""The same, below which friction at low speed acts (Stribeck)."""
BUILD_UP = (0.03, 0.2, 0.5, 1.2)
"""Distances relative to the standard deviation of the joint's position, over which friction builds up (Dahl).

Over the first it is nearly Coulomb friction, and what it lacks of that is the shape. A model without Coulomb friction
imitates friction over the others by damping and a spring: these are the shape as a whole.
"""
SMALL_COMMAND = 0.1
"""Force of a drive relative to its root mean square, beyond which it is out of a dead zone."""
_SMALLEST = 1e-9
"""Root mean square of a speed or a force below which a joint or its drive does nothing."""


def joint_forces(
    position: Float[np.ndarray, "windows steps"],
    speed: Float[np.ndarray, "windows steps"],
    exerted: Float[np.ndarray, "windows steps"],
    others: Sequence[tuple[Float[np.ndarray, "windows steps"], Float[np.ndarray, "windows steps"]]] = (),
    *,
    turns: bool,
    earlier: Float[np.ndarray, "windows earlier"] | None = None,
) -> dict[str, list[Float[np.ndarray, "windows steps"]]]:
    """Each of `FORCES` along the motion of a joint, of about 1 in size, as one function of time or more.

    Values that are not finite are those of windows that do not count.

    Args:
        position: Of the joint, in rad or m.
        speed: Of the joint.
        exerted: What its drive exerts.
        others: Positions and speeds of other joints.
        turns: Whether it is a hinge: what depends on its position then repeats with every turn.
        earlier: Logged positions before each window, which say how far friction has built up when it begins; such
            friction is left out where there are none, and begins with each window by default.
    """
    fast, strong = (float(np.sqrt(np.nanmean(values**2))) for values in (speed, exerted))
    moves, drives = fast > _SMALLEST, strong > _SMALLEST
    direction, drive = np.tanh(speed / (TURNING * max(fast, _SMALLEST))), exerted / max(strong, _SMALLEST)
    places = [np.sin(position), np.cos(position)]
    finer = [np.sin(2.0 * position), np.cos(2.0 * position)]
    if not turns:
        along = _standardised(position)
        places, finer = [along, along**2], [along**3]
    found = {CONSTANT: [np.ones_like(speed)]}
    if drives:
        found |= {DEAD_ZONE: [-np.tanh(drive / SMALL_COMMAND)], BENT: [-drive * np.abs(drive)]}
    if moves and drives:
        found |= {LOADED: [-direction * np.abs(drive)], WEAKENING: [-drive * np.abs(speed) / fast]}
    if moves:
        found |= {SLOW: [-direction * np.exp(-((speed / (LOW_SPEED * fast)) ** 2))]}
        found |= {UNEVEN: [-direction * place for place in places], PLACED: [*places, *finer]}
    if moves and (earlier is None or earlier.shape[1]):
        spread = max(float(np.nanstd(position)), _SMALLEST)
        lacking = direction * np.exp(-_since_reversal(position / spread, speed) / BUILD_UP[0])
        way = position if earlier is None else np.concatenate([earlier, position], axis=1)
        shares = (_built_up(way / (spread * distance))[:, -position.shape[1] :] for distance in BUILD_UP[1:])
        found |= {BUILT_UP: [lacking, *(-share for share in shares)]}
    if moves and drives:
        found |= {RIPPLE: [drive * place for place in places]}
    coupled = [_standardised(each) for other in others for each in other if np.nanstd(each) > _SMALLEST]
    return found | ({COUPLED: coupled} if coupled else {})


def _since_reversal(
    position: Float[np.ndarray, "windows steps"], speed: Float[np.ndarray, "windows steps"]
) -> Float[np.ndarray, "windows steps"]:
    """Distance that a joint has moved since its direction was another; infinite before the first such time."""
    moved = np.abs(np.diff(position, axis=1, prepend=position[:, :1]))
    path = np.cumsum(moved, axis=1)
    reversed_ = np.sign(speed) != np.sign(np.concatenate([speed[:, :1], speed[:, :-1]], axis=1))
    return path - np.maximum.accumulate(np.where(reversed_, path, -np.inf), axis=1)


def _built_up(way: Float[np.ndarray, "windows steps"]) -> Float[np.ndarray, "windows steps"]:
    """Share of its full size to which friction has built up along positions in units of its distance, from 0 on.

    It is the solution of Dahl's (1968) dF/dx = 1 - F sign(dx/dt) for motion of one direction between two steps.
    """
    moved = np.diff(way, axis=1)
    share = np.zeros_like(way)
    for step, (end, kept) in enumerate(zip(np.sign(moved.T), np.exp(-np.abs(moved.T)), strict=True)):
        share[:, step + 1] = end + (share[:, step] - end) * kept
    return share


def _standardised(values: Float[np.ndarray, "windows steps"]) -> Float[np.ndarray, "windows steps"]:
    """The values less their mean, over their standard deviation."""
    return (values - np.nanmean(values)) / max(float(np.nanstd(values)), _SMALLEST)


def force_effects(
    simulator: Simulator,
    logged: LoggedStates,
    responses: Responses,
    earlier: Float[np.ndarray, "windows earlier state"],
) -> tuple[list[Candidate], Float[np.ndarray, "windows values terms"]]:
    """Every listed force at joints and free bodies and of all drives, and the residuals' derivatives by it.

    These are in its reference. `earlier` are logged states before each window.
    """
    model, joints = simulator.task.model, single_joints(simulator.task.model)
    tried, forces = list[Candidate](), list[np.ndarray]()
    few, exerted = model.njnt <= FEW_JOINTS, responses.drives.sum(2)
    motion, causes = responses.motion, FORCES if few else FORCES[:USUAL]
    along = [(motion[..., int(each.qposadr[0])], motion[..., model.nq + int(each.dofadr[0])]) for each, _ in joints]
    for place, (joint, turns) in enumerate(joints):
        dof, size = int(joint.dofadr[0]), references_of(logged, simulator, joint)["dof_frictionloss"]
        others = [*along[:place], *along[place + 1 :]] if few else []
        came_from = earlier[..., int(joint.qposadr[0])]
        found = joint_forces(*along[place], exerted[..., dof], others, turns=turns, earlier=came_from)
        for cause, shape in ((each, shape) for each in causes for shape in found.get(each, [])):
            least, plausible = 0.0 if cause == DEAD_ZONE else -np.inf, (0.0 if cause in RESISTING else -np.inf, np.inf)
            named, unit = f"{cause} ({joint.name})", "N·m" if turns else "N"
            tried.append(Candidate(named, "", unit, 0.0, size, least, known_before=True, plausible=plausible))
            forces.append(size * shape[..., None] * (np.arange(model.nv) == dof))
    speed = motion[..., model.nq : model.nq + model.nv]
    bodies = list(free_bodies(simulator, responses))
    if (np.nan_to_num(responses.drives) != 0.0).any((0, 1, 3)).sum() > 1:
        height = bodies[0].height if len(bodies) == 1 else None
        for cause, force in of_all_drives(responses.drives, speed, height).items():
            tried.append(Candidate(cause, "", "of what they exert", 0.0, 1.0, -np.inf, known_before=True))
            forces.append(force)
    for body in bodies:
        for cause, pull, torque in on_body(body):
            size, unit = (body.typical_torque, "N·m") if torque.any() else (body.typical_force, "N")
            tried.append(Candidate(f"{cause} ({body.name})", "", unit, 0.0, size, -np.inf, known_before=True))
            forces.append(size * body.generalised(pull, torque, model.nv))
    return tried, responses.effects(np.stack(forces, axis=-1) if forces else np.zeros((*exerted.shape, 0)))
