"""From a spec and a model to a task."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import mujoco
import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.errors import MadocError
from madoc.parameters import FIELDS, Parameter, ParameterSpace
from madoc.robots.document import Document
from madoc.robots.expressions import Expression, ExpressionError, Read, parse
from madoc.robots.model import AddedActuator, ModelFiles, compiled, make_model, names_of
from madoc.robots.sensing import Layout, Signals, quiet_arithmetic
from madoc.robots.spec import ActionSpec, ParameterSpec, RobotSpec
from madoc.simulation.cpu import CpuSimulator
from madoc.simulation.write import find_elements
from madoc.tasks.base import ActionChannel, Batch, Task

SCALES: dict[str, float] = {
    **dict.fromkeys(("deg", "deg/s", "°", "°/s"), np.pi / 180.0),
    **dict.fromkeys(("mm", "mm/s", "mN·m", "mNm", "N·mm", "Nmm", "mN"), 1e-3),
    **dict.fromkeys(("cm", "cm/s"), 1e-2),
    **dict.fromkeys(("km/h",), 1.0 / 3.6),
}
"""Units that are not SI's, in SI's."""

SLIDE_UNITS = {
    "dof_damping": "N·s/m",
    "dof_armature": "kg",
    "dof_frictionloss": "N",
    "jnt_stiffness": "N/m",
}
"""Of the fields of a joint, where it is a slide."""


@dataclass(frozen=True)
class Signal:
    """One value of an observation: its name, its unit, and the expression it is."""

    name: str
    unit: str
    reads: str


@dataclass(frozen=True)
class Parts:
    """A task and what it was made of, for people to look at."""

    task: Task
    signals: tuple[Signal, ...]
    undetermined: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Maker:
    """A spec with its lines, and the model as it is in its file."""

    spec: RobotSpec
    document: Document
    files: ModelFiles
    base: mujoco.MjSpec
    plain: mujoco.MjModel


def make_task(spec: RobotSpec, document: Document, files: ModelFiles, source: dict[str, Any]) -> Parts:
    """The task that a spec describes.

    Raises:
        MadocError: Spec and model do not fit; the sentence names the line of the spec.
    """
    try:
        base = files.spec()
        maker = _Maker(spec, document, files, base, compiled(base.copy(), files.main))
    except MadocError as error:
        raise document.error(("model",), str(error)) from error
    _check_names(maker)
    added = tuple(found for found in map(partial(_added, maker), range(len(spec.actions))) if found is not None)
    factory = partial(make_model, base, added, spec.timestep)
    try:
        model = compiled(factory(), files.main)
    except MadocError as error:
        raise document.error(("actions",), str(error)) from error
    signals = _signals(maker, model)
    actions = tuple(_channel(maker, model, index) for index in range(len(spec.actions)))
    space, frame_skip = _space(maker, model), _frame_skip(maker, model)
    delays = [row.high for row in space.parameters if row.field == "action_delay"]
    pending = max([int(np.ceil(high / spec.control_step - 1e-9)) for high in delays], default=0)
    if signals.read_sensors & signals.layout.accelerating:
        pending = max(pending, 1)  # such a sensor shows the force of the last action
    names = tuple(signal.name for signal in spec.signals)
    task = Task(
        name=spec.name,
        physics="modern",
        spec=factory,
        frame_skip=frame_skip,
        observation_size=len(names),
        observe=partial(_needs_a_system, spec.name) if signals.read_sensors else signals.observe,
        reward=_reward(maker, signals, actions),
        terminated=_never,
        reset_noise=partial(_no_noise, size=model.nq + model.nv + pending * len(actions)),
        parameters=space,
        ranges={"normal": space},
        groups=spec.groups or min(4, len(space)),
        max_episode_steps=spec.max_episode_steps,
        reference_returns=(0.0, 100.0),
        state_from_observation=signals.rebuild(),
        pending=pending,
        actions=actions,
        signals=names,
        sense=signals.sense if signals.read_sensors else None,
        rewarded=spec.reward is not None,
        source=source,
    )
    try:
        CpuSimulator(task, threads=1)
    except MadocError as error:
        raise document.error(("model",), str(error)) from error
    shown = tuple(
        Signal(given.name, _signal_unit(maker, expression, index), expression.text)
        for index, (given, expression) in enumerate(zip(spec.signals, signals.expressions, strict=True))
    )
    return Parts(task, shown, signals.undetermined(), _idle_actuators(model, actions))


def _check_names(maker: _Maker) -> None:
    """No two signals or actions of one name, and no log column for something that is not there."""
    names: dict[str, tuple[str, int]] = {}
    for kind in ("signals", "actions"):
        for index, part in enumerate(getattr(maker.spec, kind)):
            place = (kind, index, "name")
            if part.name in names:
                line = maker.document.line((*names[part.name], "name"))
                raise maker.document.error(place, f"the name {part.name!r} is taken by line {line}; choose another")
            names[part.name] = (kind, index)
    for name in maker.spec.log.columns:
        if name not in names:
            raise maker.document.unknown(("log", "columns", name), "the name of a signal or an action", name, names)


def _frame_skip(maker: _Maker, model: mujoco.MjModel) -> int:
    """Physics steps of a control step."""
    timestep, wanted = float(model.opt.timestep), maker.spec.control_step
    steps = round(wanted / timestep)
    if steps < 1 or abs(steps * timestep - wanted) > 1e-6 * wanted:
        near = max(1, steps) * timestep
        raise maker.document.error(
            ("control_step",),
            f"expected control_step as a whole multiple of the timestep {timestep:g} s, got {wanted:g} s; "
            f"nearest: {near:g}, or give a timestep: that divides it",
        )
    return steps


def _joint(maker: _Maker, index: int) -> int:
    """The joint that an action names; a hinge or a slide."""
    action, joints = maker.spec.actions[index], names_of(maker.plain, mujoco.mjtObj.mjOBJ_JOINT, maker.plain.njnt)
    place = ("actions", index, "joint")
    if action.joint not in joints:
        raise maker.document.unknown(place, "the name of a joint", str(action.joint), joints)
    joint = int(maker.plain.joint(action.joint).id)
    if maker.plain.jnt_type[joint] not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
        raise maker.document.error(place, f"expected a hinge or a slide, got {action.joint!r}, which is a ball or free")
    return joint


def _added(maker: _Maker, index: int) -> AddedActuator | None:
    """The actuator that an action needs; None where it names one of the model's."""
    action, model, document = maker.spec.actions[index], maker.plain, maker.document
    actuators = names_of(model, mujoco.mjtObj.mjOBJ_ACTUATOR, model.nu)
    if action.joint is None:
        if action.actuator not in actuators:
            place = ("actions", index, "actuator")
            raise document.unknown(place, "the name of an actuator", str(action.actuator), actuators)
        return None
    joint = _joint(maker, index)
    slide = _is_slide(model, joint)
    if action.means == ("torque" if slide else "force"):
        right, kind = ("force", "slide") if slide else ("torque", "hinge")
        raise document.error(("actions", index, "means"), f"expected means: {right} of the {kind} {action.joint!r}")
    if action.name in actuators:
        raise document.error(
            ("actions", index, "name"),
            f"the model has an actuator {action.name!r}; drive it with actuator: {action.name}, or choose another name",
        )
    for actuator in range(model.nu):
        drives = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_trnid[actuator, 0]
        if drives is not False and drives == joint and model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT:
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, actuator) or "without a name"
            raise document.error(
                ("actions", index, "joint"),
                f"the joint {action.joint!r} has an actuator {name!r} in the model; drive that with actuator: {name}, "
                "or take it out of the model",
            )
    others = [row.joint for row in maker.spec.actions[:index]]
    if action.joint in others:
        first = document.line(("actions", others.index(action.joint), "joint"))
        raise document.error(
            ("actions", index, "joint"), f"the joint {action.joint!r} is driven by line {first} already"
        )
    if action.means in ("torque", "force"):
        return AddedActuator(action.name, action.joint)
    gain = action.kp if action.means == "position" else action.kd
    assert gain is not None  # the spec has seen to it
    return AddedActuator(
        action.name, action.joint, gain, stiffness=action.kp or 0.0, damping=action.kd or 0.0, limit=action.limit
    )


