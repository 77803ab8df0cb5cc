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
from madoc.errors import MadocError, NotAllowed
from madoc.identification.states import logged_states
from madoc.simulation.cpu import CpuSimulator
from madoc.simulation.sensitivity import insensitive
from madoc.types import Transitions
from own_robots import ARM_SPEC, BOUNCER, BOUNCER_SPEC, CART_SPEC, SPRING_SPEC, write_robot
from robots import spring, two_link_arm

URDF = """
<robot name="pendulum">
  <link name="base"/>
  <link name="rod">
    <inertial><origin xyz="0 0 -0.5"/><mass value="2"/>
      <inertia ixx="0.2" iyy="0.2" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="hinge" type="revolute">
    <parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="5" velocity="9"/><dynamics damping="0.1" friction="0"/>
  </joint>
</robot>
"""

URDF_SPEC = """\
madoc: 1
name: pendulum
model: pendulum.xml
control_step: 0.02
signals:
  - {name: angle, reads: position(hinge) * 180 / pi, unit: deg}
  - {name: rate, reads: velocity(hinge)}
actions:
  - {name: torque, joint: hinge, means: torque, low: -5, high: 5}
parameters:
  - {field: body_mass, element: rod, low: 1, high: 3}
  - {field: body_com, element: rod, low: 0.2, high: 1}
  - {field: body_inertia, element: rod, low: 0.1, high: 0.4}
  - {field: dof_damping, element: hinge, low: 0, high: 0.5}
"""


def task_of(folder, spec, **models):
    return robots.load(write_robot(folder, spec, **models)).task


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


def test_a_servo_pulls_to_its_target(tmp_path):
    # kp (u - x) - kd v = 100 (0.1 - 0.04) - 2 * 0.5 = 5 N on 2 kg for one step of 0.01 s, twice.
    spec = CART_SPEC.replace(
        "means: force, low: -10, high: 10", "means: position, kp: 100, kd: 2, low: -200, high: 200, unit: mm"
    )
    spec = (
        spec.replace("control_step: 0.02", "control_step: 0.01")
        + "  - {field: actuator_gain, element: push, low: 50, high: 200}\n"
    )
    task = task_of(tmp_path, spec)
    simulator = CpuSimulator(task, threads=1)
    system = simulator.bind(np.array([[2.0, 100.0], [2.0, 50.0]]))
    end = system.step(np.full((2, 1, 2), [0.04, 0.5]), np.full((2, 1, 1), 0.5))
    # Half the gain, in its bias as well: 50 (0.1 - 0.04) - 1 = 2 N.
    np.testing.assert_allclose(end[:, 0, 1], [0.5 + 0.01 * 5 / 2, 0.5 + 0.01 * 2 / 2], rtol=1e-12)
    assert task.parameters.parameters[1].unit == "N/m"
    assert (task.actions[0].unit, task.actions[0].scale) == ("mm", 1e-3)
    model = simulator.model(np.array([2.0, 100.0]))
    assert model.actuator_ctrllimited.all()
    np.testing.assert_allclose(model.actuator_ctrlrange, [[-0.2, 0.2]])


def test_a_velocity_servo_and_its_limit(tmp_path):
    spec = CART_SPEC.replace("means: force, low: -10, high: 10", "means: velocity, kd: 4, limit: 3, low: -1, high: 1")
    spec = spec.replace("control_step: 0.02", "control_step: 0.01")
    system = CpuSimulator(task_of(tmp_path, spec), threads=1).bind(np.array([[1.0]]))
    # kd (u - v): 4 (0.5 - 0) = 2 N; 4 (1 - 0) = 4 N, of which 3 N are had.
    end = system.step(np.zeros((1, 2, 2)), np.array([[[0.5], [1.0]]]))
    np.testing.assert_allclose(end[0, :, 1], [0.02, 0.03], rtol=1e-12)


def test_actions_are_an_affine_map_and_rest_at_nothing(tmp_path):
    spec = CART_SPEC.replace("low: -10, high: 10", "low: 0, high: 4").replace(
        "control_step: 0.02", "control_step: 0.01"
    )
    task = task_of(tmp_path, spec + "  - {field: action_delay, low: 0, high: 0.01}\n")
    simulator = CpuSimulator(task, threads=1)
    assert simulator.initial_state.tolist() == [0.0, 0.0, -1.0]
    end = simulator.bind(np.array([[1.0, 0.0]])).step(np.zeros((1, 3, 3)), np.array([[[-1.0], [0.0], [1.0]]]))
    np.testing.assert_allclose(end[0, :, 1], [0.0, 0.02, 0.04], atol=1e-15)


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


