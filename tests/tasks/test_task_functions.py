"""Task functions: batched over any leading axes, the same on JAX as on NumPy, inverse where they say so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import madoc.tasks
from madoc.errors import MadocError
from madoc.simulation.cpu import CpuSimulator

POSITION_AND_VELOCITY_NOISE = {
    "hopper": (5e-3, 5e-3),
    "walker2d": (5e-3, 5e-3),
    "halfcheetah": (0.1, None),
    "ant": (0.1, None),
}
"""Bounds of the uniform reset noise; None is normal with deviation 0.1."""


@pytest.fixture(params=madoc.tasks.TASKS)
def task(request):
    return madoc.tasks.make(request.param)


@pytest.fixture
def transition(task):
    simulator = CpuSimulator(task, threads=1)
    randomness = np.random.default_rng(0)
    shape = (2, 3, 5)
    state, next_state = (
        simulator.initial_state + randomness.normal(size=(*shape, len(simulator.initial_state))) for _ in range(2)
    )
    return state, randomness.uniform(-1, 1, (*shape, simulator.action_size)), next_state


def test_batched_is_row_by_row(task, transition):
    state, action, next_state = transition
    batched = task.observe(state), task.reward(*transition), task.terminated(next_state)
    assert batched[0].shape == (2, 3, 5, task.observation_size)
    assert batched[1].shape == batched[2].shape == (2, 3, 5)
    for index in np.ndindex(2, 3, 5):
        np.testing.assert_array_equal(batched[0][index], task.observe(state[index]))
        assert batched[1][index] == task.reward(state[index], action[index], next_state[index])
        assert batched[2][index] == task.terminated(next_state[index])


def test_jax_agrees_with_numpy_inside_jit(task, transition):
    state, _, next_state = transition
    on_jax = [jnp.asarray(array) for array in transition]
    observation = jax.jit(task.observe)(on_jax[0])
    np.testing.assert_allclose(observation, task.observe(state), rtol=1e-5)
    # x' - x loses digits in float32, and the reward divides it by the control step.
    np.testing.assert_allclose(jax.jit(task.reward)(*on_jax), task.reward(*transition), rtol=1e-4, atol=1e-3)
    np.testing.assert_array_equal(jax.jit(task.terminated)(on_jax[2]), task.terminated(next_state))
    rebuilt = jax.jit(task.state_from_observation)(observation)
    np.testing.assert_array_equal(rebuilt, task.state_from_observation(np.asarray(observation)))


def test_state_from_observation_inverts_observe(task, transition):
    state, *_ = transition
    unseen = 2 if task.name == "ant" else 1
    rebuilt = task.state_from_observation(task.observe(state))
    np.testing.assert_array_equal(rebuilt[..., unseen:], state[..., unseen:])
    np.testing.assert_array_equal(rebuilt[..., :unseen], 0.0)
    np.testing.assert_array_equal(task.observe(rebuilt), task.observe(state))
    assert task.rebuildable(task.observe(state)).all()


def test_rows_at_the_velocity_clip_cannot_be_rebuilt(task, transition):
    state = transition[0].copy()
    state[0, 0, 0, -1] = 12.0
    state[1, 2, 4, -1] = -10.0
    observation = task.observe(state)
    rebuildable = task.rebuildable(observation)
    clipped = task.name in ("hopper", "walker2d")
    assert observation[0, 0, 0, -1] == (10.0 if clipped else 12.0)
    assert rebuildable[0, 0, 0] == rebuildable[1, 2, 4] == (not clipped)
    assert rebuildable.sum() == 30 - 2 * clipped


def test_the_root_position_never_enters_the_dynamics(task):
    simulator = CpuSimulator(task, threads=1)
    system = simulator.bind(task.parameters.middle[None])
    state = simulator.initial_state + np.asarray(task.reset_noise(jax.random.key(0), 4), dtype=np.float64)
    action = np.random.default_rng(0).uniform(-1, 1, (4, simulator.action_size))
    rebuilt = task.state_from_observation(task.observe(state))
    ends = [task.observe(system.step(start[None], action[None])) for start in (state, rebuilt)]
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-9)


def test_reset_noise_is_bounded_and_keyed(task):
    simulator = CpuSimulator(task, threads=1)
    noise = np.asarray(task.reset_noise(jax.random.key(0), 1000))
    assert noise.shape == (1000, len(simulator.initial_state))
    positions = len(simulator.initial_state) - simulator.model(task.parameters.middle).nv
    of_position, of_velocity = POSITION_AND_VELOCITY_NOISE[task.name]
    assert of_position * 0.95 < abs(noise[:, :positions]).max() <= of_position
    if of_velocity is None:
        assert noise[:, positions:].std() == pytest.approx(0.1, rel=0.05)
    else:
        assert of_velocity * 0.95 < abs(noise[:, positions:]).max() <= of_velocity
    np.testing.assert_array_equal(noise, task.reset_noise(jax.random.key(0), 1000))
    assert (noise != np.asarray(task.reset_noise(jax.random.key(1), 1000))).any()


def test_episodes_start_healthy(task):
    simulator = CpuSimulator(task, threads=1)
    state = simulator.initial_state + np.asarray(task.reset_noise(jax.random.key(0), 1000))
    assert not task.terminated(state).any()


def test_ranges_contain_the_normal_level_and_all_name_the_same(task):
    assert set(task.ranges) == {"easy", "normal", "hard"}
    assert task.ranges["normal"] == task.parameters
    for level in task.ranges:
        assert task.with_level(level).parameters.names == task.parameters.names
    with pytest.raises(MadocError, match=f"no range level 'huge' for {task.name}; there are: easy, normal, hard"):
        task.with_level("huge")


def test_number_of_parameters_is_the_papers(task):
    assert len(task.parameters) == {"halfcheetah": 14, "hopper": 8, "walker2d": 14, "ant": 12}[task.name]


def test_with_parameters_selects_by_name(task):
    assert task.with_parameters(["gravity"]).parameters.names == ("gravity",)


def test_rewards_worked_by_hand():
    # Hopper: 0.016 m in 0.008 s, standing, full action in three motors: 2 + 1 - 0.003.
    hopper = madoc.tasks.make("hopper")
    state, next_state = np.zeros(12), np.zeros(12)
    state[1] = next_state[1] = 1.25
    next_state[0] = 0.016
    assert hopper.reward(state, np.ones(3), next_state) == pytest.approx(2.997)
    # HalfCheetah: 0.1 m in 0.05 s, six motors at 0.5: 2 - 0.1 · 1.5.
    half_cheetah = madoc.tasks.make("halfcheetah")
    state, next_state = np.zeros(18), np.zeros(18)
    next_state[0] = 0.1
    assert half_cheetah.reward(state, np.full(6, 0.5), next_state) == pytest.approx(1.85)
    # Ant: 0.05 m in 0.05 s, upright, eight motors at 0.5: 1 + 1 - 0.5 · 2.
    ant = madoc.tasks.make("ant")
    state, next_state = np.zeros(29), np.zeros(29)
    next_state[[0, 2]] = 0.05, 0.75
    assert ant.reward(state, np.full(8, 0.5), next_state) == pytest.approx(1.0)