def _channel(maker: _Maker, model: mujoco.MjModel, index: int) -> ActionChannel:
    """What an action's values mean to its actuator."""
    action = maker.spec.actions[index]
    name = action.actuator or action.name
    actuator = int(model.actuator(name).id)
    low, high = action.low, action.high
    if low is None or high is None:
        if not model.actuator_ctrllimited[actuator]:
            raise maker.document.error(
                ("actions", index), f"expected low: and high:, as the actuator {name!r} has no ctrlrange in the model"
            )
        low, high = (float(end) for end in model.actuator_ctrlrange[actuator])
    first = [row.actuator for row in maker.spec.actions[:index]]
    if action.actuator is not None and action.actuator in first:
        line = maker.document.line(("actions", first.index(action.actuator), "actuator"))
        raise maker.document.error(
            ("actions", index, "actuator"), f"the actuator {name!r} is driven by line {line} already"
        )
    unit = action.unit or _action_unit(action, model, actuator)
    scale = SCALES.get(unit, 1.0)
    gain, stiffness = model.actuator_gainprm[actuator, 0], -model.actuator_biasprm[actuator, 1]
    length = model.actuator_length0[actuator] if gain else 0.0
    held = length * stiffness / gain / scale if gain and stiffness else 0.0
    rest = float(np.clip((held - (low + high) / 2.0) / ((high - low) / 2.0), -1.0, 1.0))
    return ActionChannel(action.name, name, low, high, unit, scale, rest)


