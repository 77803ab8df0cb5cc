import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.data import Dataset
from madoc.identification.noise import (
    channel_noise,
    clipped,
    consecutive_noise,
    difference_noise,
    own_slopes,
    residual_noise,
    rounding_of,
)
from madoc.simulation.attitudes import differences, moved
from madoc.types import Transitions
from robots import SPRING_TRUTH, recorded, spring

SPRING = spring(max_episode_steps=100)


def test_the_noise_of_two_steps_by_hand():
    # r_t r_{t+1} = -2 and -4 with slopes 1 and 1: σ² = (2 + 4) / 2.
    first, second, slopes = (np.array([[a], [b]]) for a, b in ((1.0, 2.0), (-2.0, -2.0), (1.0, 1.0)))
    assert consecutive_noise(first, second, slopes) == pytest.approx(np.sqrt(3.0))


def test_a_slope_divides_what_it_carries_on():
    # A = ½: r_t r_{t+1} = -½ σ² = -2, so σ = 2.
    assert consecutive_noise(np.array([[1.0]]), np.array([[-2.0]]), np.array([[0.5]])) == pytest.approx(2.0)


def test_what_does_not_alternate_is_no_noise():
    same = np.ones((10, 1))
    assert consecutive_noise(same, same, same) == 0.0


def test_a_reading_that_does_not_depend_on_itself_leaves_its_own_noise():
    """Residuals of 0.5 and 0.5 ± 0.3 in turn: the constant is the model's error, (0.3)² / 2 the noise's square."""
    first, second, none = np.full((2, 1), 0.5), np.array([[0.8], [0.2]]), np.zeros((2, 1))
    assert consecutive_noise(first, second, none) == pytest.approx(0.3 / np.sqrt(2.0))


def test_noise_is_told_from_a_line_with_noisy_readings():
    rng = np.random.default_rng(0)
    noise = 0.3 * rng.standard_normal((4000, 1))
    residuals = 0.9 * noise[:-1] - noise[1:]
    found = consecutive_noise(residuals[:-1], residuals[1:], np.full((3998, 1), 0.9))
    assert found == pytest.approx(0.3, rel=0.05)


def test_an_outlier_counts_as_five_deviations():
    residuals = np.array([[1.0], [-1.0], [1.0], [-1.0], [100.0], [np.nan]])
    assert clipped(residuals)[:, 0].tolist() == [1, -1, 1, -1, pytest.approx(5 * 1.4826), 0]


def line_of(observation, episodes=(0,)):
    nothing = np.zeros(len(observation) - 1)
    flags = nothing.astype(bool)
    seen = Transitions(observation[:-1], nothing[:, None], nothing, observation[1:], flags, flags)
    return Dataset(seen, np.array(episodes), "spring", "modern", "a test")


def test_second_differences_tell_noise_from_motion():
    rng = np.random.default_rng(0)
    time = np.linspace(0, 20, 5000)[:, None]
    noise = 0.01 * rng.standard_normal(time.shape)
    force = rng.standard_normal(time.shape)
    # A force held over each step moves a mass by half of it in that step and by half in the next.
    pushed = np.cumsum(np.cumsum(0.02 * (force + np.roll(force, 1)), axis=0), axis=0)
    assert difference_noise(line_of(np.sin(time))) < 1e-4
    assert difference_noise(line_of(pushed)) == 0.0
    assert difference_noise(line_of(np.sin(time) + noise, (0, 2500))) == pytest.approx(0.01, rel=0.05)
    assert difference_noise(line_of(noise)) == pytest.approx(0.01, rel=0.05)
    assert difference_noise(line_of(noise[:4])) == 0.0


def test_the_rounding_of_counts():
    """Steps of 0.1 err by 0.1 / √12 = 0.029; what is not read in steps is not rounded."""
    time = np.arange(5000)[:, None] / 500.0
    assert rounding_of(line_of(np.round(np.sin(time) / 0.1) * 0.1)) == pytest.approx(0.029, abs=1e-3)
    assert rounding_of(line_of(np.sin(time))) == 0.0


def test_the_slopes_of_the_spring_by_itself():
    # One control step of 0.02 s: x' by x is 1 - k/m h², less the damping's share; v' by v is 1 - c/m h.
    log = recorded(SPRING, SPRING_TRUTH, 200, jax.random.key(0))
    simulator = simulation.make(SPRING, threads=1)
    unit = SPRING.parameters.to_unit(SPRING.parameters.vector(SPRING_TRUTH))
    slopes = own_slopes(simulator, log, unit, np.array([3, 17]), np.array([0.1, 0.1]))
    h, stiffness, damping, mass = 0.02, 6.5, 0.6, 1.5
    assert slopes[:, 0] == pytest.approx(1 - stiffness / mass * h**2 * 0.75, abs=1e-3)
    assert slopes[:, 1] == pytest.approx(1 - damping / mass * h, abs=2e-3)
    assert slopes[0] == pytest.approx(slopes[1], abs=1e-9)  # a spring is linear


