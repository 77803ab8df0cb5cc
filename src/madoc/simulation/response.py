"""How a model answers: which joint an action drives, how much, at what scale, and which parameters change nothing."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from madoc.errors import MadocError
from madoc.parameters import Parameter
from madoc.simulation.base import Simulator
from madoc.simulation.cpu import without_warnings
from madoc.simulation.joints import scale_forces
from madoc.simulation.write import OF_A_JOINT, ONE_DOF, single_joints
from madoc.types import generator

_PUSH = 1e-3
"""Half the difference of an action, in [-1, 1], by which the response of a joint is computed."""
_SCALE = 1.25
"""Factor on masses and forces, or on positions."""
_SAME = 1e-3
"""Difference of two next states relative to the largest change; up to it they are equal but for the solver's error."""
_FORCES = (
    "body_mass",
    "body_inertia",
    "dof_damping",
    "dof_dampingpoly",
    "dof_armature",
    "dof_frictionloss",
    "jnt_stiffness",
    "jnt_actfrcrange",
    "jnt_stiffnesspoly",
    "tendon_stiffness",
    "tendon_stiffnesspoly",
    "tendon_damping",
    "tendon_dampingpoly",
    "tendon_frictionloss",
    "tendon_armature",
    "tendon_actfrcrange",
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_forcerange",
    "actuator_damping",
    "actuator_dampingpoly",
    "actuator_armature",
)
"""Arrays of a model whose numbers are masses, forces or torques, or in proportion to them."""

ROWS = (64, 512, 4096)
"""Number of logged rows in which a parameter is tried, one after the other as long as it changes nothing: contacts may
be rare."""


@dataclass(frozen=True)
class DrivenJoint:
    """A hinge or slide that an action drives by an actuator of its own, with the places of its values in a state."""

    action: int
    joint: str
    hinge: bool
    position: int
    velocity: int


def driven_joints(simulator: Simulator) -> tuple[DrivenJoint, ...]:
    """The joints that actions drive directly, in the order of the actions; none for tendons, sites and free bodies."""
    model = simulator.task.model
    channels = simulator.task.actions
    actuators = [model.actuator(channel.actuator).id for channel in channels] or range(simulator.action_size)
    found = []
    for action, actuator in enumerate(actuators):
        joint = int(model.actuator_trnid[actuator, 0])
        if channels and not channels[action].command:
            continue
        if int(model.actuator_trntype[actuator]) in OF_A_JOINT and int(model.jnt_type[joint]) in ONE_DOF:
            hinge = bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE)
            found.append(DrivenJoint(action, model.joint(joint).name, hinge, *_place(model, joint)))
    return tuple(found)


def places_of_joints(simulator: Simulator) -> dict[str, tuple[int, int]]:
    """Indices in a state of the position and of the velocity of every hinge and slide that has a name, by the name."""
    model = simulator.task.model
    return {joint.name: _place(model, joint.id) for joint, _ in single_joints(model)}


def _place(model: mujoco.MjModel, joint: int) -> tuple[int, int]:
    return int(model.jnt_qposadr[joint]), int(model.nq + model.jnt_dofadr[joint])


def responses(
    simulator: Simulator,
    states: Float[np.ndarray, "rows state"],
    actions: Float[np.ndarray, "rows action"],
    points: Float[np.ndarray, "points d"],
    joints: tuple[DrivenJoint, ...],
) -> Float[np.ndarray, "points joints"]:
    """Change of each joint's velocity in a control step from rest, over that of its action.

    The action is held since long before, so that a delay does not count, and the velocities of the states are not used.
    It is the mean over the rows whose simulation succeeds at a point, NaN where there are none. Spends
    points · (2 · joints) · rows control steps.
    """
    system = simulator.bind(simulator.parameters.to_physical(points))
    first, model = len(simulator.initial_state) - simulator.task.pending * simulator.action_size, simulator.task.model
    found = []
    for joint in joints:
        ends = []
        for side in (-_PUSH, _PUSH):
            state, action = states.copy(), actions.copy()
            state[:, model.nq : first] = 0.0
            state[:, first + joint.action :: simulator.action_size] += side  # the pending actions
            action[:, joint.action] += side
            batch = (
                np.ascontiguousarray(np.broadcast_to(each, (len(points), *each.shape))) for each in (state, action)
            )
            ends.append(system.step(*batch)[..., joint.velocity])
        slopes = (ends[1] - ends[0]) / (2.0 * _PUSH)
        count = np.isfinite(slopes).sum(-1)
        found.append(np.where(count > 0, np.nansum(slopes, axis=-1) / np.maximum(count, 1), np.nan))
    return np.stack(found, axis=-1)


def mass_like(parameter: Parameter) -> bool:
    """Whether a value is a mass, an inertia, a force or a torque, or in proportion to one: kg or N is in its unit."""
    return parameter.field == "actuator_gain" or any(
        unit in (parameter.kind.unit or parameter.unit) for unit in ("kg", "N")
    )


