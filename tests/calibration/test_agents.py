import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy import stats

from madoc.calibration.madoc.agents import (
    Actors,
    GroupCritics,
    actor_loss,
    divergence,
    draw_parameters,
    initial_actors,
    prior_weight,
    total_value,
    value_loss,
)
from madoc.learning.networks import descend
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


VALUES = jnp.array([[1.0, 2.0], [3.0, -1.0]])
REWARD = jnp.array([2.0, 0.0])
EVEN = jnp.ones(2)
MEMBERS = jnp.array([[True, False, True, False], [False, True, False, False], [False, False, False, True]])


def critics(hidden=(16, 16)):
    return GroupCritics(3, 4, hidden, key=jax.random.key(0))


def parameters(count=20):
    return jax.random.uniform(jax.random.key(1), (count, 4), minval=-1.0)


def test_weights_start_at_one_and_the_bias_at_zero():
    made = critics()
    np.testing.assert_array_equal(made.weight, np.ones(3))
    assert made.bias == 0
    assert not np.allclose(made.networks.layers[0].weight[0], made.networks.layers[0].weight[1])


def test_total_value_by_hand(compiled):
    # 0.5·1 + 2·2 + 0.25 = 4.75, 0.5·3 + 2·(-1) + 0.25 = -0.25
    total = compiled(total_value)(VALUES, jnp.array([0.5, 2.0]), jnp.asarray(0.25))
    np.testing.assert_allclose(total, [4.75, -0.25])


def test_a_negative_k_counts_as_its_absolute_value(compiled):
    total = compiled(total_value)(VALUES, jnp.array([-0.5, -2.0]), jnp.asarray(0.25))
    np.testing.assert_allclose(total, [4.75, -0.25])


def test_total_value_never_falls_where_a_groups_value_rises():
    slope = jax.grad(lambda values: total_value(values, jnp.array([-3.0, 0.2]), jnp.zeros(())).sum())(VALUES)
    np.testing.assert_allclose(slope, [[3.0, 0.2], [3.0, 0.2]])


@pytest.mark.parametrize(
    ("mixing", "expected"),
    [
        # totals (4.75, -0.25) as above, errors (2.75, -0.25): ½ (7.5625 + 0.0625) / 2
        ("dop", 1.90625),
        # plain sums (3, 2), errors (1, 2): ½ (1 + 4) / 2
        ("sum", 1.25),
        # errors of the first critic (-1, 3), of the second (0, -1): ½ (1 + 9) / 2 + ½ (0 + 1) / 2
        ("independent", 2.75),
    ],
)
def test_value_loss_by_hand(mixing, expected, compiled):
    loss = compiled(value_loss)(VALUES, jnp.array([-0.5, 2.0]), jnp.asarray(0.25), REWARD, EVEN, mixing)
    assert loss == pytest.approx(expected)


@pytest.mark.parametrize(
    ("mixing", "expected"),
    [
        # squared errors (7.5625, 0.0625), (1, 4), (1 + 0, 9 + 1), at shares (1.5, 0.5): ½ (1.5 a + 0.5 b) / 2
        ("dop", 2.84375),
        ("sum", 0.875),
        ("independent", 1.625),
    ],
)
def test_rows_count_by_their_share(mixing, expected):
    share = jnp.array([1.5, 0.5])
    loss = value_loss(VALUES, jnp.array([-0.5, 2.0]), jnp.asarray(0.25), REWARD, share, mixing)
    assert loss == pytest.approx(expected)


def test_value_loss_slopes_by_hand():
    # dL/dV = (2.75, -0.25) / 2; dL/dk = sign(k) Σ dL/dV v, dL/db = Σ dL/dV
    slope = jax.grad(value_loss, argnums=(0, 1, 2))
    values, weight, bias = slope(VALUES, jnp.array([-0.5, 2.0]), jnp.asarray(0.25), REWARD, EVEN, "dop")
    np.testing.assert_allclose(values, [[0.6875, 2.75], [-0.0625, -0.25]])  # 1.375·(0.5, 2), -0.125·(0.5, 2)
    np.testing.assert_allclose(weight, [-1.0, 2.875])  # -(1.375·1 - 0.125·3), 1.375·2 + 0.125·1
    assert bias == pytest.approx(1.25)


@pytest.mark.parametrize("mixing", ["sum", "independent"])
def test_only_dop_has_k_and_b(mixing):
    loss = value_loss(VALUES, jnp.array([-0.5, 2.0]), jnp.asarray(0.25), REWARD, EVEN, mixing)
    assert loss == value_loss(VALUES, jnp.array([7.0, 0.0]), jnp.asarray(-9.0), REWARD, EVEN, mixing)
    weight, bias = jax.grad(value_loss, argnums=(1, 2))(VALUES, jnp.ones(2), jnp.zeros(()), REWARD, EVEN, mixing)
    np.testing.assert_array_equal(weight, np.zeros(2))
    assert bias == 0


