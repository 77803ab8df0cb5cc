import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from affine import affine
from madoc.learning.tanh_gaussian import LOG_STD_RANGE, TanhGaussianPolicy, log_density, sample

GAUSSIANS = [(0.0, 1.0), (0.5, 0.5), (-1.0, 0.3), (0.3, 0.05), (0.0, 1.4)]


def scipy_log_density(value, mean, std):
    """Change of variables: log N(arctanh y) - log (1 - y²), one value at a time, in float64."""
    return stats.norm.logpdf(np.arctanh(value), mean, std) - np.log1p(-np.square(value))


def constant_policy(mean, log_std, observation_size=1):
    """A policy whose distribution is the same everywhere."""
    mean, log_std = np.atleast_1d(mean), np.atleast_1d(log_std)
    policy = TanhGaussianPolicy(observation_size, len(mean), (), key=jax.random.key(0))
    numbers = np.concatenate([mean, log_std])
    return eqx.tree_at(
        lambda policy: policy.network, policy, affine(np.zeros((len(numbers), observation_size)), numbers)
    )


def test_log_density_by_hand(compiled):
    # y = 0, N(0, 1): log 1/√(2π) - log (1 - 0) = -0.918939
    # y = tanh 1, N(0.5, 2²): -(0.5 / 2)² / 2 - log 2 - 0.918939 = -1.643336;
    #   log (1 - tanh² 1) = log 0.419974 = -0.867562; the difference is -0.775774
    value = jnp.array([[0.0, np.tanh(1.0)]])
    mean, log_std = jnp.array([[0.0, 0.5]]), jnp.array([[0.0, np.log(2.0)]])
    density = compiled(log_density)(value, mean, log_std)
    np.testing.assert_allclose(density, [-0.918939 - 0.775774], rtol=1e-5)


@pytest.mark.parametrize(("mean", "std"), GAUSSIANS)
def test_log_density_integrates_to_one(mean, std, compiled):
    value = np.tanh(np.linspace(mean - 9 * std, mean + 9 * std, 20_001))
    value = value[np.abs(value) < 1 - 1e-5][:, None]
    full = jnp.full(value.shape, mean), jnp.full(value.shape, np.log(std))
    density = np.exp(np.asarray(compiled(log_density)(jnp.asarray(value), *full), np.float64))
    assert np.trapezoid(density, value[:, 0]) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(("mean", "std"), GAUSSIANS)
def test_log_density_is_scipys_change_of_variables(mean, std, compiled):
    value = np.linspace(-0.995, 0.995, 400, dtype=np.float32)
    full = jnp.full((400, 1), mean), jnp.full((400, 1), np.log(std))
    density = compiled(log_density)(jnp.asarray(value)[:, None], *full)
    np.testing.assert_allclose(density, scipy_log_density(value.astype(np.float64), mean, std), rtol=2e-4, atol=2e-4)


def test_log_density_sums_over_the_last_axis():
    value, mean, log_std = np.random.default_rng(0).uniform(-0.9, 0.9, (3, 4, 5, 2)).astype(np.float32)
    expected = scipy_log_density(value, mean, np.exp(log_std)).sum(-1)
    np.testing.assert_allclose(log_density(value, mean, log_std), expected, rtol=1e-4, atol=1e-4)


def test_log_density_of_recorded_extremes_is_finite_and_has_a_slope():
    value, zero = jnp.array([[1.0], [-1.0]]), jnp.zeros((2, 1))
    assert np.isfinite(log_density(value, zero, zero)).all()
    slope = jax.grad(lambda mean: log_density(value, mean, zero)[0])(zero)
    # d/dm of -(raw - m)² / 2 at m = 0 is raw = arctanh(1 - 1e-5) = 6.1030
    assert slope[0, 0] == pytest.approx(6.103, abs=0.02)
    assert slope[1, 0] == 0.0


@pytest.mark.parametrize(("mean", "std"), GAUSSIANS)
def test_the_density_of_a_sample_is_log_density_of_the_sample(mean, std, compiled):
    full = jnp.full((500, 3), mean), jnp.full((500, 3), np.log(std))
    value, density = compiled(sample)(*full, jax.random.key(3))
    assert value.shape == (500, 3)
    assert density.shape == (500,)
    inside = np.abs(np.asarray(value)).max(-1) < 0.999
    np.testing.assert_allclose(density[inside], log_density(value, *full)[inside], rtol=1e-3, atol=5e-3)


