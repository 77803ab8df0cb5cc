"""What a calibration returns: an estimate with its doubts, as a table, as JSON."""

import io
import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.holdout import HoldOut, Verdict, holdout_from_json, holdout_to_json
from madoc.errors import MadocError


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter: `estimate` ± `std` within [`low`, `high`], in `unit`; `interval` is its 95 %, where known."""

    estimate: float
    std: float
    low: float
    high: float
    unit: str
    interval: list[float] | None = None


@dataclass(frozen=True)
class CalibrationResult:
    """A finished calibration; `result.json` holds its fields but for `problem`. Printing it shows a table.

    Attributes:
        method: Name of the method, as `madoc methods` lists it.
        task: Name of the task.
        status: `finished` (budget spent), `converged`, `interrupted` or `diverged`.
        sentence: The status in words.
        control_steps: Simulated control steps spent, of any kind.
        seconds: Wall-clock time.
        seed: Of the random key.
        groups: Names of parameters calibrated together.
        parameters: By name.
        warnings: What to know before trusting it, one sentence each.
        error: Only where the truth was given: `mean_absolute`, `mean_percent_of_range`, `per_parameter`.
        covariance: Rows of the estimates' covariance in physical units, in the task's order, where known.
        verdict: What to make of it, where rows were held out to judge it by.
        holdout: The numbers behind the verdict.
        problem: What was calibrated to, while the program runs that calibrated; files do not keep it.
    """

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
    error: dict[str, Any] | None = None
    covariance: list[list[float]] | None = None
    verdict: Verdict | None = None
    holdout: HoldOut | None = None
    problem: CalibrationProblem | None = field(default=None, repr=False, compare=False)

    @property
    def mean(self) -> np.ndarray:
        """The estimate as a vector (d,), physical units, in the task's order."""
        return np.array([parameter.estimate for parameter in self.parameters.values()])

    @property
    def interval(self) -> np.ndarray | None:
        """95 % intervals (d, 2), where the method knows them."""
        rows = [parameter.interval for parameter in self.parameters.values()]
        return None if None in rows else np.array(rows)

    @property
    def std(self) -> np.ndarray:
        """Its spread (d,)."""
        return np.array([parameter.std for parameter in self.parameters.values()])

    def to_json(self) -> dict[str, Any]:
        """As JSON; what is not known (`error`, `covariance`, an `interval`, the `verdict`) is left out."""
        fields = asdict(replace(self, verdict=None, holdout=None, problem=None))
        for row in (fields, *fields["parameters"].values()):
            for name in [name for name, value in row.items() if value is None]:
                del row[name]
        judged = {} if self.verdict is None else {"verdict": self.verdict.to_json()}
        return fields | judged | ({} if self.holdout is None else {"holdout": holdout_to_json(self.holdout)})

    @classmethod
    def from_json(cls, fields: dict[str, Any]) -> "CalibrationResult":
        """What `to_json` wrote.

        Raises:
            MadocError: A field is missing or unknown, or another version wrote its report on the hold-out.
        """
        try:
            parameters = {name: ParameterEstimate(**row) for name, row in fields["parameters"].items()}
            verdict = Verdict(**fields["verdict"]) if "verdict" in fields else None
            if verdict is not None:
                verdict = replace(verdict, parameters=tuple(verdict.parameters))
            holdout = holdout_from_json(fields["holdout"]) if "holdout" in fields else None
            return cls(**{**fields, "parameters": parameters, "verdict": verdict, "holdout": holdout})
        except (KeyError, TypeError, AttributeError) as error:
            raise MadocError(f"this is not the result of a calibration: {error}") from error

    def table(self) -> Table:
        """The parameters as a rich table: name, unit, estimate ± std, range, group; interval and error if known."""
        table = Table(
            title=f"{self.method} on {self.task}",
            title_justify="left",
            box=box.SIMPLE_HEAD,
            padding=(0, 0),
            pad_edge=False,
        )
        group_of = {name: index for index, names in enumerate(self.groups, 1) for name in names}
        table.add_column("parameter", min_width=max(map(len, self.parameters)))
        table.add_column("unit")
        intervals = any(row.interval for row in self.parameters.values())
        for heading in ("estimate ± std", *(["95 %"] if intervals else []), "range", "group"):
            table.add_column(heading, justify="right")
        errors = self.error["per_parameter"] if self.error else {}
        if errors:
            table.add_column("error", justify="right")
        for name, row in self.parameters.items():
            cells = [
                name,
                row.unit,
                f"{row.estimate:.4g} ± {row.std:.2g}",
                *([_span(row.interval)] if intervals else []),
                f"[{row.low:g}, {row.high:g}]",
                str(group_of.get(name, "")),
            ]
            table.add_row(*cells, *([f"{errors[name]:.2g}"] if errors else []))
        return table

    def verdict_line(self) -> str:
        """The verdict, to be read before the table; empty where there is none."""
        return "" if self.verdict is None else str(self.verdict)

    def summary(self) -> str:
        """Status, cost, error and warnings, a line each."""
        lines = [
            f"{self.status}: {self.sentence}",
            f"{self.control_steps:,} control steps, {self.seconds:.0f} s, seed {self.seed}",
        ]
        if self.error:
            lines.append(
                f"mean absolute error {self.error['mean_absolute']:.4g}, "
                f"{self.error['mean_percent_of_range']:.2f} % of range"
            )
        return "\n".join([*lines, *(f"warning: {warning}" for warning in self.warnings)])

    def __str__(self) -> str:
        stream = io.StringIO()
        console = Console(file=stream, width=100)
        console.print(self.table())
        verdict = f"{self.verdict_line()}\n" if self.verdict else ""
        return verdict + stream.getvalue() + self.summary()


def _span(interval: list[float] | None) -> str:
    """An interval with the digits in which its ends differ."""
    if interval is None:
        return ""
    low, high = interval
    width = max(high - low, 1e-6 * max(abs(low), abs(high)), 1e-12)
    digits = min(6, max(0, 1 - math.floor(math.log10(width))))
    return f"[{low:.{digits}f}, {high:.{digits}f}]"
