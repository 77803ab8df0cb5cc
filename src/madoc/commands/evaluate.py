"""`madoc evaluate`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import Answer, Output, evaluation_text, left_behind


@dataclass(frozen=True)
class Evaluate:
    """Evaluate the policies of a run in the target, beside the yardsticks that were learnt."""

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run folder with policies in it, or the folder of one policy."""
    episodes: int = 20
    """Episodes for each policy, from the same starts."""
    seed: int = 0
    """Of the starts."""
    truth: Path | None = None
    """JSON file {parameter: value} that makes the target. Default: what the run remembers."""
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Evaluate, and leave evaluation.json."""
        from madoc.pipeline import evaluate_folder
        from madoc.pipeline.data_stage import read_truth

        evaluation = evaluate_folder(
            self.folder,
            truth=None if self.truth is None else read_truth(self.truth),
            episodes=self.episodes,
            seed=self.seed,
            quiet=self.output.quiet,
        )
        lines = (*evaluation_text(evaluation), left_behind(self.folder / "evaluation.json", "evaluation"))
        return Answer(evaluation, lines)
