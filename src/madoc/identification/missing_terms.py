"""Which terms the model lacks, as the residuals suggest them, and how they would move the estimate.

Windows of the log are simulated at the estimate, their initial states fitted. What neither initial states nor the
calibrated parameters can explain of the residuals is regressed on the same part of each candidate's effect. Terms that
would move the estimate are then fitted together with the parameters.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from madoc import simulation
from madoc.data.dataset import Dataset
from madoc.identification.candidate_terms import DELAY, EARLY, INTEGRATION, Candidate, candidates, effects
from madoc.identification.fitted_windows import Fit, fit_windows, products_of, windows_of
from madoc.identification.information import NORMAL_95
from madoc.identification.replay import Readings
from madoc.identification.score_tests import Products, Score, deviate, joint_shift, parameter_shift, score
from madoc.identification.states import LoggedStates
from madoc.parameters import ParameterSpace
from madoc.simulation.base import Simulator

SUSPICIOUS = 2.0
"""|t| from which a term cannot be excluded: 5 % of terms that are not missing reach it by chance."""
DISAGREEING = 3.0
"""|t| from which parts of the log, or windows of another length, give another estimate: one in 370 does by chance."""
TOGETHER = 4
"""Largest number of terms whose common effect on the estimate is computed."""
WORTH_FITTING = 0.5
"""Shift of a parameter in half-widths of its 95 % interval, from which terms are fitted with the parameters."""
MOST_FITTED = 2
"""Largest number of terms that are fitted together with the parameters."""
DRIFT = "a value that changes over the log"
OTHER_WINDOWS = "windows of another length, which give another estimate"
_FEWEST = 12
"""Fewest windows beyond the number of parameters for which a standard error is worth anything."""


@dataclass(frozen=True)
class MissingTerm:
    """A term that the model lacks, as the residuals suggest it.

    Attributes:
        cause: What the term stands for, in words.
        parameter: The parameter of the spec that adds it, as `dof_frictionloss.hinge`; empty if there is none.
        value: Its estimated value, in `unit`: of a parameter its value in the model.
        standard_error: Of the value.
        unit: Unit of the value.
        explained: Share of the squared residuals that it explains, those of initial states and parameters taken away.
        t: Its change from the model over the standard error, as the normal deviate of the same probability.
        shifts: By how much each calibrated parameter would move if the term were included, in half-widths of its
            95 % interval.
    """

    cause: str
    parameter: str
    value: float
    standard_error: float
    unit: str
    explained: float
    t: float
    shifts: dict[str, float]


@dataclass(frozen=True)
class Alternative:
    """Another estimate that the log does not exclude: of a model with more terms, or of other parts of the log.

    Attributes:
        causes: What it rests on, in words.
        terms: Whether these are the terms that the log asks for, all together.
        shifts: By how much it moves each calibrated parameter, in half-widths of its 95 % interval.
        errors: Half of the 95 % interval of each shift, in the same unit.
        parts: Whether it is the estimate of a part of the log.
    """

    causes: tuple[str, ...]
    terms: bool
    shifts: dict[str, float]
    errors: dict[str, float]
    parts: bool = False


@dataclass(frozen=True)
class Suspicions:
    """What the log says against the model.

    Attributes:
        terms: Candidates with a physical sign, such as friction that takes energy out, the most significant first.
        alternatives: Other estimates that it does not exclude.
        control_steps: Control steps that were simulated to find that out.
    """

    terms: tuple[MissingTerm, ...] = ()
    alternatives: tuple[Alternative, ...] = ()
    control_steps: int = 0


def suspicions(
    dataset: Dataset,
    logged: LoggedStates,
    simulator: Simulator,
    point: Float[np.ndarray, " d"],
    half_widths: Float[np.ndarray, " d"],
    scale: Float[np.ndarray, " observation"],
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
    """
    readings, states, before = windows_of(dataset, logged, scale, fewest=2 * (_FEWEST + len(point)))
    if len(readings) < _FEWEST + len(point):
        return Suspicions()
    fit = fit_windows(simulator, readings, states, point)
    led = fit.point
    added = list(candidates(logged, simulator, led, scale))
    space = ParameterSpace((*simulator.parameters.parameters, *(parameter for _, parameter in added)))
    wide = simulation.make(replace(simulator.task, parameters=space))
    at_nominal = np.concatenate([led, -np.ones(len(added))])
    tried, by_terms = effects(simulator, wide, readings, before, at_nominal, fit.states, added)
    spent = fit.control_steps + (1 + len(tried)) * len(readings) * readings.steps
    both = replace(fit.slopes, by_parameters=np.concatenate([fit.slopes.by_parameters, by_terms], axis=-1))
    products = products_of(both, readings, len(led))
    if products is None or len(products) < _FEWEST + len(led):
        return Suspicions(control_steps=spent)
    tests = _Tests(products, tuple(tried), simulator.parameters, half_widths)
    chosen, drifts = _chosen(tests), list(_drifts(tests))
    terms, others = list(_terms(tests)), [*_of_parts(drifts), *_of_other_windows(tests, led - point)]
    if any(abs(term.t) >= DISAGREEING for term in drifts):
        thirds = _fitted_thirds(tests, simulator, readings, fit)
        spent += sum(third.control_steps for third in thirds)
        drifts = [*drifts, *_changes(tests, thirds, drifts)]
        others += _of_thirds(tests, thirds, drifts, point)
    terms += _most_certain(drifts)
    if chosen:
        together = _with_terms(tests, chosen)
        richer = None
        if max(map(abs, together.shifts.values())) >= WORTH_FITTING:
            richer = _fitted(tests, chosen, simulator, readings, fit, point)
        if richer is not None:
            spent += richer.control_steps
            terms = [richer.terms.get(term.parameter, term) for term in terms]
            others.append(richer.alternative)
        if richer is None or len(richer.terms) < len(chosen):
            others.append(together)
        others += [replace(_with_terms(tests, rivals), terms=False) for rivals in _rivals(tests, chosen)]
    return Suspicions(tuple(sorted(terms, key=lambda term: -abs(term.t))), tuple(others), spent)


