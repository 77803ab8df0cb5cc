"""Robots small enough to work out by hand or to calibrate in seconds, and logs of them."""

from collections.abc import Callable
from typing import Any

import jax
import mujoco
import numpy as np

from madoc import simulation
from madoc.data.record import record
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.parameters import Parameter, ParameterSpace
from madoc.simulation.base import SIMULATED
from madoc.tasks.base import Task

SPRING = """
<mujoco>
  <option timestep="0.01" gravity="0 0 -9.81"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" pos="0 0 -1"/>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0" stiffness="4" damping="0.5"/>
      <geom name="box" type="box" size=".1 .1 .1" mass="2"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slide" gear="1"/></actuator>
</mujoco>
"""

PENDULUM = """
<mujoco>
  <option timestep="0.01" gravity="0 0 -9.81"><flag contact="disable"/></option>
  <worldbody>
    <body name="rod">
      <joint name="pivot" type="hinge" axis="0 1 0" damping="0.1"/>
      <geom name="rod" type="capsule" size=".02" fromto="0 0 0 0 0 -.5" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="pivot" joint="pivot" gear="2"/></actuator>
</mujoco>
"""

ARM = """
<mujoco>
  <option timestep="0.01" gravity="0 0 -9.81"><flag contact="disable"/></option>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.2"/>
      <geom name="upper" type="capsule" size=".04" fromto="0 0 0 0 0 -.5" mass="1"/>
      <body name="fore" pos="0 0 -.5">
        <joint name="elbow" type="hinge" axis="0 1 0" damping="0.1"/>
        <geom name="fore" type="capsule" size=".03" fromto="0 0 0 0 0 -.4" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder" gear="4"/>
    <motor name="elbow" joint="elbow" gear="2"/>
  </actuator>
</mujoco>
"""


def spring(*parameters: Parameter, max_episode_steps: int = 10) -> Task:
    """A cart on a spring along x: state (x, ẋ), one motor. It never touches the floor, and falls past |x| = 3."""
    space = ParameterSpace(
        parameters
        or (
            Parameter("jnt_stiffness", "slide", 1.0, 9.0),
            Parameter("dof_damping", "slide", 0.0, 2.0),
            Parameter("body_mass", "cart", 1.0, 3.0),
        )
    )
    return Task(
        name="spring",
        physics="modern",
        spec=lambda: mujoco.MjSpec.from_string(SPRING),
        frame_skip=2,
        observation_size=2,
        observe=lambda state: state,
        reward=lambda state, action, next_state: next_state[..., 0] - state[..., 0],
        terminated=lambda next_state: abs(next_state[..., 0]) > 3.0,
        reset_noise=lambda key, count: jax.random.uniform(key, (count, 2), minval=-0.1, maxval=0.1),
        parameters=space,
        ranges={"normal": space},
        groups=1,
        max_episode_steps=max_episode_steps,
        reference_returns=(0.0, 1.0),
        state_from_observation=lambda observation: observation,
    )


def two_link_arm(*parameters: Parameter) -> Task:
    """An arm hanging in a vertical plane: state (two angles, their speeds), a motor a joint. It never falls."""
    space = ParameterSpace(
        parameters
        or (
            Parameter("gravity", "", -15.0, -5.0),
            Parameter("body_mass", "upper", 0.5, 2.0),
            Parameter("body_mass", "fore", 0.2, 1.0),
            Parameter("dof_damping", "shoulder", 0.0, 1.0),
            Parameter("dof_damping", "elbow", 0.0, 0.5),
        )
    )
    return Task(
        name="two_link_arm",
        physics="modern",
        spec=lambda: mujoco.MjSpec.from_string(ARM),
        frame_skip=2,
        observation_size=4,
        observe=lambda state: state,
        reward=lambda state, action, next_state: -abs(next_state[..., :2]).sum(-1),
        terminated=lambda next_state: abs(next_state[..., 0]) > 1e6,
        reset_noise=lambda key, count: jax.random.uniform(key, (count, 4), minval=-0.5, maxval=0.5),
        parameters=space,
        ranges={"normal": space},
        groups=2,
        max_episode_steps=100,
        reference_returns=(-100.0, 0.0),
        state_from_observation=lambda observation: observation,
    )


