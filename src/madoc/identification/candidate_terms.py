"""The terms that a model may lack: what each stands for, its value in the model, its effect on simulated windows."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.constants import g as standard_gravity

from madoc import simulation
from madoc.identification.coarseness import FINER
from madoc.identification.replay import Readings
from madoc.identification.score_tests import Score
from madoc.identification.states import LoggedStates
from madoc.parameters import FIELDS, INERTIA, PAYLOAD, Parameter
from madoc.simulation.base import Simulator
from madoc.simulation.gears import deflections
from madoc.simulation.inertials import off_centre
from madoc.simulation.user_data import is_drive
from madoc.simulation.write import body_reach, element_names, has_gain, heavy_bodies, nominal_values

DELAY = "actions that take effect later, by a delay or a lag of the actuator"
EARLY = "actions that take effect before they are logged"
BELOW_MINIMUM = "a value below the physical minimum of a parameter"
SATURATION = "a drive that saturates below the limit of its actions"
SPACING = "rows that are farther apart in time than the spec says, by another rate or a clock that drifts"
TILTS = ("a base or a floor that is tilted towards x", "a base or a floor that is tilted towards y")
INTEGRATION = "the error of the model's integration step"
LATE_DRIVE = "a drive that acts later than the others"
LATE_SENSOR = "a sensor that reads late, as behind a filter"
UNLISTED = "a force that no listed term describes"
"""What a family of forces stands for, or a listed term of a value that no machine has; more words follow."""
ON_THE_GROUND = (-9.9, -9.7)
"""m/s², gravity downwards at the poles, at the equator and on mountains."""
_KNOWN_BEFORE = ("body_mass", "body_com")
_STILL = 1e-9
"""Standard deviation of a joint's position below which it does not move, so that nothing tells of a spring."""
CHANGE = 1e-3
"""Change of a candidate, as a share of what would balance the joint's typical torque, for its one-sided difference."""
_SATURATED = 0.3
"""Share of the largest logged action by which actions are cut off, to compute the effect of a drive that saturates."""
_RANGE = 10.0
"""Half of the range in which a term is fitted, in its change or standard error by the score test."""
_LATER = 0.1
"""Delay in control steps with which the effect of a delay is computed."""


def is_late(cause: str) -> bool:
    """Whether the cause of a term is that a single drive or sensor is late."""
    return cause.startswith((LATE_DRIVE, LATE_SENSOR))


@dataclass(frozen=True)
class Candidate:
    """A term that is tried.

    Attributes:
        cause: What it stands for, in words.
        parameter: Name of the parameter that adds it to a spec; empty if there is none.
        unit: Unit of its value.
        nominal: Its value in the model.
        reference: Unit change of its value.
        least: Its smallest physical value.
        elements: Elements of the model that share the value; empty for a term of the whole robot.
        known_before: Whether users know the value well without the log, as by scales or a level, or no parameter of
            a spec adds the term: it is not taken together with others that cannot be excluded then.
        plausible: Smallest and largest value that a machine can have; beyond them something else is missing, that the
            term imitates.
    """

    cause: str
    parameter: str
    unit: str
    nominal: float
    reference: float
    least: float
    elements: tuple[str, ...] = ()
    known_before: bool = False
    plausible: tuple[float, float] = (-np.inf, np.inf)

    def imitates(self, value: float, error: float) -> bool:
        """Whether a value is none that a machine can have, beyond two of its standard errors."""
        return not self.plausible[0] - 2.0 * error <= value <= self.plausible[1] + 2.0 * error

    def added(self, score: Score) -> Parameter | None:
        """The parameter that adds the term, in a range wide enough for its score; None if there is none."""
        field = self.parameter.partition(".")[0]
        if field not in FIELDS or not FIELDS[field].in_model:
            return None
        reach = _RANGE * self.reference * max(abs(score.change), score.error)
        low = max(self.least, self.nominal - reach)
        element = self.elements if len(self.elements) > 1 else "".join(self.elements)
        return Parameter(field, element, low, self.nominal + reach)


