"""What a user can do about a term that the model lacks."""

from collections.abc import Sequence

from madoc.identification.causes import CHANGE_MACHINE
from madoc.identification.term_tests import MissingTerm
from madoc.parameters import FIELDS, Parameter


def value_of(term: MissingTerm) -> str:
    """The value of a missing term with its standard error and unit, and what the model has where that is not 0."""
    unit = "" if term.unit == "1" else term.unit
    own = f" (the model has {term.nominal:.3g})" if term.nominal else ""
    return f"{term.value:.3g} ± {term.error:.1g} {unit}".rstrip() + own


def is_of_spec(term: MissingTerm) -> bool:
    """Whether a parameter of a spec adds a term; a parameter that changes is one already."""
    return bool(term.parameter) and not term.about.do


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
    return addition([term]) if is_of_spec(term) else term.about.do or CHANGE_MACHINE
