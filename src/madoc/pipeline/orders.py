"""The orders of the stages: every option is declared here once, with its default and its help text.

The command line reads these classes, and the stages carry them out. Nothing heavy is imported, so `--help` is quick.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, UseAppendAction, arg

from madoc.data.disturbance import Disturbance, Velocities
from madoc.errors import MadocError

AUTO = "auto"
"""The name under which several calibrators are tried and the best is kept."""

Physics = Literal["legacy", "modern"]
Place = Literal["calibrated", "distribution", "uniform", "midrange", "truth"]
Settings = UseAppendAction[tuple[tuple[str, ...], ...]]
"""Hyperparameters as texts: `--set a=1 b=2 --set c=3` is `(("a=1", "b=2"), ("c=3",))`."""

DEFAULT_LEARNER = "fast-sac"
"""Name of the policy learner that is used by default."""


@dataclass(frozen=True)
class Reading:
    """How logged data is read."""

    format: str | None = None
    """Format of the log: d4rl, neorl, minari or madoc. Default: look at its content."""
    clip_actions: bool = False
    """Clip actions outside their ranges instead of refusing them."""
    disturbance: OmitArgPrefixes[Disturbance] = field(default_factory=Disturbance)


@dataclass(frozen=True)
class Permission:
    """What a command may do beside reading files; no file can grant it."""

    allow_code: bool = False
    """Run the Python file that the spec of a robot names, with its reward, end or reset: only if you trust it."""
    allow_outside: bool = False
    """Read files outside the folder of a robot's model that the model names, as ../meshes: a run folder keeps them."""

    @property
    def words(self) -> list[str]:
        """The options of a command line that grant the same."""
        return [f"--{name.replace('_', '-')}" for name, granted in vars(self).items() if granted]


NO_PERMISSION = Permission()
"""What a command may do where nothing is allowed."""


@dataclass(frozen=True)
class Source:
    """Where logged data is, and how it is read."""

    paths: Annotated[tuple[str, ...], arg(name="data")]
    """The log: a D4RL, NeoRL or Minari file, one of `madoc record`, or a Minari id; of a robot of your own, files or
    folders of logs."""
    max_transitions: int | None = 200_000
    """Keep at most so many rows, drawn as whole episodes."""
    reading: Annotated[Reading, arg(name="")] = field(default_factory=Reading)

    def __post_init__(self) -> None:
        if not self.paths or not all(self.paths):
            raise MadocError("expected the log after --data, got nothing; name a file or a folder")

    def absolute(self) -> "Source":
        """The source that means the same from any working directory; the id of a Minari dataset stays what it is."""
        files = {path: Path(path).expanduser() for path in self.paths}
        return replace(self, paths=tuple(str(file.resolve()) if file.exists() else at for at, file in files.items()))


@dataclass(frozen=True)
class Search:
    """Which parameters are calibrated, in which ranges, and by which method."""

    physics: Physics | None = None
    """Physics of the simulator, of Madoc's own robots alone. Default: the data's; legacy where it does not say."""
    level: str = "normal"
    """Ranges to search, of Madoc's own robots alone: easy, normal or hard. A spec has its own."""
    parameters: tuple[str, ...] | None = None
    """Calibrate only these; the others stay at the model's own values. Default: all of the robot's."""
    method: str | None = None
    """A calibrator, as `madoc methods` lists it. Default: auto, which takes least-squares wherever the robot's states
    can be had or fitted, else npe."""
    set: Settings = ()
    """Hyperparameters of the method as name=value; of a method that auto may take as least-squares.name=value."""
    budget: int | str | None = None
    """Simulated control steps, or the time of the search and of judging, as 300s or 15min. Default: 300s of
    searching for least-squares, which settles by itself and mostly much sooner, and 450s with judging; 300000 control
    steps for the others."""
    seed: int = 0
    """Seed of all random numbers."""


