"""Parameters of a spec: elements found in the model, units told by their joints, nothing calibrated twice."""

import mujoco

from madoc.errors import MadocError
from madoc.parameters import FIELDS, Parameter, ParameterSpace
from madoc.robots.draft import Draft
from madoc.robots.expressions import parse
from madoc.robots.model import is_slide, names_of
from madoc.robots.signals import signal_unit
from madoc.robots.spec import ParameterSpec
from madoc.simulation.write import find_elements

SLIDE_UNITS = {
    "dof_damping": "N·s/m",
    "dof_armature": "kg",
    "dof_frictionloss": "N",
    "jnt_stiffness": "N/m",
}
"""Of the fields of a joint, where it is a slide."""


def parameter_space(draft: Draft, model: mujoco.MjModel) -> ParameterSpace:
    """The parameters, each with the unit that its elements give it."""
    found: list[Parameter] = []
    for index, given in enumerate(draft.spec.parameters):
        place = ("parameters", index)
        _check_elements(draft, model, index)
        parameter = given.parameter(_unit_of(draft, model, index))
        names = [row.name for row in found]
        if parameter.name in names:
            line = draft.document.line(("parameters", names.index(parameter.name)))
            raise draft.document.error(
                place, f"the parameter {parameter.name} is on line {line} already; name: one of them"
            )
        for other, row in enumerate(found):
            shared = set(row.elements) & set(parameter.elements) if parameter.elements else {""} - set(row.elements)
            if FIELDS[row.field].element is not None and parameter.field == row.field and shared:
                line = draft.document.line(("parameters", other))
                raise draft.document.error(
                    place,
                    f"{parameter.field} of {min(shared)!r} is calibrated by line {line} already; keep one of them",
                )
        _check_exclusive(draft, place, parameter, found)
        found.append(parameter)
    return ParameterSpace(tuple(found))


def _check_exclusive(draft: Draft, place: tuple[str, int], parameter: Parameter, found: list[Parameter]) -> None:
    """No two ways to calibrate one thing, of which the one written last would win."""
    pairs = ({"body_mass", "body_mass_and_inertia"}, {"body_inertia", "body_mass_and_inertia"})
    for other, row in enumerate(found):
        both = {row.field, parameter.field} in pairs and set(row.elements) & set(parameter.elements)
        again = row.field == parameter.field and FIELDS[row.field].element is None
        if both or again:
            line = draft.document.line(("parameters", other))
            raise draft.document.error(
                place, f"{parameter.field} and {row.field} of line {line} are one thing; keep one"
            )


def _check_elements(draft: Draft, model: mujoco.MjModel, index: int) -> None:
    """Refuse elements that are not there, with the nearest that are."""
    given = draft.spec.parameters[index]
    parameter = given.parameter()
    kind = FIELDS[given.field].element
    for position, element in enumerate(parameter.elements):
        place = ("parameters", index, *(("elements", position) if given.elements else ("element",)))
        if kind == "signal":
            known = [signal.name for signal in draft.spec.signals]
            if element not in known:
                raise draft.document.unknown(place, "the name of a signal", element, known)
            continue
        try:
            find_elements(
                model, given.model_copy(update={"elements": None, "element": element, "name": None}).parameter()
            )
        except MadocError as error:
            if kind is None:
                raise
            known = names_of(model, _OBJECTS[kind], getattr(model, _COUNTS[kind]))
            raise draft.document.unknown(place, f"the name of a {kind}", element, known) from error


_OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}


_COUNTS = {"body": "nbody", "joint": "njnt", "geom": "ngeom", "actuator": "nu"}


def _unit_of(draft: Draft, model: mujoco.MjModel, index: int) -> str:
    """The unit of a parameter where that is not its field's; refused where its elements have different ones."""
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
        names = [signal.name for signal in draft.spec.signals]
        return signal_unit(draft, parse(draft.spec.signals[names.index(element)].reads), names.index(element))
    if given.field == "actuator_gain":
        return _gain_unit(model, int(model.actuator(element).id))
    return ""


def _gain_unit(model: mujoco.MjModel, actuator: int) -> str:
    """Of a servo on a joint: force per position or speed. Else a gain has none of its own."""
    if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_JOINT:
        return ""
    slide = is_slide(model, int(model.actuator_trnid[actuator, 0]))
    gain, (_, position, velocity) = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator, :3]
    if gain and position == -gain:
        return "N/m" if slide else "N·m/rad"
    if gain and velocity == -gain and not position:
        return "N·s/m" if slide else "N·m·s/rad"
    return ""
