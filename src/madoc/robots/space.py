"""Parameters of a spec: their elements in the model, their units, and no quantity calibrated twice."""

from collections.abc import Iterator
from dataclasses import replace
from fnmatch import fnmatchcase
from itertools import product, zip_longest

import mujoco

from madoc.parameters import FIELDS, PAYLOAD, Parameter, ParameterSpace, field_of
from madoc.robots.drives import friction_parameters
from madoc.robots.expressions import parse
from madoc.robots.model import Draft, is_slide
from madoc.robots.signals import signal_unit
from madoc.simulation.arrays import check_field
from madoc.simulation.write import OF_A_JOINT, element_names, find_elements, nominal_values, same_numbers


def parameter_space(draft: Draft, model: mujoco.MjModel) -> ParameterSpace:
    """The parameters, each with the unit that follows from its elements; `each` makes one of every element."""
    parameters: list[Parameter] = []
    lines: list[int] = []
    for index, given in enumerate(draft.spec.parameters):
        with draft.document.at("parameters", index):
            check_field(model, given.fields[0])
        elements = _elements(draft, model, index)
        for field, shared in product(given.fields, [(one,) for one in elements] if given.each else [elements]):
            parameter = given.parameter(field, shared, _unit_of(draft, model, index, shared))
            with draft.document.at("parameters", index):
                nominal_values(model, parameter)  # which the model may lack
            if parameter.field == "gravity" and parameter.high > 0.0:
                problem = f"gravity is negative where it points down, got a range up to {parameter.high:g}"
                raise draft.document.error(
                    ("parameters", index, "high"), f"{problem}; give low: and high: of at most 0"
                )
            for other, earlier in zip(lines, parameters, strict=True):
                _check_distinct(draft, model, index, parameter, other, earlier)
            parameters.append(parameter)
            lines.append(index)
    _check_payloads(draft, model, parameters, lines)
    parameters += friction_parameters(draft, parameters)
    return ParameterSpace(tuple(by_condition(draft, parameters, lines)))


def by_condition(draft: Draft, parameters: list[Parameter], lines: list[int]) -> Iterator[Parameter]:
    """The parameters, those of lines with `by` once for each value of their condition."""
    values = {condition.name: condition.values for condition in draft.spec.conditions}
    for parameter, line in zip_longest(parameters, lines):
        by = None if line is None else draft.spec.parameters[line].by
        yield from [parameter] if by is None else (replace(parameter, when=(by, value)) for value in values[by])


def _check_payloads(draft: Draft, model: mujoco.MjModel, parameters: list[Parameter], lines: list[int]) -> None:
    """Refuse the place or the size of a payload without a mass, which would do nothing."""
    loaded = {body for row in parameters if row.field == PAYLOAD[0] for body in find_elements(model, row)}
    for row, line in zip(parameters, lines, strict=True):
        if row.field not in PAYLOAD[1:]:
            continue
        bodies = zip(row.elements, find_elements(model, row), strict=True)
        missing = [element for element, body in bodies if body not in loaded]
        if missing:
            problem = (
                f"{row.field} of {missing[0]!r} does nothing without a mass there; add {{field: {PAYLOAD[0]}, element: "
                f"{missing[0]}}}, in a narrow range if it is known"
            )
            raise draft.document.error(("parameters", line), problem)


