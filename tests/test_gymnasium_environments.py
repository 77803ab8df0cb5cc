"""The Gymnasium environment: Gymnasium's own checker, its rules, and agreement with the simulator."""

import subprocess
import sys

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.spaces.utils import is_space_dtype_shape_equiv
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import madoc.tasks
from madoc import ENVIRONMENTS
from madoc.errors import MadocError
from madoc.gymnasium_environment import CalibratedEnvironment, CalibratedVectorEnvironment
from madoc.policies.base import NormalParameters
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


COPIES = 4


def singles(name, **settings):
    return [gymnasium.make(f"madoc/{name}", **settings) for _ in range(COPIES)]


def spread(task, share=0.1):
    width = share * (task.parameters.high - task.parameters.low)
    return NormalParameters(task.parameters, task.parameters.middle, np.diag(width**2))


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_spaces_and_metadata_are_those_of_a_vector_environment(name):
    environment = gymnasium.make_vec(f"madoc/{name}", num_envs=COPIES)
    assert isinstance(environment, CalibratedVectorEnvironment)
    assert environment.num_envs == COPIES
    assert environment.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    (single,) = singles(name)[:1]
    for of_one, of_all in (("single_observation_space", "observation_space"), ("single_action_space", "action_space")):
        assert is_space_dtype_shape_equiv(getattr(environment, of_one), getattr(single, of_all))
        assert getattr(environment, of_all) == batch_space(getattr(environment, of_one), COPIES)
    observation, _ = environment.reset(seed=0)
    assert observation in environment.observation_space
    observation, reward, terminated, truncated, _ = environment.step(environment.action_space.sample())
    assert observation in environment.observation_space
    assert (reward.dtype, terminated.dtype, truncated.dtype) == (np.float64, bool, bool)
    assert reward.shape == terminated.shape == truncated.shape == (COPIES,)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("name", ["Hopper", "Ant"])
def test_copies_act_as_gymnasiums_vector_of_single_environments(name, mode):
    """Observations, rewards, ends and info, over episodes' ends and a time limit, bit for bit."""
    ours = gymnasium.make_vec(f"madoc/{name}", num_envs=COPIES, max_episode_steps=25, autoreset_mode=mode)
    theirs = gymnasium.vector.SyncVectorEnv(
        [lambda: gymnasium.make(f"madoc/{name}", max_episode_steps=25)] * COPIES, autoreset_mode=mode
    )
    observed, info = ours.reset(seed=3)
    expected, wanted = theirs.reset(seed=3)
    np.testing.assert_array_equal(observed, expected)
    same_info(info, wanted)
    ours.action_space.seed(0)
    ended = np.zeros(2, dtype=int)
    for _ in range(80):
        action = ours.action_space.sample()
        *steps, info = ours.step(action)
        *others, wanted = theirs.step(action)
        for mine, other in zip(steps, others, strict=True):
            np.testing.assert_array_equal(mine, other)
        same_info(info, wanted)
        ended += steps[2].sum(), steps[3].sum()
    assert (ended > 0).all() or (name == "Ant" and ended[1] > 0)


def same_info(ours, theirs):
    """Equal wherever the mask says that a value is there."""
    assert set(ours) >= set(theirs)
    for key, wanted in theirs.items():
        if key.startswith("_"):
            np.testing.assert_array_equal(ours[key], wanted, err_msg=key)
        elif isinstance(wanted, dict):
            same_info(ours[key], wanted)
        else:
            for row in np.flatnonzero(theirs[f"_{key}"]):
                np.testing.assert_array_equal(ours[key][row], wanted[row], err_msg=key)
    assert all(not np.any(ours[key]) for key in set(ours) - set(theirs) if key.startswith("_"))


def test_without_autoreset_ended_copies_are_reset_by_a_mask():
    environment = gymnasium.make_vec(
        "madoc/HalfCheetah", num_envs=2, max_episode_steps=2, autoreset_mode=AutoresetMode.DISABLED
    )
    environment.reset(seed=0)
    idle = np.zeros((2, 6), dtype=np.float32)
    environment.step(idle)
    before, _, terminated, truncated, _ = environment.step(idle)
    assert truncated.all() and not terminated.any()
    with pytest.raises(MadocError, match="copy 0 has ended; reset it with options="):
        environment.step(idle)
    after, info = environment.reset(options={"reset_mask": np.array([True, False])})
    assert (after[0] != before[0]).any()
    np.testing.assert_array_equal(after[1], before[1])
    np.testing.assert_array_equal(info["_x_position"], [True, False])
    with pytest.raises(MadocError, match="copy 1 has ended"):
        environment.step(idle)


def test_a_seed_decides_and_the_streams_go_on():
    environment = gymnasium.make_vec("madoc/Hopper", num_envs=COPIES)
    first, _ = environment.reset(seed=7)
    after, _ = environment.reset()
    again, _ = environment.reset(seed=[7, 8, 9, 10])
    np.testing.assert_array_equal(first, again)
    assert (first != after).any(1).all()
    assert len(np.unique(first[:, 0])) == COPIES


