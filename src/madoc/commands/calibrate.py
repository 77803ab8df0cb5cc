"""`madoc calibrate`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, UseAppendAction, arg

from madoc.commands.answer import Answer, Output, calibration_status, calibration_text, left_behind, page_line
from madoc.commands.log import Log
from madoc.errors import MadocError

Settings = UseAppendAction[tuple[tuple[str, ...], ...]]
"""`--set a=1 b=2 --set c=3`."""


@dataclass(frozen=True)
class Calibrate:
    """Find the parameters under which the simulator moves as the data does.

    Leaves a run folder: result.json, spec.json, metrics.jsonl, TensorBoard events and a checkpoint. With a hold-out
    the exit code is the verdict's: 0 CALIBRATED, 10 NO_IMPROVEMENT, 11 NOT_IDENTIFIABLE, 12 MODEL_MISMATCH,
    13 DATA_REJECTED.
    """

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """The robot, as `madoc tasks` lists it, or the spec file of your own, as robot.yaml."""
    log: OmitArgPrefixes[Log]
    method: str | None = None
    """A calibrator, as `madoc methods` lists it, or auto: what the data allows, compared on a hold-out. Default: auto
    for a robot of your own, else madoc."""
    holdout: float | None = None
    """Share of the rows that no method sees, to judge the result by. Default: 0.2 for auto, else none."""
    starts: Literal["policy", "logged", "replay"] | None = None
    """Where rollouts start: free running from resets, short ones from logged states, or one step of the log."""
    set: Settings = ()
    """Hyperparameters of the method as name=value; of a method that auto tries as madoc.name=value."""
    budget: int | None = None
    """Simulated control steps. Default: 600000 for auto, of which least squares may have two thirds and Madoc half;
    else 300000."""
    seed: int = 0
    """Of all randomness."""
    truth: Path | None = None
    """JSON file {parameter: value} to judge the result by; no method ever sees it."""
    out: Path | None = None
    """Run folder. Default: runs/TASK-METHOD-SEED."""
    resume: bool = False
    """Go on with the run in the folder."""
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Calibrate, and leave the run folder."""
        from madoc.pipeline import AUTO, AUTO_BUDGET, BUDGET, calibrate_auto_in, calibrate_in, leave_report, split_name
        from madoc.pipeline.data_stage import read_truth
        from madoc.robots import is_spec_path

        if split_name(self.task)[1]:
            raise MadocError(f"expected the name of a robot, got {self.task!r}; the data is given with --data")
        method = self.method or (AUTO if is_spec_path(self.task) else "madoc")
        order = self.log.order(
            self.task,
            method=method,
            changes=changes_of(self.set, self.starts),
            budget=self.budget if self.budget is not None else AUTO_BUDGET if method == AUTO else BUDGET,
            seed=self.seed,
            truth=None if self.truth is None else read_truth(self.truth),
            holdout=self.holdout,
        )
        out = self.out or Path("runs") / f"{Path(self.task).stem}-{method}-{self.seed}"
        stage = calibrate_auto_in if method == AUTO else calibrate_in
        result = stage(out, order, resume=self.resume, quiet=self.output.quiet)
        lines = (*calibration_text(result), left_behind(out, "run folder"), *page_line(leave_report(out)))
        return Answer(result.to_json(), lines, calibration_status(result))


def changes_of(settings: tuple[tuple[str, ...], ...], starts: str | None = None) -> dict[str, str]:
    """Hyperparameters as given on the command line."""
    from madoc.pipeline.methods import parse_settings

    changes = parse_settings([setting for group in settings for setting in group])
    if starts is None:
        return changes
    if "starts" in changes:
        raise MadocError(f"starts is given twice: --starts {starts} and --set starts={changes['starts']}")
    return changes | {"starts": starts}
