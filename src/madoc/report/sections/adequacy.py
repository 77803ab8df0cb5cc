"""What the log says against the model, and of parameters that it leaves open: missing terms, and combinations."""

from collections.abc import Mapping, Sequence

from madoc.identification.combinations import Combination
from madoc.identification.term_tests import Alternative, MissingTerm
from madoc.report.reading import Run
from madoc.report.words import interval_words, number, parameter_title, percent, unit_words, with_error
from madoc.verdict.adequacy import CERTAIN, is_certain, numerical


def lacks(run: Run) -> dict[str, object] | str:
    """The terms that the model may lack, and the other estimates that the intervals cover."""
    held = run.holdout
    if held is None:
        return "Nothing was held out, so the model was not tested for missing terms."
    if not held.missing_terms and not held.alternatives:
        return "No missing term was found, or the log does not tell the robot's states well enough to look for one."
    largest = max((_largest(term) for term in held.missing_terms), default=0.0)
    rows = [_row(term, largest, run.units) for term in held.missing_terms]
    causes = [term.cause for term in held.missing_terms]
    for at, cause in enumerate(causes):
        if causes.count(cause) > 1:
            rows[at]["cause"] = f"{cause}, shape {1 + causes[:at].count(cause)}"
    alternatives = [_words(each) for each in held.alternatives]
    told = {"largest": number(largest, 2), "certain": number(CERTAIN)}
    none_certain = bool(rows) and numerical(held) is None and not any(map(is_certain, held.missing_terms))
    return {"rows": rows, "alternatives": alternatives, "none_certain": none_certain} | told


def _row(term: MissingTerm, largest: float, units: Mapping[str, str]) -> dict[str, object]:
    """A term as its bar shows it: the largest shift of a parameter, relative to the largest of all terms."""
    name = max(term.shifts, key=lambda each: abs(term.shifts[each]))
    field, _, element = term.parameter.partition(".")
    unit = units.get(element, "") if field == "signal_bias" else unit_words(term.unit)
    value = f"{with_error(term.value, term.standard_error)} {unit}".rstrip()
    return {
        "cause": term.cause,
        "parameter": term.parameter,
        "value": value,
        "t": number(term.t, 3),
        "explained": percent(term.explained),
        "moves": f"{parameter_title(name)} by {number(term.shifts[name], 2)} half-widths",
        "width": round(100.0 * _largest(term) / largest, 2) if largest else 0.0,
        "certain": is_certain(term),
    }


def _largest(term: MissingTerm) -> float:
    return max(map(abs, term.shifts.values()), default=0.0)


def _words(each: Alternative) -> tuple[str, str]:
    """What an alternative rests on, and how it moves the parameters."""
    moved = sorted(each.shifts, key=lambda name: -abs(each.shifts[name]))[:3]
    shifts = (f"{parameter_title(n)} {with_error(each.shifts[n], each.errors[n])}" for n in moved)
    return ", ".join(each.causes), ", ".join(shifts)


def together(run: Run) -> dict[str, object] | str:
    """Sums and products of parameters that the log tells though it leaves each of them open."""
    told: Sequence[Combination] = run.result.combinations if run.result else ()
    if not told:
        return "No parameters had to be combined: the log tells each by itself, or it tells nothing of those left open."
    rows = [
        (each.name, f"{number(each.estimate)} {each.unit}".rstrip(), interval_words(each.interval)) for each in told
    ]
    return {"rows": rows}