def test_deviation_is_the_median_over_what_the_states_left():
    # One window, three readings, two channels; of the second, each state took three quarters of the variance.
    residuals = np.array([[[1.0, 1.0], [-2.0, 2.0], [3.0, -3.0]]])
    spare = np.array([[[1.0, 0.25], [1.0, 0.25], [1.0, 0.25]]])
    np.testing.assert_allclose(channel_noise(residuals, spare), [1.4826 * 2.0, 1.4826 * 4.0])


def test_readings_that_their_state_explains_say_nothing():
    residuals = np.array([[[1.0], [100.0], [3.0]]])
    spare = np.array([[[1.0], [0.01], [1.0]]])
    np.testing.assert_allclose(channel_noise(residuals, spare), [1.4826 * 2.0])


def test_no_channel_is_a_thousand_times_surer_than_another():
    found = channel_noise(np.array([[[1.0, 0.0]]]), np.ones((1, 1, 2)))
    np.testing.assert_allclose(found, 1.4826 * np.array([1.0, 1e-3]))


def test_the_noise_of_a_fit_counts_its_unknowns():
    # Six values of two channels, two of them spent: mean squares 1 and 4 over 4 / 6.
    residuals = np.array([[[1.0, 2.0], [-1.0, -2.0], [1.0, 2.0]]])
    np.testing.assert_allclose(residual_noise(residuals, 2), np.sqrt([1.5, 6.0]))
    assert (residual_noise(np.full((1, 3, 2), np.nan), 2) == 0.0).all()


BODY = """<mujoco><option gravity="0 0 0" timestep="0.02"/><worldbody><body><joint name="root" type="free"/>
  <geom type="box" size=".1 .2 .3" mass="1"/><site name="side" pos=".1 0 0"/></body></worldbody>
  <actuator><motor name="push" site="side" gear="0 1 0 0 0 0"/></actuator></mujoco>"""


def body_task(folder):
    """A free body that a force pushes at its side, with all signals in the order of (qpos, qvel)."""
    signals = [("position", index) for index in range(7)] + [("velocity", index) for index in range(6)]
    lines = [f"  - {{name: {kind}_{index}, reads: '{kind}(root)[{index}]'}}\n" for kind, index in signals]
    (folder / "model.xml").write_text(BODY)
    (folder / "body.yaml").write_text(
        f"madoc: 1\nname: body\nmodel: model.xml\ncontrol_step: 0.02\nsignals:\n{''.join(lines)}"
        "actions:\n  - {name: push, actuator: push, low: -1, high: 1}\n"
        "parameters:\n  - {field: dof_damping, element: root, low: 0, high: 0.1}\n"
    )
    return robots.load(folder / "body.yaml").task


def test_noise_of_an_attitude_is_that_of_small_rotations(tmp_path):
    """A body that sways about its first attitude: by its component alone, noise of w would seem many times larger."""
    task = body_task(tmp_path)
    assert task.attitudes == ((3, 4, 5, 6),)
    simulator, random = simulation.make(task, threads=1), np.random.default_rng(0)
    state, action, seen = simulator.initial_state, np.zeros(1), []
    system = simulator.bind(simulator.parameters.middle[None])
    actions = np.sin(0.2 * np.arange(600))[:, None]
    for action in actions:
        seen.append(state)
        state = system.step(state[None, None], action[None, None])[0, 0]
    exact = np.stack([*seen, state])
    noise = np.concatenate([np.zeros(4), np.full(3, 0.004), np.zeros(6)])
    logged = moved(task.attitudes, exact, noise * random.standard_normal(exact.shape))
    flags = np.zeros(len(actions), bool)
    rows = Transitions(logged[:-1], actions, np.zeros(len(actions)), logged[1:], flags, flags)
    dataset, every = Dataset(rows, np.array([0]), task.name, "modern", "a test"), np.arange(len(actions))
    after = system.step(logged[None, :-1], actions[None])[0]
    residuals = differences(task.attitudes, after, logged[1:])
    slopes = own_slopes(simulator, dataset, np.zeros(1), every[:-1], np.ones(13))
    found = consecutive_noise(residuals[:-1], residuals[1:], slopes)
    assert found == pytest.approx(noise, abs=5e-4)
    components = (after - logged[1:])[:, 3:4]  # as if they were independent: E[r r'] / A, with A = x² + y² + z² << 1
    carried = 1.0 - logged[:-2, 3:4] ** 2
    assert consecutive_noise(components[:-1], components[1:], carried) > 2.0 * components.std()
