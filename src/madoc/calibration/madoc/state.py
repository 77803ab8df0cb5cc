"""What Madoc carries from epoch to epoch, and its choices about simulated rows: how many, and what is kept of them."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.free_rollouts import windows_of
from madoc.calibration.madoc.agents import Agents
from madoc.calibration.madoc.grouping import Votes
from madoc.calibration.madoc.watch import Watch
from madoc.learning import replay
from madoc.learning.cloning import Clone
from madoc.learning.expectation import Expectation
from madoc.learning.features import WindowScaling
from madoc.simulation.rollout import Rollout, Walkers

FEW = 16
"""Number of parameters up to which an epoch has few draws, each of them for longer."""


def geometry(parameters: int) -> tuple[int, int]:
    """Number of parameter draws in an epoch, and of control steps that each row is simulated under one draw.

    Critics of many parameters need more distinct draws.
    """
    return (20, 50) if parameters <= FEW else (100, 10)


@dataclass(frozen=True)
class Collection:
    """Madoc's choices about simulated rows, made for one problem.

    Attributes:
        systems: Number of parameter draws in an epoch.
        steps: Control steps of each row under one draw.
        epoch_steps: Control steps in an epoch, of all rows together, as far as they go into as many rows for each draw;
            each has at least one.
        scaling: Scaling of the windows that the discriminators see.
        logged: Features of all logged windows, and of the observations after them.
        noise: Standard deviation of the noise that simulated observations are given.
    """

    problem: CalibrationProblem
    systems: int
    steps: int
    epoch_steps: int
    scaling: WindowScaling
    logged: tuple[Float[Array, "windows window"], Float[Array, "windows observation"]]
    noise: Float[np.ndarray, " observation"]

    def rows(self, systems: int) -> int:
        """Rows of each of so many systems, as the control steps of an epoch allow."""
        return max(1, self.epoch_steps // (systems * self.steps))

    def mean_of(
        self, rollout: Rollout, measure: Callable[[np.ndarray, np.ndarray], np.ndarray]
    ) -> Float[np.ndarray, " systems"]:
        """The mean under each system of a measure of rows, given features of (s, a) and of s', over whole windows.

        NaN for a system without any.
        """
        window, following, whole = windows_of(rollout, self.scaling)
        count = whole.sum((0, 2))
        flat = measure(*(part.reshape(-1, part.shape[-1]) for part in (window, following)))
        return np.where(whole, flat.reshape(whole.shape), 0.0).sum((0, 2)) / np.where(count, count, np.nan)

    def remember(
        self,
        rows: replay.Replay,
        rollout: Rollout,
        draws: Float[np.ndarray, "systems d"],
        identity: Int[np.ndarray, " systems"],
        described: Callable[[np.ndarray, np.ndarray], np.ndarray] = lambda window, following: following,
    ) -> replay.Replay:
        """Add the windows of a rollout to the buffer, with the draw and the varied parameter of their system.

        `described` makes of the features of (s, a) and s' those of s' that are kept.
        """
        window, following, whole = windows_of(rollout, self.scaling)
        columns = {
            "pair": window,
            "following": described(window, following),
            "parameters": np.broadcast_to(draws[:, None], (*whole.shape, draws.shape[1])),
            "identity": np.broadcast_to(identity[:, None], whole.shape),
        }
        flat = {name: replay.flatten_rows(column, 3) for name, column in columns.items()}
        return replay.add(rows, flat, whole.reshape(-1))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Assumptions behind the estimate where observations are partial or noisy, one sentence each."""
        sentences = []
        if self.scaling.length > 1:
            sentences.append(
                f"one row does not tell the robot's state: discriminators see windows of {self.scaling.length} rows"
            )
        if self.noise.any():
            change = self.problem.row_change
            share = 100.0 * (self.noise[change > 0.0] / change[change > 0.0]).max()
            sentences.append(
                f"simulated observations were given sensor noise of up to {share:.2g} % of a step's change"
            )
        return tuple(sentences)


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
        rows: Buffer of simulated rows.
        walkers: Simulated rows that go on in the next epoch.
        watch: Running averages, and the best estimate so far.
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
    grouped: int = 0
    failures: int = 0
