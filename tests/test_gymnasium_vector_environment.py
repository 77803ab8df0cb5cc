"""The vectorised environment: Gymnasium's rules for vector environments, and agreement with the single environment."""

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.spaces.utils import is_space_dtype_shape_equiv
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import madoc.tasks
from madoc import ENVIRONMENTS
from madoc.errors import MadocError
from madoc.gymnasium_environment import CalibratedVectorEnvironment
from madoc.policies.systems import NormalParameters
from own_robots import CART_SPEC, write_robot

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


def test_mistakes_are_refused_in_one_sentence():
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
