"""How Madoc simulates rows for its discriminators: starts of rollouts, window length, sensor noise, replay buffer."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.sensing import with_sensor_noise
from madoc.learning import replay
from madoc.learning.features import WindowScaling, unbroken, windows_ending
from madoc.simulation.rollout import (
    Rollout,
    Starts,
    Walkers,
    begin,
    chosen_states,
    replay_actions,
    reset_states,
    roll,
    unbiased_starts,
)
from madoc.types import Policy

StartMode = Literal["policy", "logged", "replay"]
Features = Literal["innovations", "standardised", "raw"]
"""How discriminators see s'; `Madoc` describes each."""


FEW = 16
"""Number of parameters up to which `policy` has few draws in an epoch, each of them for longer."""


def geometry(mode: StartMode, parameters: int) -> tuple[int, int]:
    """Number of parameter draws in an epoch, and of control steps that each row is simulated under one draw.

    Critics of many parameters need more distinct draws.
    """
    free = (20, 50) if parameters <= FEW else (100, 10)
    return {"policy": free, "logged": (100, 5), "replay": (100, 1)}[mode]


@dataclass(frozen=True)
class Collection:
    """Madoc's choices about simulated rows, made for one problem.

    Attributes:
        problem: Data and simulator.
        mode: `policy` lets the clone act from resets of the task, `logged` from logged states. `replay` takes one step
            from each logged state under the action logged there.
        systems: Number of parameter draws in an epoch.
        steps: Control steps of each row under one draw.
        epoch_steps: Control steps in an epoch, of all rows together, as far as they go into as many rows for each draw;
            each has at least one.
        scaling: Scaling of the windows that the discriminators see.
        logged: Features of all logged windows, and of the observations after them.
        noise: Standard deviation of the noise that simulated observations are given.
    """

    problem: CalibrationProblem
    mode: StartMode
    systems: int
    steps: int
    epoch_steps: int
    scaling: WindowScaling
    logged: tuple[Float[Array, "windows window"], Float[Array, "windows observation"]]
    noise: Float[np.ndarray, " observation"]

    @property
    def starts(self) -> Starts:
        """Where rollouts start and start again; hidden velocities of `logged` starts are finite differences.

        Raises:
            MadocError: Some positions are not observed, or states to replay from are not exact.
        """
        if self.mode == "policy":
            return reset_states(self.problem.simulator)
        logged = self.problem.states
        known = self.mode == "logged" and logged.starts_known
        return chosen_states(logged.states if known else logged.exact()[0])

    def begin(self, systems: int, key: PRNGKeyArray) -> Walkers:
        """Rows at fresh starts, as many for each system as the control steps of an epoch allow."""
        rows = max(1, self.epoch_steps // (systems * self.steps))
        return begin(self.starts, key, systems=systems, rows=rows)

    def roll(
        self,
        policy: Policy,
        draws: Float[np.ndarray, "systems d"],
        walkers: Walkers,
        keys: tuple[PRNGKeyArray, PRNGKeyArray],
    ) -> tuple[Rollout, Walkers]:
        """Rows with axes (steps, systems, rows), one system for each draw in [-1, 1], with noise on observations.

        The keys are those of the actions and of the restarts. Under `replay`, only the number of walkers matters.
        """
        simulator = self.problem.simulator
        system = simulator.bind(simulator.parameters.to_physical(draws))
        if self.mode == "replay":
            states, logged = self.problem.states.exact()
            actions, rows = np.asarray(self.problem.dataset.transitions.action)[logged], walkers.age.shape[1]
            rollout = replay_actions(system, simulator.task, states, actions, rows=rows, key=keys[0])
        else:
            starts = self.starts
            if self.mode == "logged":  # every walker stands at a logged state
                starts = unbiased_starts(system, starts)
                walkers = replace(walkers, state=system.unbiased(walkers.state))
            rollout, walkers = roll(
                system,
                simulator.task,
                policy,
                walkers,
                steps=self.steps,
                starts=starts,
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
        following: Float[np.ndarray, "windows systems rows observation"] | None = None,
    ) -> replay.Replay:
        """Add the windows of a rollout to the buffer, with the draw and the varied parameter of their system.

        Features of s' may be given; windows for which they are NaN are left out.
        """
        seen, length = rollout.transitions, self.scaling.length
        window, described = self.scaling.features(windows_ending(seen, np.arange(length - 1, len(seen)), length))
        following = described if following is None else following
        whole = unbroken(rollout.valid, np.asarray(seen.terminated) | np.asarray(seen.truncated), length)
        whole &= np.isfinite(following).all(-1)
        columns = {
            "pair": window,
            "following": following,
            "parameters": np.broadcast_to(draws[:, None], (*whole.shape, draws.shape[1])),
            "identity": np.broadcast_to(identity[:, None], whole.shape),
        }
        flat = {name: replay.flatten_rows(column, 3) for name, column in columns.items()}
        return replay.add(rows, flat, whole.reshape(-1))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Assumptions behind the estimate where observations are partial or noisy, one sentence each."""
        sentences = []
        if self.problem.states.kind != "exact":
            length = self.scaling.length
            sentences.append(f"states cannot be rebuilt from the data: discriminators see windows of {length} rows")
            if self.mode == "logged":
                sentences.append(
                    "rollouts start at states whose velocities were taken from positions, which is not exact"
                )
        if self.noise.any():
            change = self.problem.row_change
            share = 100.0 * np.median(self.noise[change > 0.0] / change[change > 0.0])
            sentences.append(f"simulated observations were given sensor noise of {share:.2g} % of a step's change")
        return tuple(sentences)
