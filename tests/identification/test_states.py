"""What a log tells of states: each kind once, and windows at which every parameter matters."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.data import Disturbance, disturb
from madoc.data.disturbing import observed_task
from madoc.errors import MadocError
from madoc.identification.ensembles import members_at
from madoc.identification.states import probing_windows, states_observed_as, states_of
from own_robots import CART_SPEC, GEARED, GEARED_SPEC, SLED, SLED_SPEC, SLED_TRUTH, write_robot
from robots import SPRING_TRUTH, recorded, spring

SPRING = spring(max_episode_steps=100)


def of_cart(folder, hidden):
    """The states of a log of a cart without one of its two signals."""
    spec = "\n".join(line for line in CART_SPEC.splitlines() if f"name: {hidden}," not in line)
    task = robots.load(write_robot(folder, spec)).task
    log = recorded(task, {"body_mass.cart": 1.0}, 100, jax.random.key(0))
    simulator = simulation.make(task, threads=1)
    return states_of(log, simulator), log, simulator


def test_observations_that_determine_states_make_them_exact():
    log = recorded(SPRING, SPRING_TRUTH, 20, jax.random.key(0))
    logged = states_of(log, simulation.make(SPRING, threads=1))
    assert (logged.kind, logged.reason, logged.physical_size, logged.measured) == ("exact", "", 2, 2)
    np.testing.assert_array_equal(logged.exact()[0], log.transitions.observation)
    np.testing.assert_array_equal(logged.exact()[1], np.arange(20))


def test_positions_alone_make_states_approximate(tmp_path):
    logged, log, _ = of_cart(tmp_path, "speed")
    assert (logged.kind, logged.starts_known, logged.measured) == ("approximate", True, 1)
    place = log.transitions.observation[:, 0]
    np.testing.assert_array_equal(logged.states[:, 0], place)
    # Over two control steps of 0.02 s between the rows before and behind.
    np.testing.assert_allclose(logged.states[1:-1, 1], (place[2:] - place[:-2]) / 0.04, atol=1e-9)
    with pytest.raises(MadocError, match="does not determine its state"):
        logged.exact()


def test_without_positions_states_are_unknown(tmp_path):
    logged, log, simulator = of_cart(tmp_path, "place")
    assert (logged.kind, logged.starts_known) == ("unknown", False)
    windows = probing_windows(logged, log, simulator, steps=5, count=7)
    assert windows.states.shape == (7, 2)
    assert windows.steps == 5


def test_rows_that_cannot_be_rebuilt_are_said():
    task = replace(SPRING, rebuildable=lambda observation: observation[..., 0] > 1e9)
    logged = states_of(recorded(SPRING, SPRING_TRUTH, 20, jax.random.key(0)), simulation.make(task, threads=1))
    assert logged.kind == "unknown"
    with pytest.raises(MadocError, match="none of the 20 logged states of spring can be rebuilt"):
        logged.guesses()


def test_states_follow_other_observations():
    task = replace(SPRING, rebuildable=lambda observation: observation[..., 0] > 0.5)
    log = recorded(SPRING, SPRING_TRUTH, 3, jax.random.key(0))
    observation = np.array([[1.0, 2.0], [0.0, 3.0], [0.7, 4.0]])
    states = states_observed_as(log, task, np.array([0, 1]), observation)
    np.testing.assert_array_equal(states, [[1.0, 2.0], [np.nan, np.nan]])


def test_windows_to_probe_begin_at_logged_states():
    log = recorded(SPRING, SPRING_TRUTH, 20, jax.random.key(0))
    simulator = simulation.make(SPRING, threads=1)
    windows = probing_windows(states_of(log, simulator), log, simulator, steps=8, count=3)
    np.testing.assert_array_equal(windows.states, log.transitions.observation[[0, 6, 12]])


def test_a_base_that_no_sensor_shows_stands_on_the_floor_and_is_followed(tmp_path):
    task = robots.load(write_robot(tmp_path, SLED_SPEC, sled=SLED)).task
    log = recorded(task, SLED_TRUTH, 100, jax.random.key(0))
    logged = states_of(log, simulation.make(task, threads=1))
    assert (logged.kind, logged.measured) == ("approximate", 9)
    np.testing.assert_array_equal(np.flatnonzero(logged.placed), [0, 1, 2, 8, 9, 10])
    np.testing.assert_array_equal(np.flatnonzero(logged.in_plane), [0, 1])
    # Once it has fallen, it is 0.07 m above the ground, which is at 0.3 m; feet give way by less than a millimetre.
    np.testing.assert_allclose(logged.states[40:, 2], 0.37, atol=2e-3)
    np.testing.assert_allclose(logged.states[40:, 10], 0.0, atol=0.05)
    simulator, noise = simulation.make(task, threads=1), np.full(9, 1e-6)
    rows = np.arange(40, 90, 10)
    drawn = members_at(log, logged, simulator, rows, noise, 400, np.random.default_rng(0)) - logged.states[rows, None]
    np.testing.assert_allclose(drawn.std((0, 1))[[0, 1, 2]], 0.003, rtol=0.1)
    np.testing.assert_allclose(drawn.std((0, 1))[[8, 9, 10]], 0.05, rtol=0.1)
    assert np.abs(drawn[..., [7, 11, 12, 13, 14]]).max() < 1e-3


def test_a_base_is_followed_alike_in_stretches(tmp_path, monkeypatch):
    task = robots.load(write_robot(tmp_path, SLED_SPEC, sled=SLED)).task
    log, simulator = recorded(task, SLED_TRUTH, 300, jax.random.key(0)), simulation.make(task, threads=1)
    whole = []
    for stretch in (30, 1000):
        monkeypatch.setattr("madoc.identification.states.STRETCH", stretch)
        whole.append(states_of(log, simulator).states)
    np.testing.assert_array_equal(whole[0][:30], whole[1][:30])
    np.testing.assert_allclose(whole[0][:, 2], whole[1][:, 2], atol=1e-3)
    assert (whole[0] - whole[1])[:, 8:11].std() < 0.01  # a body that slips keeps its speed for long


def test_states_with_derived_velocities_are_drawn_by_the_noise_of_positions():
    wanted, task = Disturbance(hidden_velocities=True, velocities="differences"), replace(SPRING, velocities=1)
    log = disturb(recorded(SPRING, SPRING_TRUTH, 50, jax.random.key(0)), wanted, task, jax.random.key(1))
    simulator = simulation.make(observed_task(task, log), threads=1)
    logged = states_of(log, simulator)
    assert (logged.kind, logged.measured) == ("exact", 1)
    rows = np.array([10, 20])
    drawn = members_at(log, logged, simulator, rows, np.full(1, 0.01), 400, np.random.default_rng(0))
    # A central difference has the noise of two positions over two control steps.
    expected = [0.01, 0.01 * np.sqrt(2.0) / (2.0 * simulator.control_step)]
    np.testing.assert_allclose((drawn - logged.states[rows, None]).std((0, 1)), expected, rtol=0.1)
    np.testing.assert_allclose(drawn.mean(1), logged.states[rows], atol=0.2 * expected[1])


@pytest.mark.parametrize("encoder", ["motor", "link"])
def test_a_gear_that_no_log_shows_begins_where_its_load_presses_it(tmp_path, encoder):
    spec = GEARED_SPEC.replace("encoder: motor", f"encoder: {encoder}")
    task = robots.load(write_robot(tmp_path, spec, geared=GEARED)).task
    truth = {"gear_backlash.shaft": 0.02, "gear_stiffness.shaft": 125.0, "gear_damping.shaft": 0.5}
    log = recorded(task, truth, 100, jax.random.key(0))
    logged = states_of(log, simulation.make(task, threads=1))
    assert (logged.kind, logged.measured) == ("approximate", 1)
    angle = np.asarray(log.transitions.observation)[:, 0]
    shown = logged.states[:, 0] + (logged.states[:, 1] if encoder == "link" else 0.0)
    np.testing.assert_allclose(shown, angle, atol=1e-12)
    assert (np.abs(logged.states[:, 1]) >= 0.01).all()