def test_a_bias_is_seen_and_taken_off_the_start(tmp_path):
    bias = "  - {field: signal_bias, element: place, low: -0.1, high: 0.1}\n"
    task = task_of(tmp_path, CART_SPEC.replace("position(rail)", "2 * position(rail) + 1") + bias)
    assert task.parameters.parameters[1].unit == "1"
    system = CpuSimulator(task, threads=1).bind(np.array([[1.0, 0.0], [1.0, 0.06]]))
    state = np.full((2, 1, 2), [0.5, 3.0])
    np.testing.assert_allclose(system.observe(state)[:, 0], [[2.0, 3.0], [2.06, 3.0]])
    # An observation of 2.06 by a sensor that reads 0.06 too much is a place of 0.5.
    rebuilt = task.state_from_observation(np.full((2, 1, 2), [2.06, 3.0]))
    np.testing.assert_allclose(system.unbiased(rebuilt)[:, 0], [[0.53, 3.0], [0.5, 3.0]])


def test_delay_and_bias_are_felt_and_an_idle_one_is_found(tmp_path):
    extra = (
        "  - {field: action_delay, low: 0, high: 0.03}\n"
        "  - {field: signal_bias, element: place, low: -0.1, high: 0.1}\n"
        "  - {field: jnt_stiffness, element: rail, low: 0, high: 1}\n"
    )
    simulator = CpuSimulator(task_of(tmp_path, CART_SPEC + extra), threads=1)
    randomness = np.random.default_rng(0)
    states, actions = randomness.uniform(-1, 1, (20, 4)), randomness.uniform(-1, 1, (20, 1))
    assert insensitive(simulator, states, actions, key=jax.random.key(0))[0] == []
    still = np.concatenate([np.zeros((20, 2)), np.zeros((20, 2))], -1)
    found, _ = insensitive(simulator, still, np.zeros((20, 1)), key=jax.random.key(0))
    assert found == ["body_mass.cart", "action_delay", "jnt_stiffness.rail"]


SENSED = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body name="cart"><joint name="rail" type="slide" axis="1 0 0"/><geom type="box" size=".1 .1 .1" mass="2"/>
      <site name="front" pos="0.3 0 0"/></body>
  </worldbody>
  <sensor><framepos name="front" objtype="site" objname="front"/><accelerometer name="shake" site="front"/></sensor>
