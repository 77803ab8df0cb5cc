"""`madoc calibrate`, `madoc learn`, `madoc evaluate`, and `madoc run`, which does all of them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import RenderableType
from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import Answer, Output, table_of
from madoc.errors import MadocError
from madoc.pipeline.orders import CalibrationOrder, EvaluationOrder, Permission, Physics, PolicyOrder, RunOrder

if TYPE_CHECKING:
    from madoc.calibration import CalibrationResult
    from madoc.policies import ErrorCost
    from madoc.report.records import EvaluationRecord, Summary

PLACE_NAMES: Mapping[str, str] = {
    "calibrated": "at the calibrated parameters",
    "distribution": "over the calibrated distribution",
    "uniform": "over the whole box",
    "midrange": "at mid-range (yardstick)",
    "truth": "at the truth (yardstick)",
}
"""Names of policies in tables, by where they were learnt."""


@dataclass(frozen=True)
class Calibrate:
    """Find the parameters under which the simulator moves as the data does.

    Leaves a run folder: result.json, spec.json, metrics.jsonl, TensorBoard events and a checkpoint. With a hold-out
    the exit code is the verdict's: 0 CALIBRATED, 9 USABLE, 10 NO_IMPROVEMENT, 11 NOT_IDENTIFIABLE,
    12 MODEL_MISMATCH, 13 DATA_REJECTED.
    """

    order: Annotated[CalibrationOrder, arg(name="")]
    out: Path | None = None
    """Run folder. Default: runs/TASK-METHOD-SEED."""
    resume: bool = False
    """Go on with the run in the folder."""
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Calibrate, and leave the run folder."""
        from madoc.pipeline import calibrate_in, default_folder, leave_motion, split_name
        from madoc.report import leave_report

        if split_name(self.order.task)[1]:
            raise MadocError(f"expected the name of a robot, got {self.order.task!r}; the data is given with --data")
        out = self.out or default_folder(self.order)
        result = calibrate_in(out, self.order, resume=self.resume, quiet=self.output.quiet, permission=self.permission)
        leave_motion(out, permission=self.permission)
        lines = (*calibration_text(result), f"run folder: {out}", *page_line(leave_report(out)))
        return Answer(result.to_json(), lines, calibration_status(result))


@dataclass(frozen=True)
class Learn:
    """Learn a policy in the calibrated simulator.

    Leaves a run folder with policy.npz, which madoc.numpy_policy acts from with NumPy alone.
    """

    calibration: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run folder of `madoc calibrate` or `madoc run`, or a result.json."""
    order: Annotated[PolicyOrder, arg(name="")] = field(default_factory=PolicyOrder)
    physics: Physics | None = None
    """Only for a result.json outside its run folder, which does not say."""
    out: Path | None = None
    """Run folder. Default, within the run: policy-AT; policy-AT-METHOD of another learner than the default one, and
    policy-METHOD of one that learns at no parameters."""
    resume: bool = False
    """Go on with the run in the folder."""
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Learn, and leave the run folder."""
        from madoc.pipeline import learn_in, policy_folder_name, read_calibration

        order = self.order
        calibrated = read_calibration(self.calibration, physics=self.physics, permission=self.permission)
        place = self.calibration if self.calibration.is_dir() else self.calibration.parent
        out = self.out or place / policy_folder_name(order.at, order.method)
        learnt = learn_in(out, calibrated, order, resume=self.resume, quiet=self.output.quiet)
        answer = {
            "method": order.method,
            "task": calibrated.task.name,
            "at": order.at,
            "status": learnt.status,
            "sentence": learnt.sentence,
            "control_steps": learnt.control_steps,
            "updates": learnt.updates,
            "budget_unit": learnt.unit,
            "spent": learnt.spent,
            "seconds": learnt.seconds,
            "seed": order.seed,
            "policy": str(out / "policy.npz"),
        }
        cost = f"{learnt.spent:,} {learnt.unit}, {learnt.seconds:.0f} s, seed {order.seed}"
        lines = (
            f"{learnt.status}: {learnt.sentence}",
            f"{order.method} {self._place()}: {cost}",
            f"policy: {out / 'policy.npz'}",
        )
        return Answer(answer, lines, learnt.status)

    def _place(self) -> str:
        """Where the policy was learnt, in words."""
        from madoc.pipeline.methods import learner_of

        _, entry = learner_of(self.order.method, self.order.set)
        if entry.needs_parameters:
            return PLACE_NAMES[self.order.at]
        return PLACE_NAMES["uniform"] if entry.unit == "control steps" else "from the data alone"