def test_what_came_before_is_left_as_it_was():
    environment = gymnasium.make_vec("madoc/Ant", num_envs=COPIES)
    first, _ = environment.reset(seed=0)
    kept = first.copy()
    environment.step(environment.action_space.sample())
    np.testing.assert_array_equal(first, kept)


def test_a_distribution_draws_a_system_for_each_copy_and_episode():
    task = madoc.tasks.make("hopper")
    settings = {"num_envs": COPIES, "parameters": spread(task), "max_episode_steps": 3}
    environment = gymnasium.make_vec("madoc/Hopper", **settings, autoreset_mode=AutoresetMode.SAME_STEP)
    observation, info = environment.reset(seed=1)
    first = environment.parameters
    assert len(np.unique(first[:, 0])) == COPIES
    assert ((first >= task.parameters.low) & (first <= task.parameters.high)).all()
    system = madoc.simulation.make(task, threads=1).bind(first)
    state = task.state_from_observation(observation)
    state[:, 0] = info["x_position"]
    action = np.full((COPIES, 3), 0.3)
    expected = task.observe(system.step(state[:, None], action[:, None])[:, 0])
    np.testing.assert_array_equal(environment.step(action)[0], expected)
    environment.step(action)
    np.testing.assert_array_equal(environment.parameters, first)
    assert environment.step(action)[3].all()
    assert (environment.parameters != first).any(1).all()
    environment.reset(seed=1)
    np.testing.assert_array_equal(environment.parameters, first)


def test_the_single_environment_draws_too():
    task = madoc.tasks.make("hopper")
    single = gymnasium.make("madoc/Hopper", parameters=spread(task))
    vector = gymnasium.make_vec("madoc/Hopper", num_envs=2, parameters=spread(task))
    observation, _ = single.reset(seed=6)
    np.testing.assert_array_equal(observation, vector.reset(seed=5)[0][1])
    np.testing.assert_array_equal(single.unwrapped.parameters, vector.parameters[1])
    drawn = single.unwrapped.parameters
    single.reset()
    assert (single.unwrapped.parameters != drawn).any()


def test_a_biased_sensor_is_each_copys_own(tmp_path):
    spec = write_robot(tmp_path, CART_SPEC + "  - {field: signal_bias, element: place, low: -1, high: 1}\n")
    task = madoc.robots.load(spec).task
    environment = CalibratedVectorEnvironment(3, task, parameters=spread(task), max_episode_steps=5)
    observation, _ = environment.reset(seed=0)
    np.testing.assert_array_equal(observation[:, 0], environment.parameters[:, -1])


def test_a_copy_that_diverges_is_truncated_and_the_others_go_on():
    environment = CalibratedVectorEnvironment(2, "hopper")
    environment.reset(seed=0)
    environment._episodes.state[0, 7] = 1e11
    observation, reward, terminated, truncated, info = environment.step(np.zeros((2, 3)))
    assert truncated.tolist() == info["failed"].tolist() == [True, False]
    assert not terminated.any()
    assert np.isfinite(observation).all() and np.isfinite(reward).all()


def test_gymnasiums_statistics_wrapper_takes_it():
    environment = RecordEpisodeStatistics(gymnasium.make_vec("madoc/Hopper", num_envs=COPIES, max_episode_steps=10))
    environment.reset(seed=0)
    lengths = []
    for _ in range(30):
        *_, info = environment.step(np.zeros((COPIES, 3), dtype=np.float32))
        if "episode" in info:
            lengths += info["episode"]["l"][info["_episode"]].tolist()
    assert lengths == [10] * len(lengths) and len(lengths) >= COPIES


def test_mistakes_of_several_at_once_are_refused_in_one_sentence():
    with pytest.raises(MadocError, match="expected num_envs of at least 1, got 0"):
        CalibratedVectorEnvironment(0, "hopper")
    with pytest.raises(MadocError, match="no value for 'gravity'"):
        gymnasium.make_vec("madoc/Hopper", num_envs=2, parameters={})
    environment = CalibratedVectorEnvironment(2, "hopper")
    with pytest.raises(MadocError, match="expected 2 seeds and a reset_mask of 2 booleans, got 3"):
        environment.reset(seed=[1, 2, 3])
    environment.reset(seed=0)
    for action in (np.zeros((3, 3)), np.zeros((2, 4)), np.full((2, 3), np.nan)):
        with pytest.raises(MadocError, match="expected 3 finite values per action for hopper, got"):
            environment.step(action)


def test_draws_depend_on_their_own_copy_alone():
    """The episodes of a copy are the same, whoever is beside it."""
    task = madoc.tasks.make("hopper")
    two, three = (CalibratedVectorEnvironment(count, task, parameters=spread(task)) for count in (2, 3))
    np.testing.assert_array_equal(two.reset(seed=0)[0], three.reset(seed=0)[0][:2])
    random = np.random.default_rng(0)
    for _ in range(40):
        action = random.uniform(-1, 1, (3, 3))
        np.testing.assert_array_equal(two.step(action[:2])[0], three.step(action)[0][:2])
    assert jax.tree.all(jax.tree.map(np.array_equal, two.parameters, three.parameters[:2]))