</mujoco>
"""


def test_sensors_are_read_in_a_forward_pass_of_each_system(tmp_path):
    spec = CART_SPEC.replace("place, reads: position(rail)", 'place, reads: "sensor(front)[0] * 1000", unit: mm')
    task = task_of(tmp_path, spec, cart=SENSED)
    assert task.pending == 0
    assert task.state_from_observation is None
    system = CpuSimulator(task, threads=1).bind(np.array([[1.0], [2.0]]))
    state = np.tile([0.2, -1.0], (2, 12, 1))
    state[1, 3] = np.nan
    seen = system.observe(state)
    np.testing.assert_allclose(seen[0], np.tile([500.0, -1.0], (12, 1)), rtol=1e-12)
    assert np.isnan(seen[1, 3]).all()
    assert np.isfinite(seen[1, 4:]).all()
    with pytest.raises(MadocError, match="only a bound system can make it"):
        task.observe(state)


def test_a_sensor_of_acceleration_feels_the_last_action(tmp_path):
    spec = CART_SPEC.replace("velocity(rail)", '"sensor(shake)[0]"')
    task = task_of(tmp_path, spec, cart=SENSED)
    assert task.pending == 1
    system = CpuSimulator(task, threads=1).bind(np.array([[0.5], [2.0]]))
    seen = system.observe(np.full((2, 1, 3), [0.0, 0.0, 0.4]))  # 4 N
    np.testing.assert_allclose(seen[:, 0, 1], [8.0, 2.0], rtol=1e-12)


def test_a_sensor_feels_the_action_that_has_taken_effect(tmp_path):
    spec = CART_SPEC.replace("velocity(rail)", '"sensor(shake)[0]"') + "  - {field: action_delay, low: 0, high: 0.04}\n"
    simulator = CpuSimulator(task_of(tmp_path, spec, cart=SENSED), threads=1)
    assert simulator.task.pending == 3  # 0.04 s, and the physics step of 0.01 s in which that action still holds
    delays = (0.01, 0.03, 0.015, 0.035)
    system = simulator.bind(np.array([[1.0, delay] for delay in delays]))
    seen = system.observe(np.full((4, 1, 5), [0.0, 0.0, 0.4, -0.2, 0.6]))
    # Where actions change within the last physics step, it has half of each: (4 - 2) / 2 and (-2 + 6) / 2.
    np.testing.assert_allclose(seen[:, 0, 1], [4.0, -2.0, 1.0, 2.0], rtol=1e-12)


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


def test_a_state_needs_every_position_and_velocity(tmp_path):
    hidden = ARM_SPEC.replace("  - {name: elbow_speed, reads: velocity(elbow)}\n", "")
    robot = robots.load(write_robot(tmp_path, hidden))
    assert robot.task.state_from_observation is None
    assert robot.undetermined == ("no signal is the velocity of elbow",)
    bent = ARM_SPEC.replace("position(elbow)", "sin(position(elbow))")
    assert task_of(tmp_path, bent).state_from_observation is None


def test_sums_of_joints_are_taken_apart(tmp_path):
    # Encoders that see the forearm's angle in the world, and one that sees the shoulder twice.
    spec = ARM_SPEC.replace("reads: position(elbow)", "reads: position(shoulder) + position(elbow)")
    spec = spec.replace("reads: position(shoulder), unit: rad", "reads: 3 - 2 * position(shoulder)")
    task = task_of(tmp_path, spec)
    state = np.random.default_rng(0).normal(size=(5, 4))
    np.testing.assert_allclose(task.state_from_observation(task.observe(state)), state, atol=1e-12)
    np.testing.assert_allclose(jax.jit(task.observe)(jnp.asarray(state)), task.observe(state), rtol=1e-5)


def test_a_free_body_has_thirteen_values(tmp_path):
    model = """<mujoco><worldbody><body name="box" pos="0 0 1"><freejoint name="root"/>
      <geom type="box" size=".1 .1 .1" mass="1"/><body name="arm"><joint name="j"/><geom size=".05" mass=".1"/></body>
      </body></worldbody></mujoco>"""
    reads = [f"position(root)[{i}]" for i in range(7)] + ["position(j)"]
    reads += [f"velocity(root)[{i}]" for i in range(6)] + ["velocity(j)"]
    signals = "".join(f'  - {{name: s{i}, reads: "{text}"}}\n' for i, text in enumerate(reads))
    spec = (
        "madoc: 1\nname: box\nmodel: box.xml\ncontrol_step: 0.02\nsignals:\n" + signals + "actions:\n"
        "  - {name: t, joint: j, means: torque, low: -1, high: 1}\n"
        "parameters:\n  - {field: body_mass, element: box, low: 0.5, high: 2}\n"
    )
    task = task_of(tmp_path, spec, box=model)
    state = CpuSimulator(task, threads=1).initial_state
    np.testing.assert_array_equal(task.observe(state), state)
    np.testing.assert_array_equal(task.state_from_observation(state), state)


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


def test_meshes_and_includes_are_kept(tmp_path):
    corner = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "corner.obj").write_text(corner)
    (tmp_path / "part.xml").write_text(
        '<mujoco><worldbody><body name="b"><joint name="j"/>'
        '<geom type="mesh" mesh="corner"/></body></worldbody></mujoco>'
    )
    model = (
        '<mujoco><compiler meshdir="meshes"/><asset><mesh name="corner" file="corner.obj"/></asset>'
        '<include file="part.xml"/></mujoco>'
    )
    spec = CART_SPEC.replace("rail", "j").replace("element: cart", "element: b").replace("force", "torque")
    task = task_of(tmp_path, spec, cart=model)
    (tmp_path / "part.xml").unlink()
    (tmp_path / "meshes" / "corner.obj").unlink()
    again = robots.restore(json.loads(json.dumps(task.source))).task
    assert again.compile().nmesh == task.compile().nmesh == 1
    np.testing.assert_array_equal(again.compile().body_inertia, task.compile().body_inertia)


def test_a_urdf_finds_meshes_in_its_package(tmp_path):
    package = tmp_path / "arm_description"
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").mkdir()
    (package / "meshes" / "rod.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    mesh = '<collision><geometry><mesh filename="package://arm_description/meshes/rod.obj"/></geometry></collision>'
    text = URDF.replace("</inertial>", f"</inertial>{mesh}")
    path = write_robot(package / "urdf", URDF_SPEC, pendulum=text)
    with pytest.raises(NotAllowed, match=r"robot.yaml, line 3: .*package://arm_description/meshes/rod.obj, outside"):
        robots.load(path)
    assert robots.load(path, allow_outside=True).task.compile().nmesh == 1
    (package / "meshes" / "rod.obj").unlink()
    with pytest.raises(
        MadocError, match=r"robot.yaml, line 3: pendulum.xml refers to package://arm_description/meshes/rod"
    ):
        robots.load(path)


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


def test_what_signals_tell_of_a_state(tmp_path):
    # The elbow's encoder sees the sum of both angles; only the elbow's speed is measured, as twice itself plus 1.
    spec = ARM_SPEC.replace("reads: position(elbow)", "reads: position(shoulder) + position(elbow)")
    spec = spec.replace("  - {name: shoulder_speed, reads: velocity(shoulder)}\n", "")
    spec = spec.replace("reads: velocity(elbow)", "reads: 1 + 2 * velocity(elbow)")
    task = task_of(tmp_path, spec)
    assert task.state_from_observation is None
    state = np.random.default_rng(0).normal(size=(5, 4))
    expected = state.copy()
    expected[:, 2] = np.nan
    np.testing.assert_allclose(task.posture(task.observe(state)), expected, atol=1e-12)
    assert task_of(tmp_path, ARM_SPEC.replace("position(", "velocity(")).posture is None


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


def test_limits_that_the_model_gives_are_in_the_unit_of_the_action(tmp_path):
    model = BOUNCER.replace('joint="knee" gear="60"', 'joint="knee" ctrlrange="-0.02 0.03"')
    spec = BOUNCER_SPEC.replace("low: -1, high: 1}", "unit: mm}")
    (action,) = robots.load(write_robot(tmp_path, spec, bouncer=model)).task.actions
    assert (action.low, action.high, action.scale) == (pytest.approx(-20.0), pytest.approx(30.0), 1e-3)


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