def _check_distinct(
    draft: Draft, model: mujoco.MjModel, index: int, parameter: Parameter, other: int, earlier: Parameter
) -> None:
    """Refuse two parameters of one name or of one quantity, of which the one written last would win."""
    line = draft.document.line(("parameters", other))
    shared = set(earlier.elements) & set(parameter.elements)
    if parameter.kind.element == earlier.kind.element == "body":  # which a joint's name may mean too
        held = set(find_elements(model, earlier))
        elements = zip(parameter.elements, find_elements(model, parameter), strict=True)
        shared = {name for name, body in elements if body in held}
    whole_robot = not earlier.elements or not parameter.elements
    written, before = (draft.spec.parameters[row].field for row in (index, other))
    exclusive = (
        {"body_mass", "body_mass_and_inertia"},
        {"body_inertia", "body_mass_and_inertia"},
        *({"inertia", one} for one in ("body_mass", "body_mass_and_inertia", "body_inertia", "body_com")),
    )
    if parameter.field == earlier.field and whole_robot and parameter.elements != earlier.elements:
        problem = (
            f"{parameter.field} of all actions and of one cannot both be calibrated, and line {line} has one already; "
            "keep that of all, or give each action its own with each:"
        )
    elif parameter.name == earlier.name and other == index:
        problem = f"{', '.join(parameter.elements)} is matched twice; leave one out"
    elif parameter.name == earlier.name:
        problem = f"the parameter {parameter.name} is on line {line} already; name: one of them"
    elif same_numbers(model, parameter, earlier):
        problem = f"{parameter.name} and {earlier.name} of line {line} are one number of the model; keep one"
    elif parameter.field == earlier.field and shared:
        problem = f"{parameter.field} of {min(shared)!r} is calibrated by line {line} already; keep one of them"
    elif ({written, before} in exclusive and shared) or (parameter.field == earlier.field and whole_robot):
        problem = f"{written} and {before} of line {line} are one thing; keep one"
    else:
        return
    raise draft.document.error(("parameters", index), problem)


def _elements(draft: Draft, model: mujoco.MjModel, index: int) -> tuple[str, ...]:
    """Names of the elements that the model or the signals have, each once; a pattern matches whole names of a kind.

    A name or a pattern that finds none is refused with the nearest names.
    """
    given = draft.spec.parameters[index]
    field = field_of(given.fields[0])
    kind = field.element
    if kind is None or (field.of_all and not given.names):
        return ()
    names = _names(draft, model, kind)
    also = element_names(model, "joint") if kind == "body" else []  # a joint names its body
    found: list[str] = []
    key = next((key for key in ("element", "elements", "each") if getattr(given, key)), "")
    for position, wanted in enumerate(given.names):
        known = wanted in names or wanted in also
        matching = [name for name in names if fnmatchcase(name, wanted)]
        if not known and (key == "element" or not matching):
            article = "an" if kind[0] in "aeiou" else "a"
            what = f"the name of {article} {kind}" + ("" if key == "element" else ", or a pattern with * for several")
            raise draft.document.unknown(("parameters", index, key, position), what, wanted, names)
        found += [wanted] if known else [name for name in matching if name not in found]
    return tuple(found)


def _names(draft: Draft, model: mujoco.MjModel, kind: str) -> list[str]:
    """Names of the elements of a kind; the world is no body that has anything to calibrate.

    An action is a command, and no number that a drive takes from the log.
    """
    if kind == "signal":
        return [signal.name for signal in draft.spec.signals]
    if kind == "action":
        return [action.name for action in draft.spec.actions]
    return [name for name in element_names(model, kind) if (kind, name) != ("body", "world")]


def _unit_of(draft: Draft, model: mujoco.MjModel, index: int, elements: tuple[str, ...]) -> str:
    """The unit of a parameter where it is not its field's; elements with different units are refused."""
    given = draft.spec.parameters[index]
    if given.field is None:
        return given.unit or ""
    field = given.fields[0]
    units = {_element_unit(draft, model, field, element) for element in elements}
    if len(units) > 1:
        raise draft.document.error(
            ("parameters", index),
            f"one value cannot be in {' and in '.join(sorted(unit or FIELDS[field].unit for unit in units))}; "
            "make it two parameters",
        )
    return next(iter(units), "")


def _element_unit(draft: Draft, model: mujoco.MjModel, field: str, element: str) -> str:
    if field == "signal_bias":
        index = [signal.name for signal in draft.spec.signals].index(element)
        return signal_unit(draft, model, parse(draft.spec.signals[index].reads), index)
    if field == "actuator_gain":
        return gain_unit(model, int(model.actuator(element).id))
    return element_unit(model, field, element)


def element_unit(model: mujoco.MjModel, field: str, element: str) -> str:
    """The unit of a field of an element where it is not the field's own, as of a joint that slides; else empty."""
    kind, joint = FIELDS[field], -1
    if kind.slide_unit and kind.element == "joint":
        joint = int(model.joint(element).id)
    elif kind.slide_unit and int(model.actuator(element).trntype[0]) in OF_A_JOINT:
        joint = int(model.actuator(element).trnid[0])
    return kind.slide_unit if joint >= 0 and is_slide(model, joint) else ""


def gain_unit(model: mujoco.MjModel, actuator: int) -> str:
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
