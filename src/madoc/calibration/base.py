"""What a calibrator is given, what it must offer, and what it returns."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from madoc.data import Dataset, typical_change
from madoc.errors import MadocError
from madoc.identification.noise import regression_noise
from madoc.identification.states import LoggedStates, probing_rows, states_of
from madoc.learning.dynamics_ratio import Scaling
from madoc.learning.window_features import WindowScaling, last_rows, logged_stretch
from madoc.simulation.base import Simulator
from madoc.types import Method, State


@dataclass(frozen=True)
class CalibrationProblem:
    """Find the parameters under which the simulator moves as the data does.

    The data's true parameters, where it carries any, are dropped here: no method can read them.

    Raises:
        MadocError: The data belongs to another task, or shows another observation than the simulator.
    """

    dataset: Dataset
    simulator: Simulator

    def __post_init__(self) -> None:
        if self.dataset.task_name != self.simulator.task.name:
            raise MadocError(
                f"the data was recorded from {self.dataset.task_name}, the simulator is {self.simulator.task.name}"
            )
        logged, shown = self.dataset.transitions.observation.shape[-1], self.simulator.task.observation_size
        if logged != shown:
            raise MadocError(
                f"the data has {logged} values per observation, the simulator's {self.simulator.task.name} shows "
                f"{shown}; where the data hides velocities, make the simulator of data.observed_task(task, dataset)"
            )
        object.__setattr__(self, "dataset", replace(self.dataset, true_parameters=None))

    @cached_property
    def states(self) -> LoggedStates:
        """What the data tells of the simulator's states."""
        return states_of(self.dataset, self.simulator)

    @property
    def logged_states(self) -> Float[np.ndarray, "states state"]:
        """States rebuilt exactly from logged observations.

        Raises:
            MadocError: Observations do not determine them.
        """
        return self.states.exact()[0]

    @property
    def logged_rows(self) -> Int[np.ndarray, " states"]:
        """The rows of the data that `logged_states` were rebuilt from, ascending."""
        return self.states.exact()[1]

    @cached_property
    def logged_actions(self) -> Float[np.ndarray, "states action"]:
        """The actions taken at `logged_states`."""
        return np.asarray(self.dataset.transitions.action)[self.logged_rows]

    @cached_property
    def typical_change(self) -> Float[np.ndarray, " observation"]:
        """Standard deviation of each channel's change in one control step."""
        return typical_change(self.dataset)

    @cached_property
    def estimated_noise(self) -> Float[np.ndarray, " observation"]:
        """Standard deviation of the sensors' noise, as far as the log alone tells."""
        return regression_noise(self.dataset)

    @property
    def doubts(self) -> tuple[str, ...]:
        """What is known to keep the simulator from moving as the data does, one sentence each."""
        recorded, simulated = self.dataset.physics, self.simulator.task.physics
        gap = (
            f"the data was recorded in {recorded} physics and the simulator's is {simulated}: "
            "the estimate will make up for the difference"
        )
        gaps = () if recorded in ("unknown", simulated) else (gap,)
        told = (finding.sentence for finding in self.dataset.findings if finding.level == "warning")
        return (*gaps, *self.dataset.disturbance.sentences(), *told)

    def require_pairs(self) -> None:
        """Refuse data in which it is not known which next observation followed which row.

        Raises:
            MadocError: The next observations are shuffled.
        """
        if self.dataset.disturbance.shuffled == "next_observations":
            raise MadocError(
                f"this method compares each row's next observation with a simulated one, and those of "
                f"{self.dataset.origin} are shuffled; take a method that compares distributions"
            )

    @cached_property
    def probe(self) -> tuple[Float[np.ndarray, "rows state"], Float[np.ndarray, "rows action"]]:
        """States and actions at which every parameter must matter."""
        return probing_rows(self.states, self.dataset, self.simulator)

    @cached_property
    def pairs(self) -> tuple[Float[Array, "rows observation"], Float[Array, "rows action"]]:
        """Logged observations and actions on the device, float32."""
        logged = self.dataset.transitions
        return jnp.asarray(logged.observation, jnp.float32), jnp.asarray(logged.action, jnp.float32)

    @cached_property
    def scalings(self) -> dict[str, Scaling]:
        """The two ways to describe (s, a, s') to a network, by name."""
        logged = self.dataset.transitions
        return {"standardised": Scaling.standardised(logged), "raw": Scaling.raw(logged)}

    @cached_property
    def standardised_features(self) -> tuple[Array, Array]:
        """Standardised features of the logged rows, on the device."""
        return self._features("standardised")

    @cached_property
    def raw_features(self) -> tuple[Array, Array]:
        """Raw features of the logged rows, on the device."""
        return self._features("raw")

    @cached_property
    def _windows(self) -> dict[tuple[str, int], tuple[WindowScaling, tuple[Array, Array]]]:
        return {}

    def windows(self, name: str, length: int) -> tuple[WindowScaling, tuple[Array, Array]]:
        """How windows of so many logged rows are described, and the features of all there are, on the device.

        Raises:
            MadocError: No episode is long enough.
        """
        if (name, length) not in self._windows:
            rows, starts = self.dataset.transitions, self.dataset.episode_starts
            last = last_rows(len(self.dataset), starts, length)
            if not len(last):
                raise MadocError(
                    f"no episode of {self.dataset.origin} has the {length} rows of a window; take a shorter one"
                )
            stretch = logged_stretch(rows, last, length)
            scaling = WindowScaling.of(self.scalings[name], stretch)
            window, following = scaling.features(stretch)
            self._windows[name, length] = scaling, (jnp.asarray(window), jnp.asarray(following))
        return self._windows[name, length]

    def _features(self, name: str) -> tuple[Array, Array]:
        pair, following = self.scalings[name].features(self.dataset.transitions)
        return jnp.asarray(pair), jnp.asarray(following)


@dataclass(frozen=True)
class Estimate:
    """What a calibrator believes, in physical units.

    Attributes:
        mean: Value of each parameter, shape (d,).
        std: Its spread under the calibration distribution, shape (d,).
        groups: Parameters calibrated together, as indices; one group of all where a method has none.
        failures: Simulated rows that exploded and were left out.
        warnings: What a user should know about it, one sentence each.
        covariance: Its joint spread, shape (d, d), where the method knows it; the diagonal is `std` squared.
        interval: 95 % confidence interval of each, columns low and high, where the method knows it.
    """

    mean: Float[np.ndarray, " d"]
    std: Float[np.ndarray, " d"]
    groups: tuple[tuple[int, ...], ...]
    failures: int = 0
    warnings: tuple[str, ...] = field(default=())
    covariance: Float[np.ndarray, "d d"] | None = None
    interval: Float[np.ndarray, "d 2"] | None = None


@runtime_checkable
class EmbedsParameters(Protocol):
    """What a method may have besides: it learns which parameters act alike, and can show it."""

    def embeddings(self, problem: CalibrationProblem, state: Any) -> Float[np.ndarray, "d latent"] | None:
        """One vector a parameter, near for those that act alike; None while nothing is learnt of it."""
        ...


class Calibrator(Method[CalibrationProblem, State], Protocol[State]):
    """A method that estimates parameters."""

    def estimate(self, problem: CalibrationProblem, state: State) -> Estimate:
        """The best estimate so far."""
        ...
