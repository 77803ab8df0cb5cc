"""Robots, and a few states and actions to step."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

import madoc.tasks
from madoc.parameters import Parameter, ParameterSpace
from madoc.simulation.cpu import CpuSimulator
from robots import spring


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
    """Hopper with one parameter of every field but those of payloads and whole inertias, which act together."""
    parameters = (
        Parameter("gravity", "", -15.0, -5.0),
        Parameter("body_mass", "torso", 3.0, 5.0),
        Parameter("body_mass_and_inertia", "thigh", 3.0, 5.0),
        Parameter("body_inertia", "foot", 0.01, 0.1),
        Parameter("body_com", "foot", 0.05, 0.2),
        Parameter("body_distance", "leg", 0.4, 0.6),
        Parameter("dof_damping", "leg_joint", 0.0, 3.0),
        Parameter("dof_armature", "leg_joint", 0.5, 2.0),
        Parameter("dof_drag", "leg_joint", 0.1, 1.0),
        Parameter("dof_frictionloss", "foot_joint", 0.0, 1.0),
        Parameter("jnt_stiffness", "thigh_joint", 0.0, 5.0),
        Parameter("geom_friction", "foot_geom", 0.5, 3.0),
        Parameter("geom_friction_torsional", "foot_geom", 0.0, 1.0),
        Parameter("geom_friction_rolling", "foot_geom", 0.0, 1.0),
        Parameter("contact_time", "foot_geom", 0.01, 0.1),
        Parameter("contact_damping", "foot_geom", 0.2, 2.0),
        Parameter("jnt_ref", "leg_joint", 0.1, 0.3),
        Parameter("actuator_gain", "foot", 0.5, 2.0),
        Parameter("actuator_kv", "leg", 1e-6, 1e-5),
    )
    task = madoc.tasks.make("hopper")
    spec = task.spec

    def named() -> mujoco.MjSpec:
        robot = spec()
        robot.actuators[1].name, robot.actuators[2].name = "leg", "foot"
        robot.geom("foot_geom").condim = 6
        robot.actuators[1].biastype = mujoco.mjtBias.mjBIAS_AFFINE
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
