"""What Madoc carries from epoch to epoch."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Int, PRNGKeyArray

from madoc.calibration.madoc.agents import Agents
from madoc.calibration.madoc.effects import SharedEffects
from madoc.calibration.madoc.grouping import Votes
from madoc.calibration.madoc.innovations import Reference
from madoc.calibration.madoc.watch import Watch
from madoc.learning import replay
from madoc.learning.cloning import Clone
from madoc.simulation.rollout import Walkers


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MadocState:
    """Everything Madoc carries.

    Attributes:
        clone: The running policy.
        grouping: What was learnt of the parameters' effects, by the VAE or by physics; None where no groups are found.
        labels: Group of each parameter.
        stability: Mean adjusted Rand index of the groups with those of resampled states, or with those proposed in
            other epochs; 0 before there are groups.
        agents: Discriminators, critics and actors.
        rows: Buffer of simulated rows.
        walkers: Simulated rows that go on in the next epoch.
        reference: What innovations are measured from; None where discriminators see none.
        watch: Running averages, and the best estimate so far.
        key: The random key.
        grouped: Number of epochs of grouping so far.
        failures: Number of simulated rows that exploded.
    """

    clone: Clone
    grouping: Votes | SharedEffects | None
    labels: Int[np.ndarray, " d"]
    stability: float
    agents: Agents
    rows: replay.Replay
    walkers: Walkers
    reference: Reference | None
    watch: Watch
    key: PRNGKeyArray
    grouped: int
    failures: int
