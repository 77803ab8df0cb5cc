import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from affine import affine
from madoc.learning.dynamics_ratio import (
    Discriminators,
    blur,
    discriminator_loss,
    log_dynamics_ratio,
    overlap,
)


def discriminators(pair, triple, bound=2.0, pair_bound=None):
    """One observation, no action: f_sa from (s,), f_sas from (s, s'), each bound·tanh of an affine map."""
    made = Discriminators(1, 0, (), key=jax.random.key(0), bound=bound, pair_bound=pair_bound or bound, dropout=0.0)
    return eqx.tree_at(lambda parts: (parts.pair, parts.triple), made, (affine(*pair), affine(*triple)))


def random_discriminators(bound=2.0, dropout=0.0, hidden=(16, 16)):
    return Discriminators(3, 2, hidden, key=jax.random.key(0), bound=bound, pair_bound=bound, dropout=dropout)


def random_features(count=64, size=1.0, seed=1):
    random = np.random.default_rng(seed)
    pair, following = size * random.normal(size=(count, 5)), size * random.normal(size=(count, 3))
    return jnp.asarray(pair, jnp.float32), jnp.asarray(following, jnp.float32)


# The pre-activation whose 2·tanh is 1.
ONE = np.arctanh(0.5)
COLUMN = jnp.ones((4, 1))


def test_loss_at_zero_logits_is_four_log_two(compiled):
    zero = discriminators((np.zeros((2, 1)), np.zeros(2)), (np.zeros((2, 2)), np.zeros(2)))
    loss, metrics = compiled(discriminator_loss)(zero, (COLUMN, COLUMN), (-COLUMN, 3 * COLUMN))
    assert loss == pytest.approx(4 * np.log(2), rel=1e-6)
    assert metrics["discriminator_loss_sa"] == pytest.approx(2 * np.log(2), rel=1e-6)
    assert metrics["discriminator_loss_sas"] == pytest.approx(2 * np.log(2), rel=1e-6)
    # nothing says target, so simulated rows are all right and logged rows all wrong
    assert metrics["accuracy_sa"] == metrics["accuracy_sas"] == 0.5


def test_loss_by_hand(compiled):
    # logged s = 1, simulated s = -1; f_sa = (2 tanh(ONE s), 0) = (1, 0) logged, (-1, 0) simulated:
    #   D_sa(target | logged) = D_sa(source | simulated) = e / (e + 1) = 0.731059
    #   loss_sa = -2 log 0.731059 = 0.626523
    # f_sas = (0, 1) everywhere: f_sas + f_sa = (1, 1) logged: 1/2; (-1, 1) simulated: e² / (e² + 1) = 0.880797
    #   loss_sas = log 2 - log 0.880797 = 0.693147 + 0.126928 = 0.820075
    parts = discriminators(([[ONE], [0]], [0, 0]), (np.zeros((2, 2)), [0, ONE]))
    loss, metrics = compiled(discriminator_loss)(parts, (COLUMN, COLUMN), (-COLUMN, COLUMN))
    assert metrics["discriminator_loss_sa"] == pytest.approx(0.626523, rel=1e-5)
    assert metrics["discriminator_loss_sas"] == pytest.approx(0.820075, rel=1e-5)
    assert loss == pytest.approx(1.446598, rel=1e-5)
    assert metrics["accuracy_sa"] == 1.0


def test_accuracy_counts_logged_and_simulated_rows_alike():
    # says target where s > 0: 3 of 4 logged rows, and 1 of 4 simulated rows is taken for logged
    parts = discriminators(([[1], [0]], [0, 0]), (np.zeros((2, 2)), [0, 0]))
    logged, simulated = jnp.array([[1.0], [1], [1], [-1]]), jnp.array([[-1.0], [-1], [-1], [1]])
    _, metrics = discriminator_loss(parts, (logged, logged), (simulated, simulated))
    assert metrics["accuracy_sa"] == 0.75
    assert metrics["accuracy_sas"] == 0.75


def test_f_sa_enters_both_softmaxes():
    parts = discriminators(([[0], [0]], [ONE, 0]), (np.zeros((2, 2)), [ONE, 0]))
    log_pair, log_triple = parts(COLUMN, COLUMN)
    # f_sa = (1, 0): softmax e / (e + 1); f_sas + f_sa = (2, 0): e² / (e² + 1)
    np.testing.assert_allclose(np.exp(log_pair[0]), [0.731059, 0.268941], rtol=1e-5)
    np.testing.assert_allclose(np.exp(log_triple[0]), [0.880797, 0.119203], rtol=1e-5)


def test_log_dynamics_ratio_by_hand(compiled):
    # f_sa = (1, 0), f_sas = (0, 1): f_sas + f_sa = (1, 1)
    # log 0.5 - log 0.5 - log 0.731059 + log 0.268941 = 0.313262 - 1.313262 = -1
    parts = discriminators(([[0], [0]], [ONE, 0]), (np.zeros((2, 2)), [0, ONE]))
    np.testing.assert_allclose(compiled(log_dynamics_ratio)(parts, COLUMN, COLUMN), np.full(4, -1.0), rtol=1e-5)


