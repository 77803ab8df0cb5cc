"""The problem that a calibrator is given, its protocol, and the estimate it returns."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from madoc import simulation
from madoc.data import Dataset, typical_change
from madoc.data.disturbing import row_change
from madoc.errors import MadocError
from madoc.identification.information import NORMAL_95
from madoc.identification.noise import difference_noise, rounding_of
from madoc.identification.states import LoggedStates, probing_rows, states_of
from madoc.learning.expectation import noise_of_log
from madoc.learning.features import LoggedFeatures
from madoc.parameters import ParameterSpace
from madoc.simulation.base import Simulator
from madoc.types import Method, State


@dataclass(frozen=True)
class CalibrationProblem:
    """A log and the simulator whose parameters are to be estimated from it.

    The data's true parameters, if it has any, are dropped here, so that no method can read them.

    Raises:
        MadocError: The data belongs to another task, or its observations differ from those of the simulator.
    """

    dataset: Dataset
    simulator: Simulator
    _noise: dict[int, Float[np.ndarray, " observation"]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        task = self.simulator.task
        if self.dataset.task_name != task.name:
            raise MadocError(f"the data was recorded from {self.dataset.task_name}, the simulator is {task.name}")
        logged, shown = self.dataset.transitions.observation.shape[-1], task.observation_size
        if logged != shown:
            raise MadocError(
                f"the data has {logged} values per observation, the simulator's {task.name} shows "
                f"{shown}; where the data hides velocities, make the simulator of data.observed_task(task, dataset)"
            )
        object.__setattr__(self, "dataset", replace(self.dataset, true_parameters=None))

    @cached_property
    def with_shorter_timestep(self) -> "CalibrationProblem":
        """The same problem with a timestep `simulation.FINER` times as short, and the same states of the log."""
        shorter = CalibrationProblem(self.dataset, simulation.with_shorter_timestep(self.simulator))
        vars(shorter).update(states=self.states, typical_change=self.typical_change)
        return shorter

    @cached_property
    def states(self) -> LoggedStates:
        """The simulator's states as far as they can be computed from the data."""
        return states_of(self.dataset, self.simulator)

    @cached_property
    def typical_change(self) -> Float[np.ndarray, " observation"]:
        """Standard deviation of each channel's change in a stride of rows, as `data.dataset.typical_change`."""
        return typical_change(self.dataset, self.simulator.task.attitudes)

    @cached_property
    def row_change(self) -> Float[np.ndarray, " observation"]:
        """Standard deviation of each channel's change from a row to the next."""
        return row_change(self.dataset)

    @cached_property
    def noise_by_differences(self) -> Float[np.ndarray, " observation"]:
        """Standard deviation of the sensor noise of each channel by differences of successive rows."""
        return difference_noise(self.dataset)

    @cached_property
    def rounding(self) -> Float[np.ndarray, " observation"]:
        """Standard deviation of what readings in whole counts are rounded by; 0 for channels that are not."""
        return rounding_of(self.dataset)

    def noise_of_log(self, rows: int) -> Float[np.ndarray, " observation"]:
        """Standard deviation of the sensor noise of each channel, estimated from the log alone by windows of `rows`."""
        if rows not in self._noise:
            self._noise[rows] = noise_of_log(self.dataset, self.features, rows)
        return self._noise[rows]

    @property
    def doubts(self) -> tuple[str, ...]:
        """Known reasons why the simulator cannot reproduce the data exactly, one sentence each."""
        recorded, simulated = self.dataset.physics, self.simulator.task.physics
        gap = (
            f"the data was recorded in {recorded} physics and the simulator's is {simulated}: "
            "the estimate will be biased by the difference"
        )
        gaps = () if recorded in ("unknown", simulated) else (gap,)
        warnings = (finding.sentence for finding in self.dataset.findings if finding.level == "warning")
        return (*gaps, *self.dataset.disturbance.sentences(), *warnings)

    @property
    def notes(self) -> tuple[str, ...]:
        """What bears on the meaning of any estimate, one sentence each."""
        return tuple(finding.sentence for finding in self.dataset.findings if finding.kept)

    def require_pairs(self) -> None:
        """Raise MadocError for data whose next observations are shuffled."""
        if self.dataset.disturbance.shuffled == "next_observations":
            raise MadocError(
                "this method compares each row's next observation with a simulated one, and those of "
                f"{self.dataset.origin} are shuffled; take a method that compares distributions"
            )

    @cached_property
    def probe(self) -> tuple[Float[np.ndarray, "rows state"], Float[np.ndarray, "rows action"]]:
        """States and actions at which every parameter must matter."""
        return probing_rows(self.states, self.dataset, self.simulator)

    @cached_property
    def features(self) -> LoggedFeatures:
        """The data as networks see it."""
        return LoggedFeatures(self.dataset)


@dataclass(frozen=True)
class Estimate:
    """An estimate of all parameters, in physical units; what is not said here is as in `CalibrationResult`.

    Attributes:
        groups: Indices of the parameters that were calibrated together; empty means one group of all.
        failures: Number of simulated rows that diverged and were left out.
        covariance: Covariance of the estimates, with `std` squared on its diagonal; None where it is unknown.
        interval: 95 % confidence intervals, columns low and high; None where they are unknown.
        quantile: Standard errors in half of such an interval, before an end of the range cuts it off.
        settled: False where the method can tell that its search is not at its end, so that a larger budget would change
            the estimate: least squares until its steps are small, Madoc until its discriminators can have settled.
        unlike_noise: Whether the model does not explain the log, which the intervals do not count. False where the
            method does not estimate the noise.
        random_forces: By degree of freedom of the model, in its order; empty where none were found that are random.
        timesteps: Into how many steps each timestep of the model was divided for the estimate.
        test_timesteps: The same for tests of what the model lacks: more where intervals cover what a
            shorter timestep changes.
        group_stability: Mean adjusted Rand index of the groups with those found from resampled states, or proposed in
            other epochs; 1 is the same groups, 0 chance. None where groups were not found from the problem.
        embeddings: One vector for each parameter, close together for those that act alike; None where none was learnt.
    """

    mean: Float[np.ndarray, " d"]
    std: Float[np.ndarray, " d"]
    groups: tuple[tuple[int, ...], ...] = ()
    failures: int = 0
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    covariance: Float[np.ndarray, "d d"] | None = None
    interval: Float[np.ndarray, "d 2"] | None = None
    quantile: float = NORMAL_95
    settled: bool = True
    unlike_noise: bool = False
    effective: bool = False
    random_forces: Float[np.ndarray, " dof"] = field(default_factory=lambda: np.zeros(0))
    timesteps: int = 1
    test_timesteps: int = 1
    group_stability: float | None = None
    embeddings: Float[np.ndarray, "d latent"] | None = None


@runtime_checkable
class Calibrator(Method[CalibrationProblem, State], Protocol[State]):
    """A method that estimates parameters."""

    def estimate(self, problem: CalibrationProblem, state: State) -> Estimate:
        """The best estimate so far."""


def at_end_of_range(
    scaled: Float[np.ndarray, " d"], space: ParameterSpace, interval: Float[np.ndarray, "d 2"] | None = None
) -> tuple[str, ...]:
    """Warn of estimates, in [-1, 1] as the interval, at an end of their range; see `ParameterSpace.at_end`."""
    ends = space.at_end(scaled, interval)
    return (f"at the end of its range: {', '.join(ends)}; widen the range or doubt the model",) if ends else ()