def candidates(
    logged: LoggedStates,
    simulator: Simulator,
    point: Float[np.ndarray, " d"],
    scale: Float[np.ndarray, " observation"],
) -> Iterator[tuple[Candidate, Parameter]]:
    """Terms that a spec can add and does not calibrate: some for each joint, one for each actuator and sensor."""
    model, task = simulator.model(simulator.parameters.to_physical(point)), simulator.task
    calibrated = {(each.field, element) for each in simulator.parameters.parameters for element in each.elements}
    fields = {each.field for each in simulator.parameters.parameters}
    wanted: list[tuple[str, str, float]] = []
    for name in (model.joint(joint).name for joint in np.setdiff1d(np.arange(model.njnt), deflections(model)).tolist()):
        if name:
            references = references_of(logged, simulator, model.joint(name))
            wanted += [(field, name, reference) for field, reference in references.items()]
    for actuator in (model.actuator(channel.actuator) for channel in task.actions):
        if is_drive(model, actuator.id):
            wanted.append(("drive_strength", actuator.name, 1.0))
        elif has_gain(model, actuator.id):
            wanted.append(("actuator_gain", actuator.name, abs(float(actuator.gainprm[0])) or 1.0))
    weighed = {element for field, element in calibrated if field in ("body_mass", "body_mass_and_inertia")}
    loaded = {element for field, element in calibrated if field in (*PAYLOAD, *INERTIA)}
    for body in heavy_bodies(model):
        at = model.body(body) if body in element_names(model, "body") else model.body(model.joint(body).bodyid[0])
        distance = off_centre(model, at.id)
        wanted += [("body_mass", body, float(at.mass[0]))] * (body not in weighed | loaded)
        wanted += [("body_com", body, distance)] * (distance > 0.0 and body not in loaded)
    if "gravity" not in fields:
        wanted.append(("gravity", "", float(abs(model.opt.gravity[2])) or standard_gravity))
    if task.source is not None:
        measured = zip(task.signals[: logged.measured], scale, strict=False)
        wanted += [("signal_bias", signal, float(typical)) for signal, typical in measured]
    for field, element, reference in wanted:
        if (field, element) not in calibrated:
            candidate, parameter = _candidate(partial(nominal_values, model), field, element, reference)
            if field == "gravity":
                candidate = replace(candidate, plausible=ON_THE_GROUND)
            if field == "body_com":
                candidate = replace(candidate, plausible=(-np.inf, body_reach(model, parameter)))
            yield candidate, parameter


def references_of(logged: LoggedStates, simulator: Simulator, joint: Any) -> dict[str, float]:
    """By field, the value with which a term would balance the torque that typically accelerates a joint.

    All degrees of freedom of a free or a ball joint share one value, and it has no spring.
    """
    model = simulator.task.model
    dofs = slice(int(joint.dofadr[0]), int(joint.dofadr[0]) + len(joint.damping))
    position, speed = logged.states[:, : model.nq], logged.states[:, model.nq : model.nq + model.nv][:, dofs]
    change = np.diff(speed, axis=0)[np.diff(logged.rows) == 1]
    acceleration = np.sqrt((change**2).mean(0)) / simulator.control_step if len(change) else np.ones(speed.shape[1])
    inertia, fast = model.dof_M0[dofs], max(float(np.sqrt((speed**2).mean())), 1e-9)
    torque = max(float((inertia * acceleration).mean()), 1e-12)
    references = {
        "dof_frictionloss": torque,
        "dof_drag": torque / fast**2,
        "dof_damping": torque / fast,
        "dof_armature": float(inertia.mean()),
    }
    far = float(position[:, int(joint.qposadr[0])].std())
    return references | ({"jnt_stiffness": torque / far} if len(joint.damping) == 1 and far > _STILL else {})


def _candidate(
    nominal_of: Callable[[Parameter], tuple[float, ...]], field: str, element: str, reference: float
) -> tuple[Candidate, Parameter]:
    """A term, and the parameter whose range begins at its value in the model and is `reference` wide."""
    parameter = Parameter(field, element, 0.0, reference)
    nominal = nominal_of(parameter)[0]
    parameter = replace(parameter, low=nominal, high=nominal + reference)
    least, elements = parameter.kind.minimum, parameter.elements
    known = field in _KNOWN_BEFORE or (field == "gravity" and nominal == 0.0)
    return Candidate(
        parameter.kind.missing, parameter.name, parameter.unit, nominal, reference, least, elements, known
    ), parameter