def test_log_dynamics_ratio_is_the_difference_of_f_sas(compiled):
    parts = random_discriminators()
    pair, following = random_features()
    logits = 2.0 * np.tanh(np.asarray(parts.triple(jnp.concatenate([pair, following], axis=-1))))
    ratio = compiled(log_dynamics_ratio)(parts, pair, following)
    assert ratio.shape == (64,)
    np.testing.assert_allclose(ratio, logits[:, 0] - logits[:, 1], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("bound", [0.5, 2.0])
def test_log_dynamics_ratio_lies_within_twice_the_bound(bound):
    ratio = np.asarray(log_dynamics_ratio(random_discriminators(bound), *random_features(size=1000.0)))
    assert np.abs(ratio).max() <= 2 * bound + 1e-5
    saturated = discriminators((np.zeros((2, 1)), [9, -9]), (np.zeros((2, 2)), [50, -50]), bound)
    np.testing.assert_allclose(log_dynamics_ratio(saturated, COLUMN, COLUMN), 2 * bound, rtol=1e-5)


def test_the_optimal_discriminators_give_the_log_ratio_of_the_dynamics():
    # s' ~ N(1/2, 1) in the target, N(-1/2, 1) in the source: log ratio s'; f_sas = (s' / 2, -s' / 2), f_sa = 0.
    # A wide bound makes tanh linear; there the loss has no slope.
    bound = 1000.0
    slope = 0.5 / bound
    best = discriminators((np.zeros((2, 1)), np.zeros(2)), ([[0, slope], [0, -slope]], [0, 0]), bound)
    quantiles = jnp.asarray(np.random.default_rng(0).normal(size=(200_000, 1)), jnp.float32)
    nothing = jnp.zeros_like(quantiles)
    gradients, _ = eqx.filter_jit(eqx.filter_grad(discriminator_loss, has_aux=True))(
        best, (nothing, quantiles + 0.5), (nothing, quantiles - 0.5)
    )
    np.testing.assert_allclose(np.asarray(gradients.triple.layers[0].weight) / bound, 0.0, atol=0.01)
    ratio = log_dynamics_ratio(best, nothing[:5], jnp.linspace(-2, 2, 5)[:, None])
    np.testing.assert_allclose(ratio, [-2, -1, 0, 1, 2], atol=1e-3)


def test_overlap_by_hand():
    # f_sa = (2 tanh s, -2 tanh s): p = 1/2 at s = 0; at tanh s = ½ log(3) / 2, log odds log 3: p = 3/4, 4 · 3/16.
    parts = discriminators(([[1.0], [-1.0]], [0, 0]), (np.zeros((2, 2)), [0, 0]))
    three_quarters = np.arctanh(np.log(3) / 4)
    pair = jnp.asarray([[0.0], [three_quarters], [-three_quarters]], jnp.float32)
    np.testing.assert_allclose(overlap(parts, pair), [1.0, 0.75, 0.75], rtol=1e-5)
    sure = discriminators(([[9.0], [-9.0]], [0, 0]), (np.zeros((2, 2)), [0, 0]), pair_bound=10.0)
    np.testing.assert_allclose(overlap(sure, COLUMN), 4 * np.exp(-20.0), rtol=1e-4)


@pytest.mark.parametrize(("pair_bound", "left"), [(2.0, True), (10.0, False)])
def test_what_the_pair_may_not_say_the_triple_says_in_its_place(pair_bound, left):
    # Logged rows all at s = 1, simulated ones all at s = -1; s' tells nothing. With f_sa at its bound for both,
    # the triple's loss still slopes by about e^-4 where that bound is 2, and by nothing where it is 10.
    saturated = discriminators(([[9.0], [-9.0]], [0, 0]), (np.zeros((2, 2)), [0, 0]), pair_bound=pair_bound)
    rows, nothing = jnp.ones((4, 1)), jnp.zeros((4, 1))
    gradients, _ = eqx.filter_grad(discriminator_loss, has_aux=True)(saturated, (rows, nothing), (-rows, nothing))
    slope = np.abs(np.asarray(gradients.triple.layers[0].weight)[:, 0])
    assert (slope > 0.01).all() if left else (slope < 1e-6).all()


def test_dropout_acts_in_the_loss_with_a_key_and_never_in_the_ratio():
    parts, features = random_discriminators(dropout=0.2), random_features()
    plain, _ = discriminator_loss(parts, features, features)
    dropped, _ = discriminator_loss(parts, features, features, jax.random.key(0))
    undropped = random_discriminators(dropout=0.0)
    assert plain == discriminator_loss(undropped, features, features)[0]
    assert plain != dropped
    np.testing.assert_array_equal(log_dynamics_ratio(parts, *features), log_dynamics_ratio(undropped, *features))


def test_blur_adds_normal_noise_of_one_scale_to_both(compiled):
    logged, simulated = jnp.zeros((20_000, 2)), jnp.full((20_000, 2), 3.0)
    noisy = [np.asarray(rows) for rows in compiled(blur)((logged, simulated), 0.5, jax.random.key(0))]
    for rows, mean in zip(noisy, (0.0, 3.0), strict=True):
        # the mean of 20 000 has std 0.5 / 141 = 0.0035
        np.testing.assert_allclose(rows.mean(0), mean, atol=0.02)
        np.testing.assert_allclose(rows.std(0), 0.5, rtol=0.03)
    # drawn apart: neither the two nor their channels share noise
    together = np.concatenate([noisy[0], noisy[1] - 3.0], axis=-1)
    np.testing.assert_allclose(np.corrcoef(together.T), np.eye(4), atol=0.04)


def test_no_blur_leaves_features_as_they_are():
    rows = random_features()[1]
    for unblurred in blur((rows, rows), 0.0, jax.random.key(0)):
        np.testing.assert_array_equal(unblurred, rows)
