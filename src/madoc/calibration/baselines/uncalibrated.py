"""Baselines without simulation: the middle of every range, and a uniform distribution over the ranges."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.types import Epoch


@dataclass(frozen=True)
class Uncalibrated:
    """An estimate that uses no data and converges in its first epoch.

    Attributes:
        randomised: False is `nominal`: the middle of every range with standard deviation 0. True is `uniform`: the
            same with the standard deviation of a uniform distribution over each range, (high - low) / √12.
    """

    randomised: bool = False

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> PRNGKeyArray:
        """The random key, which never changes."""
        return key

    def step(self, problem: CalibrationProblem, state: PRNGKeyArray) -> tuple[PRNGKeyArray, Epoch]:
        """An epoch that has converged."""
        return state, Epoch(converged="there is nothing to simulate")

    def estimate(self, problem: CalibrationProblem, state: PRNGKeyArray) -> Estimate:
        """The middle of every range, whatever the data says."""
        space = problem.simulator.parameters
        std = (space.high - space.low) / np.sqrt(12.0) if self.randomised else np.zeros(len(space))
        return Estimate(
            mean=space.middle,
            std=std,
            warnings=("nothing was calibrated: this is the middle of every range, whatever the data says",),
            covariance=np.diag(std**2),
        )