@dataclass(frozen=True)
class CalibrationOrder:
    """Options of a calibration."""

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """The robot, as `madoc tasks` lists it, or the spec file of your own, as robot.yaml."""
    source: OmitArgPrefixes[Source]
    search: OmitArgPrefixes[Search] = field(default_factory=Search)
    holdout: float | None = None
    """Share of the rows that no method sees, in whole runs where there are several, to judge the result by. Default:
    0.2 for auto, else none."""
    truth: Path | None = None
    """JSON file {parameter: value} to judge the result by; no method ever sees it."""

    @property
    def method(self) -> str:
        """Name of the calibrator, `auto` by default."""
        return self.search.method or AUTO


@dataclass(frozen=True)
class SelftestOrder:
    """Options of a selftest."""

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """The robot, as `madoc tasks` lists it, or the spec file of your own, as robot.yaml."""
    source: OmitArgPrefixes[Source]
    search: OmitArgPrefixes[Search] = field(default_factory=lambda: Search(method=AUTO))
    truths: int = 3
    """How many truths to plant, one after another."""


@dataclass(frozen=True)
class CheckOrder:
    """Options of a check of logs."""

    spec: Annotated[Positional[Path], arg(metavar="SPEC")]
    """The spec file of the robot, as robot.yaml."""
    paths: Annotated[tuple[Path, ...], arg(name="data")]
    """Logs: files (CSV, npz, HDF5, Parquet, MCAP) or folders of them, Minari or LeRobot directories."""
    clip_actions: bool = False
    """Clip actions outside their ranges instead of refusing them."""
    velocities: Velocities = "logged"
    """With differences, velocities that the logs lack are differences of positions, as `calibrate` takes them too."""
    budget: int = 300_000
    """Control steps for which the time of other methods is forecast; least squares ends by itself."""
    forecast: Annotated[
        bool,
        arg(help="Do not forecast how long methods would take, the longest part of a check.", help_behavior_hint=""),
    ] = True
    """Forecast how long methods would take: the longest part of a check."""
    seed: int = 0
    """Seed that chooses which stretches of the log are examined."""


@dataclass(frozen=True)
class RecordOrder:
    """Options of a recording."""

    name: Annotated[Positional[str], arg(metavar="TASK-QUALITY")]
    """TASK-QUALITY: hopper-medium, halfcheetah-medium-replay, walker2d-neorl-high, ..."""
    transitions: int = 200_000
    """Rows to record."""
    seed: int = 0
    """Seed of all random numbers."""
    physics: Physics = "legacy"
    """legacy is that of D4RL, NeoRL and the paper."""
    friction: float = 1.0
    """Friction of the target's contacts as a multiple of the model's: 1.2 is a gap that no parameter closes."""
    disturbance: OmitArgPrefixes[Disturbance] = field(default_factory=Disturbance)


@dataclass(frozen=True)
class Drawing:
    """How systems are drawn from the calibrated distribution, where a policy is learnt over it."""

    share: float = 1.0
    """Share of the systems that are drawn from the distribution of the estimate; the others are the estimate itself."""
    width: float = 1.0
    """Spread of the drawn systems, as a multiple of the estimate's own."""

    def __post_init__(self) -> None:
        if not 0.0 < self.share <= 1.0:
            raise MadocError(f"expected a share of systems to draw above 0 and at most 1, got {self.share:g}")
        if not 0.0 < self.width < float("inf"):
            raise MadocError(f"expected a width of the distribution above 0, got {self.width:g}")


@dataclass(frozen=True)
class PolicyOrder:
    """Options of a policy learner."""

    method: str = DEFAULT_LEARNER
    """A policy learner, as `madoc methods` lists it; some need the run's data."""
    at: Place = "calibrated"
    """The parameters to learn at: the estimate; draws from the calibrated distribution, or from the whole box, anew
    every epoch; or a yardstick: mid-range, or the truth, which only an evaluation knows."""
    drawing: OmitArgPrefixes[Drawing] = field(default_factory=Drawing)
    set: Settings = ()
    """Hyperparameters of the method as name=value."""
    budget: int | str | None = None
    """Simulated control steps, or updates of a learner that does not simulate, as `madoc methods` says; or a time, as
    300s or 15min. Default: 2400000 for fast-sac and rlpd, else 300000."""
    seed: int = 0
    """Seed of all random numbers."""
    truth: Path | None = None
    """JSON file {parameter: value}, for --at truth. Default: what the run remembers."""


