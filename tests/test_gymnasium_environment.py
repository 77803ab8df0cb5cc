"""The Gymnasium environment: Gymnasium's own checker, its rules, and agreement with the simulator."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import madoc.tasks
from madoc import ENVIRONMENTS
from madoc.errors import MadocError
from madoc.gymnasium_environment import CalibratedEnvironment
from madoc.simulation.cpu import CpuSimulator
from own_robots import CART_SPEC, write_robot


@pytest.fixture
def hopper():
    with gymnasium.make("madoc/Hopper") as environment:
        yield environment


# Positions and Ant's and HalfCheetah's velocities have no bound, and any made-up one would be wrong. Gymnasium's
# own MuJoCo environments give the same two warnings; every other one is an error.
@pytest.mark.filterwarnings("ignore:.*A Box observation space m..imum value is -?infinity")
@pytest.mark.parametrize("name", ENVIRONMENTS)
@pytest.mark.parametrize("physics", ["legacy", "modern"])
def test_passes_gymnasiums_checker(name, physics):
    with gymnasium.make(f"madoc/{name}", physics=physics) as environment:
        check_env(environment.unwrapped)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_spaces_and_info(name):
    with gymnasium.make(f"madoc/{name}") as environment:
        task = madoc.tasks.make(ENVIRONMENTS[name])
        assert environment.observation_space.shape == (task.observation_size,)
        assert environment.observation_space.dtype == np.float64
        assert environment.action_space.dtype == np.float32
        observation, info = environment.reset(seed=0)
        assert observation.dtype == np.float64
        before = info["x_position"]
        *_, info = environment.step(environment.action_space.sample())
        step = CpuSimulator(task, threads=1).control_step
        assert info["x_velocity"] == (info["x_position"] - before) / step
        assert info["failed"] is False


@pytest.mark.parametrize("first", ["import gymnasium, madoc", "import madoc, gymnasium", "import gymnasium"])
def test_the_import_of_madoc_registers_in_either_order_and_the_id_can_import_it(first):
    name = "madoc/Ant" if "madoc" in first else "madoc:madoc/Ant"
    code = (
        f"{first}\n"
        "import sys\n"
        "assert 'jax' not in sys.modules and 'mujoco' not in sys.modules\n"
        f"environment = gymnasium.make({name!r})\n"
        "print(environment.observation_space.shape[0])"
    )
    run = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout.strip()) == (0, "27"), run.stderr


def test_a_registered_episode_is_as_long_as_the_tasks():
    assert {madoc.tasks.make(task).max_episode_steps for task in ENVIRONMENTS.values()} == {madoc.EPISODE_STEPS}


def test_same_seed_same_episode_and_the_stream_goes_on(hopper):
    first, _ = hopper.reset(seed=7)
    after, _ = hopper.reset()
    again, _ = hopper.reset(seed=7)
    other, _ = hopper.reset(seed=8)
    np.testing.assert_array_equal(first, again)
    assert (first != after).any()
    assert (first != other).any()


def test_steps_are_the_simulators(hopper):
    parameters = {**dict.fromkeys(hopper.unwrapped.task.parameters.names, 1.0), "gravity": -9.0}
    parameters |= {name: 4.0 for name in parameters if name.startswith("body_mass")}
    with gymnasium.make("madoc/Hopper", parameters=parameters) as environment:
        task = environment.unwrapped.task
        system = CpuSimulator(task, threads=1).bind(task.parameters.vector(parameters)[None])
        observation, info = environment.reset(seed=1)
        environment.action_space.seed(1)
        state = task.state_from_observation(observation)
        state[0] = info["x_position"]
        for _ in range(20):
            action = environment.action_space.sample()
            next_state = system.step(state[None, None], action[None, None].astype(float))[0, 0]
            observation, reward, terminated, truncated, _ = environment.step(action)
            np.testing.assert_array_equal(observation, task.observe(next_state))
            assert reward == task.reward(state, action.astype(float), next_state)
            assert terminated == task.terminated(next_state)
            assert not truncated
            state = next_state
            if terminated:
                break


def test_parameters_default_to_mid_range_and_come_as_a_vector_too():
    task = madoc.tasks.make("hopper")
    assert (CalibratedEnvironment("hopper").parameters == task.parameters.middle).all()
    low = CalibratedEnvironment("hopper", parameters=task.parameters.low)
    assert (low.parameters == task.parameters.low).all()


def test_a_task_of_ones_own():
    task = madoc.tasks.make("hopper", "modern").with_parameters(["gravity"])
    environment = CalibratedEnvironment(task, parameters={"gravity": -9.81})
    assert environment.task is task
    assert environment.parameters == [-9.81]


def test_the_time_limit_truncates_and_does_not_terminate():
    with gymnasium.make("madoc/HalfCheetah") as environment:
        environment.reset(seed=0)
        action = np.zeros(6, dtype=np.float32)
        ends = [environment.step(action)[2:4] for _ in range(1000)]
    assert ends == [(False, False)] * 999 + [(False, True)]


def test_a_fall_terminates(hopper):
    hopper.reset(seed=0)
    for _ in range(1000):
        _, _, terminated, truncated, _ = hopper.step(np.ones(3, dtype=np.float32))
        if terminated:
            break
    assert terminated
    assert not truncated


def test_an_explosion_truncates_at_the_last_good_state():
    environment = CalibratedEnvironment("hopper")
    before, _ = environment.reset(seed=0)
    environment._episodes.state[0, 7] = 1e11
    observation, reward, terminated, truncated, info = environment.step(np.zeros(3, dtype=np.float32))
    assert (terminated, truncated, info["failed"]) == (False, True, True)
    assert np.isfinite(observation).all()
    assert np.isfinite(reward)
    np.testing.assert_array_equal(observation[:5], before[:5])


def test_mistakes_are_refused_in_one_sentence(hopper):
    with pytest.raises(MadocError, match=r"unknown parameter 'body_mass.head'; expected values for exactly"):
        values = dict.fromkeys(hopper.unwrapped.task.parameters.names, 1.0)
        gymnasium.make("madoc/Hopper", parameters={**values, "body_mass.head": 1.0})
    with pytest.raises(MadocError, match="no value for 'gravity'"):
        gymnasium.make("madoc/Hopper", parameters={})
    with pytest.raises(MadocError, match=r"expected 8 parameter values \(gravity, .* got an array of shape \(3,\)"):
        gymnasium.make("madoc/Hopper", parameters=np.zeros(3))
    with pytest.raises(MadocError, match="unknown physics 'old'"):
        gymnasium.make("madoc/Hopper", physics="old")
    hopper.reset(seed=0)
    with pytest.raises(MadocError, match="expected 3 finite values per action for hopper, got"):
        hopper.unwrapped.step(np.zeros(4))
    with pytest.raises(MadocError, match="expected 3 finite values per action for hopper, got"):
        hopper.unwrapped.step(np.array([0.0, np.nan, 0.0]))


def test_a_robot_of_ones_own_by_its_path(tmp_path):
    environment = CalibratedEnvironment(write_robot(tmp_path, CART_SPEC), parameters={"body_mass.cart": 2.0})
    observation, _ = environment.reset(seed=0)
    np.testing.assert_array_equal(observation, [0.0, 0.0])
    observation, reward, *_ = environment.step(np.array([0.4]))  # 4 N on 2 kg for two steps of 0.01 s
    np.testing.assert_allclose(observation, [0.0006, 0.04], atol=1e-15)
    assert reward == 0.0
