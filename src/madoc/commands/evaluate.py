"""`madoc evaluate`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import Answer, Output, evaluation_text
from madoc.pipeline.orders import EvaluationOrder, Permission


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
