"""What rows held out from a calibration say of its estimate: the records a result carries, saved as JSON.

How far the hold-out can be predicted depends on what a log tells of the robot's states, so there are three records:
`Predicted`, `Fitted` and `ToldApart`. `madoc.verdict` fills them in and judges them.
"""

import functools
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from typing import Annotated, Literal, TypeAlias

from pydantic import Field, TypeAdapter, ValidationError

from madoc.errors import MadocError

Word = Literal["CALIBRATED", "NO_IMPROVEMENT", "NOT_IDENTIFIABLE", "MODEL_MISMATCH", "DATA_REJECTED"]


@dataclass(frozen=True)
class Verdict:
    """What to make of an estimate.

    Attributes:
        word: A key of `madoc.verdict.WORDS`.
        sentence: The reason, with its numbers.
        parameters: The parameters that it is about, if it is about some.
    """

    word: Word
    sentence: str
    parameters: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.word}: {self.sentence}"

    def to_json(self) -> dict[str, object]:
        """As JSON."""
        return asdict(self) | {"parameters": list(self.parameters)}


@dataclass(frozen=True)
class PredictionError:
    """Mean absolute error of predictions so many control steps ahead, in typical changes of a signal in one step.

    Attributes:
        steps: Control steps ahead.
        mean: Over windows and signals.
        interval: 95 % confidence interval of the mean, from resampled episodes.
        by_signal: Mean over windows of each signal.
    """

    steps: int
    mean: float
    interval: tuple[float, float]
    by_signal: dict[str, float]


@dataclass(frozen=True)
class PredictionErrors:
    """Prediction errors on the hold-out, at every horizon, of the simulator at several parameters.

    Attributes:
        mid_range: At the middle of every range.
        estimate: At the estimate.
        nearby_best: At the best parameters that a search from the estimate finds on the hold-out itself.
        noise: What noise of the sensors alone would leave at those best parameters.
        relative: Error at the estimate over that at mid-range, mean over horizons.
        relative_interval: 95 % confidence interval of `relative`.
        nearby_relative: The same ratio of the best parameters nearby, or of noise alone where that is larger.
        windows: Stretches of the hold-out that were replayed.
        failed_windows: How many of them failed in simulation at the estimate.
    """

    mid_range: tuple[PredictionError, ...]
    estimate: tuple[PredictionError, ...]
    nearby_best: tuple[PredictionError, ...]
    noise: tuple[PredictionError, ...]
    relative: float
    relative_interval: tuple[float, float]
    nearby_relative: float
    windows: int
    failed_windows: int


@dataclass(frozen=True)
class Area:
    """Area under the ROC curve of a classifier that tells simulated from logged rows; 0.5 is chance, 1 is certainty.

    Attributes:
        area: On rows that the classifier was not trained on.
        interval: 95 % confidence interval.
        rows: Number of rows of both kinds.
    """

    area: float
    interval: tuple[float, float]
    rows: int


@dataclass(frozen=True)
class AgainstChance:
    """Whether predicted next observations belong to their rows, compared with the same rows paired at random.

    Attributes:
        prediction: What predicted, in words.
        skill: 1 - error over the median error of random pairings: 1 is perfect, 0 is chance.
        p_value: Share of random pairings that do as well.
    """

    prediction: str
    skill: float
    p_value: float


@dataclass(frozen=True)
class Tried:
    """A method that was run and judged on the hold-out: its `score` (less is better), cost and verdict."""

    method: str
    score: float
    interval: tuple[float, float]
    verdict: Word
    control_steps: int
    seconds: float


@dataclass(frozen=True)
class NotRun:
    """A method that was not run, and why."""

    method: str
    not_run: str


