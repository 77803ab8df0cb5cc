"""What score tests of a log say of single terms: the tests, the terms they find, and other estimates they allow."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from madoc.identification.candidate_terms import Candidate, of_steps
from madoc.identification.causes import DELAY, EARLY, INTEGRATION, UNLISTED, Cause, cause_of
from madoc.identification.score_tests import Products, Score, imitators, score
from madoc.parameters import ParameterSpace

SUSPICIOUS = 2.0
"""|t| from which a term cannot be excluded: 5 % of terms that are not missing reach it by chance."""
DISAGREEING = 3.0
"""|t| from which parts of the log, or windows of another length, give another estimate: one in 370 does by chance."""
LIKELY_FORCE = 3.5
"""|t| from which a force at a joint counts though it is not certain; of a hundred that are tested, one log in twenty
has such a one by chance."""
FEWEST = 12
"""Fewest windows beyond the number of parameters for which a standard error is worth anything."""
MOVES_TOO = 0.1
"""Shift of a parameter in its half-widths over the largest shift of any, from which it counts among the imitators of a
term."""


@dataclass(frozen=True)
class MissingTerm:
    """A term that the model lacks, as the residuals suggest it.

    Attributes:
        cause: What the term stands for, in words.
        parameter: The parameter of the spec that adds it, as `dof_frictionloss.hinge`; empty if there is none.
        value: Its estimated value, in `unit`: of a parameter its value in the model.
        standard_error: Of the value. That few windows tell of the term it does not count, as `t` and `error` do.
        unit: Unit of the value.
        explained: Share of the squared residuals that it explains, those of initial states and parameters taken away.
        t: The change divided by its standard error, converted from Student's t to the normal deviate of the same tail
            probability.
        shifts: By how much each calibrated parameter would move if the term were included, in half-widths of its
            95 % interval.
        nominal: Its value in the model as it is.
    """

    cause: str
    parameter: str
    value: float
    standard_error: float
    unit: str
    explained: float
    t: float
    shifts: dict[str, float]
    nominal: float = 0.0

    @property
    def about(self) -> Cause:
        """What is told and done about its cause."""
        return cause_of(self.cause)

    @property
    def error(self) -> float:
        """The standard error of which the value's difference from the model is `t` times as much."""
        return abs((self.value - self.nominal) / self.t) if self.t else self.standard_error


def named(term: MissingTerm | Candidate) -> str:
    """What a term stands for, and the parameter that adds it where there is one."""
    return f"{term.cause} ({term.parameter})" if term.parameter else term.cause


@dataclass(frozen=True)
class Alternative:
    """Another estimate that the log does not exclude: of a model with more terms, or of other parts of the log.

    Attributes:
        causes: What it rests on, in words.
        shifts: By how much it moves each calibrated parameter, in half-widths of its 95 % interval.
        errors: Half of the 95 % interval of each shift, in the same unit.
        parts: Whether it is the estimate of a part of the log.
        bounded: Whether the errors are bounds, so that no shift is farther off.
    """

    causes: tuple[str, ...]
    shifts: dict[str, float]
    errors: dict[str, float]
    parts: bool = False
    bounded: bool = False


@dataclass(frozen=True)
class ImitatedTerm:
    """A term whose effect the parameters imitate in all of the logged motion: no test can tell whether it is missing.

    Attributes:
        cause: What the term stands for, in words.
        parameter: The parameter of the spec that adds it.
        imitators: The calibrated parameters that would be wrong in its place, the one that moves most first.
    """

    cause: str
    parameter: str
    imitators: tuple[str, ...]


@dataclass(frozen=True)
class Suspicions:
    """What the log says against the model.

    Attributes:
        terms: Candidates with a physical sign, such as friction that takes energy out, the most significant first.
        alternatives: Other estimates that it does not exclude.
        imitated: Terms that the model has none of and of which the log cannot tell whether they are missing.
        control_steps: Control steps that were simulated to find that out.
        tested: Whether there were states to begin at, and enough windows.
        alike: Correlation of what the fitted model leaves of a reading with what it leaves of the next; 0 for noise.
    """

    terms: tuple[MissingTerm, ...] = ()
    alternatives: tuple[Alternative, ...] = ()
    imitated: tuple[ImitatedTerm, ...] = ()
    control_steps: int = 0
    tested: bool = True
    alike: float = 0.0