@dataclass(frozen=True)
class EvaluationOrder:
    """Options of an evaluation of policies."""

    episodes: int = 20
    """Episodes for each policy, from the same starts."""
    draws: int = 50
    """Systems drawn from the calibrated distribution, to see how policies do where the estimate is not sure."""
    seed: int = 0
    """Seed of the starts of episodes and of the draws."""
    truth: Path | None = None
    """JSON file {parameter: value} that makes the target. Default: what the run remembers."""


@dataclass(frozen=True)
class RunOrder:
    """Options of a whole run: to record or load, calibrate, learn, evaluate and export."""

    name: Annotated[Positional[str], arg(metavar="TASK-QUALITY")]
    """TASK-QUALITY to record, as hopper-medium; with --data the name of the robot is enough, or the spec file of your
    own, as robot.yaml."""
    data: tuple[str, ...] = ()
    """Use this log instead of recording one: a file, or of a robot of your own files or folders."""
    transitions: int = 200_000
    """Rows to record, or to keep of the log."""
    reading: Annotated[Reading, arg(name="")] = field(default_factory=Reading)
    search: OmitArgPrefixes[Search] = field(default_factory=Search)
    holdout: float = 0.2
    """Share of the rows that no method sees, for the verdict."""
    truth: Path | None = None
    """JSON file {parameter: value} to judge by; no method ever sees it. Default: the data's, if it has any."""
    policy_at: Literal["calibrated", "distribution"] = "calibrated"
    """Learn at the estimate, or over draws from the calibrated distribution."""
    policy_share: float = Drawing.share
    """With `--policy-at distribution`: share of the systems that are drawn from it; the others are the estimate."""
    policy_width: float = Drawing.width
    """With `--policy-at distribution`: spread of the drawn systems, as a multiple of the estimate's own."""
    learner: str = DEFAULT_LEARNER
    """A policy learner, as `madoc methods` lists it."""
    policy_set: Settings = ()
    """Hyperparameters of the learner as name=value."""
    policy_budget: int | str | None = None
    """Simulated control steps for each policy, or updates of a learner that does not simulate; or a time, as 300s.
    Default: 2400000 for fast-sac and rlpd, else 300000."""
    yardsticks: Annotated[
        bool,
        arg(help="Learn no policy at mid-range, nor one at the truth where that is known.", help_behavior_hint=""),
    ] = True
    """Learn also a policy at mid-range and one at the truth, where that is known."""
    episodes: int = 20
    """Episodes for the evaluation of each policy."""
    draws: int = 50
    """Systems drawn from the calibrated distribution for the evaluation of each policy."""

    @property
    def drawing(self) -> Drawing:
        """How systems are drawn where the policy is learnt over the distribution."""
        return Drawing(self.policy_share, self.policy_width)


def parse_settings(settings: tuple[tuple[str, ...], ...]) -> dict[str, str]:
    """`(("updates=2", "hidden=[64,64]"),)` as a dictionary of texts.

    Raises:
        MadocError: One is not `name=value`, or a name comes twice.
    """
    changes: dict[str, str] = {}
    for setting in (text for group in settings for text in group):
        name, equals, value = setting.partition("=")
        name = name.strip().replace("-", "_")
        if not equals or not name:
            raise MadocError(f"expected hyperparameters as name=value, got {setting!r}")
        if name in changes:
            raise MadocError(f"hyperparameter {name} is given twice: {changes[name]!r} and {value!r}")
        changes[name] = value
    return changes