def test_samples_follow_the_distribution():
    full = jnp.full((20_000, 1), 0.4), jnp.full((20_000, 1), np.log(0.6))
    raw = np.arctanh(np.asarray(sample(*full, jax.random.key(0))[0][:, 0], np.float64))
    assert stats.kstest(raw, "norm", (0.4, 0.6)).pvalue > 0.01


def test_a_far_sample_has_a_finite_density_and_gradient():
    far = jnp.full((4, 1), 30.0), jnp.zeros((4, 1))
    value, density = sample(*far, jax.random.key(0))
    assert np.isfinite(density).all()
    np.testing.assert_allclose(value, 1.0)
    slope = jax.grad(lambda mean: sample(mean, far[1], jax.random.key(0))[1].sum())(far[0])
    # d log π / d mean of a reparameterised draw is 2 tanh(raw) -> 2
    np.testing.assert_allclose(slope, 2.0, rtol=1e-5)


def test_policy_standardises_what_it_sees(compiled):
    policy = TanhGaussianPolicy(
        2, 1, (), key=jax.random.key(0), offset=np.array([1.0, -2.0]), scale=np.array([2.0, 4.0])
    )
    policy = eqx.tree_at(lambda policy: policy.network, policy, affine([[1, 10], [0.5, 0]], [0.25, -1]))
    # (5, 2) -> ((5 - 1) / 2, (2 + 2) / 4) = (2, 1): mean 2 + 10 + 0.25 = 12.25, log std 1 - 1 = 0
    mean, log_std = compiled(policy.distribution)(jnp.array([[5.0, 2.0]]))
    np.testing.assert_allclose(mean, [[12.25]])
    np.testing.assert_allclose(log_std, [[0.0]], atol=1e-6)


def test_the_standardisation_is_not_learnt():
    policy = TanhGaussianPolicy(2, 1, (4,), key=jax.random.key(0), offset=np.ones(2), scale=np.full(2, 3.0))
    gradients = eqx.filter_grad(lambda policy: policy.distribution(jnp.ones((5, 2)) * 2.0)[0].sum())(policy)
    np.testing.assert_array_equal(gradients.offset, np.zeros(2))
    np.testing.assert_array_equal(gradients.scale, np.zeros(2))
    assert np.abs(gradients.network.layers[0].weight).max() > 0


def test_log_std_is_kept_in_its_range():
    _, log_std = constant_policy([0.0, 0.0, 0.0], [-50.0, 0.5, 50.0]).distribution(jnp.zeros((2, 1)))
    np.testing.assert_allclose(log_std[0], [LOG_STD_RANGE[0], 0.5, LOG_STD_RANGE[1]])


def test_policy_is_deterministic_without_a_key_and_samples_with_one(compiled):
    policy = constant_policy(0.5, np.log(0.3))
    observation = np.zeros((3000, 1))
    act = compiled(policy)
    np.testing.assert_allclose(act(observation), np.full((3000, 1), np.tanh(0.5)), rtol=1e-6)
    raw = np.arctanh(np.asarray(act(observation, jax.random.key(0)), np.float64))
    assert raw.mean() == pytest.approx(0.5, abs=0.03)  # std of the mean: 0.3 / √3000 = 0.0055
    assert raw.std() == pytest.approx(0.3, rel=0.06)
    np.testing.assert_array_equal(act(observation, jax.random.key(0)), act(observation, jax.random.key(0)))


def test_policy_takes_any_leading_axes():
    policy = TanhGaussianPolicy(3, 2, (8,), key=jax.random.key(0))
    observation = np.random.default_rng(0).normal(size=(4, 5, 3))
    assert policy(observation).shape == (4, 5, 2)
    assert policy(observation, jax.random.key(1)).shape == (4, 5, 2)
    np.testing.assert_allclose(policy(observation)[1, 2], policy(observation[1, 2]), rtol=1e-5, atol=1e-6)
