"""Whether parameters change over the log: by score tests, between runs, and from its first third to its last."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.identification.candidate_terms import Candidate
from madoc.identification.fitted_windows import Fit, fit_windows, products_of
from madoc.identification.information import NORMAL_95
from madoc.identification.random_effects import common
from madoc.identification.replay import Readings
from madoc.identification.score_tests import deviate, parameter_shift, score, shared_deviate, variances_by_group
from madoc.identification.term_tests import (
    DISAGREEING,
    FEWEST,
    SUSPICIOUS,
    Alternative,
    MissingTerm,
    TermTests,
    term_of,
)
from madoc.simulation.base import Simulator

DRIFT = "a value that changes over the log"
WITHIN_RUNS = "a value that changes within each run"
ONE_RUN = "another value in one run"
"""What it stands for; the name of the run follows in brackets."""
MOST_RUNS = 20
"""Largest number of runs of which each is compared with all others; of more, they are compared all together alone."""
FEWEST_OF_A_RUN = 3
"""Fewest windows of a run beyond the number of parameters, of which its values are estimated: their errors count only
together with those of other runs."""
FEWEST_RUNS = 3
"""Fewest degrees of freedom of a variance between runs; with fewer, runs of their own motions would seem to differ."""


def drifts_of(
    tests: TermTests,
    simulator: Simulator,
    readings: Readings,
    runs: Int[np.ndarray, " windows"],
    fit: Fit,
    point: Float[np.ndarray, " d"],
    names: Sequence[str],
) -> tuple[list[MissingTerm], list[Alternative]]:
    """The most significant change of each parameter, and estimates of parts of the log that disagree.

    A parameter may change over the log, within each run, as where a drive warms up, from run to run, or in one alone.

    Thirds of the log, and single runs, are fitted by themselves only where a test says that a parameter changes: score
    tests underestimate a change that leaves residuals far from noise, which count little.

    Args:
        tests: Score tests of the log.
        simulator: The model with its calibrated parameters.
        readings: The windows that the tests are of.
        runs: The episode that each of them is from.
        fit: What they were fitted by.
        point: The estimate in [-1, 1], from which shifts count.
        names: Names of the episodes.

    Returns:
        The changes and the other estimates.
    """
    drifts = list(_drifts(tests))
    others = list(_of_parts(drifts))
    between, covering = _between_runs(tests)
    others += covering
    disagreeing = dict.fromkeys(term.parameter for term in drifts if term.cause == DRIFT and abs(term.t) >= DISAGREEING)
    if disagreeing:
        time = np.linspace(-1.0, 1.0, len(readings))
        thirds = _fitted_parts(simulator, readings, fit, [time < -1.0 / 3.0, time > 1.0 / 3.0])
        if len(thirds) == 2:
            drifts += list(_changes(tests, thirds, drifts))
            others += _of_fitted_parts(tests, thirds, disagreeing, point)
    differing = [term.parameter for term in between if term.t >= SUSPICIOUS]
    if differing:
        single = [runs == run for run in np.unique(runs)]
        fitted = _fitted_parts(simulator, readings, fit, single, fewest=FEWEST_OF_A_RUN)
        others += _of_fitted_runs(tests, fitted, differing, point)
    return list(_most_certain([*drifts, *between, *_in_one_run(tests, names)])), others


def is_change(cause: str) -> bool:
    """Whether the cause of a missing term is that a parameter changes over the log, within runs or in one of them."""
    return cause in (DRIFT, WITHIN_RUNS) or cause.startswith(ONE_RUN)


def _in_one_run(tests: TermTests, names: Sequence[str]) -> Iterator[MissingTerm]:
    """By how much each parameter is another one in one run than in all others, in the run where that is clearest."""
    named = np.array(names)[tests.runs]
    present = np.unique(named).tolist()
    if not FEWEST_RUNS <= len(present) <= MOST_RUNS:
        return
    for index, row in enumerate(tests.space.parameters):
        found = {run: score(tests.products, 1 + index, shape=_less_mean(named == run)) for run in present}
        scores = {run: each for run, each in found.items() if each is not None}
        if not scores:
            continue
        clearest = max(scores, key=lambda run: abs(scores[run].t))
        own = scores[clearest]
        candidate = Candidate(f"{ONE_RUN} ({clearest})", row.name, row.unit, 0.0, (row.high - row.low) / 2, -np.inf)
        term = term_of(candidate, own, {row.name: own.change / float(tests.half_widths[index])})
        t = max(0.0, shared_deviate(abs(own.t), len(present)))
        yield replace(term, t=float(np.copysign(t, own.change)))


def _less_mean(chosen: Bool[np.ndarray, " windows"]) -> Float[np.ndarray, " windows"]:
    """1 in the chosen windows and 0 in the others, less the mean."""
    return chosen - float(np.mean(chosen))


def _drifts(tests: TermTests) -> Iterator[MissingTerm]:
    """How each parameter changes over the log: in a straight line, in its first third, in its last, in every run.

    A line's value is the change from the middle of the first third to that of the last, as those of the thirds are.
    """
    time, age = np.linspace(-1.0, 1.0, len(tests.products)), _since_begin(tests.runs)
    shapes = [(DRIFT, shape - np.mean(shape)) for shape in (0.75 * time, time < -1.0 / 3.0, time > 1.0 / 3.0)]
    shapes += [(WITHIN_RUNS, age)] if len(np.unique(tests.runs)) > 1 and age.any() else []
    for index, row in enumerate(tests.space.parameters):
        for cause, shape in shapes:
            candidate = Candidate(cause, row.name, row.unit, 0.0, (row.high - row.low) / 2.0, -np.inf)
            found = score(tests.products, 1 + index, shape=shape)
            if found is not None:
                yield term_of(candidate, found, {row.name: found.change / float(tests.half_widths[index])})


def _since_begin(runs: Int[np.ndarray, " windows"]) -> Float[np.ndarray, " windows"]:
    """Place of each window among those of its run, from -1 for the first to 1 for the last; 0 for a single one."""
    age = np.zeros(len(runs))
    for run in np.unique(runs):
        own = runs == run
        age[own] = np.linspace(-1.0, 1.0, own.sum()) if own.sum() > 1 else 0.0
    return age


def _between_runs(tests: TermTests) -> tuple[list[MissingTerm], list[Alternative]]:
    """Parameters that differ from run to run, and estimates that cover how much.

    Where all windows are alike, the variance of an estimate by leaving out runs is that by leaving out windows, and
    their ratio has Fisher's distribution.
    """
    from scipy.stats import f as fisher  # slow to import, and only tests of terms need it
    from scipy.stats import norm

    terms, others = list[MissingTerm](), list[Alternative]()
    if len(np.unique(tests.runs)) <= FEWEST_RUNS:
        return terms, others
    by_run, freedom = variances_by_group(tests.products, tests.runs)
    by_window, windows = variances_by_group(tests.products, np.arange(len(tests.products)))
    for index, row in enumerate(tests.space.parameters):
        if freedom[index] < FEWEST_RUNS or not by_window[index] > 0.0:
            continue
        chance = fisher.sf(by_run[index] / by_window[index], freedom[index], windows[index])
        # Runs that agree better than by chance, as where all repeat one motion, are no sign of a change.
        t = float(norm.isf(np.clip(chance, np.finfo(float).tiny, 0.5)))
        beyond = max(0.0, float(by_run[index] - by_window[index]))
        deviation, error = np.sqrt([(freedom[index] + 1.0) * beyond, by_run[index]]).tolist()
        half, half_width = (row.high - row.low) / 2.0, float(tests.half_widths[index])
        shift = {row.name: deviation / half_width}
        terms.append(MissingTerm(DRIFT, row.name, deviation * half, error * half, row.unit, 0.0, t, shift))
        if t >= SUSPICIOUS:  # then an interval is to hold the value of any run
            errors = {row.name: NORMAL_95 * float(np.hypot(deviation, error)) / half_width}
            others.append(Alternative((f"{row.name} changing from run to run",), {row.name: 0.0}, errors, True))
    return terms, others


@dataclass(frozen=True)
class _Part:
    """The estimate of a part of the log: its point in [-1, 1], the variance of that, and its degrees of freedom."""

    point: Float[np.ndarray, " d"]
    variance: Float[np.ndarray, " d"]
    freedom: int


def _fitted_parts(
    simulator: Simulator,
    readings: Readings,
    fit: Fit,
    parts: Iterable[Bool[np.ndarray, " windows"]],
    *,
    fewest: int = FEWEST,
) -> list[_Part]:
    """Estimates of the parts of the log with `fewest` windows more than parameters."""
    found = list[_Part]()
    for part in parts:
        if part.sum() < fewest + len(fit.point):
            continue
        own_readings = readings.of(np.flatnonzero(part))
        own = fit_windows(simulator, own_readings, fit.states[part], fit.point)
        products = products_of(own.slopes, own_readings, len(own.point))
        if products is None or len(products) < fewest + len(own.point):
            continue
        step, covariance = parameter_shift(products)
        point, variance = np.clip(own.point + step, -1.0, 1.0), np.maximum(np.diag(covariance), 0.0)
        found.append(_Part(point, variance, len(products) - 1))
    return found


def _changes(tests: TermTests, thirds: list[_Part], drifts: Iterable[MissingTerm]) -> Iterator[MissingTerm]:
    """The change of each parameter from the first third to the last; `explained` is that of its score tests."""
    first, last = thirds
    explained: dict[str, float] = defaultdict(float)
    for drift in drifts:
        explained[drift.parameter] = max(explained[drift.parameter], drift.explained)
    freedom = min(first.freedom, last.freedom)
    columns = zip(tests.space.parameters, last.point - first.point, first.variance + last.variance, strict=True)
    for index, (row, change, variance) in enumerate(columns):
        if variance > 0.0:
            half, error = (row.high - row.low) / 2.0, float(np.sqrt(variance))
            yield MissingTerm(
                cause=DRIFT,
                parameter=row.name,
                value=float(change) * half,
                standard_error=error * half,
                unit=row.unit,
                explained=explained[row.name],
                t=deviate(float(change) / error, freedom),
                shifts={row.name: float(change / tests.half_widths[index])},
            )


def _of_fitted_parts(
    tests: TermTests, parts: list[_Part], names: Iterable[str], point: Float[np.ndarray, " d"]
) -> Iterator[Alternative]:
    """The estimates of all parts of the log for each parameter that changes over it."""
    for part in parts:
        shifts = tests.by_name(part.point - point)
        errors = tests.by_name(NORMAL_95 * np.sqrt(part.variance))
        for name in names:
            cause = f"{name} changing over the log"
            yield Alternative((cause,), {name: shifts[name]}, {name: errors[name]}, parts=True)


def _of_fitted_runs(
    tests: TermTests, runs: list[_Part], names: Iterable[str], point: Float[np.ndarray, " d"]
) -> Iterator[Alternative]:
    """For each parameter that differs from run to run the mean of its estimates, and an interval for any of them.

    Mean and standard deviation are those of the random-effects model, in which a run that tells little counts little.
    """
    for name in names:
        index = tests.space.names.index(name)
        telling = [run for run in runs if run.variance[index] > 0.0]  # a run in which it has no effect tells nothing
        if len(telling) <= FEWEST_RUNS:
            continue
        values, variances = np.array([(run.point[index], run.variance[index]) for run in telling]).T
        kind, half_width = common(values, np.sqrt(variances)), float(tests.half_widths[index])
        shift, reach = (kind.mean - float(point[index])) / half_width, NORMAL_95 * kind.spread / half_width
        cause = f"{name} changing from run to run"
        yield Alternative((cause,), {name: shift}, {name: reach}, parts=True)


def _most_certain(drifts: Iterable[MissingTerm]) -> Iterable[MissingTerm]:
    """Of the changes of each parameter the most significant one."""
    best: dict[str, MissingTerm] = {}
    for drift in drifts:
        if drift.parameter not in best or abs(drift.t) > abs(best[drift.parameter].t):
            best[drift.parameter] = drift
    return best.values()


def _of_parts(drifts: Iterable[MissingTerm]) -> Iterator[Alternative]:
    """Estimates of parts of the log that disagree with the whole, to either side."""
    for term in drifts:
        if abs(term.t) >= DISAGREEING:
            shift = term.shifts[term.parameter]
            errors = {term.parameter: abs(NORMAL_95 * shift / term.t)}
            for side in (-shift, shift):
                when = "over the log" if term.cause == DRIFT else "within each run"
                causes, shifts = (f"{term.parameter} changing {when}",), {term.parameter: side}
                yield Alternative(causes, shifts, errors, parts=True)
