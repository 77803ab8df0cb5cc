"""The terms that a model may lack: what each stands for, its value in the model, the values it can have."""

from collections.abc import Callable, Iterator
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.constants import g as standard_gravity

from madoc.identification.score_tests import Score
from madoc.identification.states import LoggedStates
from madoc.identification.windows import evenly
from madoc.parameters import FIELDS, INERTIA, PAYLOAD, Parameter
from madoc.robots.space import element_unit
from madoc.simulation.base import Simulator
from madoc.simulation.inertials import off_centre
from madoc.simulation.joints import deflections, is_drive
from madoc.simulation.probes import touching_geoms
from madoc.simulation.write import body_reach, element_names, has_gain, heavy_bodies, linked_bodies, nominal_values

WHOLE = 1.5
"""Largest value of the error of the integration step. The value is 1 / (1 - 4^-p) for an integrator of order p, at
most 4 / 3, as the steps compared with are a quarter as long."""
ON_THE_GROUND = (-9.9, -9.7)
"""m/s², gravity downwards at the poles, at the equator and on mountains."""
_KNOWN_BEFORE = ("body_mass", "body_com", "body_distance")
_LENGTHS = (0.7, 1.4)
"""Smallest and largest length of a link over that of the model; beyond them something else is missing."""
_SEEN = 200
"""Number of logged states in which contacts are looked for."""
_STILL = 1e-9
"""Standard deviation of a joint's position below which it does not move, so that nothing tells of a spring."""
_RANGE = 10.0
"""Half of the range in which a term is fitted, in its change or standard error by the score test."""


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
    wanted: list[tuple[str, str | tuple[str, ...], float]] = []
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
    wanted += [("body_distance", body, distance) for body, distance in linked_bodies(model)]
    if "gravity" not in fields:
        wanted.append(("gravity", "", float(abs(model.opt.gravity[2])) or standard_gravity))
    if task.source is not None:
        measured = zip(task.signals[: logged.measured], scale, strict=False)
        wanted += [("signal_bias", signal, float(typical)) for signal, typical in measured]
    wanted += _at_contacts(model, logged, calibrated)
    for field, element, reference in wanted:
        if (field, element) not in calibrated:
            unit = element_unit(model, field, element) if isinstance(element, str) else ""
            candidate, parameter = _candidate(partial(nominal_values, model), field, element, reference, unit)
            yield replace(candidate, plausible=_plausible(model, parameter, reference)), parameter


def _at_contacts(
    model: Any, logged: LoggedStates, calibrated: AbstractSet[tuple[str, str]]
) -> Iterator[tuple[str, tuple[str, ...], float]]:
    """Friction and stiffness of the geoms that touch others in the log, of one value for all of a kind."""
    touching = touching_geoms(model, logged.states[evenly(np.arange(len(logged.states)), _SEEN)])
    for field, numbers in (("geom_friction", model.geom_friction), ("contact_time", model.geom_solref)):
        free = [geom for geom in touching if (field, geom) not in calibrated]
        values = np.array([numbers[model.geom(geom).id, 0] for geom in free])
        if len(values) and values[0] > 0.0:
            alike = tuple(geom for geom, value in zip(free, values, strict=True) if value == values[0])
            yield field, alike, float(values[0])


def _plausible(model: Any, parameter: Parameter, reference: float) -> tuple[float, float]:
    """Smallest and largest value that a machine can have."""
    if parameter.field == "gravity":
        return ON_THE_GROUND
    if parameter.field == "body_distance":
        return _LENGTHS[0] * reference, _LENGTHS[1] * reference
    return (-np.inf, body_reach(model, parameter) if parameter.field == "body_com" else np.inf)


def references_of(logged: LoggedStates, simulator: Simulator, joint: Any) -> dict[str, float]:
    """By field, the value with which a term would balance the torque that typically accelerates a joint.

    All degrees of freedom of a free or a ball joint share one value, and it has no spring. A free joint has nothing but
    air about it: neither dry friction nor a rotor.
    """
    model = simulator.task.model
    dofs = slice(int(joint.dofadr[0]), int(joint.dofadr[0]) + len(joint.damping))
    position, speed = logged.states[:, : model.nq], logged.states[:, model.nq : model.nq + model.nv][:, dofs]
    change = np.diff(speed, axis=0)[np.diff(logged.rows) == 1]
    acceleration = np.sqrt((change**2).mean(0)) / simulator.control_step if len(change) else np.ones(speed.shape[1])
    inertia, fast = model.dof_M0[dofs], max(float(np.sqrt((speed**2).mean())), 1e-9)
    torque = max(float((inertia * acceleration).mean()), 1e-12)
    of_air = {"dof_drag": torque / fast**2, "dof_damping": torque / fast}
    if len(joint.damping) == 6:
        return of_air
    references = {"dof_frictionloss": torque, **of_air, "dof_armature": float(inertia.mean())}
    far = float(position[:, int(joint.qposadr[0])].std())
    return references | ({"jnt_stiffness": torque / far} if len(joint.damping) == 1 and far > _STILL else {})


def _candidate(
    nominal_of: Callable[[Parameter], tuple[float, ...]],
    field: str,
    element: str | tuple[str, ...],
    reference: float,
    unit: str = "",
) -> tuple[Candidate, Parameter]:
    """A term, and the parameter whose range begins at its value in the model and is `reference` wide.

    It is in the field's unit if none is given.
    """
    parameter = Parameter(field, element, 0.0, reference, measured_in=unit)
    nominal = nominal_of(parameter)[0]
    parameter = replace(parameter, low=nominal, high=nominal + reference)
    least, elements = parameter.kind.minimum, parameter.elements
    known = field in _KNOWN_BEFORE or (field == "gravity" and nominal == 0.0)
    return Candidate(
        parameter.kind.missing, parameter.name, parameter.unit, nominal, reference, least, elements, known
    ), parameter


def of_steps(value: float) -> bool:
    """Whether the error of the integration step can have a value; another one is something else that acts alike."""
    return 0.0 < value <= WHOLE