@dataclass(frozen=True)
class _Tests:
    """What score tests need: products of residuals and derivatives, the candidates, and the scale of shifts."""

    products: Products
    tried: tuple[Candidate, ...]
    space: ParameterSpace
    half_widths: Float[np.ndarray, " d"]

    def score(self, index: int, beside: Sequence[int] = ()) -> Score | None:
        """The score of a candidate beside others; None if there is none, or if its value would not be physical."""
        first = 1 + self.products.count
        found, candidate = score(self.products, first + index, [first + other for other in beside]), self.tried[index]
        below = found is not None and candidate.nominal + found.change * candidate.reference < candidate.least
        return None if below else found

    def by_name(self, values: Float[np.ndarray, " d"]) -> dict[str, float]:
        """Values in [-1, 1] of each parameter, by name and in half-widths."""
        return dict(zip(self.space.names, (values / self.half_widths).tolist(), strict=True))


@dataclass(frozen=True)
class _RicherModel:
    """Terms by the name of their parameter, fitted together with the parameters, and the estimate with them."""

    terms: dict[str, MissingTerm]
    alternative: Alternative
    control_steps: int


def _terms(tests: _Tests) -> Iterator[MissingTerm]:
    """The score test of every candidate whose value is physical.

    If the error of the integration step is significant, it is taken away before the others are tested.
    """
    beside: list[int] = []
    for index in sorted(range(len(tests.tried)), key=lambda index: tests.tried[index].cause != INTEGRATION):
        candidate, found = tests.tried[index], tests.score(index, beside)
        if found is None:
            continue
        if candidate.cause == INTEGRATION and abs(found.t) >= SUSPICIOUS:
            beside = [index]
        yield _term(candidate, found, tests.by_name(found.shifts))


def _term(candidate: Candidate, found: Score, shifts: dict[str, float]) -> MissingTerm:
    early = candidate.cause == DELAY and found.change < 0.0
    return MissingTerm(
        cause=EARLY if early else candidate.cause,
        parameter="" if early else candidate.parameter,
        value=candidate.nominal + found.change * candidate.reference,
        standard_error=found.error * candidate.reference,
        unit=candidate.unit,
        explained=found.explained,
        t=found.t,
        shifts=shifts,
    )