def _action_unit(action: ActionSpec, model: mujoco.MjModel, actuator: int) -> str:
    """The unit of a channel that names none: SI's, where the joint tells."""
    if action.joint is None:
        return ""
    slide = _is_slide(model, int(model.actuator_trnid[actuator, 0]))
    units = {
        "torque": "N·m",
        "force": "N",
        "position": "m" if slide else "rad",
        "velocity": "m/s" if slide else "rad/s",
    }
    return units[str(action.means)]


def _signals(maker: _Maker, model: mujoco.MjModel) -> Signals:
    """What is observed, tried once at the model's initial state."""
    expressions = []
    layout = Layout.of(model)
    for index, signal in enumerate(maker.spec.signals):
        place = ("signals", index, "reads")
        try:
            expression = parse(signal.reads)
            for read in expression.reads:
                layout.address(read)
            with quiet_arithmetic():
                expression.value(lambda _: np.zeros(1), np)
                expression.affine()
        except ExpressionError as error:
            raise maker.document.error(place, str(error)) from error
        except ArithmeticError as error:
            raise maker.document.error(place, f"expected an expression with a value, got {signal.reads!r}") from error
        expressions.append(expression)
        _check_unit(maker, model, index, expression)
    return Signals(tuple(expressions), layout)


def _plain_unit(maker: _Maker, expression: Expression) -> str:
    """The SI unit of an expression that is one joint's position or speed as it is; else empty."""
    affine = expression.affine()
    if affine is None or len(affine[0]) != 1:
        return ""
    ((read, weight),) = affine[0].items()
    if read.kind == "sensor" or weight != 1.0:
        return ""
    slide = maker.plain.jnt_type[maker.plain.joint(read.name).id]
    if slide not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
        return ""
    return ("m" if slide == mujoco.mjtJoint.mjJNT_SLIDE else "rad") + ("/s" if read.kind == "velocity" else "")


def _signal_unit(maker: _Maker, expression: Expression, index: int) -> str:
    return maker.spec.signals[index].unit or _plain_unit(maker, expression)


