"""A calibrated simulator as a Gymnasium environment, single and vectorised, to train with other libraries.

`import madoc` registers `madoc/Hopper`, `madoc/HalfCheetah`, `madoc/Walker2d` and `madoc/Ant`, for `gymnasium.make` and
for `gymnasium.make_vec`. `gymnasium.make("madoc:madoc/Hopper", parameters={...})` needs no import.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import gymnasium
import jax
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float

from madoc import ENVIRONMENTS, robots, simulation
from madoc.errors import MadocError
from madoc.parameters import ParameterDistribution
from madoc.simulation.base import System
from madoc.tasks.base import Task

Information = dict[str, object]
"""The `info` of Gymnasium."""


Parameters = Mapping[str, float] | Float[np.ndarray, " parameters"] | ParameterDistribution | None
"""Physical values by name or in the task's order; or a distribution, from which every episode draws new values; or None
for the middle of every range."""


class Episodes:
    """Episodes of one robot, one in each row, that are stepped together; both environments use it.

    A step depends on state, action and parameters alone: unlike in Gymnasium's own MuJoCo environments, the solver
    never starts from the last step's solution.

    Attributes:
        task: The robot.
        parameters: Physical values of each row.
        state: State of each row, float64.

    Raises:
        MadocError: No such task or physics; a parameter is unknown, missing, not finite or below its bound.
    """

    def __init__(
        self, task: Task | str | Path, parameters: Parameters, physics: str | None, *, rows: int, threads: int | None
    ) -> None:
        self.task = (task if isinstance(task, Task) else robots.resolve(task, physics)).for_policies
        self._simulator = simulation.make(self.task, threads=threads)
        space, values, self._distribution = self.task.parameters, self.task.parameters.middle, None
        if isinstance(parameters, ParameterDistribution):
            self._distribution = parameters
        elif parameters is not None:
            values = space.vector(parameters)
        self.parameters = np.tile(values, (rows, 1))
        self.state = np.tile(self._simulator.initial_state, (rows, 1))
        # One system with many rows where all have the same parameters, else one system a row.
        self._axes = (rows, 1) if self._distribution else (1, rows)
        self._system: System = self._simulator.bind(self.parameters[: self._axes[0]])
        noise = self.task.reset_noise
        of_row = lambda seed: noise(jax.random.key(seed), 1)[0]  # noqa: E731
        self._noise = (
            jax.jit(jax.vmap(of_row)) if self.task.traced_reset else lambda seeds: np.stack([*map(of_row, seeds)])
        )
        self.observation_space = Box(-np.inf, np.inf, (self.task.observation_size,), np.float64)
        self.action_space = Box(-1.0, 1.0, (self.task.action_size,), np.float32)

    def reset(self, chosen: Bool[np.ndarray, " rows"], generators: Sequence[np.random.Generator]) -> None:
        """Start the chosen rows with the task's noise of the start and, given a distribution, with new parameters.

        Each row draws from its own generator, so that an episode does not depend on the other rows.
        """
        rows: list[int] = np.flatnonzero(chosen).tolist()
        seeds = np.zeros(len(chosen), dtype=np.uint32)
        seeds[rows] = [generators[row].integers(2**31) for row in rows]
        # Noise is computed for all rows, because a shape that never changes is compiled once.
        fresh = self._simulator.initial_state + np.asarray(self._noise(seeds), dtype=np.float64)
        self.state = np.where(chosen[:, None], fresh, self.state)
        if self._distribution is None:
            return
        for row in rows:
            key = jax.random.key(int(generators[row].integers(2**31)))
            self.parameters[row] = self._distribution.draw(key, 1)[0]
        self._system = self._system.replaced(np.array(rows), self.parameters[rows])

    def step(
        self, action: Float[np.ndarray, "rows action"]
    ) -> tuple[np.ndarray, Bool[np.ndarray, " rows"], dict[str, np.ndarray]]:
        """One control step of all rows; a row whose simulation diverges stays at its last state.

        Returns:
            Rewards, whether the task has ended, and an info: `failed`, and for Madoc's own robots `x_position` (m) and
            `x_velocity` (m/s, the mean over the step).

        Raises:
            MadocError: The actions have the wrong shape or are not finite.
        """
        control = np.asarray(action, dtype=np.float64)
        if control.shape != (len(self.state), self.task.action_size) or not np.isfinite(control).all():
            raise MadocError(
                f"expected {self.task.action_size} finite values per action for {self.task.name}, "
                f"got {np.array2string(control, threshold=16)}"
            )
        state = self.state
        moved = self._system.step(state.reshape(*self._axes, -1), control.reshape(*self._axes, -1))
        next_state = moved.reshape(state.shape)
        failed = ~np.isfinite(next_state).all(-1)
        self.state = np.where(failed[:, None], state, next_state)
        terminated = np.asarray(self.task.terminated(self.state)) & ~failed
        info = self.position()
        if info:
            info["x_velocity"] = (self.state[:, 0] - state[:, 0]) / self._simulator.control_step
        return np.asarray(self.task.reward(state, control, self.state)), terminated, {**info, "failed": failed}

    def observe(self) -> Float[np.ndarray, "rows observation"]:
        """Observations of all rows, in a new array."""
        return np.array(self._system.observe(self.state.reshape(*self._axes, -1))).reshape(len(self.state), -1)

    def position(self) -> dict[str, np.ndarray]:
        """`x_position` in m for Madoc's own robots; empty for others."""
        return {"x_position": self.state[:, 0].copy()} if self.task.name in ENVIRONMENTS.values() else {}