@dataclass(frozen=True)
class TermTests:
    """What score tests need: products of residuals and derivatives, the candidates, and the scale of shifts.

    Attributes:
        products: Products of residuals and derivatives, those of the parameters first, then those of the candidates.
        tried: The candidates.
        space: The calibrated parameters.
        half_widths: Half of each parameter's 95 % interval in [-1, 1].
        runs: The episodes that the windows are from.
    """

    products: Products
    tried: tuple[Candidate, ...]
    space: ParameterSpace
    half_widths: Float[np.ndarray, " d"]
    runs: Int[np.ndarray, " windows"]

    def score(self, index: int, beside: Sequence[int] = ()) -> Score | None:
        """The score of a candidate beside others; None if there is none, or if its value would not be physical."""
        first = 1 + self.products.count
        found, candidate = score(self.products, first + index, [first + other for other in beside]), self.tried[index]
        below = found is not None and candidate.nominal + found.change * candidate.reference < candidate.least
        return None if below else found

    @cached_property
    def steps(self) -> tuple[int, Score] | None:
        """The error of the integration step and its score; None if it is not significant, or of another effect.

        Of another effect is a value that no timestep has: the tests of other terms are to find that one.
        """
        for index, candidate in enumerate(self.tried):
            if candidate.cause == INTEGRATION and (found := self.score(index)) is not None:
                return (index, found) if abs(found.t) >= SUSPICIOUS and of_steps(found.change) else None
        return None

    @property
    def beside_steps(self) -> float:
        """Share in [0, 1] of the squared residuals that the error of the integration step does not explain."""
        return 1.0 if self.steps is None else max(0.0, 1.0 - self.steps[1].explained)

    def alone(self, index: int) -> Score | None:
        """The score of a candidate beside the error of the integration step; its share is one of all residuals."""
        if self.steps is None or self.steps[0] == index:
            return self.score(index)
        found = self.score(index, [self.steps[0]])
        return None if found is None else replace(found, explained=self.beside_steps * found.explained)

    def less_steps(self) -> "TermTests":
        """The same tests of what the error of the integration step leaves."""
        if self.steps is None:
            return self
        index, found = self.steps
        return replace(self, products=self.products.less(1 + self.products.count + index, found.change))

    def by_name(self, values: Float[np.ndarray, " d"]) -> dict[str, float]:
        """Values in [-1, 1] of each parameter, by name and in half-widths; no estimate leaves its range by more."""
        return dict(zip(self.space.names, (np.clip(values, -2.0, 2.0) / self.half_widths).tolist(), strict=True))

    def alternative(
        self,
        causes: tuple[str, ...],
        shift: Float[np.ndarray, " d"],
        error: Float[np.ndarray, " d"],
        *,
        bounded: bool = False,
    ) -> Alternative:
        """The estimate with candidates that shift it by this much in [-1, 1], from the given one."""
        return Alternative(causes, self.by_name(shift), self.by_name(error), bounded=bounded)


def term_of(candidate: Candidate, found: Score, shifts: dict[str, float]) -> MissingTerm:
    """A candidate as its score test finds it; a delay below 0 has a cause of its own, `EARLY`.

    One of a value that is not plausible is another force, which this one imitates.
    """
    early = candidate.cause == DELAY and found.change < 0.0
    value, error = candidate.nominal + found.change * candidate.reference, found.error * candidate.reference
    imitates = candidate.imitates(value, error)
    cause = f"{UNLISTED}, which acts like {candidate.cause} of an impossible value" if imitates else candidate.cause
    return MissingTerm(
        cause=EARLY if early else cause,
        parameter="" if early or imitates else candidate.parameter,
        value=value,
        standard_error=error,
        unit=candidate.unit,
        explained=found.explained,
        t=found.t,
        shifts=shifts,
        nominal=candidate.nominal,
    )


def imitated_terms(tests: TermTests) -> Iterator[ImitatedTerm]:
    """Terms that the model has none of and parameters imitate, as a mass does a spring where a joint moves little."""
    for index, candidate in enumerate(tests.tried):
        if candidate.known_before or not candidate.parameter or candidate.nominal > candidate.least:
            continue
        moved = imitators(tests.products, 1 + tests.products.count + index)
        if moved is not None:
            shifts = {name: abs(shift) for name, shift in tests.by_name(moved).items()}
            most = max(shifts.values())
            names = [name for name, shift in shifts.items() if shift >= MOVES_TOO * most]
            yield ImitatedTerm(
                candidate.cause, candidate.parameter, tuple(sorted(names, key=lambda name: -shifts[name]))
            )
