"""`madoc run`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from rich.console import RenderableType
from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import Answer, Output, evaluation_text, left_behind, page_line
from madoc.commands.calibrate import Settings, changes_of
from madoc.commands.disturbed import Disturbed, disturbance_of


@dataclass(frozen=True)
class Run:
    """Do all of it: record or load, calibrate, learn, and evaluate in the target beside two yardsticks.

    Leaves a folder with the data, the calibration, the policies, evaluation.json and summary.json. Killed at any
    moment, --resume goes on to the same result.
    """

    name: Annotated[Positional[str], arg(metavar="TASK-QUALITY")]
    """TASK-QUALITY to record, as hopper-medium; with --data the name of the robot is enough."""
    data: str | None = None
    """Use this log instead of recording one."""
    format: str | None = None
    """Format of the log: d4rl, neorl, minari or madoc. Default: look at its content."""
    clip_actions: bool = False
    """Clip actions outside [-1, 1] instead of refusing them."""
    transitions: int = 200_000
    """Rows to record, or to keep of the log."""
    disturbed: OmitArgPrefixes[Disturbed] = field(default_factory=Disturbed)
    physics: Literal["legacy", "modern"] | None = None
    """Physics to calibrate in. Default: the data's; legacy where it does not say."""
    level: str = "normal"
    """Ranges to search: easy, normal or hard."""
    parameters: tuple[str, ...] = ()
    """Calibrate only these. Default: all of the robot's."""
    method: str = "madoc"
    """A calibrator, as `madoc methods` lists it."""
    starts: Literal["policy", "logged", "replay"] | None = None
    """Where rollouts start: free running from resets, short ones from logged states, or one step of the log."""
    set: Settings = ()
    """Hyperparameters of the calibrator as name=value."""
    budget: int = 300_000
    """Simulated control steps for the calibration."""
    learner: str = "sac"
    """A policy learner, as `madoc methods` lists it."""
    policy_set: Settings = ()
    """Hyperparameters of the learner as name=value."""
    policy_budget: int = 300_000
    """Simulated control steps for each policy, or updates of a learner that does not simulate."""
    yardsticks: bool = True
    """Learn also a policy at mid-range and one at the truth."""
    episodes: int = 20
    """Episodes for the evaluation of each policy."""
    seed: int = 0
    """Of all randomness."""
    truth: Path | None = None
    """JSON file {parameter: value} to judge by; no method ever sees it. Default: the data's, if it has any."""
    out: Path | None = None
    """Folder. Default: runs/NAME."""
    resume: bool = False
    """Go on with the run in the folder."""
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Do it, and leave the folder."""
        from madoc.calibration import CalibrationResult
        from madoc.pipeline import Plan, Source, leave_report, run_all
        from madoc.pipeline.data_stage import absolute_source, read_truth

        plan = Plan(
            name=self.name,
            data=None if self.data is None else absolute_source(Source((self.data,), self.format, self.clip_actions)),
            transitions=self.transitions,
            disturbance=disturbance_of(self.disturbed),
            physics=self.physics,
            level=self.level,
            parameters=self.parameters,
            method=self.method,
            changes=changes_of(self.set, self.starts),
            learner=self.learner,
            learner_changes=changes_of(self.policy_set),
            calibration_budget=self.budget,
            policy_budget=self.policy_budget,
            episodes=self.episodes,
            yardsticks=self.yardsticks,
            seed=self.seed,
            truth=None if self.truth is None else read_truth(self.truth),
        )
        out = self.out or Path("runs") / self.name
        summary = run_all(plan, out, resume=self.resume, quiet=self.output.quiet)
        result = CalibrationResult.from_json(summary["calibration"])
        lines = (result.table(), result.summary(), *_rest(summary, out), *page_line(leave_report(out)))
        return Answer(summary | {"folder": str(out)}, lines, summary["status"])


def _rest(summary: dict[str, Any], out: Path) -> tuple[RenderableType, ...]:
    """What came after the calibration, and where everything lies."""
    evaluation = () if summary["evaluation"] is None else evaluation_text(summary["evaluation"])
    files = [left_behind(out / "calibration" / "result.json", "estimate")]
    files += [left_behind(out / f"policy-{at}" / "policy.npz", f"policy {at}") for at in summary["policies"]]
    if summary["status"] == "finished":
        files.append(left_behind(out / "summary.json", "summary"))
    elif summary["status"] == "interrupted":
        files.append("go on with the same command and --resume")
    return (*evaluation, f"{summary['status']}: {summary['sentence']}", *files)
