"""Which terms the model lacks, as the residuals suggest them, and how they would move the estimate.

Windows of the log are simulated at the estimate, their initial states fitted. What neither initial states nor the
calibrated parameters can explain of the residuals is regressed on the same part of each candidate's effect. Terms that
would move the estimate are then fitted together with the parameters.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from madoc import simulation
from madoc.data.dataset import Dataset
from madoc.identification.candidate_effects import effects
from madoc.identification.candidate_terms import WHOLE, Candidate, candidates, of_steps
from madoc.identification.causes import BELOW_MINIMUM, EARLY, INTEGRATION, cause_of
from madoc.identification.drifts import drifts_of
from madoc.identification.fitted_windows import (
    Fit,
    LoggedWindows,
    alike,
    fit_log,
    fit_windows,
    negligible,
    products_of,
    windows_of,
)
from madoc.identification.information import NORMAL_95
from madoc.identification.joint_forces import force_effects
from madoc.identification.replay import Readings
from madoc.identification.responses import Responses, responses_of
from madoc.identification.score_tests import deviate, imitators, joint_shift, parameter_shift, score
from madoc.identification.states import LoggedStates
from madoc.identification.term_tests import (
    DISAGREEING,
    FEWEST,
    LIKELY_FORCE,
    SUSPICIOUS,
    Alternative,
    MissingTerm,
    Suspicions,
    TermTests,
    imitated_terms,
    named,
    term_of,
)
from madoc.identification.unlisted_forces import families, unlisted_forces
from madoc.parameters import FIELDS, ParameterSpace
from madoc.simulation.base import SIMULATED, Simulator

TOGETHER = 4
"""Largest number of terms whose common effect on the estimate is computed."""
WORTH_FITTING = 0.5
"""Shift of a parameter in half-widths of its 95 % interval, from which terms are fitted with the parameters."""
MOST_FITTED = 2
"""Largest number of terms that are fitted together with the parameters."""
DIVERGING = 0.1
"""Share in [0, 1] of windows; a candidate with which more of them diverge is not tested."""
_AT_MINIMUM = 1e-3
"""Distance in [-1, 1] from the end of a range, up to which a parameter is at its minimum."""
LIKELY_FRICTION = 1.0
"""t from which Coulomb friction counts though it is not significant; 16 % of joints without any reach it by chance."""
OTHER_WINDOWS = "windows of another length, which give another estimate"


def suspicions(
    dataset: Dataset,
    logged: LoggedStates,
    simulator: Simulator,
    point: Float[np.ndarray, " d"],
    half_widths: Float[np.ndarray, " d"],
    scale: Float[np.ndarray, " observation"],
    *,
    most: int | None = None,
) -> Suspicions:
    """Terms that the model may lack, and what including them would do to the estimate.

    Args:
        dataset: The log that was calibrated to.
        logged: What it says of states; those must not be `unknown`.
        simulator: The model with its calibrated parameters.
        point: The estimate in [-1, 1]. An estimate that is not at the minimum is led there first, as residuals of wrong
            parameters would pass for missing terms.
        half_widths: Half of each parameter's 95 % interval in [-1, 1].
        scale: Typical change of each signal in a step.
        most: Largest number of windows; None for the usual one.
    """
    began = SIMULATED.control_steps
    windows = windows_of(dataset, logged, scale, fewest=2 * (FEWEST + len(point)), most=most)
    readings, runs = windows.readings, windows.runs
    if len(readings) < FEWEST + len(point):
        return Suspicions(tested=False)
    led = (fit := fit_log(dataset, logged, simulator, windows, point)).point
    responses = responses_of(simulator, readings, fit.point, fit.states, fit.slopes.whole)
    tried, by_terms = _effects(logged, simulator, windows, fit, scale, responses)
    both = replace(fit.slopes, by_parameters=np.concatenate([fit.slopes.by_parameters, by_terms], axis=-1))
    products, counted = products_of(both, readings, len(led)), both.finite
    if products is None or len(products) < FEWEST + len(led):
        return Suspicions(control_steps=SIMULATED.control_steps - began, tested=negligible(both))
    tests = TermTests(products, tuple(tried), simulator.parameters, half_widths, runs[counted])
    beside = tests.less_steps()
    drifts, others = drifts_of(beside, dataset.names_of_runs)
    of_rest = (*_below_minimum(beside, led), *drifts)
    terms = [*_terms(tests), *(replace(each, explained=tests.beside_steps * each.explained) for each in of_rest)]
    unlisted, covering = unlisted_forces(tests, families(simulator, responses), readings, fit, by_terms, responses)
    terms, others = [*terms, *unlisted], [*others, *covering]
    others += _of_other_windows(tests, led - point)
    chosen = _chosen(tests)
    fitted, with_chosen = _of_chosen(tests, chosen, simulator, readings, fit, point)
    terms = [fitted.get(term.parameter, term) for term in terms]
    others += [*with_chosen, *_within_bounds(tests, chosen), *_of_forces(tests, chosen)]
    most_significant_first = sorted(terms, key=lambda term: -abs(term.t))
    found = tuple(most_significant_first), tuple(others), tuple(imitated_terms(tests))
    lasting = alike(_less_steps(fit, tests, by_terms), readings)
    return Suspicions(*found, SIMULATED.control_steps - began, alike=lasting)


def _less_steps(fit: Fit, tests: TermTests, by_terms: Float[np.ndarray, "windows values terms"]) -> Fit:
    """The fit with residuals that the error of the integration step leaves, to first order."""
    if tests.steps is None:
        return fit
    index, found = tests.steps
    moved = found.change * np.nan_to_num(by_terms[..., index]) + fit.slopes.by_parameters @ found.shifts
    return replace(fit, slopes=replace(fit.slopes, residuals=fit.slopes.residuals + moved))


def _effects(
    logged: LoggedStates,
    simulator: Simulator,
    windows: LoggedWindows,
    fit: Fit,
    scale: Float[np.ndarray, " observation"],
    responses: Responses,
) -> tuple[list[Candidate], Float[np.ndarray, "windows values terms"]]:
    """Every candidate and the derivative of the residuals by it, 0 for one that most windows cannot bear."""
    readings, added = windows.readings, list(candidates(logged, simulator, fit.point, scale))
    space = ParameterSpace((*simulator.parameters.parameters, *(parameter for _, parameter in added)))
    wide = simulation.make(replace(simulator.task, parameters=space))
    at_nominal = np.concatenate([fit.point, -np.ones(len(added))])
    tried, by_terms = effects(simulator, wide, readings, windows.before, at_nominal, fit.states, added)
    whole = fit.slopes.whole
    forces, by_forces = force_effects(simulator, logged, responses, windows.earlier)
    by_terms = np.concatenate([by_terms, by_forces], axis=-1)
    if whole.any():
        diverges = (~np.isfinite(by_terms).all(1)[whole]).mean(0) > DIVERGING
        by_terms[..., diverges] = 0.0  # so that others are tested
    return [*tried, *forces], by_terms


def _of_chosen(
    tests: TermTests,
    chosen: list[int],
    simulator: Simulator,
    readings: Readings,
    fit: Fit,
    point: Float[np.ndarray, " d"],
) -> tuple[dict[str, MissingTerm], list[Alternative]]:
    """The estimates with the chosen terms, with their rivals, and with one more.

    The terms are fitted together with the parameters where they move these by much: the fitted ones come first, by the
    name of their parameter.
    """
    if not chosen:
        return {}, []
    together, terms, others = _with_terms(tests, chosen), dict[str, MissingTerm](), list[Alternative]()
    if max(map(abs, together.shifts.values())) >= WORTH_FITTING and not _beside_steps(tests, chosen):
        terms, others = _fitted(tests, chosen, simulator, readings, fit, point)
    if len(terms) < len(chosen):
        others.append(together)
    further = [*_rivals(tests, chosen), *_further(tests, chosen)]
    others += [_with_terms(tests, rivals) for rivals in further]
    return terms, others


def _beside_steps(tests: TermTests, chosen: list[int]) -> bool:
    """Whether the error of the integration step is among the chosen: in a fit without it other terms would have it."""
    steps = (tests.score(index) for index in chosen if tests.tried[index].cause == INTEGRATION)
    return any(found is not None and of_steps(found.change) for found in steps)


def _terms(tests: TermTests) -> Iterator[MissingTerm]:
    """The score test of every candidate whose value is physical; the error of the integration step is taken away."""
    for index, candidate in enumerate(tests.tried):
        found = tests.alone(index)
        if found is not None:
            yield term_of(candidate, found, tests.by_name(found.shifts))


def _below_minimum(tests: TermTests, led: Float[np.ndarray, " d"]) -> Iterator[MissingTerm]:
    """Parameters at their physical minimum that the residuals pull below it, where no search may follow.

    Something else must be missing, and in other tests these parameters would explain it, with the wrong sign.
    """
    rows = tests.space.parameters
    pinned = [
        index for index, row in enumerate(rows) if led[index] <= -1.0 + _AT_MINIMUM and row.low <= row.kind.minimum
    ]
    free = [index for index in range(len(rows)) if index not in pinned]
    products = tests.products.with_parameters(free)
    for place, index in enumerate(pinned):
        row, found = rows[index], score(products, 1 + len(free) + place)
        if found is None or found.change >= 0.0 or abs(found.t) < SUSPICIOUS:
            continue
        half, shifts, early = (row.high - row.low) / 2.0, np.zeros(len(rows)), row.kind.of_all
        shifts[free], shifts[index] = found.shifts, found.change
        yield MissingTerm(
            cause=EARLY if early else BELOW_MINIMUM,
            parameter="" if early else row.name,
            value=row.low + half * found.change,
            standard_error=half * found.error,
            unit=row.unit,
            explained=found.explained,
            t=found.t,
            shifts=tests.by_name(shifts),
        )


def _chosen(tests: TermTests) -> list[int]:
    """Candidates that cannot be excluded, each the most significant beside those before it."""
    chosen: list[int] = []
    for _ in range(TOGETHER):
        significance = _significance(tests, chosen)
        best = max(significance, key=lambda index: significance[index], default=None)
        if best is None or significance[best] < SUSPICIOUS:
            break
        chosen.append(best)
    return chosen


def _rivals(tests: TermTests, chosen: list[int]) -> Iterator[list[int]]:
    """The chosen candidates with one of them replaced by another that cannot be excluded in its place.

    Twice the difference of two terms' logarithms of the likelihood is about that of their t². A rival need not be
    significant by itself, as something is missing; but the t² of a term that is not missing is 1 on average.
    """
    for place in range(len(chosen)):
        rest = [*chosen[:place], *chosen[place + 1 :]]
        significance = _significance(tests, rest)
        least = max(1.0, significance.get(chosen[place], 0.0) ** 2 - SUSPICIOUS**2)
        for index, t in significance.items():
            if index not in chosen and t**2 >= least:
                yield [index, *rest]


def _further(tests: TermTests, chosen: list[int]) -> Iterator[list[int]]:
    """The chosen candidates with one more that cannot be excluded beside them, as they are at most `TOGETHER`."""
    for index, t in _significance(tests, chosen).items():
        if t >= SUSPICIOUS:
            yield [index, *chosen]


def _significance(tests: TermTests, beside: list[int]) -> dict[int, float]:
    """|t| of every other candidate beside these; terms that users know well without the log are not asked for."""
    others = (index for index, each in enumerate(tests.tried) if index not in beside and not each.known_before)
    scores = {index: tests.score(index, beside) for index in others}
    return {index: abs(found.t) for index, found in scores.items() if found is not None}


def _with_terms(tests: TermTests, chosen: list[int]) -> Alternative:
    """The estimate of the model with these terms, by linear regression.

    The error of the integration step counts as uncertain by all of its effect, as that changes with the length of
    windows.
    """
    _, shift, covariance = joint_shift(tests.products, [1 + tests.products.count + index for index in chosen])
    error = NORMAL_95 * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    for index in chosen:
        if tests.tried[index].cause == INTEGRATION:
            alone = tests.score(index)
            error = np.hypot(error, 0.0 if alone is None else alone.shifts)
    causes = tuple(dict.fromkeys(named(tests.tried[index]) for index in chosen))
    return tests.alternative(causes, shift, error)


def _fitted(
    tests: TermTests,
    chosen: list[int],
    simulator: Simulator,
    readings: Readings,
    without: Fit,
    point: Float[np.ndarray, " d"],
) -> tuple[dict[str, MissingTerm], list[Alternative]]:
    """The first of these terms fitted together with the parameters, and the estimate; none if a spec can say no term.

    A score test is one linear step, which is too short where residuals are far from noise and so count little.
    `without` is the fit without the terms.
    """
    led = without.point
    changes, shift, _ = joint_shift(tests.products, [1 + tests.products.count + index for index in chosen])
    possible = [
        (tests.tried[index], parameter, float(change))
        for index, change in zip(chosen, changes, strict=True)
        if (found := tests.score(index)) is not None and (parameter := tests.tried[index].added(found)) is not None
    ][:MOST_FITTED]
    if not possible:
        return {}, []
    space = ParameterSpace((*tests.space.parameters, *(parameter for _, parameter, _ in possible)))
    wide = simulation.make(replace(simulator.task, parameters=space))
    values = np.array([candidate.nominal + change * candidate.reference for candidate, _, change in possible])
    start = np.concatenate([led + shift, np.zeros(len(values))])
    start[len(led) :] = space.to_unit(np.concatenate([simulator.parameters.middle, values]))[len(led) :]
    fit = fit_windows(wide, readings, without.states, np.clip(start, -1.0, 1.0))
    at, products = fit.point, products_of(fit.slopes, readings, len(fit.point))
    if products is None:
        return {}, []
    step, covariance = parameter_shift(products)
    at, error = at + step, np.sqrt(np.maximum(np.diag(covariance), 0.0))
    alone = np.sqrt(np.maximum(np.diag(parameter_shift(tests.products)[1]), 0.0))
    beyond = NORMAL_95 * np.sqrt(np.maximum(error[: len(led)] ** 2 - alone**2, 0.0))
    shifts, physical = tests.by_name(at[: len(led)] - point), space.to_physical(at)
    terms = {}
    for place, (candidate, parameter, _) in enumerate(possible, start=len(led)):
        found = tests.alone(tests.tried.index(candidate))
        value, deviation = float(physical[place]), float(error[place]) * (parameter.high - parameter.low) / 2.0
        if found is not None and deviation > 0.0:
            significance = deviate((value - candidate.nominal) / deviation, found.freedom)
            term = replace(term_of(candidate, found, shifts), value=value, standard_error=deviation, t=significance)
            terms[candidate.parameter] = term
    causes = tuple(named(candidate) for candidate, _, _ in possible)
    return terms, [Alternative(causes, shifts, tests.by_name(beyond))]


def _within_bounds(tests: TermTests, chosen: list[int]) -> Iterator[Alternative]:
    """The estimates with as much of a term as its 95 % interval holds and is possible, if it is not `chosen` anyway.

    Nearly every joint has Coulomb friction: where noise hides it, it biases a damping by several standard errors. And a
    machine has no integration steps: parameters imitate their error, as a delay does half a step.
    """
    for index, candidate in enumerate(tests.tried):
        of_step = candidate.cause == INTEGRATION
        if index in chosen or not (of_step or candidate.cause == FIELDS["dof_frictionloss"].missing):
            continue
        found, least = (
            tests.score(index),
            0.0 if of_step else (candidate.least - candidate.nominal) / candidate.reference,
        )
        most = WHOLE if of_step else np.inf
        if found is not None and (of_step or found.t >= LIKELY_FRICTION):
            low, high, by_one = found.change - found.reach, found.change + found.reach, found.shifts / found.change
        elif of_step and (imitated := imitators(tests.products, 1 + tests.products.count + index)) is not None:
            low, high, by_one = least, most, imitated
        else:
            continue
        if low > most or high < least:
            continue
        low, high = np.clip((low, high), least, most)
        shift, error = 0.5 * (low + high) * by_one, 0.5 * (high - low) * np.abs(by_one)
        if np.max((np.abs(shift) + error) / tests.half_widths) >= WORTH_FITTING:
            yield tests.alternative((named(candidate),), shift, error, bounded=True)


def _of_forces(tests: TermTests, chosen: list[int]) -> Iterator[Alternative]:
    """The estimates with a force at a joint, or a late drive or sensor, that is likely beside the chosen terms.

    These are too many for all that cannot be excluded to be covered.
    """
    for index, candidate in enumerate(tests.tried):
        tried = cause_of(candidate.cause).group in ("force", "unlisted", "late")
        found = tests.score(index, chosen) if tried else None
        if found is not None and abs(found.t) >= LIKELY_FORCE:
            yield _with_terms(tests, [index, *chosen])


def _of_other_windows(tests: TermTests, led: Float[np.ndarray, " d"]) -> Iterator[Alternative]:
    """The estimate of these windows, where it disagrees with the given one, from which `led` has led to them."""
    step, covariance = parameter_shift(tests.products)
    shifts = tests.by_name(led + step)
    errors = tests.by_name(np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    apart = [
        name for name, shift in shifts.items() if abs(shift) > DISAGREEING * np.hypot(errors[name], 1.0 / NORMAL_95)
    ]
    if apart:
        beyond = {name: NORMAL_95 * errors[name] for name in apart}
        yield Alternative((OTHER_WINDOWS,), {name: shifts[name] for name in apart}, beyond)