def effects(
    simulator: Simulator,
    wide: Simulator,
    readings: Readings,
    before: Float[np.ndarray, "windows action"],
    at: Float[np.ndarray, " k"],
    states: Float[np.ndarray, "windows state"],
    added: list[tuple[Candidate, Parameter]],
) -> tuple[list[Candidate], Float[np.ndarray, "windows values terms"]]:
    """Every candidate and the derivative of the residuals by it, in its reference.

    `wide` is the simulator with the added parameters, the last ones of `at`; `before` are the actions before windows.
    """
    count, base = len(added), readings.residuals(wide, at[None], states[None])[0, 0]
    points = np.repeat(at[None], count, axis=0)
    points[np.arange(count), len(at) - count + np.arange(count)] += 2.0 * CHANGE
    by_candidate = readings.residuals(wide, points, np.repeat(states[None], count, axis=0))[:, 0] - base
    tried, found = [candidate for candidate, _ in added], list(by_candidate / CHANGE)
    for candidate, column in _of_groups(simulator, added, np.stack(found)):
        tried.append(candidate)
        found.append(column)
    point, step = at[: len(at) - count], simulator.control_step
    earlier = np.concatenate([before[:, None], readings.actions[:, :-1]], axis=1)
    late = replace(readings, actions=readings.actions + _LATER * (earlier - readings.actions))
    saturated = replace(readings, actions=_cut_off(readings.actions, simulator))
    stretched = simulation.make(simulator.task.with_time_step(1.0 + CHANGE))
    finer = simulation.make(simulator.task.with_time_step(1.0 / FINER, substeps=FINER))
    fields = {each.field for each in simulator.parameters.parameters}
    tilts = TILTS if np.any(simulator.task.model.opt.gravity) else ()
    for candidate, other, inputs, change in (
        *(
            (
                Candidate(cause, "", "rad", 0.0, 1.0, -np.inf, known_before=True),
                simulation.make(simulator.task.with_tilt(axis, CHANGE)),
                readings,
                CHANGE,
            )
            for axis, cause in enumerate(tilts)
        ),
        (Candidate(DELAY, "action_delay", "s", 0.0, step, -np.inf), simulator, late, _LATER),
        (Candidate(SATURATION, "", "of the largest action cut off", 0.0, 1.0, 0.0), simulator, saturated, _SATURATED),
        (Candidate(SPACING, "", "s", step, step, 0.0), stretched, readings, CHANGE),
        (Candidate(INTEGRATION, "", "", 0.0, 1.0, -np.inf), finer, readings, 1.0),
    ):
        if candidate.parameter not in fields:
            moved = inputs.residuals(other, point[None], states[None])[0, 0]
            tried.append(candidate)
            found.append((moved - base) / change)
    commands = [(place, channel) for place, channel in enumerate(simulator.task.actions) if channel.command]
    for place, channel in commands if len(commands) > 1 else ():
        actions = readings.actions.copy()
        actions[..., place] = late.actions[..., place]
        moved = replace(readings, actions=actions).residuals(simulator, point[None], states[None])[0, 0]
        tried.append(_late(f"{LATE_DRIVE} ({channel.name})", step))
        found.append((moved - base) / _LATER)
    for signal, column in _late_sensors(simulator, readings, base):
        tried.append(_late(f"{LATE_SENSOR} ({signal})", step))
        found.append(column)
    return tried, np.stack(found, axis=-1)


def _late(cause: str, step: float) -> Candidate:
    """A lag of a single drive or sensor, s."""
    return Candidate(cause, "", "s", 0.0, step, 0.0, known_before=True)


def _late_sensors(
    simulator: Simulator, readings: Readings, residuals: Float[np.ndarray, "windows values"]
) -> Iterator[tuple[str, Float[np.ndarray, "windows values"]]]:
    """Each signal that a user's robot logs, and what it reads less by if it is a control step late: to first order."""
    if simulator.task.source is None:
        return
    predicted = residuals.reshape(readings.observed.shape) + readings.observed / readings.scale
    less = -np.gradient(predicted, axis=1)
    for place, signal in enumerate(simulator.task.signals[: predicted.shape[-1]]):
        column = np.where(np.isnan(less), np.nan, 0.0)
        column[..., place] = less[..., place]
        yield signal, column.reshape(residuals.shape)


def _cut_off(
    actions: Float[np.ndarray, "windows steps action"], simulator: Simulator
) -> Float[np.ndarray, "windows steps action"]:
    """Actions of a drive that saturates: in the spec's units none is farther from 0 than a share of the largest."""
    middle, half = simulator.task.action_ranges
    asked = actions * half + middle
    most = (1.0 - _SATURATED) * np.abs(asked).max((0, 1))
    most[[not channel.command for channel in simulator.task.actions] or slice(0)] = np.inf
    return (np.clip(asked, -most, most) - middle) / half


def _of_groups(
    simulator: Simulator,
    added: list[tuple[Candidate, Parameter]],
    columns: Float[np.ndarray, "added windows values"],
) -> Iterator[tuple[Candidate, Float[np.ndarray, "windows values"]]]:
    """The terms of joints that share a calibrated parameter, and the gain of all drives, of one value for all.

    Effects of small values add up. Of terms that all of these lack, the others would hide each single one.
    """
    index_of = {(parameter.field, parameter.element): index for index, (_, parameter) in enumerate(added)}
    groups = dict.fromkeys(row.elements for row in simulator.parameters.parameters if len(row.elements) > 1)
    joint_fields = [name for name, field in FIELDS.items() if field.element == "joint" and field.missing]
    gains = {parameter.element: each.nominal for each, parameter in added if parameter.field == "actuator_gain"}
    drives = [("actuator_gain", tuple(gains))] if len(gains) > 1 and len(set(gains.values())) == 1 else []
    for field, group in (*product(joint_fields, groups), *drives):
        members = [index_of[field, element] for element in group if (field, element) in index_of]
        if len(members) == len(group):
            single = [added[index][0] for index in members]
            reference = float(np.mean([each.reference for each in single]))
            name = Parameter(field, group, 0.0, 1.0).name
            together = replace(single[0], parameter=name, elements=group, reference=reference)
            yield together, sum(reference / added[index][0].reference * columns[index] for index in members)
