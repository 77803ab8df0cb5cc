"""Options that say what is to be calibrated, and to which log."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import OmitArgPrefixes

from madoc.commands.disturbed import Disturbed, disturbance_of
from madoc.errors import MadocError

if TYPE_CHECKING:
    from madoc.pipeline import CalibrationOrder


@dataclass(frozen=True)
class Log:
    """The log, and the parameters to find."""

    data: tuple[str, ...]
    """The log: a D4RL, NeoRL or Minari file, one of `madoc record`, or a Minari id; of a robot of your own, files or
    folders of logs."""
    format: str | None = None
    """Format of the log: d4rl, neorl, minari or madoc. Default: look at its content."""
    clip_actions: bool = False
    """Clip actions outside their ranges instead of refusing them."""
    max_transitions: int = 200_000
    """Keep at most so many rows, drawn as whole episodes."""
    disturbed: OmitArgPrefixes[Disturbed] = field(default_factory=Disturbed)
    physics: Literal["legacy", "modern"] | None = None
    """Physics of the simulator. Default: the data's; legacy where it does not say."""
    level: str = "normal"
    """Ranges to search: easy, normal or hard."""
    parameters: tuple[str, ...] = ()
    """Calibrate only these. Default: all of the robot's."""

    def order(self, task: str, **more: Any) -> "CalibrationOrder":
        """What the pipeline is asked.

        Raises:
            MadocError: No log is named.
        """
        from madoc.pipeline import CalibrationOrder, Source

        if not self.data:
            raise MadocError("expected the log after --data, got nothing; name a file or a folder")
        source = Source(self.data, self.format, self.clip_actions, self.max_transitions, disturbance_of(self.disturbed))
        return CalibrationOrder(
            task=task, source=source, physics=self.physics, level=self.level, parameters=self.parameters, **more
        )
