"""A calibrated simulator as a Gymnasium environment, for people who train with what they already use.

`import madoc` registers `madoc/Hopper`, `madoc/HalfCheetah`, `madoc/Walker2d` and `madoc/Ant`; where nobody imports it,
the id can: `gymnasium.make("madoc:madoc/Hopper", parameters={...})`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
from jaxtyping import Float

from madoc import ENVIRONMENTS, robots
from madoc.errors import MadocError
from madoc.simulation.cpu import CpuSimulator
from madoc.simulation.rollout import reset_states
from madoc.tasks.base import Task

Parameters = Mapping[str, float] | Float[np.ndarray, " parameters"] | None
"""Physical values by name or in the task's order; None is mid-range, the uncalibrated robot."""


class CalibratedEnvironment(gymnasium.Env[np.ndarray, np.ndarray]):
    """One robot in the CPU simulator at given parameters; `gymnasium.make` adds its time limit.

    A step is a function of state, action and parameters alone: unlike Gymnasium's own MuJoCo environments the
    solver never starts from the last step's solution. Where the simulation explodes, the episode is truncated
    at its last good state and `info["failed"]` is true. Nothing is rendered.

    Args:
        task: A task, the name of one, or the path of a robot's spec file.
        parameters: Physical values by name, as a vector in the task's order, or None for mid-range.
        physics: `legacy` or `modern`, for a task given by name; None is `legacy`.

    Raises:
        MadocError: No such task or physics; a parameter is unknown, missing, not finite or below its bound.
    """

    def __init__(self, task: Task | str | Path, *, parameters: Parameters = None, physics: str | None = None) -> None:
        self.task = task if isinstance(task, Task) else robots.resolve(task, physics)
        space = self.task.parameters
        self.parameters = space.middle if parameters is None else space.vector(parameters)
        simulator = CpuSimulator(self.task, threads=1)
        self._system = simulator.bind(self.parameters[None])
        self._starts = reset_states(simulator)
        self._control_step, self._motors = simulator.control_step, simulator.action_size
        self._state = simulator.initial_state
        shape = (self.task.observation_size,)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self._motors,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode at the task's own noise, drawn from `seed` or from where the stream stands.

        Args:
            seed: Starts the stream anew.
            options: Gymnasium's; there are none.
        """
        super().reset(seed=seed)
        key = jax.random.key(int(self.np_random.integers(2**31)))
        self._state = self._starts(key, 1)[0]
        return self._observe(), self._position()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step.

        Returns:
            Observation, reward, terminated, truncated, and an info: `failed`, and for the project's robots
            `x_position` (m) and `x_velocity` (m/s, the mean over the step).

        Raises:
            MadocError: The action has the wrong shape or is not finite.
        """
        control = np.asarray(action, dtype=np.float64)
        if control.shape != (self._motors,) or not np.isfinite(control).all():
            raise MadocError(
                f"expected {self._motors} finite values per action for {self.task.name}, "
                f"got {np.array2string(control, threshold=16)}"
            )
        state = self._state
        next_state = self._system.step(state[None, None], control[None, None])[0, 0]
        failed = not np.isfinite(next_state).all()
        if not failed:
            self._state = next_state
        terminated = not failed and bool(self.task.terminated(self._state))
        reward = float(self.task.reward(state, control, self._state))
        info = self._position()
        if info:
            info["x_velocity"] = float((self._state[0] - state[0]) / self._control_step)
        return self._observe(), reward, terminated, failed, {**info, "failed": failed}

    def _observe(self) -> np.ndarray:
        return np.array(self._system.observe(self._state[None, None])[0, 0])

    def _position(self) -> dict[str, Any]:
        return {"x_position": float(self._state[0])} if self.task.name in ENVIRONMENTS.values() else {}
