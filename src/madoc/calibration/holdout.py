"""How well an estimate explains rows held out from its calibration: the records that a result carries.

Which measure is possible depends on whether the robot's states can be computed from the log, so there are three
records: `Predicted`, `Fitted` and `ToldApart`. `madoc.verdict` fills them in and judges them.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from madoc.identification.term_tests import Alternative, ImitatedTerm, MissingTerm

Beside = Literal["same", "shorter", "longer"]
"""A timestep beside another one."""
Word = Literal["CALIBRATED", "USABLE", "NO_IMPROVEMENT", "NOT_IDENTIFIABLE", "MODEL_MISMATCH", "DATA_REJECTED"]


@dataclass(frozen=True)
class Verdict:
    """The verdict on an estimate: its word, the reason, and the parameters it concerns."""

    word: Word
    sentence: str
    parameters: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.word}: {self.sentence}"


@dataclass(frozen=True)
class PredictionError:
    """Mean absolute error of predictions, each signal in units of its typical change in a stride (`data.stride`).

    Attributes:
        steps: Horizon of the predictions in control steps.
        mean: Mean over windows and signals.
        interval: 95 % confidence interval of the mean, by resampling episodes, or stretches where these are few.
    """

    steps: int
    mean: float
    interval: tuple[float, float]


@dataclass(frozen=True)
class PredictionErrors:
    """Prediction errors on the hold-out, one for each horizon, of the simulator at several parameters.

    Attributes:
        mid_range: With every parameter at the middle of its range.
        estimate: At the estimate.
        nearby_best: At the parameters that a search from the estimate finds best on the hold-out itself.
        noise: Errors that sensor noise alone would cause at those best parameters.
        relative: Error at the estimate divided by that at mid-range, mean over horizons.
        relative_interval: 95 % confidence interval of `relative`.
        nearby_relative: The same ratio for `nearby_best`, or for `noise` where that is larger.
        windows: Number of windows of the hold-out that were replayed.
        stride: Number of control steps in which a signal typically changes by the errors' unit.
    """

    mid_range: tuple[PredictionError, ...]
    estimate: tuple[PredictionError, ...]
    nearby_best: tuple[PredictionError, ...]
    noise: tuple[PredictionError, ...]
    relative: float
    relative_interval: tuple[float, float]
    nearby_relative: float
    windows: int
    stride: int = 1


@dataclass(frozen=True)
class OpenLoop:
    """Errors of held-out motion that is predicted from its start and the logged actions alone.

    Attributes:
        seconds: How long the simulator runs on.
        whole: Whether that is the length of whole held-out runs.
        windows: Number of stretches that were predicted.
        as_given: Root mean square error over the stretches of each signal, in its unit, of the user's model as it was
            given.
        mid_range: The same with every parameter at the middle of its range.
        estimate: The same at the estimate.
        relative: Error at the estimate over that of the model as given: the mean over stretches of the root mean square
            over all signals, each in units of its change and by the share of its squared error that chance does not
            make.
        relative_interval: 95 % confidence interval of that, by resampling episodes, or stretches where these are few.
        beside_noise: How many times as large the error at the estimate is, at least, as that which the sensors' noise,
            random forces (those read off the log where predictions begin at logged states, else those that an ensemble
            filter found), and the estimate's uncertainty make; for each signal, the lower end of a 95 % interval.
    """

    seconds: float
    whole: bool
    windows: int
    as_given: dict[str, float]
    mid_range: dict[str, float]
    estimate: dict[str, float]
    relative: float
    relative_interval: tuple[float, float]
    beside_noise: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Area:
    """Area under the ROC curve of a classifier of simulated and logged rows: 0.5 is chance, 1 is certainty.

    `area` is measured on rows that the classifier was not trained on, `interval` is its 95 % confidence interval, and
    `rows` is the number of simulated and logged rows together.
    """

    area: float
    interval: tuple[float, float]
    rows: int


@dataclass(frozen=True)
class AgainstChance:
    """A permutation test of whether the logged next observations follow from their rows.

    Attributes:
        prediction: The predictor, in words.
        skill: 1 - error / median error of random pairings: 1 is perfect, 0 is chance.
        p_value: Share of random pairings with no larger error.
    """

    prediction: str
    skill: float
    p_value: float


@dataclass(frozen=True)
class RicherModel:
    """The model with the parameter that it seems to lack, fitted to the same windows and put to the same tests.

    Attributes:
        parameter: The parameter that was added, as `dof_frictionloss.hinge`.
        left: What this model seems to lack in turn, in words, the most significant term first; none where it explains
            the log.
        others: Further terms that were added with it, each the likeliest of what the model still lacked.
    """

    parameter: str
    left: tuple[str, ...]
    others: tuple[MissingTerm, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Judged:
    """The fields that all three records have in common.

    Attributes:
        split: How the rows were held out, in a sentence.
        rows: Number of rows held out.
        episodes: Number of episodes held out.
        estimate: Estimate of each parameter, scaled to [-1, 1] over its range.
        values: Each estimate, half of its 95 % interval before that was widened, and their unit.
        interval_shares: Share of each parameter's range that its 95 % confidence interval covers, at most 1.
        against_chance: Permutation tests, one for each of several predictors.
        noise: Standard deviation of the sensor noise of those signals where it can be estimated, in the signal's unit.
        control_steps: Control steps that were simulated in judging.
        missing_terms: Terms that the model may lack, the most significant first.
        alternatives: Other estimates that the log does not exclude, which the intervals cover.
        imitated: Terms that the model has none of and parameters imitate, which the intervals do not cover.
        richer: The model with the likeliest term, where a parameter of a spec adds it and there was time to test it.
        timestep_of_tests: That with which it was tested what the model lacks, beside that of the errors.
        tested: False where the log cannot tell whether the model lacks a term: it is too short, or tells no states.
        open_in_time: Parameters that only the alternatives leave open, where there was no time to test these on as many
            windows as usual.
        at_end: Parameters estimated at an end of their range that is no physical bound, but for those that are open.
        open_at_end: Open parameters at such an end that without the alternatives would not be open.
        contradictions: Sentences of the check of the log that contradict the spec, such as actions that come late.
        open_loop: Errors of open-loop predictions in the signals' units, the shortest first; none without states.
    """

    split: str
    rows: int
    episodes: int
    estimate: dict[str, float]
    values: dict[str, tuple[float, float, str]]
    interval_shares: dict[str, float]
    against_chance: tuple[AgainstChance, ...]
    noise: dict[str, float]
    control_steps: int = 0
    missing_terms: tuple[MissingTerm, ...] = ()
    alternatives: tuple[Alternative, ...] = ()
    imitated: tuple[ImitatedTerm, ...] = ()
    richer: RicherModel | None = None
    timestep_of_tests: Beside = "same"
    tested: bool = True
    open_in_time: tuple[str, ...] = ()
    at_end: tuple[str, ...] = ()
    open_at_end: tuple[str, ...] = ()
    contradictions: tuple[str, ...] = ()
    open_loop: tuple[OpenLoop, ...] = ()

    @property
    def ahead(self) -> OpenLoop | None:
        """The longest predictions, but for whole runs, that are better than those of the model as given; None of none.

        Those that are certainly better come first.
        """
        better = [each for each in self.open_loop if not each.whole and each.relative <= 1.0]
        return max(better, key=lambda each: (each.relative_interval[1] < 1.0, each.seconds), default=None)

    @property
    def clearest(self) -> AgainstChance:
        """The test with the smallest p-value."""
        return min(self.against_chance, key=lambda each: (each.p_value, -each.skill))

    @property
    def chance(self) -> float:
        """Upper bound of the probability that the clearest test is a product of chance (Bonferroni)."""
        return self.clearest.p_value * len(self.against_chance)


@dataclass(frozen=True, kw_only=True)
class JudgedByErrors(Judged):
    """The fields of the two records of prediction errors."""

    errors: PredictionErrors

    @property
    def score(self) -> float:
        """What estimates of one problem are compared by, smaller is better: the error relative to mid-range."""
        return self.errors.relative

    @property
    def score_interval(self) -> tuple[float, float]:
        """95 % confidence interval of the score."""
        return self.errors.relative_interval


@dataclass(frozen=True, kw_only=True)
class Predicted(JudgedByErrors):
    """Windows of the hold-out replayed from logged states, where states can be computed from the log."""

    measure: Literal["predicted"] = "predicted"


@dataclass(frozen=True, kw_only=True)
class Fitted(JudgedByErrors):
    """Predictions from states that were fitted to the readings before.

    So it is where velocities are hidden, or readings so noisy that they hide what parameters do. The horizon of an
    error is counted from the last of these.
    """

    measure: Literal["fitted"] = "fitted"


@dataclass(frozen=True, kw_only=True)
class ToldApart(Judged):
    """Rollouts compared with the hold-out by a classifier, where no state can be computed from the log.

    Attributes:
        area_at_mid_range: How well the classifier distinguishes rollouts at mid-range from the hold-out.
        area_at_estimate: The same for rollouts at the estimate.
    """

    area_at_mid_range: Area
    area_at_estimate: Area
    measure: Literal["told apart"] = "told apart"

    @property
    def score(self) -> float:
        """What estimates of one problem are compared by, smaller is better: the area beyond that of chance."""
        return self.area_at_estimate.area - 0.5

    @property
    def score_interval(self) -> tuple[float, float]:
        """95 % confidence interval of the score."""
        low, high = self.area_at_estimate.interval
        return low - 0.5, high - 0.5


HoldOut: TypeAlias = Annotated[Predicted | Fitted | ToldApart, Field(discriminator="measure")]