class CalibratedEnvironment(gymnasium.Env[np.ndarray, np.ndarray]):
    """One robot at given parameters; `gymnasium.make` adds its time limit.

    If the simulation diverges, the episode is truncated at its last state and `info["failed"]` is true. Nothing is
    rendered.

    Args:
        task: A task, its name, or the path of a robot's spec file.
        parameters: See `Parameters`.
        physics: `legacy` or `modern`, for a task given by name; None is `legacy`.

    Raises:
        MadocError: The task or physics does not exist; a parameter is unknown, missing, not finite or below its bound.
    """

    def __init__(self, task: Task | str | Path, *, parameters: Parameters = None, physics: str | None = None) -> None:
        self._episodes = Episodes(task, parameters, physics, rows=1, threads=1)
        self.task = self._episodes.task
        self.observation_space, self.action_space = self._episodes.observation_space, self._episodes.action_space

    @property
    def parameters(self) -> Float[np.ndarray, " parameters"]:
        """Physical values in this episode."""
        return self._episodes.parameters[0].copy()

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, object] | None = None
    ) -> tuple[np.ndarray, Information]:
        """Start an episode; a seed restarts the random numbers. There are no options."""
        super().reset(seed=seed)
        self._episodes.reset(np.ones(1, dtype=bool), [self.np_random])
        return self._episodes.observe()[0], _of_row(self._episodes.position())

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Information]:
        """One control step: observation, reward, terminated, truncated, info (`Episodes.step`).

        Raises:
            MadocError: The action has the wrong shape or is not finite.
        """
        reward, terminated, info = self._episodes.step(np.asarray(action)[None])
        observation = self._episodes.observe()[0]
        return observation, float(reward[0]), bool(terminated[0]), bool(info["failed"][0]), _of_row(info)


