"""A spec made into a task: the same robot as one written in Python, worked out by hand where it does more."""

import json
import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import madoc.simulation
import madoc.tasks
from madoc import robots
from madoc.data import Dataset
from madoc.errors import MadocError
from madoc.identification.states import logged_states
from madoc.simulation.cpu import CpuSimulator
from madoc.simulation.response import insensitive
from madoc.types import Transitions
from own_robots import ARM_SPEC, CART_SPEC, SPRING_SPEC, URDF, URDF_SPEC, task_of, write_robot
from robots import spring, two_link_arm


def same_steps(mine, written, values=None):
    """Next states of two tasks from the same states, under the same actions and parameters, bit for bit."""
    ends = []
    for task in (mine, written):
        simulator = CpuSimulator(task, threads=1)
        randomness = np.random.default_rng(0)
        unit = randomness.uniform(-0.9, 0.9, (3, len(simulator.parameters)))
        state = randomness.normal(size=(3, 4, len(simulator.initial_state)))
        action = randomness.uniform(-1, 1, (3, 4, simulator.action_size))
        system = simulator.bind(simulator.parameters.to_physical(unit))
        for _ in range(3):
            state = system.step(state, action)
        ends.append((state, system.observe(state)))
    np.testing.assert_array_equal(ends[0][0], ends[1][0])
    np.testing.assert_array_equal(ends[0][1], ends[1][1])


@pytest.mark.parametrize(("spec", "written"), [(ARM_SPEC, two_link_arm), (SPRING_SPEC, spring)])
def test_the_same_robot_as_in_python(tmp_path, spec, written):
    mine, task = task_of(tmp_path, spec), written()
    same_steps(mine, task)
    assert mine.parameters.names == task.parameters.names
    np.testing.assert_array_equal(mine.parameters.low, task.parameters.low)
    assert (mine.name, mine.frame_skip, mine.observation_size) == (task.name, task.frame_skip, task.observation_size)
    assert (mine.physics, mine.action_size) == ("modern", task.action_size)


def test_what_a_run_folder_keeps_makes_the_same_robot(tmp_path):
    mine = task_of(tmp_path, ARM_SPEC)
    kept = json.loads(json.dumps(mine.source))
    for file in tmp_path.iterdir():
        file.unlink()
    again = robots.restore(kept).task
    same_steps(again, mine)
    assert again.source == mine.source
    with pytest.raises(MadocError, match=r"the robot in this run's spec.json cannot be read"):
        robots.restore({"file": "arm.yaml"})


def test_units_follow_the_joint(tmp_path):
    units = {row.name: row.unit for row in task_of(tmp_path, SPRING_SPEC).parameters.parameters}
    assert units == {"jnt_stiffness.slide": "N/m", "dof_damping.slide": "N·s/m", "body_mass.cart": "kg"}
    units = {row.name: row.unit for row in task_of(tmp_path, ARM_SPEC).parameters.parameters}
    assert units["dof_damping.elbow"] == "N·m·s/rad"
    robot = robots.load(write_robot(tmp_path, SPRING_SPEC))
    assert [signal.unit for signal in robot.signals] == ["m", "m/s"]


def test_a_shared_value_is_written_into_each_element(tmp_path):
    shared = "  - {field: dof_damping, elements: [shoulder, elbow], name: damping, low: 0, high: 1}\n"
    apart = ARM_SPEC[: ARM_SPEC.index("  - {field: dof_damping")]
    task = task_of(tmp_path, apart + shared)
    assert task.parameters.names[-1] == "damping"
    values = [-9.81, 1.5, 0.4]
    one = CpuSimulator(task, threads=1).bind(np.array([[*values, 0.3]]))
    both = CpuSimulator(task_of(tmp_path, ARM_SPEC), threads=1).bind(np.array([[*values, 0.3, 0.3]]))
    state, action = np.full((1, 2, 4), 0.4), np.full((1, 2, 2), 0.2)
    np.testing.assert_array_equal(one.step(state, action), both.step(state, action))


def test_delay_and_bias_are_felt_and_an_idle_one_is_found(tmp_path):
    extra = (
        "  - {field: action_delay, low: 0, high: 0.03}\n"
        "  - {field: signal_bias, element: place, low: -0.1, high: 0.1}\n"
        "  - {field: jnt_stiffness, element: rail, low: 0, high: 1}\n"
    )
    simulator = CpuSimulator(task_of(tmp_path, CART_SPEC + extra), threads=1)
    randomness = np.random.default_rng(0)
    states, actions = randomness.uniform(-1, 1, (20, 4)), randomness.uniform(-1, 1, (20, 1))
    assert insensitive(simulator, states, actions, key=jax.random.key(0)) == []
    still = np.concatenate([np.zeros((20, 2)), np.zeros((20, 2))], -1)
    found = insensitive(simulator, still, np.zeros((20, 1)), key=jax.random.key(0))
    assert found == ["body_mass.cart", "action_delay", "jnt_stiffness.rail"]


