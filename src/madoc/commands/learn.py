"""`madoc learn`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import PLACE_NAMES, Answer, Output, left_behind
from madoc.commands.calibrate import Settings, changes_of


@dataclass(frozen=True)
class Learn:
    """Learn a policy in the calibrated simulator.

    Leaves a run folder with policy.npz, which madoc.numpy_policy acts from with NumPy alone.
    """

    calibration: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run folder of `madoc calibrate` or `madoc run`, or a result.json."""
    method: str = "sac"
    """A policy learner, as `madoc methods` lists it; some need the run's data."""
    at: Literal["calibrated", "distribution", "uniform", "midrange", "truth"] = "calibrated"
    """The parameters to learn at: the estimate; draws from the calibrated distribution, or from the whole box, anew
    every epoch; or a yardstick: mid-range, or the truth, which only an evaluation knows."""
    set: Settings = ()
    """Hyperparameters of the method as name=value."""
    budget: int = 300_000
    """Simulated control steps, or updates of a learner that does not simulate, as `madoc methods` says."""
    seed: int = 0
    """Of all randomness."""
    truth: Path | None = None
    """JSON file {parameter: value}, for --at truth. Default: what the run remembers."""
    physics: Literal["legacy", "modern"] | None = None
    """Only for a result.json outside its run folder, which does not say."""
    out: Path | None = None
    """Run folder. Default: policy-AT within the run."""
    resume: bool = False
    """Go on with the run in the folder."""
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Learn, and leave the run folder."""
        from madoc.pipeline import PolicyOrder, learn_in, read_calibration
        from madoc.pipeline.data_stage import read_truth
        from madoc.pipeline.learning_stage import policy_folder_name

        calibrated = read_calibration(self.calibration, physics=self.physics)
        order = PolicyOrder(self.at, self.method, changes_of(self.set), self.budget, self.seed)
        place = self.calibration if self.calibration.is_dir() else self.calibration.parent
        out = self.out or place / policy_folder_name(self.at, self.method)
        truth = None if self.truth is None else read_truth(self.truth)
        learnt = learn_in(out, calibrated, order, truth=truth, resume=self.resume, quiet=self.output.quiet)
        answer = {
            "method": self.method,
            "task": calibrated.task.name,
            "at": self.at,
            "status": learnt.status,
            "sentence": learnt.sentence,
            "control_steps": learnt.control_steps,
            "budget_unit": learnt.unit,
            "spent": learnt.spent,
            "seconds": learnt.seconds,
            "seed": self.seed,
            "policy": str(out / "policy.npz"),
        }
        lines = (
            f"{learnt.status}: {learnt.sentence}",
            f"{self.method} {self._place()}: {learnt.spent:,} {learnt.unit}, {learnt.seconds:.0f} s, seed {self.seed}",
            left_behind(out / "policy.npz", "policy"),
        )
        return Answer(answer, lines, learnt.status)

    def _place(self) -> str:
        """Where it learns, in words."""
        from madoc.pipeline.methods import make_method
        from madoc.policies import LEARNERS
        from madoc.types import entry_of

        entry = entry_of(make_method(LEARNERS, self.method, changes_of(self.set)), LEARNERS)
        if entry.needs_parameters:
            return PLACE_NAMES[self.at]
        return PLACE_NAMES["uniform"] if entry.unit == "control steps" else "from the data alone"
