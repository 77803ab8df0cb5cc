"""How Madoc simulates rows: rollouts of the clone, window length, sensor noise, replay buffer."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.sensing import numbers_recalled, with_sensor_noise
from madoc.learning import replay
from madoc.learning.features import WindowScaling, unbroken, windows_ending
from madoc.simulation.rollout import Rollout, Walkers, begin, reset_states, roll
from madoc.types import Policy

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
        problem: Data and simulator.
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

    def begin(self, systems: int, key: PRNGKeyArray) -> Walkers:
        """Rows at the task's resets, as many for each system as the control steps of an epoch allow."""
        rows = max(1, self.epoch_steps // (systems * self.steps))
        recalled = numbers_recalled(self.problem, self.scaling.length)
        return begin(reset_states(self.problem.simulator), key, systems=systems, rows=rows, recalled=recalled)

    def mean_of(
        self, rollout: Rollout, measure: Callable[[np.ndarray, np.ndarray], np.ndarray]
    ) -> Float[np.ndarray, " systems"]:
        """The mean under each system of a measure of rows, given features of (s, a) and of s', over whole windows.

        NaN for a system without any.
        """
        window, following, whole = self._windows(rollout)
        count = whole.sum((0, 2))
        flat = measure(*(part.reshape(-1, part.shape[-1]) for part in (window, following)))
        return np.where(whole, flat.reshape(whole.shape), 0.0).sum((0, 2)) / np.where(count, count, np.nan)

    def _windows(self, rollout: Rollout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Features of the windows of a rollout and of s' after each, and which windows are whole."""
        seen, length = rollout.transitions, self.scaling.length
        window, following = self.scaling.features(windows_ending(seen, np.arange(length - 1, len(seen)), length))
        ended = np.asarray(seen.terminated) | np.asarray(seen.truncated)
        return window, following, unbroken(rollout.valid, ended, length)

    def roll(
        self,
        policy: Policy,
        draws: Float[np.ndarray, "systems d"],
        walkers: Walkers,
        keys: tuple[PRNGKeyArray, PRNGKeyArray],
    ) -> tuple[Rollout, Walkers]:
        """Rows with axes (steps, systems, rows), one system for each draw in [-1, 1], with noise on observations.

        The clone acts from the task's resets on. The keys are those of the actions and of the restarts.
        """
        simulator = self.problem.simulator
        rollout, walkers = roll(
            simulator.bind(simulator.parameters.to_physical(draws)),
            simulator.task,
            policy,
            walkers,
            steps=self.steps,
            starts=reset_states(simulator),
            key=keys[0],
            restart_key=keys[1],
        )
        return with_sensor_noise(rollout, self.noise, keys[0]), walkers

    def empty_rows(self, capacity: int) -> replay.Replay:
        """A buffer of features, of the draw each row was simulated under, and of the parameter that was varied."""
        window, following = self.scaling.sizes
        parameters = len(self.problem.simulator.parameters)
        return replay.empty(capacity, pair=(window,), following=(following,), parameters=(parameters,), identity=())

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
        window, following, whole = self._windows(rollout)
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
