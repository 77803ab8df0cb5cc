"""The result of a calibration, as a table and as JSON."""

import functools
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import ConfigDict, GetPydanticSchema, TypeAdapter, ValidationError
from pydantic_core import core_schema
from rich import box
from rich.console import Console
from rich.table import Table

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.holdout import HoldOut, Verdict
from madoc.errors import MadocError
from madoc.identification.combinations import Combination
from madoc.identification.information import NORMAL_95

MOST_SIGNALS = 12
"""Largest number of signals whose prediction errors are printed."""


@dataclass(frozen=True)
class ParameterEstimate:
    """The estimate of one parameter and its standard deviation, range, unit and, where known, 95 % interval.

    `given` is the value in a user's own model as it was given, where all elements of the parameter have the same.
    """

    estimate: float
    std: float
    low: float
    high: float
    unit: str
    interval: list[float] | None = None
    given: float | None = None

    @property
    def half_width(self) -> float:
        """Half the width of the 95 % interval in the parameter's unit; of a normal distribution's where there is none.

        It is the distance from the estimate to the farther end, as an interval may be cut off at an end of the range.
        """
        if self.interval is None:
            return NORMAL_95 * self.std
        return max(self.estimate - self.interval[0], self.interval[1] - self.estimate)


@dataclass(frozen=True)
class CalibrationResult:
    """A finished calibration; `result.json` holds its fields but for `problem`. Printing it shows a table.

    Attributes:
        method: Name of the method, as `madoc methods` lists it.
        task: Name of the task.
        status: `finished` (the budget is spent, or too little of it is left), `converged`, `interrupted` or `diverged`.
        sentence: The status in words.
        control_steps: Simulated control steps of any kind.
        seconds: Wall-clock time of the search.
        judging_seconds: Wall-clock time of judging it on held-out rows; 0 where it was not judged.
        seed: Seed of the random key.
        groups: Names of the parameters that were calibrated together.
        parameters: Estimates by name.
        warnings: Reasons to doubt the estimate, one sentence each.
        notes: How the method had initial states from the log, and why, one sentence each.
        error: `mean_absolute`, `mean_percent_of_range` and `per_parameter`; None where the truth was not given.
        covariance: Covariance of the estimates in physical units, in the task's order; None where it is unknown.
        combinations: Sums and products of parameters that the log tells though it leaves each of them open.
        settled: False where the method can tell that its search is not at its end; its intervals mean nothing before.
        unlike_noise: Whether residuals have longer tails than noise has, add up over longer windows, are each like the
            next, or follow from state and action.
        effective: Whether the model leaves more than noise, and the estimate is the one that predicts best with it.
        random_forces: Standard deviation of random forces by degree of freedom, in N or N·m, new ones in each control
            step, that act on the machine besides what the model has; empty where none were found that are random.
        timesteps: Into how many steps each timestep of the model was divided for the estimate.
        test_timesteps: The same for tests of what the model lacks, where there is time: more than one where
            intervals cover what a shorter timestep changes.
        group_stability: How alike groups of resampled states are: their mean adjusted Rand index, 1 for the same
            groups, 0 for chance; None where the method did not find groups.
        chosen: Why `auto` took this method, in a sentence; None where the method was named.
        verdict: The judgement on held-out rows; None where none were held out.
        holdout: The numbers behind the verdict.
        problem: The data and the simulator; None in a result that was read from a file.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    method: str
    task: str
    status: str
    sentence: str
    control_steps: int
    seconds: float
    seed: int
    groups: list[list[str]]
    parameters: dict[str, ParameterEstimate]
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    error: dict[str, Any] | None = None
    covariance: list[list[float]] | None = None
    combinations: list[Combination] = field(default_factory=list)
    settled: bool = True
    unlike_noise: bool = False
    effective: bool = False
    random_forces: dict[str, float] = field(default_factory=dict)
    timesteps: int = 1
    test_timesteps: int = 1
    judging_seconds: float = field(default=0.0, compare=False)
    group_stability: float | None = None
    chosen: str | None = None
    verdict: Verdict | None = None
    holdout: HoldOut | None = None
    problem: Annotated[CalibrationProblem | None, GetPydanticSchema(lambda kind, handler: core_schema.any_schema())] = (
        field(default=None, repr=False, compare=False)
    )

    def with_intervals(self, widened: Mapping[str, tuple[float, float]], warning: str) -> "CalibrationResult":
        """The same result with ends of 95 % intervals moved out, low and high, by multiples of the half-width."""
        parameters = dict(self.parameters)
        for name, (below, above) in widened.items():
            row = parameters[name]
            if row.interval is not None:
                out_below, out_above = below * row.half_width, above * row.half_width
                low, high = max(row.low, row.interval[0] - out_below), min(row.high, row.interval[1] + out_above)
                parameters[name] = replace(row, interval=[low, high])
        return replace(self, parameters=parameters, warnings=[*self.warnings, warning])

    @property
    def mean(self) -> np.ndarray:
        """Estimates (d,) in physical units, in the task's order."""
        return np.array([parameter.estimate for parameter in self.parameters.values()])

    @property
    def interval(self) -> np.ndarray | None:
        """95 % confidence intervals (d, 2); None where the method has none."""
        rows = [parameter.interval for parameter in self.parameters.values()]
        return None if None in rows else np.array(rows)

    @property
    def std(self) -> np.ndarray:
        """Standard deviations (d,) in physical units."""
        return np.array([parameter.std for parameter in self.parameters.values()])

    def to_json(self) -> dict[str, object]:
        """The fields but for `problem` as JSON; a field that is None is left out."""
        return dict(_adapter().dump_python(self, mode="json", exclude={"problem"}, exclude_none=True))

    @classmethod
    def from_json(cls, fields: object) -> "CalibrationResult":
        """Read what `to_json` wrote.

        Raises:
            MadocError: A field is missing, unknown, or of another version of Madoc.
        """
        try:
            return _adapter().validate_python(fields)
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"]))
            remedy = " calibrate again"
            if place.startswith("holdout"):
                remedy += ", or delete its entry holdout to keep the estimate without its verdict"
            raise MadocError(
                f"this is not the result of a calibration by this version of Madoc ({place}: {first['msg']});{remedy}"
            ) from error

    @property
    def grouped(self) -> bool:
        """Whether parameters are in groups, and not all in one or each in its own."""
        return 1 < len(self.groups) < len(self.parameters)

    def table(self) -> Table:
        """The parameters as a rich table, with intervals and errors where they are known."""
        title = f"{self.method} on {self.task}"
        table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 0), pad_edge=False)
        names, rows = list(self.parameters), list(self.parameters.values())
        group_of = {name: str(index) for index, group in enumerate(self.groups, 1) for name in group}
        errors = self.error["per_parameter"] if self.error else {}
        some = any(row.given is not None for row in rows)  # elsewhere the elements of a parameter differ
        numbers = {
            "as given": [f"{row.given:.4g}" if row.given is not None else "differs" * some for row in rows],
            "estimate ± std": [f"{row.estimate:.4g} ± {row.std:.2g}" for row in rows],
            "95 %": [_span(row.interval) for row in rows],
            "range": [f"[{row.low:g}, {row.high:g}]" for row in rows],
            "group": [group_of[name] if self.grouped else "" for name in names],
            "error": [f"{errors[name]:.2g}" if errors else "" for name in names],
        }
        shown = {heading: cells for heading, cells in numbers.items() if any(cells)}
        table.add_column("parameter", min_width=max(map(len, names)))
        table.add_column("unit")
        for heading in shown:
            table.add_column(heading, justify="right")
        for name, row, *cells in zip(names, rows, *shown.values(), strict=True):
            table.add_row(name, row.unit, *cells)
        return table

    def predictions(self) -> Table | None:
        """Errors of open-loop predictions of the hold-out, of the model as given and at the estimate; None of none."""
        shown = self.holdout.open_loop if self.holdout is not None else ()
        if self.holdout is None or not shown:
            return None
        title = "held-out motion predicted from its start (root mean square error: the model as given → calibrated)"
        table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 0), pad_edge=False)
        table.add_column("signal")
        for each in shown:
            table.add_column(f"over {each.seconds:.3g} s{' (whole runs)' if each.whole else ''}", justify="right")
        table.add_column("noise", justify="right")
        signals = list(shown[-1].estimate)
        for name in signals[:MOST_SIGNALS]:
            cells = (f"{each.as_given[name]:.2g} → {each.estimate[name]:.2g}" for each in shown)
            noise = self.holdout.noise.get(name, 0.0)
            table.add_row(name, *cells, f"{noise:.2g}" if noise else "none found")
        if len(signals) > MOST_SIGNALS:
            table.add_row(f"and {len(signals) - MOST_SIGNALS} more in result.json")
        return table

    def summary(self) -> str:
        """Status, cost, error and warnings, one line each."""
        judging = f" and {self.judging_seconds:.0f} s of judging" if self.judging_seconds else ""
        lines = [
            f"{self.status}: {self.sentence}",
            f"{self.control_steps:,} control steps in {self.seconds:.0f} s{judging}, seed {self.seed}",
        ]
        if self.error:
            lines.append(
                f"mean absolute error {self.error['mean_absolute']:.4g}, "
                f"{self.error['mean_percent_of_range']:.2f} % of range"
            )
        if self.chosen is not None:
            lines.append(self.chosen)
        if self.group_stability is not None:
            lines.append(
                f"{len(self.groups)} groups; adjusted Rand index with those found again {self.group_stability:.2f}"
            )
        lines += [f"told in combination: {told}" for told in self.combinations]
        lines += [f"note: {note}" for note in self.notes]
        return "\n".join([*lines, *(f"warning: {warning}" for warning in self.warnings)])

    def __str__(self) -> str:
        stream = io.StringIO()
        console, predictions = Console(file=stream, width=100, markup=False), self.predictions()
        console.print(self.table())
        if predictions is not None:
            console.print(predictions)
        verdict = f"{self.verdict}\n" if self.verdict else ""
        return verdict + stream.getvalue() + self.summary()


@functools.cache
def _adapter() -> TypeAdapter:  # type: ignore[type-arg]  # beartype knows no TypeAdapter[...]
    return TypeAdapter(CalibrationResult)


def _span(interval: list[float] | None) -> str:
    """An interval, rounded to the digits in which its ends differ."""
    if interval is None:
        return ""
    low, high = interval
    width = max(high - low, 1e-6 * max(abs(low), abs(high)), 1e-12)
    digits = min(6, max(0, 1 - math.floor(math.log10(width))))
    return f"[{low:.{digits}f}, {high:.{digits}f}]"
