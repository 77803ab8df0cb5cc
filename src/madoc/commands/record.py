"""`madoc record`."""

import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, arg

from madoc.commands.answer import Answer, Output
from madoc.errors import MadocError
from madoc.pipeline.orders import RecordOrder


@dataclass(frozen=True)
class Record:
    """Record the paper's data in a target with the paper's truth.

    Behaviour policies that come with madoc act in the target; its true parameters travel with the data.
    """

    order: Annotated[RecordOrder, arg(name="")]
    out: Path | None = None
    """File to write. Default: NAME.npz."""
    force: bool = False
    """Write over an existing file."""
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Record, and write the file."""
        from madoc import data
        from madoc.pipeline import record_named, split_name

        split_name(self.order.name)
        out = (self.out or Path(f"{self.order.name}.npz")).expanduser()
        if out.exists() and not self.force:
            raise MadocError(f"{out} exists already; choose another --out or pass --force to write over it")
        if not out.parent.is_dir():
            raise MadocError(f"no folder {out.parent} to write {out.name} into; make it first")
        started = time.monotonic()
        dataset = record_named(self.order, quiet=self.output.quiet)
        data.save(dataset, out)
        seconds = time.monotonic() - started
        episodes = len(dataset.episode_starts)
        mean_return = float(dataset.transitions.reward.sum()) / episodes
        answer = {
            "path": str(out),
            "name": self.order.name,
            "task": dataset.task_name,
            "physics": dataset.physics,
            "transitions": len(dataset),
            "episodes": episodes,
            "mean_return": mean_return,
            "seed": self.order.seed,
            "seconds": round(seconds, 3),
            "disturbance": asdict(dataset.disturbance),
            "true_parameters": dataset.true_parameters,
        }
        line = f"{len(dataset):,} transitions in {episodes:,} episodes, mean return {mean_return:,.1f}, {seconds:.1f} s"
        return Answer(answer, (line, *dataset.disturbance.sentences(), f"data: {out}"))