def _drifts(tests: _Tests) -> Iterator[MissingTerm]:
    """How each parameter changes over the log: in a straight line, in its first third, and in its last."""
    time = np.linspace(-1.0, 1.0, len(tests.products))
    shapes = [shape - np.mean(shape) for shape in (time, time < -1.0 / 3.0, time > 1.0 / 3.0)]
    for index, row in enumerate(tests.space.parameters):
        candidate = Candidate(DRIFT, row.name, row.unit, 0.0, (row.high - row.low) / 2.0, -np.inf)
        for shape in shapes:
            found = score(tests.products, 1 + index, shape=shape)
            if found is not None:
                yield _term(candidate, found, {row.name: found.change / float(tests.half_widths[index])})


@dataclass(frozen=True)
class _Third:
    """The estimate of a third of the log: its point in [-1, 1], the variance of that, and its degrees of freedom."""

    point: Float[np.ndarray, " d"]
    variance: Float[np.ndarray, " d"]
    freedom: int
    control_steps: int


def _fitted_thirds(tests: _Tests, simulator: Simulator, readings: Readings, fit: Fit) -> list[_Third]:
    """Estimates of the first and of the last third of the log; none where a third has too few windows.

    A score test underestimates a change that leaves residuals far from noise, which count little.
    """
    time, found = np.linspace(-1.0, 1.0, len(readings)), list[_Third]()
    for third in (time < -1.0 / 3.0, time > 1.0 / 3.0):
        if third.sum() < _FEWEST + len(fit.point):
            return []
        part = replace(readings, actions=readings.actions[third], observed=readings.observed[third])
        own = fit_windows(simulator, part, fit.states[third], fit.point)
        products = products_of(own.slopes, part, len(own.point))
        if products is None or len(products) < _FEWEST + len(own.point):
            return []
        step, covariance = parameter_shift(products)
        point, variance = np.clip(own.point + step, -1.0, 1.0), np.maximum(np.diag(covariance), 0.0)
        found.append(_Third(point, variance, len(products) - 1, own.control_steps))
    return found


def _changes(tests: _Tests, thirds: list[_Third], drifts: Iterable[MissingTerm]) -> Iterator[MissingTerm]:
    """The change of each parameter from the first third to the last; `explained` is that of its score tests."""
    if not thirds:
        return
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


def _of_thirds(
    tests: _Tests, thirds: list[_Third], drifts: Iterable[MissingTerm], point: Float[np.ndarray, " d"]
) -> Iterator[Alternative]:
    """The estimates of both thirds for each parameter that certainly differs between parts of the log."""
    disagreeing = dict.fromkeys(term.parameter for term in drifts if abs(term.t) >= DISAGREEING)
    for third in thirds:
        shifts = tests.by_name(third.point - point)
        errors = tests.by_name(NORMAL_95 * np.sqrt(third.variance))
        for name in disagreeing:
            causes = (f"{name} changing over the log",)
            yield Alternative(causes, False, {name: shifts[name]}, {name: errors[name]}, parts=True)


def _most_certain(drifts: Iterable[MissingTerm]) -> Iterable[MissingTerm]:
    """Of the changes of each parameter the most significant one."""
    best: dict[str, MissingTerm] = {}
    for drift in drifts:
        if drift.parameter not in best or abs(drift.t) > abs(best[drift.parameter].t):
            best[drift.parameter] = drift
    return best.values()


def _chosen(tests: _Tests) -> list[int]:
    """Candidates that cannot be excluded, each the most significant beside those before it."""
    chosen: list[int] = []
    for _ in range(TOGETHER):
        significance = _significance(tests, chosen)
        best = max(significance, key=lambda index: significance[index], default=None)
        if best is None or significance[best] < SUSPICIOUS:
            break
        chosen.append(best)
    return chosen


def _rivals(tests: _Tests, chosen: list[int]) -> Iterator[list[int]]:
    """The chosen candidates with one of them replaced by another that cannot be excluded in its place.

    Twice the difference of two terms' logarithms of the likelihood is about that of their t².
    """
    for place in range(len(chosen)):
        rest = [*chosen[:place], *chosen[place + 1 :]]
        significance = _significance(tests, rest)
        least = max(SUSPICIOUS**2, significance.get(chosen[place], 0.0) ** 2 - SUSPICIOUS**2)
        for index, t in significance.items():
            if index not in chosen and t**2 >= least:
                yield [index, *rest]