@dataclass(frozen=True, kw_only=True)
class Judged(ABC):
    """What all measures of an estimate on a hold-out have in common.

    Attributes:
        split: How the rows were held out, in a sentence.
        rows: Number of rows held out.
        episodes: Number of episodes held out.
        estimate: Of each parameter, in [-1, 1] of its range.
        interval_shares: Share of each parameter's range that its 95 % confidence interval covers, at most 1.
        against_chance: How well next observations are predicted, by each of several means.
        noise: Standard deviation of the sensors' noise by signal, in its unit, as far as it can be estimated.
        control_steps: Simulated to find all of this.
        candidates: The methods that were compared on this hold-out, where several were.
        chosen: The method among them whose estimate was kept.
    """

    split: str
    rows: int
    episodes: int
    estimate: dict[str, float]
    interval_shares: dict[str, float]
    against_chance: tuple[AgainstChance, ...]
    noise: dict[str, float]
    control_steps: int
    candidates: tuple[Tried | NotRun, ...] = ()
    chosen: str | None = None

    @property
    @abstractmethod
    def score(self) -> float:
        """What estimates of one problem are compared by; less is better."""

    @property
    @abstractmethod
    def score_interval(self) -> tuple[float, float]:
        """95 % confidence interval of the score."""

    @property
    def clearest(self) -> AgainstChance:
        """The prediction that is surest to be better than chance."""
        return min(self.against_chance, key=lambda each: (each.p_value, -each.skill))

    @property
    def chance(self) -> float:
        """Upper bound of the probability that any of the predictions is as good by chance (Bonferroni)."""
        return self.clearest.p_value * len(self.against_chance)


@dataclass(frozen=True, kw_only=True)
class JudgedByErrors(Judged):
    """What the measures that predict the hold-out have in common.

    Attributes:
        errors: Of the predictions.
        explained: Share of the squared residuals at the best parameters nearby that what came before explains.
    """

    errors: PredictionErrors
    explained: float

    @property
    def score(self) -> float:
        """Prediction error over that of mid-range."""
        return self.errors.relative

    @property
    def score_interval(self) -> tuple[float, float]:
        """Its interval."""
        return self.errors.relative_interval


@dataclass(frozen=True, kw_only=True)
class Predicted(JudgedByErrors):
    """The hold-out replayed from logged states: states can be rebuilt from what was logged.

    Attributes:
        autocorrelation: Of the residuals at the best parameters nearby, from step to step.
        area_at_mid_range: How well a classifier tells replays at mid-range from logged windows.
        area_at_estimate: The same for replays at the estimate.
    """

    autocorrelation: float
    area_at_mid_range: Area
    area_at_estimate: Area
    measure: Literal["predicted"] = "predicted"


@dataclass(frozen=True, kw_only=True)
class Fitted(JudgedByErrors):
    """Stretches of the hold-out predicted from states fitted to the stretches before: velocities are hidden.

    A horizon of the errors counts control steps behind the fitted stretch.

    Attributes:
        fitted_steps: Control steps of a fitted stretch.
    """

    fitted_steps: int
    measure: Literal["fitted"] = "fitted"


@dataclass(frozen=True, kw_only=True)
class ToldApart(Judged):
    """Rows of rollouts compared with rows of the hold-out by a classifier: no state can be rebuilt.

    Attributes:
        area_at_mid_range: How well rollouts at mid-range are told from the hold-out.
        area_at_estimate: The same for rollouts at the estimate.
    """

    area_at_mid_range: Area
    area_at_estimate: Area
    measure: Literal["told apart"] = "told apart"

    @property
    def score(self) -> float:
        """The area at the estimate, less that of chance."""
        return self.area_at_estimate.area - 0.5

    @property
    def score_interval(self) -> tuple[float, float]:
        """Its interval."""
        low, high = self.area_at_estimate.interval
        return low - 0.5, high - 0.5


HoldOut: TypeAlias = Predicted | Fitted | ToldApart


@functools.cache
def _adapter() -> TypeAdapter:
    return TypeAdapter(Annotated[HoldOut, Field(discriminator="measure")])


def holdout_to_json(holdout: HoldOut) -> dict[str, object]:
    """As JSON; without `candidates` and `chosen` where only one method was run."""
    omitted = {"candidates", "chosen"} if not holdout.candidates else set()
    return dict(_adapter().dump_python(holdout, mode="json", exclude=omitted))


def holdout_from_json(fields: object) -> HoldOut:
    """What `holdout_to_json` wrote.

    Raises:
        MadocError: It is something else, such as the report of an older version.
    """
    try:
        return _adapter().validate_python(fields)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, ("holdout", *first["loc"])))
        raise MadocError(
            f"this result's report on the hold-out was not written by this version of Madoc ({place}: {first['msg']}); "
            "calibrate again, or delete its entry holdout to keep the estimate without it"
        ) from error