def test_a_urdf(tmp_path):
    robot = robots.load(write_robot(tmp_path, URDF_SPEC, pendulum=URDF))
    task = robot.task
    simulator = CpuSimulator(task, threads=1)
    # About the hinge I = 0.2 + 2 * 0.5² = 0.7 + timestep * damping; gravity pulls with m g l sin(angle).
    timestep = float(task.compile().opt.timestep)
    assert task.frame_skip == round(0.02 / timestep)
    system = simulator.bind(np.array([[2.0, 0.5, 0.2, 0.0]]))
    single = replace(task, frame_skip=1)
    end = CpuSimulator(single, threads=1).bind(np.array([[2.0, 0.5, 0.2, 0.0]]))
    after = end.step(np.array([[[math.pi / 6, 0.0]]]), np.array([[[0.6]]]))[0, 0]
    torque = 3.0 - 2.0 * 9.81 * 0.5 * math.sin(math.pi / 6)
    np.testing.assert_allclose(after[1], timestep * torque / 0.7, rtol=1e-9)
    np.testing.assert_allclose(system.observe(np.array([[[math.pi / 6, 1.0]]]))[0, 0], [30.0, 1.0])
    np.testing.assert_allclose(task.state_from_observation(np.array([30.0, 1.0])), [math.pi / 6, 1.0])


def test_length_and_inertia_of_a_pendulum(tmp_path):
    single = replace(task_of(tmp_path, URDF_SPEC, pendulum=URDF), frame_skip=1)
    timestep = float(single.compile().opt.timestep)
    system = CpuSimulator(single, threads=1).bind(np.array([[2.0, 0.25, 0.4, 0.0]]))
    after = system.step(np.array([[[math.pi / 2, 0.0]]]), np.zeros((1, 1, 1)))[0, 0]
    np.testing.assert_allclose(after[1], -timestep * 2.0 * 9.81 * 0.25 / (0.4 + 2.0 * 0.25**2), rtol=1e-9)


def logged(task, observation, action, starts):
    rows = len(observation)
    none = np.zeros(rows, dtype=bool)
    seen = Transitions(observation, action, np.zeros(rows), observation, none, none)
    return Dataset(seen, np.array(starts), task.name, "modern", "a log")


def test_pending_actions_are_those_of_the_rows_before(tmp_path):
    task = task_of(tmp_path, CART_SPEC + "  - {field: action_delay, low: 0, high: 0.04}\n")
    observation, action = np.arange(14.0).reshape(7, 2), np.arange(7.0)[:, None] / 10
    states, rows = logged_states(logged(task, observation, action, [0, 4]), task)
    assert rows.tolist() == [2, 3, 6]
    np.testing.assert_allclose(states, [[4, 5, 0.1, 0.0], [6, 7, 0.2, 0.1], [12, 13, 0.5, 0.4]])
    with pytest.raises(
        MadocError, match="a state of cart carries the 2 actions before it, and no episode of a log has"
    ):
        logged_states(logged(task, observation, action, range(7)), task)


def test_a_reward_of_signals_and_actions(tmp_path):
    task = task_of(tmp_path, CART_SPEC + "reward: -(place - 1) ** 2 - 0.01 * push ** 2 + speed\n")
    assert task.rewarded
    state, action = np.zeros((3, 2)), np.array([[0.0], [0.5], [-1.0]])
    next_state = np.array([[1.0, 2.0], [0.5, 0.0], [1.0, 0.0]])
    np.testing.assert_allclose(task.reward(state, action, next_state), [2.0, -0.25 - 0.25, -1.0])
    on_jax = jax.jit(task.reward)(jnp.asarray(state), jnp.asarray(action), jnp.asarray(next_state))
    np.testing.assert_allclose(on_jax, [2.0, -0.5, -1.0], rtol=1e-6)
    plain = task_of(tmp_path, CART_SPEC)
    assert not plain.rewarded
    np.testing.assert_array_equal(plain.reward(state, action, next_state), np.zeros(3))
    np.testing.assert_array_equal(plain.terminated(next_state), np.zeros(3, dtype=bool))


def test_moving_a_centre_of_mass_leaves_shapes_where_they_are(tmp_path):
    task = task_of(
        tmp_path,
        URDF_SPEC,
        pendulum="""<mujoco><worldbody><body name="rod"><joint name="hinge" axis="0 1 0"/>
      <geom name="a" type="box" size=".1 .2 .3" pos="0 0 -.5" euler="0 20 0" mass="2"/><site name="s" pos="0 0 -.5"/>
      </body></worldbody></mujoco>""",
    )
    places = []
    for com in (0.5, 0.9):
        model = CpuSimulator(task, threads=1).model(np.array([2.0, com, 0.2, 0.1]))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        places.append((data.geom_xpos.copy(), data.site_xpos.copy(), data.xipos[1, 2]))
    np.testing.assert_allclose(places[0][0], places[1][0], atol=1e-12)
    np.testing.assert_allclose(places[0][1], places[1][1], atol=1e-12)
    assert places[1][2] == pytest.approx(-0.9)


