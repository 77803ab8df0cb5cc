"""What a user can do about a term that the model lacks."""

from collections.abc import Sequence

from madoc.identification.body_forces import CUBIC_ALL, WEAKENING_ALL
from madoc.identification.candidate_terms import (
    BELOW_MINIMUM,
    EARLY,
    SATURATION,
    SPACING,
    TILTS,
    UNLISTED,
    is_late,
)
from madoc.identification.drifts import is_change
from madoc.identification.joint_forces import LOADED, SLOW, WEAKENING
from madoc.identification.term_tests import MissingTerm
from madoc.parameters import FIELDS, Parameter

REMEDIES = {
    EARLY: "log each action with what was seen just before it",
    BELOW_MINIMUM: "look for what acts against it: a force, a gain or a sign that the model has wrong",
    SPACING: "check control_step of the spec against the log's time column",
    SATURATION: "say what drives the joint (drive: of its action), or narrow low and high of the actions to what it "
    "follows, or log smaller actions",
    **dict.fromkeys(TILTS, "level it, or tilt the gravity of the model (its option gravity) as the base is"),
}
"""What to do about terms that no further parameter of a spec adds."""
WARM_UP = "let the machine warm up before it is logged, or leave out the start of each run"
"""The same for a parameter that changes within each run."""
CHANGE_MACHINE = (
    "no parameter of a spec adds it: find out whether the machine has it, and calibrate to motions in which it is small"
)
"""The same for a force at a joint."""
LOOK = "look there for what the model leaves out; a parameter that acts like it would be wrong in its place"
"""The same for a force that no listed term describes."""
OF_JOINTS = {
    LOADED: "say under friction: of the spec that it grows with the load (model: M3, or M4 where Stribeck's is there)",
    SLOW: "say under friction: of the spec that it is larger at rest (model: M2, or M4 where it grows with the load)",
    WEAKENING: "say what drives the joint (drive: of its action, whose back-EMF weakens it)",
    WEAKENING_ALL: "where they are motors of joints, say so (drive: of their actions, whose back-EMF weakens them)",
    CUBIC_ALL: "where they are motors of joints, say what limits them (drive: of their actions: supply, current_limit "
    "or saturation)",
}
"""What to do about forces at joints that the spec has words for."""
CHANGE_LOG = "log it without its filter, or shift its column by that time"
"""The same for a sensor that is late."""


def value_of(term: MissingTerm) -> str:
    """The value of a missing term with its standard error and unit, and what the model has where that is not 0."""
    unit = "" if term.unit == "1" else term.unit
    own = f" (the model has {term.nominal:.3g})" if term.nominal else ""
    return f"{term.value:.3g} ± {term.error:.1g} {unit}".rstrip() + own


def is_of_spec(term: MissingTerm) -> bool:
    """Whether a parameter of a spec adds a term; a parameter that changes is one already."""
    other = term.cause in REMEDIES or is_change(term.cause) or term.cause.startswith(UNLISTED)
    return bool(term.parameter) and not other


def line_of(term: MissingTerm) -> Parameter:
    """The parameter that adds a term, in a range twice as wide as its value or eight of its standard errors."""
    field, _, element = term.parameter.partition(".")
    high = 2.0 * max(abs(term.value), 4.0 * term.standard_error)
    low = 0.0 if term.value >= 0.0 else max(-high, FIELDS[field].minimum)
    high = 0.0 if field == "gravity" and term.value < 0.0 else high  # it points downwards
    elements = tuple(element.split("+")) if "+" in element else element
    return Parameter(field, elements, low, high, measured_in=term.unit)


def addition(terms: Sequence[MissingTerm]) -> str:
    """The lines of the spec that add terms."""
    return f"add to the spec's parameters: {' and '.join(map(_entry, terms))}"


def _entry(term: MissingTerm) -> str:
    """A parameter of a spec in YAML."""
    line = line_of(term)
    named = f", element: {line.element}" if isinstance(line.element, str) and line.element else ""
    named = named or (f", elements: [{', '.join(line.elements)}]" if line.elements else "")
    return f"{{field: {line.field}{named}, low: {line.low:.2g}, high: {line.high:.2g}}}"


def remedy(term: MissingTerm) -> str:
    """What to do about a missing term: the line of the spec that adds it, where there is one."""
    if is_of_spec(term):
        return addition([term])
    if term.cause in REMEDIES:
        return REMEDIES[term.cause]
    if is_late(term.cause):
        return CHANGE_LOG
    if term.cause.startswith(UNLISTED):
        return LOOK
    return next((told for cause, told in OF_JOINTS.items() if term.cause.startswith(cause)), CHANGE_MACHINE)
