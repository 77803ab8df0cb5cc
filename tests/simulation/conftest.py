"""A spring small enough to work out by hand, and a few states and actions to step."""

from dataclasses import replace

import jax
import mujoco
import numpy as np
import pytest

import madoc.tasks
from madoc.parameters import Parameter, ParameterSpace
from madoc.simulation.cpu import CpuSimulator
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


def spring(*parameters: Parameter) -> Task:
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
        max_episode_steps=10,
        reference_returns=(0.0, 1.0),
        state_from_observation=lambda observation: observation,
    )


@pytest.fixture
def spring_task():
    """The builder: `spring_task(*parameters)`."""
    return spring


@pytest.fixture
def hopper():
    """Legacy Hopper on one thread."""
    return CpuSimulator(madoc.tasks.make("hopper"), threads=1)


@pytest.fixture
def everything():
    """Hopper with one parameter of every field there is."""
    parameters = (
        Parameter("gravity", "", -15.0, -5.0),
        Parameter("body_mass", "torso", 3.0, 5.0),
        Parameter("body_mass_and_inertia", "thigh", 3.0, 5.0),
        Parameter("dof_damping", "leg_joint", 0.0, 3.0),
        Parameter("dof_armature", "leg_joint", 0.5, 2.0),
        Parameter("dof_frictionloss", "foot_joint", 0.0, 1.0),
        Parameter("jnt_stiffness", "thigh_joint", 0.0, 5.0),
        Parameter("geom_friction", "foot_geom", 0.5, 3.0),
        Parameter("actuator_gain", "foot", 0.5, 2.0),
    )
    task = madoc.tasks.make("hopper")
    spec = task.spec

    def named() -> mujoco.MjSpec:
        robot = spec()
        robot.actuators[2].name = "foot"
        return robot

    return replace(task, spec=named, parameters=ParameterSpace(parameters))


def batch(simulator: CpuSimulator, systems: int, rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parameters (systems, d), states and actions (systems, rows, n): random, some of them in contact."""
    randomness = np.random.default_rng(0)
    parameters = simulator.parameters.to_physical(randomness.uniform(-0.9, 0.9, (systems, len(simulator.parameters))))
    size = len(simulator.initial_state)
    state = simulator.initial_state + 0.2 * randomness.normal(size=(systems, rows, size))
    return parameters, state, randomness.uniform(-1, 1, (systems, rows, simulator.action_size))


@pytest.fixture
def make_batch():
    """The builder of batches: `make_batch(simulator, systems, rows)`."""
    return batch