def pendulum(*parameters: Parameter) -> Task:
    """A rod swinging in a vertical plane: state (angle, its speed), one motor. It never falls."""
    space = ParameterSpace(
        parameters
        or (
            Parameter("body_mass", "rod", 0.5, 2.0),
            Parameter("dof_damping", "pivot", 0.0, 0.5),
            Parameter("actuator_gain", "pivot", 0.5, 1.5),
        )
    )
    return Task(
        name="pendulum",
        physics="modern",
        spec=lambda: mujoco.MjSpec.from_string(PENDULUM),
        frame_skip=2,
        observation_size=2,
        observe=lambda state: state,
        reward=lambda state, action, next_state: -abs(next_state[..., 0]),
        terminated=lambda next_state: abs(next_state[..., 0]) > 1e6,
        reset_noise=lambda key, count: jax.random.uniform(key, (count, 2), minval=-0.5, maxval=0.5),
        parameters=space,
        ranges={"normal": space},
        groups=1,
        max_episode_steps=200,
        reference_returns=(-100.0, 0.0),
        state_from_observation=lambda observation: observation,
        velocities=1,
    )


SPRING_TRUTH = {"jnt_stiffness.slide": 6.5, "dof_damping.slide": 0.6, "body_mass.cart": 1.5}

ARM_TRUTH = {
    "gravity": -9.81,
    "body_mass.upper": 1.5,
    "body_mass.fore": 0.4,
    "dof_damping.shoulder": 0.3,
    "dof_damping.elbow": 0.35,
}


def recorded(task: Task, truth: dict[str, float], rows: int, key, force: float = 0.0):
    """A log of so many rows under a random policy, with the truth that it travels with.

    Random forces act meanwhile, of this standard deviation on every degree of freedom.
    """
    simulator = simulation.make(task, threads=1)
    simulator = PushedSimulator(simulator, force) if force else simulator
    of_policy, of_rollout = jax.random.split(key)
    policy = TanhGaussianPolicy(task.observation_size, simulator.action_size, (16,), key=of_policy)
    return record(policy, simulator, truth, transitions=rows, key=of_rollout, origin="a random policy")


class PushedSimulator:
    """A simulator in which random forces act on every degree of freedom in each control step."""

    def __init__(self, simulator, force: float):
        self._simulator, self._force = simulator, force

    def __getattr__(self, name):
        return getattr(self._simulator, name)

    def bind(self, parameters):
        system, random = self._simulator.bind(parameters), np.random.default_rng(0)
        step = system.step

        def pushed(state, action):
            dofs = self._simulator.task.model.nv
            return step(state, action, self._force * random.standard_normal((*action.shape[:-1], dofs)))

        system.step = pushed
        return system


class CountingSimulator:
    """A simulator that counts the control steps of its systems."""

    def __init__(self, simulator):
        self._simulator = simulator
        self.rows = 0

    def __getattr__(self, name):
        return getattr(self._simulator, name)

    def bind(self, parameters):
        system = self._simulator.bind(parameters)
        roll_out = system.roll_out

        def counted(state, actions, force=None):
            self.rows += actions[..., 0].size
            return roll_out(state, actions, force)

        system.roll_out = counted
        return system


CELL = """\
  - task: spring.yaml
    data: log.npz
    method: least-squares
    budget: 400
    set: {windows: 4}
"""
"""A cell of a suite's file: a calibration of some hundredths of a second."""


def counted(work: Callable[..., Any], *given: Any, **named: Any) -> tuple[Any, int]:
    """What a function returns, and the control steps that it simulates."""
    began = SIMULATED.control_steps
    return work(*given, **named), SIMULATED.control_steps - began
