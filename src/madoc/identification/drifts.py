"""Whether parameters change over the log, by score tests: over time, within runs, between runs, or in one of them."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import fdtrc, ndtri

from madoc.identification.candidate_terms import Candidate
from madoc.identification.causes import DRIFT, ONE_RUN, WITHIN_RUNS
from madoc.identification.information import NORMAL_95
from madoc.identification.score_tests import score, shared_deviate, variances_by_group
from madoc.identification.term_tests import (
    DISAGREEING,
    SUSPICIOUS,
    Alternative,
    MissingTerm,
    TermTests,
    term_of,
)

MOST_RUNS = 20
"""Largest number of runs of which each is compared with all others; of more, they are compared all together alone."""
FEWEST_RUNS = 3
"""Fewest degrees of freedom of a variance between runs; with fewer, runs of their own motions would seem to differ."""


def drifts_of(tests: TermTests, names: Sequence[str]) -> tuple[list[MissingTerm], list[Alternative]]:
    """The most significant change of each parameter, and estimates of parts of the log that disagree.

    A parameter may change over the log, within each run, as where a drive warms up, from run to run, or in one alone.

    Args:
        tests: Score tests of the log.
        names: Names of the episodes.

    Returns:
        The changes and the other estimates.
    """
    drifts = list(_drifts(tests))
    between, covering = _between_runs(tests)
    others = [*_of_parts(drifts), *covering]
    return list(_most_certain([*drifts, *between, *_in_one_run(tests, names)])), others


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
    """How each parameter changes over the log: in a straight line, after its first third, in its last, in every run.

    A line's value is the change from the middle of the first third to that of the last; the other two's are those from
    the first third to the rest, and from the rest to the last third.
    """
    time, age = np.linspace(-1.0, 1.0, len(tests.products)), _since_begin(tests.runs)
    shapes = [(DRIFT, shape - np.mean(shape)) for shape in (0.75 * time, time > -1.0 / 3.0, time > 1.0 / 3.0)]
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
    terms, others = list[MissingTerm](), list[Alternative]()
    if len(np.unique(tests.runs)) <= FEWEST_RUNS:
        return terms, others
    by_run, freedom = variances_by_group(tests.products, tests.runs)
    by_window, windows = variances_by_group(tests.products, np.arange(len(tests.products)))
    for index, row in enumerate(tests.space.parameters):
        if freedom[index] < FEWEST_RUNS or not by_window[index] > 0.0:
            continue
        chance = fdtrc(freedom[index], windows[index], by_run[index] / by_window[index])
        # Runs that agree better than by chance, as where all repeat one motion, are no sign of a change.
        t = -float(ndtri(np.clip(chance, np.finfo(float).tiny, 0.5)))
        beyond = max(0.0, float(by_run[index] - by_window[index]))
        deviation, error = np.sqrt([(freedom[index] + 1.0) * beyond, by_run[index]]).tolist()
        half, half_width = (row.high - row.low) / 2.0, float(tests.half_widths[index])
        shift = {row.name: deviation / half_width}
        explained = _explained_by_runs(tests, index) if t >= SUSPICIOUS else 0.0
        terms.append(MissingTerm(DRIFT, row.name, deviation * half, error * half, row.unit, explained, t, shift))
        if t >= SUSPICIOUS:  # then an interval is to hold the value of any run
            errors = {row.name: NORMAL_95 * float(np.hypot(deviation, error)) / half_width}
            others.append(Alternative((f"{row.name} changing from run to run",), {row.name: 0.0}, errors, True))
    return terms, others


def _explained_by_runs(tests: TermTests, index: int) -> float:
    """Share in [0, 1] of squared residuals that a value of its own in each run explains of a parameter.

    Of R runs that have told as much, each with another value than all others explains R / (R - 1) times its part.
    """
    runs = np.unique(tests.runs)
    alone = (score(tests.products, 1 + index, shape=_less_mean(tests.runs == run)) for run in runs)
    parts = sum(found.explained for found in alone if found is not None)
    return float(min(1.0, (1.0 - 1.0 / len(runs)) * parts))


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
