"""What Madoc carries from epoch to epoch."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from madoc.calibration.madoc.agents import Agents
from madoc.calibration.madoc.grouping import Votes
from madoc.calibration.madoc.watch import Watch
from madoc.learning import replay
from madoc.learning.cloning import Clone
from madoc.learning.expectation import Expectation
from madoc.simulation.rollout import Walkers


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MadocState:
    """Everything Madoc carries from epoch to epoch.

    Attributes:
        clone: The running policy.
        expectation: The regression of s' on (s, a); None where discriminators see s' as it is.
        noise: Standard deviation of the noise that simulated observations are given.
        grouping: The VAE and its votes; None where no groups are found.
        labels: Group of each parameter.
        agents: Discriminators, critics and actors.
        rows: Buffer of simulated rows.
        walkers: Simulated rows that go on in the next epoch.
        watch: Running averages, and the best estimate so far.
        key: The random key.
        grouped: Number of epochs of grouping so far.
        failures: Number of simulated rows that exploded.
    """

    clone: Clone
    expectation: Expectation | None
    noise: Float[np.ndarray, " observation"]
    grouping: Votes | None
    labels: Int[np.ndarray, " d"]
    agents: Agents
    rows: replay.Replay
    walkers: Walkers
    watch: Watch
    key: PRNGKeyArray
    grouped: int
    failures: int
