import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from madoc.calibration.madoc.actors import (
    Actors,
    actor_loss,
    divergence,
    draw_parameters,
    initial_actors,
    prior_weight,
)
from madoc.learning.tanh_gaussian import log_density


def gaussian(mean, std):
    return Actors(
        jnp.atleast_1d(jnp.asarray(mean, jnp.float32)), jnp.log(jnp.atleast_1d(jnp.asarray(std, jnp.float32)))
    )


def test_actors_start_as_the_standard_normal():
    actors = initial_actors(3)
    np.testing.assert_array_equal(actors.mean, np.zeros(3))
    np.testing.assert_array_equal(np.exp(actors.log_std), np.ones(3))
    raw = np.arctanh(np.asarray(draw_parameters(actors, jax.random.key(0), 5000)[0], np.float64))
    assert stats.kstest(raw.ravel(), "norm").pvalue > 0.01


def test_draws_are_in_the_box_with_the_density_of_all_groups_together(compiled):
    actors = gaussian([0.3, -0.5, 0.0], [0.2, 0.4, 0.6])
    draws, density = compiled(lambda actors, key: draw_parameters(actors, key, 400))(actors, jax.random.key(1))
    assert draws.shape == (400, 3)
    assert density.shape == (400,)
    assert np.abs(draws).max() <= 1
    value = np.asarray(draws, np.float64)
    each = stats.norm.logpdf(np.arctanh(value), [0.3, -0.5, 0.0], [0.2, 0.4, 0.6]) - np.log1p(-(value**2))
    np.testing.assert_allclose(density, each.sum(-1), rtol=1e-3, atol=2e-3)


def test_draws_of_one_call_differ():
    draws, _ = draw_parameters(initial_actors(2), jax.random.key(0), 50)
    assert len(np.unique(np.asarray(draws))) == 100


def test_divergence_by_hand(compiled):
    # KL(N(1, 2²) || N(0, 1)) = ½ (4 + 1 - 1) - log 2 = 1.306853
    # KL(N(0, 1) || N(1, 2²)) = ½ (¼ + ¼ - 1) + log 2 = 0.443147
    kl = compiled(divergence)(gaussian([1, 0], [2, 1]), gaussian([0, 1], [1, 2]))
    np.testing.assert_allclose(kl, [1.306853, 0.443147], rtol=1e-5)


def test_divergence_is_zero_at_equality_and_flat_there(compiled):
    actors = gaussian([0.3, -2.0], [0.2, 5.0])
    np.testing.assert_allclose(compiled(divergence)(actors, actors), np.zeros(2), atol=1e-6)
    slope = compiled(jax.grad(lambda actors, prior: divergence(actors, prior).sum()))(actors, actors)
    np.testing.assert_allclose(slope.mean, np.zeros(2), atol=1e-6)
    np.testing.assert_allclose(slope.log_std, np.zeros(2), atol=1e-6)


def test_divergence_is_positive_elsewhere():
    random = np.random.default_rng(0)
    actors, prior = (gaussian(random.normal(size=200), random.uniform(0.1, 3, 200)) for _ in range(2))
    assert np.asarray(divergence(actors, prior)).min() > 0


@pytest.mark.parametrize(
    ("actor", "prior"), [((0.3, 0.5), (0.0, 1.0)), ((-0.5, 0.7), (0.2, 0.4)), ((0, 0.1), (0.1, 0.3))]
)
def test_divergence_is_the_mean_log_ratio_of_squashed_draws(actor, prior):
    draws, density = draw_parameters(gaussian(*actor), jax.random.key(0), 200_000)
    full = (jnp.full(draws.shape, part) for part in (prior[0], np.log(prior[1])))
    ratio = np.asarray(density - log_density(draws, *full), np.float64)
    error = ratio.std() / np.sqrt(len(ratio))
    assert divergence(gaussian(*actor), gaussian(*prior))[0] == pytest.approx(ratio.mean(), abs=4 * error + 1e-4)


@pytest.mark.parametrize(
    ("updates", "weight"),
    # λ = exp(t / 2e5): 1 at the start, e at 2e5, 10 from 2e5·log 10 = 460517 on
    [(0, 1.0), (200_000, 2.718282), (400_000, 7.389056), (460_000, 9.974182), (461_000, 10.0), (10**9, 10.0)],
)
def test_prior_weight_by_hand(updates, weight, compiled):
    weigh = compiled(lambda count: prior_weight(count, time_constant=2e5, largest=10.0))
    assert weigh(jnp.asarray(updates)) == pytest.approx(weight, rel=1e-5)


def test_actor_loss_by_hand(compiled):
    # draws: 0.1·(-1) - 1 = -1.1 and 0.1·(-3) - 3 = -3.3, mean -2.2; plus 2·0.5 is -1.2
    loss = compiled(actor_loss)(
        jnp.array([1.0, 3.0]),
        jnp.array([-1.0, -3.0]),
        jnp.asarray(0.5),
        entropy_weight=0.1,
        prior_weight=jnp.asarray(2.0),
    )
    assert loss == pytest.approx(-1.2, rel=1e-6)


def test_actors_follow_the_value_and_are_held_by_the_prior():
    # v(ξ) = 4 ξ pulls the mean up; with a heavy λ on a prior at -0.5 it stays there
    prior = gaussian(-0.5, 0.3)

    def slope(weight):
        def loss_of(actors):
            draws, density = draw_parameters(actors, jax.random.key(0), 500)
            kl = divergence(actors, prior).sum()
            return actor_loss(4 * draws[:, 0], density, kl, entropy_weight=0.05, prior_weight=weight)

        return jax.grad(loss_of)(gaussian(0.0, 0.3)).mean[0]

    assert slope(0.0) < -2
    # λ d KL / d mean = λ (0 + 0.5) / 0.3² = 5.5556 λ
    assert slope(10.0) - slope(0.0) == pytest.approx(55.556, rel=1e-3)