def hidden_scales(
    simulator: Simulator,
    values: Float[np.ndarray, " d"],
    states: Float[np.ndarray, "rows state"],
    actions: Float[np.ndarray, "rows action"],
) -> tuple[bool, bool]:
    """Whether all masses and forces, and whether all positions and actions, can be scaled alike without a trace.

    Each state is stepped by the model at the given values, by one whose masses and forces are scaled, and by the first
    from scaled positions, velocities and controls. As this is a property of the model, actions in [-1, 1] stand for the
    controls. What the spec's sensors read is compared too, so that one of force or acceleration counts.
    """
    model, heavier = simulator.model(values), simulator.model(values)
    for name in _FORCES:
        getattr(heavier, name)[:] *= _SCALE
    scale_forces(heavier, _SCALE)
    heavier.opt.density *= _SCALE
    heavier.opt.viscosity *= _SCALE
    mujoco.mj_setConst(heavier, mujoco.MjData(heavier))
    start = states[:, : model.nq + model.nv]
    plain = _stepped(simulator, model, start, actions)
    resolution = _SAME * np.abs(plain[:, : start.shape[1]] - start).max()
    by_mass = np.abs(_stepped(simulator, heavier, start, actions) - plain).max()
    by_length = np.abs(_stepped(simulator, model, _SCALE * start, _SCALE * actions) - _SCALE * plain).max()
    return bool(by_mass <= resolution), bool(by_length <= resolution)


def _stepped(
    simulator: Simulator,
    model: mujoco.MjModel,
    states: Float[np.ndarray, "rows physical"],
    controls: Float[np.ndarray, "rows action"],
) -> Float[np.ndarray, "rows seen"]:
    """States after a control step of a model, with its sensors where signals read them."""
    task, data = simulator.task, mujoco.MjData(model)
    driven = [model.actuator(channel.actuator).id for channel in task.actions] or slice(None)
    inputs = [not channel.command for channel in task.actions]
    if any(inputs):
        middle, half = task.action_ranges
        rest = middle + half * [channel.rest for channel in task.actions]
        controls = np.where(inputs, rest, controls)
    seen = []
    with without_warnings():
        for state, control in zip(states, controls, strict=True):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = np.split(state, [model.nq])
            data.ctrl[driven] = control
            mujoco.mj_step(model, data, nstep=task.frame_skip)
            seen.append(np.concatenate([data.qpos, data.qvel, data.sensordata if task.sense else []]))
    return np.stack(seen)


def insensitive(
    simulator: Simulator,
    states: Float[np.ndarray, "logged state"],
    actions: Float[np.ndarray, "logged action"],
    *,
    key: PRNGKeyArray,
) -> list[str]:
    """The names of parameters that change no bit of any next state or observation at either end of their range.

    All other parameters stay at mid-range. At most the last of `ROWS` logged rows are drawn without repetition, and a
    row counts only where both simulations succeeded. No rows, or rows that all fail at mid-range, are refused.
    """
    if not len(states):
        raise MadocError("expected at least one logged state to test the parameters at, got none")
    order = generator(key).permutation(len(states))
    left, before = list(range(len(simulator.parameters))), 0
    for rows in ROWS:
        chosen, before = order[before:rows], rows
        if not left or not len(chosen):
            break
        changed = _changed(simulator, states[chosen], actions[chosen], left)
        left = [index for index, felt in zip(left, changed, strict=True) if not felt]
    return [simulator.parameters.names[index] for index in left]


def _changed(
    simulator: Simulator,
    states: Float[np.ndarray, "rows state"],
    actions: Float[np.ndarray, "rows action"],
    tried: list[int],
) -> Bool[np.ndarray, " tried"]:
    """Whether each of these parameters changes a next state or an observation in any of the rows."""
    space = simulator.parameters
    # Mid-range, then each parameter in turn at its low and at its high end.
    moves = np.kron(np.eye(len(space))[tried], [[-1.0], [1.0]])
    ends = space.to_physical(np.vstack([np.zeros(len(space)), moves]))
    state, action = (np.repeat(logged[None], len(ends), axis=0) for logged in (states, actions))
    system = simulator.bind(ends)
    next_states = system.step(system.unbiased(state), action)
    following = np.concatenate([next_states, system.observe(next_states)], axis=-1)
    middle, moved = following[0], following[1:]
    if not np.isfinite(middle).all(-1).any():
        raise MadocError(
            f"{simulator.task.name}: the simulation fails in all {len(states)} rows at mid-range parameters; "
            "check the ranges and the states"
        )
    comparable = np.isfinite(moved).all(-1) & np.isfinite(middle).all(-1)
    felt: Bool[np.ndarray, " tried"] = ((moved != middle).any(-1) & comparable).any(-1).reshape(-1, 2).any(-1)
    return felt


def refuse_insensitive(
    simulator: Simulator,
    states: Float[np.ndarray, "logged state"],
    actions: Float[np.ndarray, "logged action"],
    *,
    key: PRNGKeyArray,
) -> None:
    """Check that every parameter changes some next state.

    Raises:
        MadocError: A parameter changes none, so no method could calibrate it.
    """
    names = insensitive(simulator, states, actions, key=key)
    if names:
        what = f"parameter {names[0]} changes" if len(names) == 1 else f"parameters {', '.join(names)} change"
        remedy = "remove it or widen its range" if len(names) == 1 else "remove them or widen their ranges"
        raise MadocError(f"{what} no next state in {min(ROWS[-1], len(states)):,} logged rows; {remedy}")
