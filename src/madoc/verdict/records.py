"""The fields of a record that all measures have: what the model lacks, what contradicts the spec, what is open."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from madoc.calibration.holdout import AgainstChance, Judged, RicherModel
from madoc.data.findings import Finding
from madoc.diagnosis.exchanged_columns import exchanged_columns
from madoc.identification.causes import INTEGRATION, LAG
from madoc.identification.excitation import WINDOWS, expected_half_widths
from madoc.identification.fitted_windows import NEGLIGIBLE, windows_of
from madoc.identification.information import OPEN
from madoc.identification.missing_terms import OTHER_WINDOWS, suspicions
from madoc.identification.term_tests import Alternative, MissingTerm, Suspicions
from madoc.identification.windows import horizons
from madoc.parameters import ParameterSpace
from madoc.verdict.adequacy import (
    far_beyond_noise,
    in_full,
    is_certain,
    missing_term,
    of_small_terms,
    widening,
)
from madoc.verdict.bench import Bench
from madoc.verdict.remedies import is_of_spec
from madoc.verdict.richer import Tested, in_turn, richer_model

_MOST_TERMS = 5
"""Number of missing terms that a report keeps, the most significant ones; besides them the integration step's and all
that are certain are kept, as a verdict rests on them."""
NARROWEST = 0.1
"""Share in (0, 1) of the time left that the narrowest intervals which the log allows may take."""
EXCHANGED = "whether columns are exchanged"
"""A part of judging without which nothing is tested."""
TESTS = "tests of what the model lacks"
"""Another such part."""
FEWER = "tests on as many windows as usual"
"""A part of judging; on fewer windows more terms seem possible, and intervals cover what they would change."""
_DELAYED = "action_delay"
BEFORE_OTHERS = 2.0
"""Time left over that of a test, from which it comes before what is to follow, as predictions over longer times."""
TESTING = 0.7
"""Share in (0, 1) of the time left that testing what the model lacks may take, if that is enough."""

Measure = TypeVar("Measure", bound=Judged)


def _doubts(bench: Bench, point: Float[np.ndarray, " d"], half_widths: Float[np.ndarray, " d"]) -> Suspicions:
    """What the log says against the model.

    A log that tells neither states nor what is needed to fit them cannot be tested, nor can one without pairs of
    consecutive observations. Under a limit of time windows are as many as that allows.
    """
    problem = bench.problem
    ordered = bool((problem.dataset.episode_ends - problem.dataset.episode_starts > 1).any())
    told = bench.states_known or (bench.states.kind == "approximate" and ordered)
    if not told or problem.dataset.disturbance.shuffled == "next_observations":
        return Suspicions(tested=False)
    given, most = (problem.dataset, bench.states), _windows_in_time(bench)
    enough = most is None or most >= bench.windows_to_test
    if not bench.begins(TESTS, 0.0 if enough else np.inf):
        return Suspicions(tested=False)
    usual = len(windows_of(*given, bench.change, fewest=bench.windows_to_test).rows)
    if most is not None and most < usual:
        bench.left_out.append(FEWER)
    doubts = suspicions(*given, problem.simulator, point, half_widths, bench.change, most=most)
    alternatives = in_full((*doubts.alternatives, *of_small_terms(doubts.terms)), doubts.terms)
    return replace(doubts, alternatives=alternatives)


def _windows_in_time(bench: Bench) -> int | None:
    """How many windows the model can be tested on in the time left; None where that is not limited.

    As few as a test takes may use all of that time: without one nothing is certain, whatever else there is time for.
    """
    if bench.until is None:
        return None
    affordable = bench.seconds_left / bench.window_seconds
    return int(max(TESTING * affordable, min(affordable, bench.windows_to_test)))


def judged(
    record: Callable[..., Measure],
    bench: Bench,
    point: Float[np.ndarray, " d"],
    interval: Float[np.ndarray, "d 2"] | None,
    *,
    at: Float[np.ndarray, " d"],
    residual: Float[np.ndarray, " channels"],
    by_model: tuple[AgainstChance, ...],
    noise: Float[np.ndarray, " channels"],
    exact: bool = False,
) -> Measure:
    """Complete a measure's record by the fields that all measures have.

    The best possible intervals are computed for parameters `at`, as if `residual` were the standard deviation of noise:
    of a single step from a logged state where states are `exact`, else of a reading. That and the sensors' `noise` are
    in typical changes of a stride.
    """
    space, problem = bench.simulator.parameters, bench.problem
    best = _best_half_widths(bench, at, residual, noise if exact and noise.any() else None, exact=exact)
    own = best
    if interval is not None:  # to the farther end, as the other may be cut off at an end of the range
        own = np.maximum(np.abs(space.to_unit(interval.T) - point).max(0), 1e-9)
    exchanged = _exchanged(bench, point, at)  # tests take what is left of the time
    testing, timestep = bench.for_tests()
    doubts = _doubts(testing, point, own)
    against = [each for each in (*exchanged, *problem.dataset.findings) if each.contradicts]
    ends = point[:, None] + np.outer(own, (-1.0, 1.0)) if interval is None else space.to_unit(interval.T).T
    widths = space, point[:, None] + np.outer(best, (-1.0, 1.0)), ends, own
    shares = _shares(*widths, doubts.alternatives)
    of_range = dict(zip(space.names, shares.tolist(), strict=True))
    narrower = _shares(*widths, () if FEWER in bench.left_out else doubts.alternatives)
    at_end = [space.names.index(name) for name in space.at_end(point, ends)]  # an open one tells of no end
    by_noise = _shares(*widths, ())
    signals = bench.simulator.task.signal_names[: len(noise)]
    found = record(
        split=bench.split,
        rows=len(bench.held_out),
        episodes=len(bench.held_out.episode_starts),
        estimate=dict(zip(space.names, point.tolist(), strict=True)),
        values=_values(space, point, own),
        interval_shares=of_range,
        against_chance=(*by_model, *bench.model_free),
        noise=dict(zip(signals, (noise * bench.change[: len(noise)]).tolist(), strict=True)),
        missing_terms=_worth_keeping(doubts.terms),
        alternatives=doubts.alternatives,
        imitated=doubts.imitated,
        timestep_of_tests=timestep,
        tested=doubts.tested and EXCHANGED not in bench.left_out,
        open_in_time=tuple(itertools.compress(space.names, (shares >= OPEN) & (narrower < OPEN))),
        at_end=tuple(space.names[index] for index in at_end if narrower[index] < OPEN),
        open_at_end=tuple(space.names[index] for index in at_end if by_noise[index] < OPEN <= narrower[index]),
    )
    unexplained = far_beyond_noise(found) and missing_term(found) is None
    told = tuple(each.sentence for each in against if unexplained or not each.rough)
    term = missing_term(found)
    tested = partial(_richer, testing, point, own, doubts=doubts)
    richer = tested(term)
    if term is not None and richer is not None and richer.left and term.parameter.startswith(_DELAYED):
        lag = replace(term, cause=LAG, parameter=term.parameter.replace(_DELAYED, "action_lag", 1))
        with_lag = tested(lag)
        if with_lag is not None and not with_lag.left:
            same = (term.cause, term.parameter)
            terms = tuple(lag if (each.cause, each.parameter) == same else each for each in found.missing_terms)
            found, term, richer = replace(found, missing_terms=terms), lag, with_lag
    return replace(found, richer=richer, contradictions=told)


def _values(
    space: ParameterSpace, point: Float[np.ndarray, " d"], half_widths: Float[np.ndarray, " d"]
) -> dict[str, tuple[float, float, str]]:
    """Each estimate and half of its interval in the parameter's unit, and that unit."""
    physical = space.to_physical(point).tolist(), (half_widths * (space.high - space.low) / 2.0).tolist()
    return {row.name: (at, half, row.unit) for row, at, half in zip(space.parameters, *physical, strict=True)}


