"""One update of SAC worked by hand: plain gradient descent of rate 1 in Adam's place, so that a step is a gradient."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy import stats

from affine import affine
from madoc.learning import replay, sac_losses
from madoc.learning.actor_critic import ActorCritic, Descent, actor_step, fresh, soft_critic_step
from madoc.learning.features import Features
from madoc.learning.sac_losses import TwinCritic
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.policies.interaction import UniformPolicy
from madoc.policies.sac import SAC

STATE, NEXT = np.array([1.0, -0.5]), np.array([0.5, 2.0])
ACTION, REWARD, TERMINATED = np.array([0.3, -0.2]), np.array([1.0, -2.0]), np.array([0.0, 1.0])
MEAN_SLOPE, MEAN, STD, TEMPERATURE = 0.4, 0.1, 0.5, 0.2
FIRST, SECOND, TARGET_FIRST, TARGET_SECOND = (1.0, 2.0, 0.5), (-1.0, 1.0, 3.0), (0.5, 1.0, 2.0), (2.0, -1.0, 1.0)
"""Values of (s, a) as (weight of s, weight of a, bias)."""


def column(numbers):
    return jnp.asarray(numbers, jnp.float32)[:, None]


def twins(first, second):
    made = TwinCritic(1, 1, (), key=jax.random.key(0))
    nets = tuple(affine([numbers[:2]], numbers[2:]) for numbers in (first, second))
    return eqx.tree_at(lambda twins: (twins.first, twins.second), made, nets)


def value(numbers, state, action):
    return numbers[0] * state + numbers[1] * action + numbers[2]


def learner(optimiser):
    policy = TanhGaussianPolicy(1, 1, (), key=jax.random.key(0))
    policy = eqx.tree_at(lambda policy: policy.network, policy, affine([[MEAN_SLOPE], [0.0]], [MEAN, np.log(STD)]))
    critic, target = twins(FIRST, SECOND), twins(TARGET_FIRST, TARGET_SECOND)
    log_temperature = jnp.asarray(np.log(TEMPERATURE), jnp.float32)
    states = (optimiser.init(eqx.filter(net, eqx.is_array)) for net in (policy, critic, log_temperature))
    return ActorCritic(policy, critic, target, log_temperature, *states)


PLAIN = Descent(optax.sgd(1.0), optax.sgd(1.0), target_rate=0.25)


def drawn(key, state):
    """What the policy draws: the noise before squashing times its std, the action, its log density."""
    noise = STD * np.asarray(jax.random.normal(key, (2, 1)), np.float64)[:, 0]
    raw = MEAN_SLOPE * state + MEAN + noise
    action = np.tanh(raw)
    return noise, action, stats.norm.logpdf(noise, 0, STD) - np.log1p(-(action**2))


def test_networks_see_the_data_standardised():
    features = Features(*(jnp.asarray(part) for part in ([1.0, 2.0, 9.0], [0.999, 3.999, 9.0], [1.0, 1.0], 0.0, 1.0)))
    key, rows, action = jax.random.key(3), jnp.array([[3.0, 6.0]]), jnp.array([[0.5]])
    plain = fresh(2, 1, hidden=(4,), descent=PLAIN, key=key)
    standardised = fresh(2, 1, hidden=(4,), descent=PLAIN, features=features, key=key)
    seen = jnp.array([[2.0, 1.0]])  # (3 - 1) / (0.999 + 0.001), (6 - 2) / (3.999 + 0.001)
    np.testing.assert_allclose(standardised.policy(rows), plain.policy(seen), rtol=1e-6)
    for name in ("critic", "target_critic"):
        found = getattr(standardised, name)(rows, action)
        np.testing.assert_allclose(found, getattr(plain, name)(seen, action), rtol=1e-6)


def test_how_observations_are_standardised_is_not_learnt():
    features = Features(*(jnp.asarray(part) for part in ([1.0, 0.0], [2.0, 1.0], [1.0], 0.0, 1.0)))
    learner = fresh(1, 1, hidden=(4,), descent=PLAIN, features=features, key=jax.random.key(3))
    batch = {name: jnp.ones((2, 1)) for name in ("observation", "action", "next_observation")}
    batch |= {"reward": jnp.ones(2), "terminated": jnp.zeros(2)}
    following, _ = soft_critic_step(learner, batch, jax.random.key(0), PLAIN, discount=0.9)
    following, _ = actor_step(following, batch["observation"], jax.random.key(1), PLAIN)
    for name in ("policy", "critic", "target_critic"):
        before, after = getattr(learner, name), getattr(following, name)
        np.testing.assert_array_equal(before.offset, after.offset)
        np.testing.assert_array_equal(before.scale, after.scale)


@pytest.mark.parametrize("least", [None, -1.5])
def test_critic_update_by_hand(compiled, least):
    key = jax.random.key(3)
    batch = {
        "observation": column(STATE),
        "action": column(ACTION),
        "reward": jnp.asarray(REWARD, jnp.float32),
        "next_observation": column(NEXT),
        "terminated": jnp.asarray(TERMINATED, jnp.float32),
    }
    before = learner(optax.sgd(1.0))
    given = None if least is None else jnp.asarray(least)
    after, metrics = compiled(soft_critic_step)(before, batch, key, PLAIN, discount=0.9, least=given)

    _, next_action, density = drawn(key, NEXT)
    next_value = np.minimum(value(TARGET_FIRST, NEXT, next_action), value(TARGET_SECOND, NEXT, next_action))
    target = REWARD + 0.9 * (1 - TERMINATED) * (next_value - TEMPERATURE * density)
    assert target[1] == -2.0
    target = target if least is None else np.maximum(target, least)
    errors = [value(numbers, STATE, ACTION) - target for numbers in (FIRST, SECOND)]
    assert metrics["critic_loss"] == pytest.approx(0.5 * sum((error**2).mean() for error in errors), rel=1e-5)
    assert metrics["value_target"] == pytest.approx(target.mean(), rel=1e-5)
    nets = (
        (after.critic.first, FIRST, TARGET_FIRST, after.target_critic.first),
        (
            after.critic.second,
            SECOND,
            TARGET_SECOND,
            after.target_critic.second,
        ),
    )
    for error, (net, numbers, slow_numbers, slow) in zip(errors, nets, strict=True):
        # d ½ mean(error²) = mean(error · (s, a, 1)); then slow + 0.25 (new - slow)
        new = np.array(numbers) - [(error * STATE).mean(), (error * ACTION).mean(), error.mean()]
        averaged = np.array(slow_numbers) + 0.25 * (new - slow_numbers)
        np.testing.assert_allclose(net.layers[0].weight[0], new[:2], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(net.layers[0].bias, new[2:], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(slow.layers[0].weight[0], averaged[:2], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(slow.layers[0].bias, averaged[2:], rtol=1e-5, atol=1e-6)
    jax.tree.map(np.testing.assert_array_equal, after.policy, before.policy)
    assert after.log_temperature == before.log_temperature


def actor_gradient(key):
    """Per row: d (α log π - min Q) / d (mean, log std), reparameterised.

    log π = -ε²/2 - log σ - const - log (1 - tanh² raw), raw = mean + σε, so d log π / d mean = 2 tanh(raw) and
    d log π / d log σ = 2 tanh(raw) σε - 1; Q has slope w_a (1 - tanh² raw) in raw.
    """
    noise, action, density = drawn(key, STATE)
    values = np.stack([value(numbers, STATE, action) for numbers in (FIRST, SECOND)])
    weight = np.array([FIRST[1], SECOND[1]])[values.argmin(0)]
    by_raw = TEMPERATURE * 2 * action - weight * (1 - action**2)
    return by_raw, by_raw * noise - TEMPERATURE, values.min(0), density


def moved(after):
    layer = after.policy.network.layers[0]
    return np.array([layer.weight[0, 0], layer.bias[0], layer.bias[1]])


def test_actor_and_temperature_update_by_hand(compiled):
    key = jax.random.key(4)
    before = learner(optax.sgd(1.0))
    after, metrics = compiled(actor_step)(before, column(STATE), key, PLAIN)
    by_mean, by_log_std, smaller, density = actor_gradient(key)
    expected = [MEAN_SLOPE - (by_mean * STATE).mean(), MEAN - by_mean.mean(), np.log(STD) - by_log_std.mean()]
    np.testing.assert_allclose(moved(after), expected, rtol=1e-4)
    assert metrics["actor_loss"] == pytest.approx((TEMPERATURE * density - smaller).mean(), rel=1e-4)
    assert metrics["entropy"] == pytest.approx(-density.mean(), rel=1e-4)
    # log α + mean(log π + target entropy); the target entropy of one motor is -1
    log_temperature = np.log(TEMPERATURE) + density.mean() - 1.0
    assert after.log_temperature == pytest.approx(log_temperature, rel=1e-4)
    assert metrics["temperature"] == pytest.approx(np.exp(log_temperature), rel=1e-4)
    jax.tree.map(np.testing.assert_array_equal, after.critic, before.critic)


def test_cloning_update_by_hand(compiled):
    key = jax.random.key(4)
    cloned = column([2.0, -1.0]), column([0.9, -0.5])

    def combine(policy, loss, value):
        return sac_losses.cloned_actor_loss(loss, value, sac_losses.cloning_error(policy, *cloned), weight=2.5)

    after, metrics = compiled(lambda *parts: actor_step(*parts, PLAIN, combine))(
        learner(optax.sgd(1.0)), column(STATE), key
    )
    by_mean, by_log_std, smaller, density = actor_gradient(key)
    weight = 2.5 / np.abs(smaller).mean()  # TD3+BC: of the values, no gradient through it
    logged_state, logged_action = np.array([2.0, -1.0]), np.array([0.9, -0.5])
    clone = np.tanh(MEAN_SLOPE * logged_state + MEAN)
    pull = 2 * (clone - logged_action) * (1 - clone**2)
    expected = [
        MEAN_SLOPE - weight * (by_mean * STATE).mean() - (pull * logged_state).mean(),
        MEAN - weight * by_mean.mean() - pull.mean(),
        np.log(STD) - weight * by_log_std.mean(),
    ]
    np.testing.assert_allclose(moved(after), expected, rtol=1e-4)
    # the metric stays SAC's own loss, comparable between both
    assert metrics["actor_loss"] == pytest.approx((TEMPERATURE * density - smaller).mean(), rel=1e-4)


def filled(count=64):
    random = np.random.default_rng(0)
    ring = replay.empty(100, observation=(1,), action=(1,), reward=(), next_observation=(1,), terminated=())
    shapes = {name: values.shape[1:] for name, values in ring.rows.items()}
    rows = {name: random.uniform(-1, 1, (count, *shape)).astype(np.float32) for name, shape in shapes.items()}
    rows["terminated"] = (rows["terminated"] > 0.8).astype(np.float32)
    return replay.add(ring, rows, np.ones(count, bool))


@pytest.mark.parametrize("cloning", [None, 2.5])
def test_updates_trace_once(cloning, traced):
    sac = SAC(batch=8, cloning=cloning)
    logged = (
        None if cloning is None else {"observation": column(STATE), "action": column(ACTION), "reward": column(STATE)}
    )
    rows, state = filled(), learner(optax.adam(sac.learning_rate))
    keys = list(jax.random.split(jax.random.key(0), 11))
    state, _ = sac._update(state, rows, logged, keys[0], 3)
    before = traced()
    for key in keys[1:]:
        state, metrics = sac._update(state, rows, logged, key, 3)
    assert traced() == before
    assert state.critic_optimiser[0].count == 33
    assert all(np.isfinite(number) for number in metrics.values())


def test_updates_are_set_by_the_key():
    sac, rows = SAC(batch=8), filled()

    def weights(key):
        return sac._update(learner(optax.adam(sac.learning_rate)), rows, None, jax.random.key(key), 3)[0]

    first, again, other = weights(0), weights(0), weights(1)
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert not np.array_equal(moved(first), moved(other))


def test_the_exploring_policy_is_uniform():
    policy = UniformPolicy(2)
    observation = jnp.zeros((3, 1000, 5))
    action = np.asarray(policy(observation, jax.random.key(0)))
    assert action.shape == (3, 1000, 2)
    assert stats.kstest(action.ravel(), "uniform", (-1, 2)).pvalue > 0.01
    np.testing.assert_array_equal(policy(observation), np.zeros((3, 1000, 2)))