def _check_unit(maker: _Maker, model: mujoco.MjModel, index: int, expression: Expression) -> None:
    """Refuse `position(JOINT)` in deg: the unit is only a word, the expression has to convert."""
    plain, said = _plain_unit(maker, expression), maker.spec.signals[index].unit
    if plain and said in SCALES:
        angle = plain.startswith("rad")
        hint = " * 180 / pi" if angle else f" * {1.0 / SCALES[said]:g}"
        raise maker.document.error(
            ("signals", index, "unit"),
            f"{expression.text} is in {plain}, not in {said}; write reads: {expression.text}{hint}, or unit: {plain}",
        )


def _space(maker: _Maker, model: mujoco.MjModel) -> ParameterSpace:
    """The parameters, each with the unit that its elements give it."""
    found: list[Parameter] = []
    for index, given in enumerate(maker.spec.parameters):
        place = ("parameters", index)
        _check_elements(maker, model, index)
        parameter = given.parameter(_unit_of(maker, model, index))
        names = [row.name for row in found]
        if parameter.name in names:
            line = maker.document.line(("parameters", names.index(parameter.name)))
            raise maker.document.error(
                place, f"the parameter {parameter.name} is on line {line} already; name: one of them"
            )
        for other, row in enumerate(found):
            shared = set(row.elements) & set(parameter.elements) if parameter.elements else {""} - set(row.elements)
            if FIELDS[row.field].element is not None and parameter.field == row.field and shared:
                line = maker.document.line(("parameters", other))
                raise maker.document.error(
                    place,
                    f"{parameter.field} of {min(shared)!r} is calibrated by line {line} already; keep one of them",
                )
        _check_exclusive(maker, place, parameter, found)
        found.append(parameter)
    return ParameterSpace(tuple(found))


def _check_exclusive(maker: _Maker, place: tuple[str, int], parameter: Parameter, found: list[Parameter]) -> None:
    """No two ways to calibrate one thing, of which the one written last would win."""
    pairs = ({"body_mass", "body_mass_and_inertia"}, {"body_inertia", "body_mass_and_inertia"})
    for other, row in enumerate(found):
        both = {row.field, parameter.field} in pairs and set(row.elements) & set(parameter.elements)
        again = row.field == parameter.field and FIELDS[row.field].element is None
        if both or again:
            line = maker.document.line(("parameters", other))
            raise maker.document.error(
                place, f"{parameter.field} and {row.field} of line {line} are one thing; keep one"
            )


def _check_elements(maker: _Maker, model: mujoco.MjModel, index: int) -> None:
    """Refuse elements that are not there, with the nearest that are."""
    given = maker.spec.parameters[index]
    parameter = given.parameter()
    kind = FIELDS[given.field].element
    for position, element in enumerate(parameter.elements):
        place = ("parameters", index, *(("elements", position) if given.elements else ("element",)))
        if kind == "signal":
            known = [signal.name for signal in maker.spec.signals]
            if element not in known:
                raise maker.document.unknown(place, "the name of a signal", element, known)
            continue
        try:
            find_elements(
                model, given.model_copy(update={"elements": None, "element": element, "name": None}).parameter()
            )
        except MadocError as error:
            if kind is None:
                raise
            known = names_of(model, _OBJECTS[kind], getattr(model, _COUNTS[kind]))
            raise maker.document.unknown(place, f"the name of a {kind}", element, known) from error


_OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}
_COUNTS = {"body": "nbody", "joint": "njnt", "geom": "ngeom", "actuator": "nu"}


def _unit_of(maker: _Maker, model: mujoco.MjModel, index: int) -> str:
    """The unit of a parameter where that is not its field's; refused where its elements have different ones."""
    given = maker.spec.parameters[index]
    units = {_element_unit(maker, model, given, element) for element in given.parameter().elements}
    if len(units) > 1:
        raise maker.document.error(
            ("parameters", index),
            f"one value cannot be in {' and in '.join(sorted(unit or FIELDS[given.field].unit for unit in units))}; "
            "make it two parameters",
        )
    return next(iter(units), "")