def _significance(tests: _Tests, beside: list[int]) -> dict[int, float]:
    """|t| of every other candidate beside these; terms that users know well without the log are not asked for."""
    others = (index for index, each in enumerate(tests.tried) if index not in beside and not each.known_before)
    scores = {index: tests.score(index, beside) for index in others}
    return {index: abs(found.t) for index, found in scores.items() if found is not None}


def _with_terms(tests: _Tests, chosen: list[int]) -> Alternative:
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
    causes = tuple(dict.fromkeys(_named(tests.tried[index]) for index in chosen))
    return Alternative(causes, True, tests.by_name(shift), tests.by_name(error))


def _fitted(
    tests: _Tests,
    chosen: list[int],
    simulator: Simulator,
    readings: Readings,
    without: Fit,
    point: Float[np.ndarray, " d"],
) -> _RicherModel | None:
    """The first of these terms fitted together with the parameters; None if a spec can say none of them.

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
        return None
    space = ParameterSpace((*tests.space.parameters, *(parameter for _, parameter, _ in possible)))
    wide = simulation.make(replace(simulator.task, parameters=space))
    values = np.array([candidate.nominal + change * candidate.reference for candidate, _, change in possible])
    start = np.concatenate([led + shift, np.zeros(len(values))])
    start[len(led) :] = space.to_unit(np.concatenate([simulator.parameters.middle, values]))[len(led) :]
    fit = fit_windows(wide, readings, without.states, np.clip(start, -1.0, 1.0))
    at, products = fit.point, products_of(fit.slopes, readings, len(fit.point))
    if products is None:
        return None
    step, covariance = parameter_shift(products)
    at, error = at + step, np.sqrt(np.maximum(np.diag(covariance), 0.0))
    alone = np.sqrt(np.maximum(np.diag(parameter_shift(tests.products)[1]), 0.0))
    beyond = NORMAL_95 * np.sqrt(np.maximum(error[: len(led)] ** 2 - alone**2, 0.0))
    shifts, physical = tests.by_name(at[: len(led)] - point), space.to_physical(at)
    terms = {}
    for place, (candidate, parameter, _) in enumerate(possible, start=len(led)):
        found = tests.score(tests.tried.index(candidate))
        value, deviation = float(physical[place]), float(error[place]) * (parameter.high - parameter.low) / 2.0
        if found is not None and deviation > 0.0:
            significance = deviate((value - candidate.nominal) / deviation, found.freedom)
            term = replace(_term(candidate, found, shifts), value=value, standard_error=deviation, t=significance)
            terms[candidate.parameter] = term
    causes = tuple(_named(candidate) for candidate, _, _ in possible)
    return _RicherModel(terms, Alternative(causes, True, shifts, tests.by_name(beyond)), fit.control_steps)


def _of_parts(drifts: Iterable[MissingTerm]) -> Iterator[Alternative]:
    """Estimates of parts of the log that disagree with the whole, to either side."""
    for term in drifts:
        if abs(term.t) >= DISAGREEING:
            shift = term.shifts[term.parameter]
            errors = {term.parameter: abs(NORMAL_95 * shift / term.t)}
            for side in (-shift, shift):
                causes, shifts = (f"{term.parameter} changing over the log",), {term.parameter: side}
                yield Alternative(causes, False, shifts, errors, parts=True)


def _of_other_windows(tests: _Tests, led: Float[np.ndarray, " d"]) -> Iterator[Alternative]:
    """The estimate of these windows, where it disagrees with the given one, from which `led` has led to them."""
    step, covariance = parameter_shift(tests.products)
    shifts = tests.by_name(led + step)
    errors = tests.by_name(np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    apart = [
        name for name, shift in shifts.items() if abs(shift) > DISAGREEING * np.hypot(errors[name], 1.0 / NORMAL_95)
    ]
    if apart:
        beyond = {name: NORMAL_95 * errors[name] for name in apart}
        yield Alternative((OTHER_WINDOWS,), False, {name: shifts[name] for name in apart}, beyond)


def _named(candidate: Candidate) -> str:
    return f"{candidate.cause} ({candidate.parameter})" if candidate.parameter else candidate.cause
