"""How sharply a log can determine parameters: one of a spring by hand, and from states known and unknown."""

import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.identification.excitation import expected_half_widths, widened
from madoc.identification.states import states_of
from madoc.parameters import Parameter
from own_robots import CART_SPEC, write_robot
from robots import SPRING_TRUTH, counted, recorded, spring


def test_the_half_width_of_a_stiffness_is_that_of_a_regression():
    # After a step of 0.02 s a unit of stiffness has moved v' by -h x / m, m = 2 kg, and x' hardly.
    free = Parameter("jnt_stiffness", "slide", 0.0, 20.0)
    task = spring(free, max_episode_steps=100)
    log = recorded(spring(max_episode_steps=100), SPRING_TRUTH, 300, jax.random.key(0))
    simulator = simulation.make(task, threads=1)
    noise = np.array([1e9, 0.01])
    given = states_of(log, simulator), log, simulator, np.zeros(1), noise
    half, spent = counted(expected_half_widths, *given, exact=True)
    slope = 0.02 / 2.0 * log.transitions.observation[:, 0] * 10.0
    assert half == pytest.approx([1.959964 * 0.01 / np.sqrt((slope**2).sum())], rel=0.05)
    assert spent == 3 * 300


def test_without_speeds_it_is_noise_over_windows_that_widens_them(tmp_path):
    spec = "\n".join(line for line in CART_SPEC.splitlines() if "name: speed," not in line)
    task = robots.load(write_robot(tmp_path, spec)).task
    log, simulator = recorded(task, {"body_mass.cart": 1.0}, 400, jax.random.key(0)), simulation.make(task, threads=1)
    logged = states_of(log, simulator)
    first, second = (
        expected_half_widths(logged, log, simulator, np.zeros(1), np.array([noise]), exact=False)
        for noise in (1e-5, 2e-5)
    )
    assert 0.0 < first < 0.1
    assert second == pytest.approx(2.0 * first, rel=1e-2)


def test_an_open_direction_is_as_long_as_the_box():
    direction = np.array([0.6, 0.8])
    across = np.array([0.8, -0.6])
    covariance = np.outer(direction, direction) / 3 + 1e-6 * np.outer(across, across)
    # along (0.6, 0.8) the second reaches its end first: there the first stands at 0.75
    expected = np.array([0.75, 1.0]) * np.sqrt(1 / 3)
    assert np.sqrt(np.diag(widened(covariance))) == pytest.approx(expected, rel=1e-5)


def test_what_is_told_stays_as_it_is():
    covariance = np.array([[0.02, 0.01], [0.01, 0.03]])
    assert widened(covariance) == pytest.approx(covariance, rel=1e-12)
