"""Parameters of a spec: their elements in the model, their units, and no quantity calibrated twice."""

from dataclasses import replace

import mujoco

from madoc.parameters import FIELDS, Parameter, ParameterSpace
from madoc.robots.drives import friction_parameters
from madoc.robots.grammar import parse
from madoc.robots.model import Draft, is_slide
from madoc.robots.signals import signal_unit
from madoc.robots.spec import ParameterSpec
from madoc.simulation.write import OF_A_JOINT, element_names, find_elements

SLIDE_UNITS = {
    "dof_damping": "N·s/m",
    "dof_drag": "N·s²/m²",
    "dof_armature": "kg",
    "dof_frictionloss": "N",
    "jnt_stiffness": "N/m",
    "jnt_ref": "m",
}
"""Units of the fields of a joint where the joint is a slide."""


def parameter_space(draft: Draft, model: mujoco.MjModel) -> ParameterSpace:
    """The parameters, each with the unit that follows from its elements."""
    lines: list[Parameter] = []
    for index, given in enumerate(draft.spec.parameters):
        _check_elements(draft, model, index)
        parameter = given.parameter(_unit_of(draft, model, index))
        for other, earlier in enumerate(lines):
            _check_distinct(draft, model, index, parameter, other, earlier)
        lines.append(parameter)
    values = {condition.name: condition.values for condition in draft.spec.conditions}
    found = [
        parameter if given.by is None else replace(parameter, when=(given.by, value))
        for given, parameter in zip(draft.spec.parameters, lines, strict=True)
        for value in ([0.0] if given.by is None else values[given.by])
    ]
    return ParameterSpace((*found, *friction_parameters(draft)))


def _check_distinct(
    draft: Draft, model: mujoco.MjModel, index: int, parameter: Parameter, other: int, earlier: Parameter
) -> None:
    """Refuse two parameters of one name or of one quantity, of which the one written last would win."""
    line = draft.document.line(("parameters", other))
    shared = set(earlier.elements) & set(parameter.elements)
    if FIELDS[parameter.field].element == FIELDS[earlier.field].element == "body":  # which a joint's name may mean too
        held = set(find_elements(model, earlier))
        elements = zip(parameter.elements, find_elements(model, parameter), strict=True)
        shared = {name for name, body in elements if body in held}
    whole_robot = FIELDS[earlier.field].element is None
    exclusive = ({"body_mass", "body_mass_and_inertia"}, {"body_inertia", "body_mass_and_inertia"})
    if parameter.name == earlier.name:
        problem = f"the parameter {parameter.name} is on line {line} already; name: one of them"
    elif parameter.field == earlier.field and shared:
        problem = f"{parameter.field} of {min(shared)!r} is calibrated by line {line} already; keep one of them"
    elif ({earlier.field, parameter.field} in exclusive and shared) or (
        parameter.field == earlier.field and whole_robot
    ):
        problem = f"{parameter.field} and {earlier.field} of line {line} are one thing; keep one"
    else:
        return
    raise draft.document.error(("parameters", index), problem)


def _check_elements(draft: Draft, model: mujoco.MjModel, index: int) -> None:
    """Refuse elements that the model or the signals do not have, with the nearest that they have."""
    given = draft.spec.parameters[index]
    kind = FIELDS[given.field].element
    if kind is None:
        return
    names = [signal.name for signal in draft.spec.signals] if kind == "signal" else element_names(model, kind)
    also = element_names(model, "joint") if kind == "body" else []  # a joint names its body
    for position, element in enumerate(given.parameter().elements):
        if element not in names and element not in also:
            place = ("parameters", index, *(("elements", position) if given.elements else ("element",)))
            raise draft.document.unknown(place, f"the name of a {kind}", element, names)


def _unit_of(draft: Draft, model: mujoco.MjModel, index: int) -> str:
    """The unit of a parameter where it is not its field's; elements with different units are refused."""
    given = draft.spec.parameters[index]
    units = {_element_unit(draft, model, given, element) for element in given.parameter().elements}
    if len(units) > 1:
        raise draft.document.error(
            ("parameters", index),
            f"one value cannot be in {' and in '.join(sorted(unit or FIELDS[given.field].unit for unit in units))}; "
            "make it two parameters",
        )
    return next(iter(units), "")


def _element_unit(draft: Draft, model: mujoco.MjModel, given: ParameterSpec, element: str) -> str:
    if given.field in SLIDE_UNITS:
        return SLIDE_UNITS[given.field] if is_slide(model, int(model.joint(element).id)) else ""
    if given.field == "signal_bias":
        index = [signal.name for signal in draft.spec.signals].index(element)
        return signal_unit(draft, model, parse(draft.spec.signals[index].reads), index)
    if given.field == "actuator_kv":
        driven = model.actuator(element)
        on_joint = int(driven.trntype[0]) in OF_A_JOINT
        return "N·s/m" if on_joint and is_slide(model, int(driven.trnid[0])) else ""
    return _gain_unit(model, int(model.actuator(element).id)) if given.field == "actuator_gain" else ""


def _gain_unit(model: mujoco.MjModel, actuator: int) -> str:
    """The unit of a servo on a joint: force per position or velocity. Other gains have no unit of their own."""
    if int(model.actuator_trntype[actuator]) not in OF_A_JOINT:
        return ""
    slide = is_slide(model, int(model.actuator_trnid[actuator, 0]))
    gain, (_, position, velocity) = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator, :3]
    if gain and position == -gain:
        return "N/m" if slide else "N·m/rad"
    if gain and velocity == -gain and not position:
        return "N·s/m" if slide else "N·m·s/rad"
    return ""