def test_names_and_paths_resolve(tmp_path, monkeypatch):
    path = write_robot(tmp_path, ARM_SPEC)
    assert robots.resolve("hopper").physics == "legacy"
    assert robots.resolve("hopper", "modern").physics == "modern"
    assert robots.resolve(str(path)).name == robots.resolve(path, "modern").name == "two_link_arm"
    with pytest.raises(MadocError, match="legacy physics exists only for Madoc's own robots"):
        robots.resolve(path, "legacy")
    with pytest.raises(MadocError, match=r"did you mean hopper\?.*or give the path of a robot's spec file"):
        robots.resolve("hoper")
    with pytest.raises(MadocError, match=r"nothing.yaml, which does not exist; write one with: madoc init MODEL"):
        robots.resolve(tmp_path / "nothing.yaml")


def test_a_spec_is_parsed_and_its_model_compiled_once(tmp_path, monkeypatch):
    compiled, compile_spec = [], mujoco.MjSpec.compile
    monkeypatch.setattr(mujoco.MjSpec, "compile", lambda spec: compiled.append(spec) or compile_spec(spec))
    path = write_robot(tmp_path, ARM_SPEC.replace("two_link_arm", "counted_arm"))
    robot = robots.load(path)
    madoc.simulation.make(robot.task, threads=1)
    assert robot.task.with_parameters(["gravity"]).action_size == 2
    assert len(compiled) == 1
    assert robots.restore(json.loads(json.dumps(robot.task.source))).task is robot.task
    assert robots.load(path).task is robots.resolve(path) is robot.task
    assert len(compiled) == 1
    path.write_text(path.read_text().replace("groups: 2", "groups: 3"))
    assert robots.load(path).task.groups == 3


def test_a_compiled_model_is_the_callers_own():
    task = madoc.tasks.make("hopper")
    task.compile().opt.gravity[2] = 0.0
    assert task.model is task.with_parameters(["gravity"]).model
    assert task.model.opt.gravity[2] == task.compile().opt.gravity[2] == -9.81


def test_a_drone_takes_a_payload_off_its_centre(tmp_path):
    """By itself MuJoCo keeps its mass matrix diagonal. With 1 kg at 0.2 m of a drone of 1 kg, 19.62 N at the drone's
    centre turn both about the common centre: at 0.1 m, with 0.004 + 2 · 0.1² kg·m²."""
    drone = """<mujoco><option timestep="1e-4"/><worldbody><body name="drone"><freejoint name="free"/>
    <geom size=".1" mass="1" type="sphere"/><site name="rotors"/></body></worldbody>
    <actuator><motor name="thrust" site="rotors" gear="0 0 1 0 0 0" ctrlrange="0 40"/></actuator></mujoco>"""
    spec = """\
madoc: 1
name: drone
model: drone.xml
control_step: 1e-4
signals:
  - {name: pitch_rate, reads: "velocity(free)[4]", unit: rad/s}
actions:
  - {name: thrust, actuator: thrust}
parameters:
  - {field: payload_mass, element: drone, low: 0, high: 2}
  - {field: payload_x, element: drone, low: -0.3, high: 0.3}
"""
    simulator = CpuSimulator(task_of(tmp_path, spec, drone=drone), threads=1)
    system = simulator.bind(np.array([[1.0, 0.2]]))
    after = system.step(simulator.initial_state[None, None], np.full((1, 1, 1), 19.62 / 20.0 - 1.0))
    expected = 1e-4 * 19.62 * 0.1 / (0.004 + 2 * 0.1**2)
    np.testing.assert_allclose(system.observe(after)[0, 0, 0], expected, rtol=1e-5)


def test_a_body_that_only_slides_takes_a_payload_off_its_centre(tmp_path):
    slider = """<mujoco><worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0"/>
    <geom size=".1" mass="1" type="sphere"/></body></worldbody>
    <actuator><motor name="push" joint="x" ctrlrange="-1 1"/></actuator></mujoco>"""
    spec = """\
madoc: 1
name: slider
model: slider.xml
control_step: 0.002
signals:
  - {name: speed, reads: velocity(x)}
actions:
  - {name: push, actuator: push}
parameters:
  - {field: payload_mass, element: cart, low: 0, high: 2}
  - {field: payload_x, element: cart, low: -0.3, high: 0.3}
"""
    simulator = CpuSimulator(task_of(tmp_path, spec, slider=slider), threads=1)
    after = simulator.bind(np.array([[1.0, 0.2]])).step(simulator.initial_state[None, None], np.ones((1, 1, 1)))
    np.testing.assert_allclose(after[0, 0, 1], 0.002 / 2.0)  # 1 N on 2 kg
