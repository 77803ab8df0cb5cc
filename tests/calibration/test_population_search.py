"""CMA-ES as the library computes it, carried in arrays, and what searches share: rows, failures, estimates."""

import jax
import numpy as np
import pytest
from cmaes import CMA

from madoc import simulation
from madoc.calibration import CalibrationProblem
from madoc.calibration.baselines.population_search import (
    FIRST_DEVIATION,
    LARGEST_DEVIATION,
    Evolution,
    SearchState,
    draw_windows,
    estimate_from_search,
    mean_with_failures,
    next_generation,
)
from madoc.errors import MadocError
from robots import SPRING_TRUTH, recorded, spring

BOX = np.tile([-1.0, 1.0], (3, 1))


def sphere(rows):
    return ((rows - np.array([0.3, -0.6, 1.0])) ** 2).sum(-1)


def after(generations, *, seed=0):
    search = Evolution.about(np.zeros(3))
    for generation in range(generations):
        candidates = search.ask(jax.random.key(100 * seed + generation))
        search = search.tell(candidates, sphere(candidates))
    return search


def test_it_is_the_search_of_the_library_that_never_stopped():
    whole = CMA(mean=np.zeros(3), sigma=FIRST_DEVIATION, bounds=BOX, seed=0)
    search = Evolution.about(np.zeros(3))
    for generation in range(30):
        candidates = search.ask(jax.random.key(generation))
        whole.tell(list(zip(candidates, sphere(candidates).tolist(), strict=True)))
        search = search.tell(candidates, sphere(candidates))
    np.testing.assert_array_equal(search.mean, whole.mean)
    assert search.deviation == whole._sigma
    np.testing.assert_allclose(search.covariance, whole._C, rtol=1e-9)


def test_it_finds_an_optimum_on_the_wall_of_the_box_and_says_so_when_it_has():
    search = after(150)
    assert search.mean == pytest.approx([0.3, -0.6, 1.0], abs=1e-6)
    assert (np.abs(search.mean) <= 1.0).all()
    assert "after 150 generations every deviation is below 0.001" in search.settled(1e-3)
    assert search.settled(0.0) is None


def test_candidates_stay_in_the_box_even_from_its_corner():
    search = Evolution.about(np.ones(8), deviation=2.0)
    candidates = search.ask(jax.random.key(0), 20)
    assert candidates.shape == (20, 8)
    assert (np.abs(candidates) <= 1.0).all()


def test_the_same_key_draws_the_same_candidates():
    search = after(3)
    first, again, other = (search.ask(jax.random.key(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_the_first_candidates_are_round_and_half_as_wide_as_the_box():
    assert Evolution.about(np.zeros(2)).spread == pytest.approx(0.25 * np.eye(2))
    assert Evolution.about(np.zeros(2)).widest == 0.5


@pytest.mark.parametrize(("dimensions", "population"), [(1, 4), (8, 10), (14, 11), (28, 13)])
def test_the_population_grows_with_the_logarithm_of_dimensions(dimensions, population):
    assert len(Evolution.about(np.zeros(dimensions)).ask(jax.random.key(0))) == population


def test_a_cost_without_a_slope_does_not_send_the_step_size_off():
    search = Evolution.about(np.zeros(3))
    for generation in range(300):
        candidates = search.ask(jax.random.key(generation))
        search = search.tell(candidates, np.zeros(len(candidates)))
    assert 0.0 < search.widest <= LARGEST_DEVIATION * (1 + 1e-12)


@pytest.fixture(scope="module")
def problem():
    task = spring(max_episode_steps=6)
    return CalibrationProblem(recorded(task, SPRING_TRUTH, 40, jax.random.key(0)), simulation.make(task, threads=1))


def test_a_failure_costs_the_worst_and_as_much_more_as_that_is_above_the_best():
    costs = np.array([[1.0, 3.0], [np.nan, 5.0]])
    assert mean_with_failures(costs) == pytest.approx([2.0, (9.0 + 5.0) / 2.0])
    assert mean_with_failures(np.full((2, 3), np.nan)) == pytest.approx([0.0, 0.0])


def test_nothing_is_gained_by_failing_even_where_costs_are_negative():
    costs = np.array([[-5.0, -1.0], [-5.0, np.nan]])
    assert mean_with_failures(costs)[1] > mean_with_failures(costs)[0]


def test_windows_never_reach_over_the_end_of_an_episode(problem):
    windows = draw_windows(problem, 4, 200, jax.random.key(1))
    assert windows.actions.shape == (200, 4, 1)
    logged = problem.dataset.transitions.observation
    rows = np.array([np.flatnonzero((logged == state).all(-1))[0] for state in windows.states])
    starts, ends = problem.dataset.episode_starts, problem.dataset.episode_ends
    assert (rows + 4 <= ends[np.searchsorted(starts, rows, side="right") - 1]).all()
    assert len(np.unique(rows)) > 10


def test_every_generation_draws_windows_of_its_own(problem):
    first, again, other = (draw_windows(problem, 1, 10, jax.random.key(seed)).states for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_windows_longer_than_any_episode_are_refused(problem):
    with pytest.raises(MadocError, match="no stretch of 7 rows"):
        draw_windows(problem, 7, 10, jax.random.key(0))


def test_the_estimate_is_the_search_in_physical_units(problem):
    search = Evolution.about(np.array([0.5, 0.0, -1.0]), deviation=0.1)
    estimate = estimate_from_search(problem, SearchState(search, jax.random.key(0), 0))
    assert estimate.mean == pytest.approx([7.0, 1.0, 1.0])
    assert estimate.std == pytest.approx([0.4, 0.1, 0.1])
    assert estimate.covariance == pytest.approx(np.diag([0.16, 0.01, 0.01]))
    assert "at the end of its range: body_mass.cart" in estimate.warnings[0]


def test_a_generation_says_what_it_cost_and_when_the_search_is_narrow():
    key, other = jax.random.split(jax.random.key(0))
    state, spent = SearchState(Evolution.about(np.zeros(2)), key, 1), {"control_steps": 7, "failures": 2}
    candidates = state.search.ask(key)
    following, epoch = next_generation(state, candidates, candidates[:, 0], other, **spent, tolerance=0.0)
    assert (following.search.generation, epoch.control_steps, epoch.converged) == (1, 7, None)
    assert (following.failures, following.key) == (3, other)
    assert epoch.metrics["cost"] == candidates[:, 0].min()
    _, last = next_generation(state, candidates, candidates[:, 0], other, **spent, tolerance=1.0)
    assert last.converged == "after 1 generations every deviation is below 1 of its range"
    assert following.search.mean[0] < 0.0