class CalibratedVectorEnvironment(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many copies of a robot, stepped in one batch; copy i with seed s equals the single environment with seed s + i.

    Args:
        num_envs: Number of copies.
        task: A task, its name, or the path of a robot's spec file.
        parameters: See `Parameters`; a distribution gives each copy a new system at every reset.
        physics: `legacy` or `modern`, for a task given by name; None is `legacy`.
        max_episode_steps: Time limit in control steps, at which an episode is truncated. None takes the task's.
        autoreset_mode: When a copy whose episode has ended starts the next one: by default in the following step, whose
            action is then ignored; `SAME_STEP` puts the last observation into `info["final_obs"]`.
        threads: Number of threads; by default one for each core that this process may use.

    Raises:
        MadocError: As `CalibratedEnvironment`, or fewer than one copy.
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 - Gymnasium declares it so

    def __init__(
        self,
        num_envs: int,
        task: Task | str | Path,
        *,
        parameters: Parameters = None,
        physics: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
    ) -> None:
        if num_envs < 1:
            raise MadocError(f"expected num_envs of at least 1, got {num_envs}")
        self._episodes = Episodes(task, parameters, physics, rows=num_envs, threads=threads)
        self.num_envs, self.task = num_envs, self._episodes.task
        self.single_observation_space = self._episodes.observation_space
        self.single_action_space = self._episodes.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"autoreset_mode": self.autoreset_mode}
        self._limit = max_episode_steps or self.task.max_episode_steps
        self._age = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.zeros(num_envs, dtype=bool)
        self._generators = [np_random()[0] for _ in range(num_envs)]

    @property
    def parameters(self) -> Float[np.ndarray, "num_envs parameters"]:
        """Physical values of each copy."""
        return self._episodes.parameters.copy()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, object] | None = None
    ) -> tuple[np.ndarray, Information]:
        """Start an episode in all copies, or in those of `options["reset_mask"]`.

        Args:
            seed: The seed of the first copy, from which the others count up; or one for each copy.
            options: `reset_mask`, an array of booleans; copies outside it stay as they are.

        Raises:
            MadocError: The number of seeds or the size of the mask is not the number of copies.
        """
        if seed is None or isinstance(seed, int):
            seed = [None if seed is None else seed + row for row in range(self.num_envs)]
        chosen = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if len(seed) != self.num_envs or chosen.shape != (self.num_envs,) or chosen.dtype != bool:
            raise MadocError(
                f"expected {self.num_envs} seeds and a reset_mask of {self.num_envs} booleans, got {len(seed)} and "
                f"shape {chosen.shape} of {chosen.dtype}"
            )
        for row, one in enumerate(seed):
            if chosen[row] and one is not None:
                self._generators[row], _ = np_random(one)
        self._restart(chosen)
        return self._episodes.observe(), _masked(self._episodes.position(), chosen)

    def step(
        self, actions: Float[np.ndarray, "num_envs action"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Information]:
        """One control step of all copies: observations, rewards, terminations, truncations, info (`Episodes.step`).

        Raises:
            MadocError: The actions have the wrong shape or are not finite, or an ended copy was not reset although
                autoreset is disabled.
        """
        fresh = self._ended
        if self.autoreset_mode == AutoresetMode.DISABLED and fresh.any():
            raise MadocError(f"copy {fresh.argmax()} has ended; reset it with options={{'reset_mask': ...}} first")
        reward, terminated, values = self._episodes.step(actions)
        self._age += 1
        truncated = values["failed"] | (self._age >= self._limit)
        final: Information = {}
        if fresh.any():  # ended in the last step, so this one is their reset
            reward, terminated, truncated = np.where(fresh, 0.0, reward), terminated & ~fresh, truncated & ~fresh
        self._ended = terminated | truncated
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._ended.any():
            fresh, last = self._ended, np.full(self.num_envs, None, dtype=object)
            for row, observation in zip(np.flatnonzero(fresh), self._episodes.observe()[fresh], strict=True):
                last[row] = observation
            final = {"final_obs": last, "final_info": _masked(values, fresh)}
            final |= {"_final_obs": fresh.copy(), "_final_info": fresh.copy()}
        if fresh.any():
            self._restart(fresh)
        info = _masked(values, ~fresh) | _masked(self._episodes.position(), np.ones(self.num_envs, dtype=bool)) | final
        return self._episodes.observe(), reward, terminated, truncated, info

    def _restart(self, chosen: Bool[np.ndarray, " num_envs"]) -> None:
        self._episodes.reset(chosen, self._generators)
        self._age[chosen] = 0
        self._ended = self._ended & ~chosen


def _of_row(info: Mapping[str, np.ndarray]) -> Information:
    """The info of the only row."""
    return {name: values[0].item() for name, values in info.items()}


def _masked(info: Mapping[str, np.ndarray], of: Bool[np.ndarray, " num_envs"]) -> Information:
    """The info of a vectorised environment: each array, zero outside a mask of copies, and that mask."""
    values = {name: np.where(of, array, np.zeros((), array.dtype)) for name, array in info.items()}
    return {**values, **{f"_{name}": of.copy() for name in info}}
