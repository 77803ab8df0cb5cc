"""What a command returns and prints, and the options that all commands share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import RenderableType
from rich.table import Table

if TYPE_CHECKING:
    from madoc.calibration import CalibrationResult
    from madoc.policies import ErrorCost
    from madoc.report.records import EvaluationRecord

EXIT_CODES: Mapping[str, int] = {
    "finished": 0,
    "converged": 0,
    "diverged": 1,
    "rejected": 2,
    "interrupted": 130,
    "CALIBRATED": 0,
    "USABLE": 9,
    "NO_IMPROVEMENT": 10,
    "NOT_IDENTIFIABLE": 11,
    "MODEL_MISMATCH": 12,
    "DATA_REJECTED": 13,
    "NOT_RECOVERABLE": 14,
}
"""Exit codes by the status of a run, or by its verdict where it has one; 2 is a refusal."""

PLACE_NAMES: Mapping[str, str] = {
    "calibrated": "at the calibrated parameters",
    "distribution": "over the calibrated distribution",
    "uniform": "over the whole box",
    "midrange": "at mid-range (yardstick)",
    "truth": "at the truth (yardstick)",
}
"""Names of policies in tables, by where they were learnt."""


@dataclass(frozen=True)
class Answer:
    """The outcome of a command: what is printed with `--json` and without, and a key of `EXIT_CODES`."""

    json: Mapping[str, object]
    text: tuple[RenderableType, ...]
    status: str = "finished"


@dataclass(frozen=True)
class Output:
    """What is shown."""

    quiet: bool = False
    """Show no progress."""
    json: bool = False
    """Print exactly one JSON object on standard output."""


def table_of(title: str, words: Sequence[str], numbers: Sequence[str] = ()) -> Table:
    """A table with headings of columns of words, and after them of columns of numbers."""
    table = Table(*words, title=title, title_justify="left")
    for heading in numbers:
        table.add_column(heading, justify="right")
    return table


def evaluation_text(evaluation: "EvaluationRecord") -> tuple[RenderableType, ...]:
    """Returns where policies were evaluated, what errors of the estimate cost, and how near the truth's return is."""
    parts: list[RenderableType] = []
    if evaluation.policies:
        parts.append(_target_table(evaluation))
    if evaluation.over_draws:
        parts.append(_estimate_table(evaluation))
    parts += [_costs_table(name, costs) for name, costs in evaluation.error_costs.items()]
    share = evaluation.calibrated_percent_of_truth
    if share is not None:
        parts.append(f"calibrated: {share:.1f} % of the return of the policy learnt at the truth")
    return tuple(parts)


def _target_table(evaluation: "EvaluationRecord") -> Table:
    """Returns in the target, a row for each policy."""
    title = f"{evaluation.task}: returns in the target, {evaluation.episodes} episodes"
    table = table_of(title, ["policy learnt"], ("return ± std", "normalized", "length"))
    for name, row in evaluation.policies.items():
        table.add_row(
            PLACE_NAMES.get(name, name),
            f"{row['return']:,.1f} ± {row['return_std']:,.1f}",
            f"{row['normalized']:.1f}",
            f"{row['length']:.0f}",
        )
    return table


def _estimate_table(evaluation: "EvaluationRecord") -> Table:
    """Returns at the estimate and over draws of it, a row for each policy."""
    draws = next(iter(evaluation.over_draws.values())).draws
    title = f"{evaluation.task}: returns in the calibrated simulator"
    table = table_of(title, ["policy learnt"], ("at the estimate", f"mean of {draws} draws", "worst tenth"))
    for name, drawn in evaluation.over_draws.items():
        cells = (drawn.at_estimate, drawn.mean, drawn.worst_tenth)
        table.add_row(PLACE_NAMES.get(name, name), *(f"{value:,.1f}" for value in cells))
    return table


def _costs_table(name: str, costs: "Mapping[str, ErrorCost]") -> Table:
    """What an error of half an interval of each parameter costs a policy, the dearest first."""
    title = f"policy {name}: return lost where one parameter is off"
    table = table_of(title, ["parameter"], ("off by", "if lower ± std error", "if higher ± std error"))
    for parameter, cost in sorted(costs.items(), key=lambda item: -item[1].largest):
        table.add_row(
            parameter,
            f"{cost.half_width:.3g}",
            f"{cost.below:,.3g} ± {cost.below_error:.2g}",
            f"{cost.above:,.3g} ± {cost.above_error:.2g}",
        )
    return table


def calibration_text(result: "CalibrationResult") -> tuple[RenderableType, ...]:
    """The verdict, the tables of estimates and of predictions, and a summary."""
    verdict = (str(result.verdict),) if result.verdict else ()
    predictions = result.predictions()
    return (*verdict, result.table(), *(() if predictions is None else (predictions,)), result.summary())


def calibration_status(result: "CalibrationResult") -> str:
    """The key of `EXIT_CODES` of a calibration: its verdict, where it has one."""
    return result.verdict.word if result.verdict else result.status


def page_line(page: Path | None) -> tuple[str, ...]:
    """A line that says where the report of a run is, if it could be written."""
    return () if page is None else (f"report: {page}",)