def _worth_keeping(terms: Sequence[MissingTerm]) -> tuple[MissingTerm, ...]:
    """The most significant terms, those that are certain, and the error of the integration step."""
    kept = (place < _MOST_TERMS or term.cause == INTEGRATION or is_certain(term) for place, term in enumerate(terms))
    return tuple(itertools.compress(terms, kept))


def _richer(
    bench: Bench,
    point: Float[np.ndarray, " d"],
    half_widths: Float[np.ndarray, " d"],
    term: MissingTerm | None,
    *,
    doubts: Suspicions,
) -> RicherModel | None:
    """The model with a term, and with others in turn, if parameters of a spec add them and there is time for tests."""
    if term is None or not is_of_spec(term) or not doubts.tested:
        return None
    given = bench.problem.dataset, bench.states, bench.simulator, point, half_widths, bench.change

    def tested(terms: Sequence[MissingTerm]) -> Tested:
        part = f"tests of the model with {' and '.join(each.parameter for each in terms)} as well"
        if not bench.begins(part, BEFORE_OTHERS * doubts.control_steps / bench.rate):
            return None
        return richer_model(*given, terms, most=_windows_in_time(bench))

    return in_turn(term, tested)


def _best_half_widths(
    bench: Bench,
    at: Float[np.ndarray, " d"],
    residual: Float[np.ndarray, " channels"],
    sensors: Float[np.ndarray, " channels"] | None,
    *,
    exact: bool,
) -> Float[np.ndarray, " d"]:
    """Half of the narrowest 95 % intervals that the log allows, in [-1, 1].

    Where states are exact but for the noise of `sensors`, windows with fitted initial states may tell more than single
    noisy steps do.
    """
    given = bench.problem.states, bench.problem.dataset, bench.problem.simulator, at
    residual = np.maximum(residual, NEGLIGIBLE) * bench.change[: len(residual)]
    values = 1 + 2 * len(at) + bench.states.physical_size
    in_time = bench.windows_in_time(horizons(bench.problem.dataset)[-1] * values, NARROWEST, WINDOWS)
    most = max(in_time, WINDOWS // 2)  # fewer may miss what is rare
    half = expected_half_widths(*given, residual, exact=exact, most=most)
    if sensors is None:
        return half
    fitted = expected_half_widths(*given, np.maximum(sensors, NEGLIGIBLE) * bench.change, exact=False, most=most)
    return np.minimum(half, fitted)


def _exchanged(bench: Bench, point: Float[np.ndarray, " d"], at: Float[np.ndarray, " d"]) -> tuple[Finding, ...]:
    """Findings of columns of the log that are exchanged."""
    simulator, held = bench.simulator, bench.held_out
    possible = simulator.task.state_from_observation is not None and held.disturbance.shuffled == "none"
    if not possible or not bench.begins(EXCHANGED):
        return ()
    points, steps = np.stack([np.zeros(len(point)), point, at]), horizons(bench.problem.dataset)[1]
    return exchanged_columns(held, simulator, points, steps, bench.change, contradicts=True)


def _shares(
    space: ParameterSpace,
    best: Float[np.ndarray, "d 2"],
    ends: Float[np.ndarray, "d 2"],
    half_widths: Float[np.ndarray, " d"],
    alternatives: Sequence[Alternative],
) -> Float[np.ndarray, " d"]:
    """Shares in [0, 1] of each range that intervals cover: the best possible, or the given ones widened, if wider.

    Another estimate of other windows says that the search is not at its end, not that a parameter is open.
    """
    open_by = tuple(each for each in alternatives if each.causes != (OTHER_WINDOWS,))
    ends = ends + half_widths[:, None] * widening(open_by, space.names) * (-1.0, 1.0)
    return np.maximum(*(np.ptp(np.clip(each, -1.0, 1.0), axis=1) / 2.0 for each in (best, ends)))