def _element_unit(maker: _Maker, model: mujoco.MjModel, given: ParameterSpec, element: str) -> str:
    if given.field in SLIDE_UNITS:
        return SLIDE_UNITS[given.field] if _is_slide(model, int(model.joint(element).id)) else ""
    if given.field == "signal_bias":
        names = [signal.name for signal in maker.spec.signals]
        return _signal_unit(maker, parse(maker.spec.signals[names.index(element)].reads), names.index(element))
    if given.field == "actuator_gain":
        return _gain_unit(model, int(model.actuator(element).id))
    return ""


def _gain_unit(model: mujoco.MjModel, actuator: int) -> str:
    """Of a servo on a joint: force per position or speed. Else a gain has none of its own."""
    if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_JOINT:
        return ""
    slide = _is_slide(model, int(model.actuator_trnid[actuator, 0]))
    gain, (_, position, velocity) = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator, :3]
    if gain and position == -gain:
        return "N/m" if slide else "N·m/rad"
    if gain and velocity == -gain and not position:
        return "N·s/m" if slide else "N·m·s/rad"
    return ""


def _is_slide(model: mujoco.MjModel, joint: int) -> bool:
    return bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)


def _idle_actuators(model: mujoco.MjModel, actions: tuple[ActionChannel, ...]) -> tuple[str, ...]:
    """A sentence on the actuators that no action drives."""
    driven = {int(model.actuator(channel.actuator).id) for channel in actions}
    idle = [actuator for actuator in range(model.nu) if actuator not in driven]
    if not idle:
        return ()
    names = [
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, actuator) or f"number {actuator}" for actuator in idle
    ]
    return (f"no action drives the model's actuators {', '.join(names)}: their control is always 0",)


def _reward(
    maker: _Maker, signals: Signals, actions: tuple[ActionChannel, ...]
) -> Callable[[Batch, Batch, Batch], Batch]:
    """(state, action, next state) -> reward: the spec's expression, or 0."""
    if maker.spec.reward is None:
        return _no_reward
    of_signals = {signal.name: index for index, signal in enumerate(maker.spec.signals)}
    of_actions = {channel.name: index for index, channel in enumerate(actions)}
    place = ("reward",)
    try:
        expression = parse(maker.spec.reward, names=[*of_signals, *of_actions])
        expression.value(lambda _: np.zeros(1), np)
    except ExpressionError as error:
        raise maker.document.error(place, str(error)) from error
    except ArithmeticError as error:
        raise maker.document.error(place, f"expected an expression with a value, got {maker.spec.reward!r}") from error
    for read in expression.reads:
        inside = signals.expressions[of_signals[read.name]].reads if read.name in of_signals else ()
        if any(part.kind == "sensor" for part in inside):
            raise maker.document.error(
                place, f"a reward is a function of state and action, and the signal {read.name!r} reads a sensor"
            )

    def reward(state: Batch, action: Batch, next_state: Batch) -> Batch:
        namespace = next_state.__array_namespace__()

        def look_up(read: Read) -> Batch:
            if read.name in of_signals:
                return signals._stacked([signals.expressions[of_signals[read.name]]], next_state, None)[..., 0]
            channel = actions[of_actions[read.name]]
            middle, half = (channel.low + channel.high) / 2.0, (channel.high - channel.low) / 2.0
            return middle + half * action[..., of_actions[read.name]]

        with quiet_arithmetic():
            return expression.value(look_up, namespace)

    return reward


def _no_reward(state: Batch, action: Batch, next_state: Batch) -> Batch:
    return 0.0 * next_state[..., 0]


def _never(next_state: Batch) -> Batch:
    return next_state.__array_namespace__().zeros(next_state.shape[:-1], dtype=bool)


def _no_noise(key: PRNGKeyArray, count: int, *, size: int) -> jax.Array:
    return jax.numpy.zeros((count, size))


def _needs_a_system(name: str, state: Batch) -> Batch:
    raise MadocError(f"an observation of {name} reads sensors of its model, so only a bound system can make it")
