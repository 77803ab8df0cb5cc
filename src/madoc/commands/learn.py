"""`madoc learn`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import PLACE_NAMES, Answer, Output
from madoc.pipeline.orders import Permission, Physics, PolicyOrder, parse_settings


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
        from madoc.pipeline.methods import make_method
        from madoc.policies import LEARNERS
        from madoc.types import entry_of

        entry = entry_of(make_method(LEARNERS, self.order.method, parse_settings(self.order.set)), LEARNERS)
        if entry.needs_parameters:
            return PLACE_NAMES[self.order.at]
        return PLACE_NAMES["uniform"] if entry.unit == "control steps" else "from the data alone"
