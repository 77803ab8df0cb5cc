"""bind and step: two batch axes, the same bits however they are stepped, failures isolated."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

import madoc.tasks
from madoc.errors import MadocError
from madoc.parameters import Parameter, ParameterSpace
from madoc.robots import load
from madoc.simulation.cpu import CpuSimulator, CpuSystem
from madoc.simulation.probes import drive_forces
from own_robots import CART_SPEC, write_robot
from robots import spring


@pytest.mark.parametrize("name", madoc.tasks.TASKS)
def test_two_axes_equal_one_by_one_bit_for_bit(name, make_batch):
    simulator = CpuSimulator(madoc.tasks.make(name), threads=1)
    parameters, state, action = make_batch(simulator, 3, 5)
    together = simulator.bind(parameters).step(state, action)
    assert np.isfinite(together).all()
    assert (together != state).any(-1).all()
    for system in range(3):
        alone = simulator.bind(parameters[system : system + 1])
        for row in range(5):
            one = alone.step(state[system, row][None, None], action[system, row][None, None])
            np.testing.assert_array_equal(one[0, 0], together[system, row])


@pytest.mark.parametrize("name", madoc.tasks.TASKS)
def test_threads_give_the_same_bits(name, make_batch):
    ends = []
    for threads in (1, 2, 3):
        simulator = CpuSimulator(madoc.tasks.make(name), threads=threads)
        parameters, state, action = make_batch(simulator, 4, 8)
        system = simulator.bind(parameters)
        for _ in range(3):
            state = system.step(state, action)
        ends.append(state)
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[0], ends[2])


def test_a_rollout_is_its_steps_bit_for_bit_where_nothing_is_solved(monkeypatch):
    late = replace(spring(Parameter("action_delay", "", 0.0, 0.1)), pending=5)
    simulator = CpuSimulator(late, threads=1)
    system = simulator.bind(np.array([[0.0], [0.033], [0.1]]))
    random = np.random.default_rng(0)
    state = random.normal(size=(3, 4, len(simulator.initial_state)))
    actions, force = random.uniform(-1, 1, (3, 4, 7, 1)), random.normal(size=(3, 4, 7, 1))
    state[1, 2, 0] = np.nan
    together, now = system.roll_out(state, actions, force), state
    for step in range(7):
        now = system.step(now, actions[:, :, step], force[:, :, step])
        np.testing.assert_array_equal(together[:, :, step], now)
    assert np.isnan(together[1, 2]).all() and np.isfinite(together[[0, 2]]).all()
    monkeypatch.setattr("madoc.simulation.cpu._VALUES_AT_ONCE", 1)
    np.testing.assert_array_equal(system.roll_out(state, actions, force), together)


def test_a_machine_without_actuators_falls():
    cart = '<body name="cart"><joint name="slide" type="slide"/><geom size="1"/></body>'
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{cart}</worldbody></mujoco>")
    simulator = CpuSimulator(replace(spring(), spec=lambda: spec), threads=1)
    system = CpuSystem(simulator, [[simulator.task.model]], np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)))
    fallen = system._simulated(np.zeros((1, 2, 2)), np.zeros((1, 2, 5, 0)))
    np.testing.assert_allclose(fallen[0, :, :, 1], 2 * [-9.81 * 0.002 * np.arange(1, 6)])


def test_a_rollout_fails_at_an_action_that_is_no_number():
    task = replace(spring(), frame_skip=1)
    simulator = CpuSimulator(task, threads=1)
    actions = np.array([0.1, 0.2, np.nan, 0.3]).reshape(1, 1, 4, 1)
    end = simulator.bind(simulator.parameters.middle).roll_out(simulator.initial_state[None, None], actions)
    np.testing.assert_array_equal(np.isnan(end[0, 0]).any(-1), [False, False, True, True])
    with pytest.raises(MadocError, match=r"got \(1, 1, 2\) and \(1, 1, 2\)"):
        simulator.bind(simulator.parameters.middle).roll_out(np.zeros((1, 1, 2)), np.zeros((1, 1, 4, 2)))


def test_a_rollout_through_contacts_is_its_steps_within_the_tolerance_of_the_solver(make_batch):
    batches = []
    for threads in (1, 2):
        simulator = CpuSimulator(madoc.tasks.make("hopper"), threads=threads)
        parameters, state, action = make_batch(simulator, 3, 6)
        system, actions = simulator.bind(parameters), np.repeat(action[:, :, None], 10, axis=2)
        actions[0, 2, 4, 1] = np.nan
        batches.append(system.roll_out(state, actions))
    np.testing.assert_array_equal(*batches)
    steps, now = [], state
    for step in range(10):
        now = system.step(now, actions[:, :, step])
        steps.append(now)
    stepped, failed = np.stack(steps, axis=2), np.isnan(batches[0]).any(-1)
    assert failed[0, 2, 4:].all() and failed.sum() == 6
    assert simulator.contacts(batches[0][~failed]).any()
    np.testing.assert_array_equal(failed, np.isnan(stepped).any(-1))
    np.testing.assert_allclose(batches[0], stepped, rtol=0, atol=1e-9)


def test_a_step_does_not_depend_on_the_steps_before(hopper, make_batch):
    parameters, state, action = make_batch(hopper, 2, 6)
    system = hopper.bind(parameters)
    first = system.step(state, action)
    system.step(first, action)
    np.testing.assert_array_equal(system.step(state, action), first)
    other_rows = system.step(state[:, :2], action[:, :2])
    np.testing.assert_array_equal(other_rows, first[:, :2])


def test_a_step_is_mujocos(spring_task):
    task = spring_task()
    simulator = CpuSimulator(task, threads=1)
    model = simulator.model(np.array([4.0, 0.5, 2.0]))
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.ctrl = 0.3, -0.2, 0.7
    mujoco.mj_step(model, data, nstep=task.frame_skip)
    end = simulator.bind(np.array([[4.0, 0.5, 2.0]])).step(np.array([[[0.3, -0.2]]]), np.array([[[0.7]]]))
    np.testing.assert_array_equal(end[0, 0], [data.qpos[0], data.qvel[0]])


def test_one_step_worked_by_hand(spring_task):
    # Semi-implicit Euler with implicit damping, twice 0.01 s:
    # v += 0.01 (u - k x - d v) / (m + 0.01 d); x += 0.01 v, with k = 4, d = 0.5, m = 2, u = 1 from x = 0.5, v = 0.
    position, velocity = 0.5, 0.0
    for _ in range(2):
        velocity += 0.01 * (1.0 - 4.0 * position - 0.5 * velocity) / (2.0 + 0.01 * 0.5)
        position += 0.01 * velocity
    simulator = CpuSimulator(spring_task(), threads=1)
    end = simulator.bind(np.array([[4.0, 0.5, 2.0]])).step(np.array([[[0.5, 0.0]]]), np.ones((1, 1, 1)))
    np.testing.assert_allclose(end[0, 0], [position, velocity], atol=1e-15)


@pytest.mark.parametrize("threads", [1, 2])
def test_an_exploding_row_is_nan_and_the_others_keep_their_bits(threads, make_batch, capfd, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    simulator = CpuSimulator(madoc.tasks.make("hopper"), threads=threads)
    parameters, state, action = make_batch(simulator, 3, 6)
    system = simulator.bind(parameters)
    good = system.step(state, action)
    bad_state, bad_action = state.copy(), action.copy()
    bad_state[0, 2, 7] = 1e11  # faster than MuJoCo takes
    bad_state[1, 4, 8] = 1e8  # explodes on the way
    bad_state[2, 0, 3] = np.nan
    bad_state[2, 5, -1] = np.inf
    bad_action[0, 0, 1] = np.nan
    end = system.step(bad_state, bad_action)
    failed = np.zeros((3, 6), dtype=bool)
    failed[[0, 1, 2, 2, 0], [2, 4, 0, 5, 0]] = True
    assert np.isnan(end[failed]).all()
    np.testing.assert_array_equal(end[~failed], good[~failed])
    np.testing.assert_array_equal(system.step(state, action), good)
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())


def test_an_exploding_system_fails_alone(hopper, make_batch):
    parameters, state, action = make_batch(hopper, 3, 4)
    good = hopper.bind(parameters).step(state, action)
    wild = parameters.copy()
    wild[1, 0] = -1e12
    end = hopper.bind(wild).step(state, action)
    assert np.isnan(end[1]).all()
    np.testing.assert_array_equal(end[[0, 2]], good[[0, 2]])


def test_a_huge_but_finite_end_is_a_failure_too(spring_task):
    # 1.5e9 m/s for 0.02 s is a state MuJoCo takes; a larger force leaves one that it does not.
    simulator = CpuSimulator(spring_task(Parameter("actuator_gain", "push", 1.0, 1e12)), threads=1)
    system = simulator.bind(np.array([[1.0], [1e13]]))
    end = system.step(np.zeros((2, 1, 2)), np.ones((2, 1, 1)))
    assert np.isfinite(end[0]).all()
    assert np.isnan(end[1]).all()


def test_a_hopper_touches_the_ground_when_it_is_low(hopper):
    states = np.stack([hopper.initial_state] * 2)
    states[:, 1] += 1.0, -0.05
    assert hopper.contacts(states).tolist() == [0, 1]  # of the foot and the floor, at two points


def test_contacts_are_where_a_calibrated_zero_places_the_bodies(hopper):
    space = ParameterSpace((Parameter("jnt_ref", "rootz", 0.0, 2.0),))
    simulator, state = CpuSimulator(replace(hopper.task, parameters=space)), hopper.initial_state[None] + 0.0
    state[:, 1] -= 0.05
    drawn = float(hopper.task.model.joint("rootz").qpos0[0])
    touching = [int(simulator.contacts(state, np.array([value]))[0] > 0) for value in (drawn, drawn - 0.2)]
    assert touching == [1, 0]


def test_the_users_own_warning_handler_comes_back(hopper, make_batch):
    def handler(_: str) -> None: ...

    mujoco.set_mju_user_warning(handler)
    try:
        parameters, state, action = make_batch(hopper, 1, 1)
        hopper.bind(parameters).step(state * 1e12, action)
        assert mujoco.get_mju_user_warning() is handler
    finally:
        mujoco.set_mju_user_warning(None)


def test_inputs_are_not_written_to(hopper, make_batch):
    given = make_batch(hopper, 2, 9)
    copies = [array.copy() for array in given]
    given[1][0, 0, 0] = copies[1][0, 0, 0] = np.nan
    hopper.bind(given[0]).step(given[1], given[2])
    for array, copy in zip(given, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_binding_leaves_the_base_model_as_it_was(hopper, make_batch):
    before = hopper.task.compile()
    parameters, _, _ = make_batch(hopper, 2, 1)
    models = [*hopper.bind(parameters).models, hopper.model(parameters[0])]
    for field in ("body_mass", "dof_damping", "body_inertia", "body_subtreemass", "dof_invweight0"):
        np.testing.assert_array_equal(getattr(hopper._model, field), getattr(before, field), err_msg=field)
    assert hopper._model.opt.gravity[2] == before.opt.gravity[2]
    assert models[0].opt.gravity[2] == models[2].opt.gravity[2] == parameters[0, 0]
    assert models[1].opt.gravity[2] == parameters[1, 0]


def test_initial_state_and_sizes(hopper):
    np.testing.assert_array_equal(hopper.initial_state, [0, 1.25, *10 * [0]])
    assert hopper.action_size == 3
    assert hopper.control_step == pytest.approx(0.008)
    assert hopper.bind(np.stack([hopper.parameters.middle] * 4)).count == 4


def test_one_system_by_name_or_as_a_vector(hopper):
    values = dict(zip(hopper.parameters.names, hopper.parameters.middle.tolist(), strict=True))
    assert hopper.bind(values).count == hopper.bind(hopper.parameters.middle).count == 1


@pytest.mark.parametrize(
    ("shape", "sentence"),
    [
        ((7,), "expected 8 parameter values"),
        ((2, 7), "expected 8 parameter values"),
        ((1, 2, 8), r"\(systems, 8\), got"),
    ],
)
def test_parameters_of_a_wrong_shape_are_refused(hopper, shape, sentence):
    with pytest.raises(MadocError, match=sentence):
        hopper.bind(np.ones(shape))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_parameters_that_are_not_finite_are_refused(hopper, value):
    parameters = np.stack([hopper.parameters.middle] * 2)
    parameters[1, 3] = value
    with pytest.raises(MadocError, match="expected finite parameters, got NaN or infinity"):
        hopper.bind(parameters)


def test_parameters_below_their_physical_bound_are_refused(hopper):
    parameters = np.stack([hopper.parameters.middle] * 3)
    parameters[2, -1] = -0.5
    sentence = r"expected dof_damping.foot_joint of at least 0.0 N·m·s/rad, got -0.5 in system 2"
    with pytest.raises(MadocError, match=sentence):
        hopper.bind(parameters)


@pytest.mark.parametrize(
    ("state", "action"),
    [
        ((2, 3, 11), (2, 3, 3)),
        ((2, 3, 12), (2, 3, 4)),
        ((2, 3, 12), (2, 3, 1)),
        ((2, 3, 12), (2, 2, 3)),
        ((3, 3, 12), (3, 3, 3)),
        ((6, 12), (6, 3)),
    ],
)
def test_states_and_actions_of_a_wrong_shape_are_refused(hopper, state, action):
    system = hopper.bind(np.stack([hopper.parameters.middle] * 2))
    with pytest.raises(
        MadocError, match=r"expected states of shape \(2, rows, 12\) and actions of shape \(2, rows, 3\)"
    ):
        system.step(np.zeros(state), np.zeros(action))


def test_models_with_activations_are_refused(spring_task):
    task = spring_task()
    spec = task.spec

    def with_activation() -> mujoco.MjSpec:
        robot = spec()
        robot.actuators[0].dyntype = mujoco.mjtDyn.mjDYN_INTEGRATOR
        return robot

    with pytest.raises(MadocError, match="spring: of the actuators push with an activation"):
        CpuSimulator(replace(task, spec=with_activation))


def test_a_parameter_of_an_element_that_is_not_there_is_refused_at_once(spring_task):
    with pytest.raises(MadocError, match=r"dof_damping.slid: the model has no joint 'slid'; nearest: slide"):
        CpuSimulator(spring_task(Parameter("dof_damping", "slid", 0.0, 1.0)))


def test_replaced_systems_are_as_if_bound_together(tmp_path):
    bias = "  - {field: action_delay, low: 0, high: 0.04}\n  - {field: signal_bias, element: place, low: -1, high: 1}\n"
    simulator = CpuSimulator(load(write_robot(tmp_path, CART_SPEC + bias)).task, threads=1)
    first, second = np.array([[1.0, 0.0, 0.1], [2.0, 0.01, 0.2], [1.5, 0.03, 0.3]]), np.array([[0.7, 0.035, -0.5]])
    exchanged = simulator.bind(first).replaced(np.array([1]), second)
    together = simulator.bind(np.concatenate([first[:1], second, first[2:]]))
    state, action = np.zeros((3, 2, len(simulator.initial_state))), np.full((3, 2, 1), 0.4)
    for _ in range(3):
        state = exchanged.step(state, action)
        np.testing.assert_array_equal(exchanged.observe(state), together.observe(state))
        np.testing.assert_array_equal(exchanged.step(state, -action), together.step(state, -action))


def test_no_rows_step_to_no_rows(hopper):
    system = hopper.bind(hopper.parameters.middle)
    state = np.zeros((1, 0, len(hopper.initial_state)))
    assert system.step(state, np.zeros((1, 0, 3))).shape == state.shape


def test_a_model_that_keeps_a_history_is_refused():
    def delayed():
        spec = spring().spec()
        spec.actuators[0].delay, spec.actuators[0].nsample = 0.01, 4
        return spec

    with pytest.raises(MadocError, match=r"actuators or sensors keep a history \(delay, nsample\)"):
        CpuSimulator(replace(spring(), spec=delayed))


def test_a_force_from_outside_acts_as_an_actuator_would_and_is_gone_after_its_step():
    simulator = CpuSimulator(spring(), threads=1)
    system, action = simulator.bind(simulator.parameters.middle[None]), np.full((1, 1, 1), 0.4)
    state, idle = np.array([[[0.2, -0.1]]]), np.zeros((1, 1, 1))
    force = system.actuator_forces(state, action)[:, :, 0]
    assert force.shape == (1, 1, 1)
    pushed = system.step(state, idle, force)
    np.testing.assert_allclose(pushed, system.step(state, action), rtol=0, atol=1e-12)
    assert (pushed != system.step(state, idle)).any()
    np.testing.assert_array_equal(system.step(state, idle), system.step(state, idle, np.zeros((1, 1, 1))))


def test_what_actuators_exert_on_joints_and_by_sites():
    motor, servo, other = (
        '<motor joint="a" gear="3" ctrllimited="true" ctrlrange="-1 1"/>',
        '<position jointinparent="b" kp="10" kv="2" forcelimited="true" forcerange="-4 4"/>',
        '<motor tendon="both"/>',
    )
    xml = f"""<mujoco><worldbody>
      <body><joint name="a" type="hinge" actuatorfrcrange="-2.5 2.5"/><geom size="0.1"/>
        <body pos="1 0 0"><joint name="b" type="slide"/><geom size="0.1"/></body></body></worldbody>
      <tendon><fixed name="both"><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed></tendon>
      <actuator>{motor}{servo}{other}</actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    state, control = np.array([[0.3, 0.1, 0.5, -0.2]]), np.array([[2.0, 0.2, 0.5]])
    each = drive_forces([model], state, control)[0]
    np.testing.assert_allclose(each[1:], [[0.0, 1.4], [0.5 * 2.5 / 3.5, 0.5]])
    found = each.sum(0)[None]
    # The motor is asked for more than it can, and its joint bears less still. The servo: 10 (0.2 - 0.1) - 2 (-0.2) N.
    np.testing.assert_allclose(found, [[2.5, 1.9]])
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = state[0, :2], state[0, 2:], control[0]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(found[0], data.qfrc_actuator)


def test_drives_exert_what_late_actions_ask_for():
    late = replace(spring(Parameter("action_delay", "", 0.0, 0.1)), pending=5)
    simulator = CpuSimulator(late, threads=1)
    prompt, delayed = (simulator.bind(np.array([[delay]])) for delay in (0.0, simulator.control_step))
    first, second = (np.full((1, 1, 1), value) for value in (0.4, -0.7))
    state = delayed.step(simulator.initial_state[None, None].copy(), first)
    assert (delayed.actuator_forces(state, second) == prompt.actuator_forces(state, first)).all()
    assert (prompt.actuator_forces(state, second) != prompt.actuator_forces(state, first)).all()
