"""Where Madoc's actors begin: at N(0, 1), or at the estimate of another method."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import calibrating
from madoc import simulation
from madoc.calibration import CalibrationProblem, LeastSquares, Madoc, Prior
from madoc.calibration.madoc.actors import draw_parameters
from madoc.calibration.madoc.beginning import FARTHEST, NARROWEST, first_actors, sentence
from madoc.errors import MadocError
from robots import SPRING_TRUTH, recorded, spring

KEY = jax.random.key(0)
WHERE = "the estimate of least squares"


@pytest.fixture(scope="module")
def problem():
    task = spring()
    return CalibrationProblem(recorded(task, SPRING_TRUTH, 300, KEY), simulation.make(task, threads=1))


def at(problem, point, deviation):
    """The problem with a prior given in [-1, 1]."""
    space = problem.simulator.parameters
    half = (space.high - space.low) / 2.0
    return replace(problem, prior=Prior(space.to_physical(np.array(point)), half * np.array(deviation), WHERE))


def test_draws_have_the_mean_and_the_deviation_of_the_prior(problem):
    actors = first_actors(at(problem, [0.5, -0.6, 0.0], [0.15, 0.12, 0.2]))
    draws = np.asarray(draw_parameters(actors, KEY, 20_000)[0], np.float64)
    np.testing.assert_allclose(np.median(draws, axis=0), [0.5, -0.6, 0.0], atol=0.01)
    np.testing.assert_allclose(draws.std(axis=0), [0.15, 0.12, 0.2], rtol=0.1)


def test_a_prior_that_is_too_sure_can_be_left(problem):
    actors = first_actors(at(problem, [0.0, 0.6, 1.0], [0.0, 0.01, 0.05]))
    np.testing.assert_allclose(np.exp(actors.log_std), [NARROWEST, NARROWEST / 0.64, 1.0], rtol=1e-5)
    np.testing.assert_allclose(np.tanh(actors.mean), [0.0, 0.6, FARTHEST], rtol=1e-5)


def test_what_the_prior_leaves_open_begins_as_without_one(problem):
    partly = at(problem, [0.7, 0.7, 0.7], [0.6, 0.1, 5.0])
    actors, names = first_actors(partly), problem.simulator.parameters.names
    assert (np.asarray(actors.mean)[[0, 2]] == 0.0).all()
    assert (np.asarray(actors.log_std)[[0, 2]] == 0.0).all()
    assert actors.mean[1] == pytest.approx(np.arctanh(0.7))
    assert sentence(partly) == (
        f"Madoc began at {WHERE}; it leaves {names[0]}, {names[2]} open, which began at the middle of the range"
    )
    nothing = at(problem, [0.7, 0.7, 0.7], [0.6, 0.6, 0.6])
    assert sentence(nothing) == f"Madoc began at the middle of every range, as {WHERE} leaves all parameters open"


@pytest.mark.parametrize("method", [Madoc(), Madoc(groups="one"), Madoc(starts=None)])
def test_madoc_and_its_variants_begin_there(problem, method):
    known = at(problem, [0.5, -0.5, 0.2], [0.1, 0.1, 0.1])
    state = method.init(known, KEY)
    estimate = method.estimate(known, state)
    for actors in (state.agents.actors, state.agents.prior, state.agents.average, state.watch.best):
        np.testing.assert_allclose(np.tanh(actors.mean), [0.5, -0.5, 0.2], rtol=1e-5)
    assert estimate.mean == pytest.approx(known.prior.mean)
    assert estimate.std == pytest.approx(known.prior.std)
    assert estimate.began == f"Madoc began at {WHERE}"


def test_only_the_prior_of_what_is_left_open_follows_the_actors(problem):
    partly = at(problem, [0.5, -0.5, 0.2], [0.1, 0.1, 0.9])
    method = calibrating.madoc(groups="one", cloning_epochs=0, updates=20)
    state = first = method.init(partly, KEY)
    for _ in range(2):
        state, _ = method.step(partly, state)
    before, after = first.agents.prior, state.agents.prior
    assert (np.asarray(state.agents.actors.mean) != np.asarray(first.agents.actors.mean)).all()
    np.testing.assert_array_equal(before.mean[:2], after.mean[:2])
    np.testing.assert_array_equal(before.log_std[:2], after.log_std[:2])
    assert before.mean[2] != after.mean[2]


def test_without_a_prior_it_is_the_papers(problem):
    state = Madoc().init(problem, KEY)
    assert not np.asarray(state.agents.actors.mean).any()
    assert not np.asarray(state.agents.prior.log_std).any()
    assert Madoc().estimate(problem, state).began is None


def test_other_methods_do_not_look_at_it(problem):
    known, method = at(problem, [0.5, -0.5, 0.2], [0.1, 0.1, 0.1]), LeastSquares()
    for plain, informed in zip(*(jax.tree.leaves(method.init(each, KEY)) for each in (problem, known)), strict=True):
        np.testing.assert_array_equal(plain, informed)
    assert method.estimate(known, method.init(known, KEY)).began is None


def test_a_prior_that_is_none_is_refused(problem):
    with pytest.raises(MadocError, match="finite deviations of at least 0"):
        Prior(np.zeros(3), np.array([1.0, np.inf, 1.0]), WHERE)
    with pytest.raises(MadocError, match="the prior is of 2 parameters, the simulator has 3"):
        replace(problem, prior=Prior(np.zeros(2), np.ones(2), WHERE))