@dataclass(frozen=True)
class Evaluate:
    """Evaluate the policies of a run: in the target, if it is known, at the estimate, and where that may be wrong."""

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run folder with policies in it, or the folder of one policy."""
    order: Annotated[EvaluationOrder, arg(name="")] = field(default_factory=EvaluationOrder)
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Evaluate, and leave evaluation.json."""
        from madoc.pipeline import evaluate_folder

        evaluation = evaluate_folder(self.folder, self.order, quiet=self.output.quiet, permission=self.permission)
        lines = (*evaluation_text(evaluation), f"evaluation: {self.folder / 'evaluation.json'}")
        return Answer(evaluation.to_json(), lines)


@dataclass(frozen=True)
class Run:
    """Do all of it: record or load, calibrate and judge, learn, evaluate, and export.

    Leaves a folder with the data, the calibration, the policies, evaluation.json, the exported model, report.html and
    summary.json. Killed at any moment, --resume goes on to the same result. The exit code is the verdict's, as that of
    madoc calibrate.
    """

    order: Annotated[RunOrder, arg(name="")]
    out: Path | None = None
    """Folder. Default: runs/NAME, of a robot of your own without the .yaml."""
    resume: bool = False
    """Go on with the run in the folder."""
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Do all stages, and leave the folder."""
        from madoc.calibration import CalibrationResult
        from madoc.pipeline import leave_motion, run_all
        from madoc.report import leave_report
        from madoc.robots import is_spec_path

        out = self.out or Path("runs") / (
            Path(self.order.name).stem if is_spec_path(self.order.name) else self.order.name
        )
        summary = run_all(self.order, out, resume=self.resume, quiet=self.output.quiet, permission=self.permission)
        result = CalibrationResult.from_json(summary.calibration)
        leave_motion(out, permission=self.permission)
        lines = (*calibration_text(result), *_rest(summary, out), *page_line(leave_report(out)))
        status = calibration_status(result) if summary.status == "finished" else summary.status
        return Answer(summary.to_json() | {"folder": str(out)}, lines, status)


def _rest(summary: "Summary", out: Path) -> tuple[RenderableType, ...]:
    """The stages after the calibration, and where all files are."""
    evaluation = () if summary.evaluation is None else evaluation_text(summary.evaluation)
    files = [f"estimate: {out / 'calibration' / 'result.json'}"]
    files += [f"policy {at}: {out / f'policy-{at}' / 'policy.npz'}" for at in summary.policies]
    if summary.status == "finished":
        files.append(f"summary: {out / 'summary.json'}")
    elif summary.status == "interrupted":
        files.append("go on with the same command and --resume")
    return (*evaluation, f"{summary.status}: {summary.sentence}", *files)


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
    """The verdict, the tables of estimates and of predictions, a summary, and what to do."""
    from madoc.report.words import to_do

    predictions = result.predictions()
    text = (result.table(), *(() if predictions is None else (predictions,)), result.summary())
    if result.verdict is None:
        return text
    return (str(result.verdict), *text, f"what to do: {to_do(result)}")


def calibration_status(result: "CalibrationResult") -> str:
    """The key of `EXIT_CODES` of a calibration: its verdict, where it has one."""
    return result.verdict.word if result.verdict else result.status


def page_line(page: Path | None) -> tuple[str, ...]:
    """A line that says where the report of a run is, if it could be written."""
    return () if page is None else (f"report: {page}",)