def test_dop_at_its_start_is_vdn():
    start = value_loss(VALUES, jnp.ones(2), jnp.zeros(()), REWARD, EVEN, "dop")
    assert start == pytest.approx(value_loss(VALUES, jnp.ones(2), jnp.zeros(()), REWARD, EVEN, "sum"))


def test_independent_critics_regress_the_reward_each_on_its_own():
    slope = jax.grad(value_loss)
    none = jnp.ones(2), jnp.zeros(())
    before = slope(VALUES, *none, REWARD, EVEN, "independent")
    np.testing.assert_allclose(before, (VALUES - REWARD[:, None]) / 2)
    after = slope(VALUES.at[:, 1].add(100.0), *none, REWARD, EVEN, "independent")
    np.testing.assert_array_equal(after[:, 0], before[:, 0])
    # the others' slopes do depend on every critic: they share one error
    assert not np.array_equal(
        slope(VALUES, *none, REWARD, EVEN, "sum"), slope(VALUES + 1.0, *none, REWARD, EVEN, "sum")
    )


def test_values_are_each_groups_network_on_its_own_parameters(compiled):
    made = eqx.tree_at(
        lambda made: (made.networks.layers[0].weight, made.networks.layers[0].bias),
        critics(hidden=()),
        (jnp.array([[[1.0, 2, 3, 4]], [[5, 6, 7, 8]], [[-1, -1, -1, -2]]]), jnp.array([[0.0], [10], [100]])),
    )
    # group 0 has parameters 0 and 2: 1·1 + 3·0.5 = 2.5; group 1 has 1: 6·(-1) + 10 = 4; group 2 has 3: -2·0.25 + 100
    values = compiled(made.values)(jnp.array([[1.0, -1.0, 0.5, 0.25]]), MEMBERS)
    np.testing.assert_allclose(values, [[2.5, 4.0, 99.5]])


@pytest.mark.parametrize("parameter", range(4))
def test_a_critic_sees_only_its_own_groups_parameters(parameter, compiled):
    made, drawn = critics(), parameters()
    values = compiled(made.values)
    before = np.asarray(values(drawn, MEMBERS))
    after = np.asarray(values(drawn.at[:, parameter].set(-drawn[:, parameter] + 0.1), MEMBERS))
    own = np.asarray(MEMBERS)[:, parameter]
    np.testing.assert_array_equal(after[:, ~own], before[:, ~own])
    assert (after[:, own] != before[:, own]).all()


def test_nothing_flows_back_to_another_groups_parameters():
    jacobian = jax.jacobian(lambda row: critics().values(row[None], MEMBERS)[0])(parameters()[0])
    assert ((np.asarray(jacobian) != 0) == np.asarray(MEMBERS)).all()


def test_a_critic_learns_what_its_parameters_earn():
    # R = ξ_0 ξ_2 + ξ_1² - ξ_3 is a sum over the groups; VDN's sum can fit it, and credits parameter 3 as it should
    optimiser, drawn = optax.adam(1e-2), parameters(512)
    reward = drawn[:, 0] * drawn[:, 2] + drawn[:, 1] ** 2 - drawn[:, 3]

    def loss_of(made):
        return value_loss(made.values(drawn, MEMBERS), made.weight, made.bias, reward, jnp.ones(512), "sum")

    @eqx.filter_jit
    def update(made, state):
        return descend(optimiser, eqx.filter_grad(loss_of)(made), state, made)

    made = critics()
    state = optimiser.init(eqx.filter(made, eqx.is_array))
    for _ in range(300):
        made, state = update(made, state)
    assert loss_of(made) < 0.005
    credit = np.asarray(made.values(drawn, MEMBERS))[:, 2]
    assert np.corrcoef(credit, drawn[:, 3])[0, 1] < -0.99


def test_a_baseline_takes_what_it_says_of_each_row_and_the_papers_takes_nothing():
    pair = jax.random.normal(jax.random.key(2), (2, 5))
    assert critics().baseline is None
    np.testing.assert_array_equal(critics().less_baseline(REWARD, pair), REWARD)
    made = GroupCritics(3, 4, (16, 16), window=5, key=jax.random.key(0))
    constant = eqx.tree_at(lambda made: made.baseline.layers[-1].weight, made, jnp.zeros((1, 16)))
    constant = eqx.tree_at(lambda made: made.baseline.layers[-1].bias, constant, jnp.array([0.5]))
    np.testing.assert_allclose(constant.less_baseline(REWARD, pair), [1.5, -0.5])
