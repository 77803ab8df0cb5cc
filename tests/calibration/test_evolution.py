"""The shared CMA-ES: the library's own search, carried from generation to generation in arrays."""

import jax
import numpy as np
import pytest
from cmaes import CMA

from madoc.calibration.baselines import evolution

BOX = np.tile([-1.0, 1.0], (3, 1))


def sphere(rows):
    return ((rows - np.array([0.3, -0.6, 1.0])) ** 2).sum(-1)


def after(generations, *, seed=0):
    search = evolution.begin(np.zeros(3))
    for generation in range(generations):
        candidates = evolution.ask(search, jax.random.key(100 * seed + generation))
        search = evolution.tell(search, candidates, sphere(candidates))
    return search


def test_it_is_the_search_of_the_library_that_never_stopped():
    whole = CMA(mean=np.zeros(3), sigma=evolution.FIRST_DEVIATION, bounds=BOX, seed=0)
    search = evolution.begin(np.zeros(3))
    for generation in range(30):
        candidates = evolution.ask(search, jax.random.key(generation))
        whole.tell(list(zip(candidates, sphere(candidates).tolist(), strict=True)))
        search = evolution.tell(search, candidates, sphere(candidates))
    np.testing.assert_array_equal(search.mean, whole.mean)
    assert search.deviation == whole._sigma
    np.testing.assert_allclose(search.covariance, whole._C, rtol=1e-9)


def test_it_finds_an_optimum_on_the_wall_of_the_box_and_says_so_when_it_has():
    search = after(150)
    assert search.mean == pytest.approx([0.3, -0.6, 1.0], abs=1e-6)
    assert (np.abs(search.mean) <= 1.0).all()
    assert "after 150 generations every deviation is below 0.001" in evolution.settled(search, 1e-3)
    assert evolution.settled(search, 0.0) is None


def test_candidates_stay_in_the_box_even_from_its_corner():
    search = evolution.begin(np.ones(8), deviation=2.0)
    candidates = evolution.ask(search, jax.random.key(0), 20)
    assert candidates.shape == (20, 8)
    assert (np.abs(candidates) <= 1.0).all()


def test_the_same_key_draws_the_same_candidates():
    search = after(3)
    first, again, other = (evolution.ask(search, jax.random.key(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_the_first_candidates_are_round_and_half_as_wide_as_the_box():
    assert evolution.spread(evolution.begin(np.zeros(2))) == pytest.approx(0.25 * np.eye(2))
    assert evolution.widest_deviation(evolution.begin(np.zeros(2))) == 0.5


@pytest.mark.parametrize(("dimensions", "population"), [(1, 4), (8, 10), (14, 11), (28, 13)])
def test_the_population_grows_with_the_logarithm_of_dimensions(dimensions, population):
    assert len(evolution.ask(evolution.begin(np.zeros(dimensions)), jax.random.key(0))) == population


def test_a_cost_without_a_slope_does_not_send_the_step_size_off():
    search = evolution.begin(np.zeros(3))
    for generation in range(300):
        candidates = evolution.ask(search, jax.random.key(generation))
        search = evolution.tell(search, candidates, np.zeros(len(candidates)))
    assert 0.0 < evolution.widest_deviation(search) <= evolution.LARGEST_DEVIATION * (1 + 1e-12)
