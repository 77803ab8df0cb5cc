import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from madoc.learning.dynamics_ensemble import (
    BOUNDS_WEIGHT,
    Ensemble,
    bellman_inconsistency,
    fit,
    holdout_error,
    keep_best,
    likelihood_loss,
    training_rows,
    uncertainty_penalty,
    weight_decay,
)
from madoc.learning.features import Features
from madoc.learning.networks import adam
from madoc.types import Transitions

FEATURES = Features(jnp.zeros(2), jnp.ones(2), jnp.array([2.0]), jnp.asarray(1.0), jnp.asarray(4.0))


def constant(means, log_variance):
    """Models of one observation with constant outputs: means of (change, reward), a log variance within bounds."""
    made = Ensemble(1, 1, (), models=len(means), key=jax.random.key(0))
    bias = jnp.array([[*mean, log_variance, log_variance] for mean in means], jnp.float32)
    weight = jnp.zeros_like(made.networks.layers[0].weight)
    made = eqx.tree_at(lambda e: (e.networks.layers[0].weight, e.networks.layers[0].bias), made, (weight, bias))
    return eqx.tree_at(lambda e: (e.largest, e.smallest), made, (jnp.full(2, 30.0), jnp.full(2, -30.0)))


def test_loss_by_hand(compiled):
    # errors (1, 2) and (0, 1) over a variance of e^0.5: mean(1, 4) e^-0.5 + 0.5 and mean(0, 1) e^-0.5 + 0.5
    ensemble = constant([(1.0, 2.0), (0.0, 1.0)], 0.5)
    pair, target = jnp.zeros((2, 3, 2)), jnp.zeros((2, 3, 2))
    wanted = (2.5 + 0.5) * np.exp(-0.5) + 1.0 + BOUNDS_WEIGHT * 120.0
    assert compiled(likelihood_loss)(ensemble, pair, target) == pytest.approx(wanted, rel=1e-5)


def test_weight_decay_by_hand(compiled):
    # 2 models of a first layer of 2 x 2 ones and a last of 4 x 2: half of 2.5e-5 · 4 + 1e-4 · 8, twice
    made = Ensemble(1, 1, (2,), models=2, key=jax.random.key(0))
    ones = [jnp.ones_like(layer.weight) for layer in made.networks.layers]
    made = eqx.tree_at(lambda e: [layer.weight for layer in e.networks.layers], made, ones)
    assert compiled(weight_decay)(made) == pytest.approx(9e-4)


def test_variance_stays_within_its_bounds():
    ensemble = constant([(0.0, 0.0)], 100.0)
    ensemble = eqx.tree_at(lambda e: (e.largest, e.smallest), ensemble, (jnp.full(2, 0.5), jnp.full(2, -10.0)))
    assert ensemble(jnp.zeros((1, 2)))[1].max() <= np.exp(0.25) * 1.0001


def test_holdout_error_by_hand(compiled):
    ensemble = constant([(1.0, 2.0), (0.0, 1.0)], 0.5)
    np.testing.assert_allclose(compiled(holdout_error)(ensemble, jnp.zeros((4, 2)), jnp.zeros((4, 2))), [2.5, 0.5])


def test_penalty_is_the_largest_norm_in_physical_units(compiled):
    # standardised stds (1, 1) and (2, 0.5) are (2, 4) and (4, 2) in units of change 2 and reward 4: the same norm;
    # (0.5, 2) is (1, 8), of norm sqrt 65
    std = jnp.array([[[1.0, 1.0]], [[0.5, 2.0]]])
    np.testing.assert_allclose(compiled(uncertainty_penalty)(std, FEATURES), [np.sqrt(65.0)], rtol=1e-6)


def test_the_bellman_inconsistency_by_hand(compiled):
    # two models that value what follows at 1 and 3: variance 2 of n - 1; two that agree: 0
    value = jnp.array([[1.0, 5.0], [3.0, 5.0]])
    np.testing.assert_allclose(compiled(bellman_inconsistency)(value), [np.sqrt(2.0), 0.0], rtol=1e-6)


def test_held_out_rows_are_never_fitted_to():
    rows = np.asarray(training_rows(jnp.arange(20 - 20 // 5), 5))
    assert set(rows) == set(range(20)) - {4, 9, 14, 19}
    assert len(set(rows)) == 16


def test_features_come_back():
    random = np.random.default_rng(0)
    rows = Transitions(
        random.normal(3, 2, (50, 2)),
        random.uniform(-1, 1, (50, 1)),
        random.normal(5, 2, 50),
        random.normal(3, 2, (50, 2)),
        np.zeros(50, bool),
        np.zeros(50, bool),
    )
    features = Features.of(rows)
    observation, following = jnp.asarray(rows.observation, jnp.float32), jnp.asarray(rows.next_observation, jnp.float32)
    pair = features.pair(observation, jnp.asarray(rows.action, jnp.float32))
    np.testing.assert_allclose(np.asarray(pair).std(0), 1.0, rtol=1e-4)
    change = (following - observation) / features.change_scale[None]
    np.testing.assert_allclose(np.asarray(change).std(0), 1.0, rtol=1e-4)
    np.testing.assert_allclose(features.following(observation, change), following, rtol=1e-4, atol=1e-4)


def test_a_linear_system_is_learnt():
    random = np.random.default_rng(0)
    pair = random.normal(size=(2000, 2)).astype(np.float32)
    outputs = np.stack([0.5 * pair[:, 0] + pair[:, 1], pair[:, 0]], axis=-1).astype(np.float32)
    ensemble, optimiser = Ensemble(1, 1, (16,), models=3, key=jax.random.key(0)), adam(1e-2)
    state = optimiser.init(eqx.filter(ensemble, eqx.is_array))
    rows = (jnp.asarray(pair), jnp.asarray(outputs))
    run = eqx.filter_jit(lambda *parts: fit(*parts, optimiser=optimiser, batch=64, count=500, holdout_every=10))
    before = holdout_error(ensemble, rows[0][9::10], rows[1][9::10])
    ensemble, _, _ = run(ensemble, state, rows, jax.random.key(1))
    after = holdout_error(ensemble, rows[0][9::10], rows[1][9::10])
    assert (after < 0.02 * before).all()
    assert len(set(after.tolist())) == 3


def test_each_model_is_kept_where_its_error_was_smallest():
    first, second = (Ensemble(1, 1, (), models=2, key=jax.random.key(seed)) for seed in range(2))
    second = eqx.tree_at(lambda models: models.largest, second, jnp.full(2, 0.3))
    # The first model's error falls by 0.5 %, which is too little to count; the second's by half.
    kept, smallest, fell = keep_best(first, jnp.array([1.0, 1.0]), second, jnp.array([0.995, 0.5]))
    weights, old, new = (models.networks.layers[0].weight for models in (kept, first, second))
    np.testing.assert_array_equal(weights, jnp.stack([old[0], new[1]]))
    np.testing.assert_array_equal(smallest, [1.0, 0.5])
    np.testing.assert_array_equal(kept.largest, second.largest)
    assert fell
    kept, smallest, fell = keep_best(first, jnp.array([1.0, 1.0]), second, jnp.array([1.0, 2.0]))
    assert eqx.tree_equal(kept, first)
    assert not fell
