import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from affine import affine
from madoc.learning.dynamics_ensemble import Ensemble
from madoc.learning.features import Features
from madoc.learning.networks import stack
from madoc.learning.sac_losses import TwinCritic
from madoc.policies.imagination import (
    ImaginedRows,
    Models,
    StateValue,
    WithoutNoise,
    chosen_candidate,
    imagine,
    imagined_return,
    mean_return,
    start_imagining,
    worst_value,
)

FEATURES = Features(jnp.zeros(2), jnp.ones(2), jnp.array([0.5]), jnp.asarray(1.0), jnp.asarray(2.0))
LOGGED = jnp.array([[0.0], [10.0]])


def certain(changes):
    """Models whose (change, reward) is constant, all but sure of it."""
    made = Ensemble(1, 1, (), models=len(changes), key=jax.random.key(0))
    bias = jnp.array([[change, 0.0, -100.0, -100.0] for change in changes], jnp.float32)
    layer = made.networks.layers[0]
    made = eqx.tree_at(lambda e: e.networks.layers[0].weight, made, jnp.zeros_like(layer.weight))
    made = eqx.tree_at(lambda e: e.networks.layers[0].bias, made, bias)
    return eqx.tree_at(lambda e: e.smallest, made, jnp.full(2, -30.0))


def imagined(
    *, slope, steps=3, penalty=0.0, terminated=lambda o: o[:, 0] > 100, horizon=100, threshold=0.1, value=None
):
    """Two models, changes 1 and 3 (0.5 and 1.5 physical); past discriminators whose logit rises by `slope` with it."""
    past = stack(2, lambda key: affine([[0.0, 0.0, slope]], [0.0]), jax.random.key(0))
    models = Models(
        certain([1.0, 3.0]),
        jnp.arange(2),
        past,
        FEATURES,
        logged=LOGGED,
        terminated=terminated,
        state_of=lambda observation: observation,
        samples=2,
        selection_temperature=0.0,
        threshold=threshold,
        worst=jnp.asarray(-7.0),
    )
    return imagine(
        models,
        lambda observation, key: jnp.zeros_like(observation),
        start_imagining(LOGGED[:1], 4, jax.random.key(1)),
        value,
        horizon=horizon,
        penalty=penalty,
        steps=steps,
        key=jax.random.key(2),
    )


def test_the_best_candidate_by_hand():
    candidates = jnp.arange(12.0).reshape(3, 2, 2)
    rewards = jnp.array([[0.0, 5.0], [2.0, 1.0], [1.0, 3.0]])
    outcome, best = chosen_candidate(candidates, rewards, 0.0, jax.random.key(0))
    np.testing.assert_array_equal(outcome, [[4.0, 5.0], [2.0, 3.0]])
    np.testing.assert_array_equal(best, [2.0, 5.0])


def test_candidates_are_drawn_by_their_dynamics_reward():
    # softmax((0.1, 0) / 0.1): the first with probability e / (e + 1) = 0.731
    candidates = jnp.zeros((2, 20_000, 1)).at[0].set(1.0)
    rewards = jnp.zeros((2, 20_000)).at[0].set(0.1)
    outcome, _ = chosen_candidate(candidates, rewards, 0.1, jax.random.key(0))
    assert float(outcome.mean()) == pytest.approx(0.7311, abs=0.01)


def test_the_mean_return_by_hand():
    # Two rows, three steps: the first ends in its second step, and what follows is another rollout's.
    reward = np.array([[1.0, 10.0], [2.0, 20.0], [4.0, 40.0]])
    ended = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    assert mean_return(reward, ended) == (3.0 + 70.0) / 2


def acting(ends_after, calls):
    """Two steps at a time of two rows that earn 1 and 10 a step; a row ends in the given step, counted from 1."""

    def act(under_way, key):
        ages = np.asarray(under_way.age) + np.array([[1], [2]])
        calls.append(ages)
        ends = (ages == ends_after).astype(float).reshape(-1)
        acted = {"reward": np.array([1.0, 10.0, 1.0, 10.0]), "terminated": ends}
        return ImaginedRows(under_way.observation, under_way.age + 2), acted, {}

    return act


def test_the_imagined_return_by_hand():
    start, calls = ImaginedRows(jnp.zeros((2, 1)), jnp.zeros(2, jnp.int32)), []
    # the first row ends in its third step, the second in its first: 3 · 1 and 1 · 10; then no more steps are taken
    assert imagined_return(acting([3, 1], calls), start, 100, jax.random.key(0)) == (3.0 + 10.0) / 2
    assert len(calls) == 2
    # the second never ends, and may take 5 steps
    assert imagined_return(acting([3, 0], calls), start, 5, jax.random.key(0)) == (3.0 + 50.0) / 2


def test_a_policy_is_judged_without_noise():
    quiet = WithoutNoise(lambda observation, key=None: observation if key is None else -observation)
    np.testing.assert_array_equal(quiet(LOGGED, jax.random.key(0)), LOGGED)


def test_what_looks_most_real_is_what_happens():
    for slope, change in ((1.0, 1.5), (-0.1, 0.5)):
        under_way, rows, _ = imagined(slope=slope)
        np.testing.assert_allclose(rows["next_observation"] - rows["observation"], change, rtol=1e-4)
        np.testing.assert_allclose(rows["reward"], 1.0, rtol=1e-5)  # the offset: a standardised reward of 0
        np.testing.assert_allclose(under_way.observation, 3 * change, rtol=1e-4)
        assert (np.asarray(under_way.age) == 3).all()
        assert not rows["terminated"].any()


def test_the_worst_value_by_hand():
    reward = np.array([-9.0, 3.0, 1.0, -2.0, -3.0, -1.0], np.float32)
    # Mean rewards of episodes: (-9 + 3 + 1 - 2) / 4 = -1.75 and (-3 - 1) / 2 = -2; -2 / (1 - 0.9) = -20.
    assert float(worst_value(reward, np.array([0, 4]), 0.9)) == pytest.approx(-20.0)
    assert float(worst_value(reward + 3.0, np.array([0, 4]), 0.9)) == 0.0


def test_what_looks_unreal_ends_and_is_worth_the_worst_but_a_fall_is_a_fall():
    # even the better candidate, change 1, has D = sigmoid(-3), r = 0.0486 < 0.1
    under_way, rows, metrics = imagined(slope=-3.0, steps=1)
    assert rows["terminated"].all()
    np.testing.assert_array_equal(rows["reward"], -7.0)
    assert metrics["unreal"] == 1.0
    assert set(np.asarray(under_way.observation)[:, 0].tolist()) <= {0.0, 10.0}
    assert (np.asarray(under_way.age) == 0).all()
    _, fallen, metrics = imagined(slope=-3.0, steps=1, terminated=lambda o: o[:, 0] > -100)
    assert fallen["terminated"].all()
    np.testing.assert_allclose(fallen["reward"], 1.0, rtol=1e-5)
    assert metrics["unreal"] == 0.0


def test_a_fall_ends_and_the_horizon_only_starts_again():
    _, rows, _ = imagined(slope=1.0, steps=1, terminated=lambda o: o[:, 0] > 1.0)
    assert rows["terminated"].all()
    under_way, rows, _ = imagined(slope=1.0, steps=2, horizon=2)
    assert not rows["terminated"].any()
    assert (np.asarray(under_way.age) == 0).all()


def test_uncertainty_costs():
    _, rows, metrics = imagined(slope=1.0, steps=1, penalty=1e6)
    np.testing.assert_allclose(rows["reward"], 1.0 - 1e6 * metrics["penalty"], rtol=1e-4)
    assert metrics["penalty"] > 0


def test_imagined_observations_stay_near_the_logged_ones():
    _, rows, _ = imagined(slope=1.0, steps=60)
    assert rows["next_observation"].max() <= 20.0


def test_models_that_differ_on_what_follows_cost():
    # From 0 the two models expect 0.5 and 1.5, each worth twice itself: a standard deviation of sqrt(2).
    worth = lambda observation: 2.0 * observation[..., 0]  # noqa: E731
    _, rows, metrics = imagined(slope=1.0, steps=1, penalty=10.0, value=worth)
    assert metrics["penalty"] == pytest.approx(np.sqrt(2.0), rel=1e-4)
    np.testing.assert_allclose(rows["reward"], 1.0 - 10.0 * np.sqrt(2.0), rtol=1e-4)
    # A next state where the task has ended is worth nothing: 1 and 0 differ by sqrt(0.5)
    _, _, metrics = imagined(slope=1.0, steps=1, value=worth, terminated=lambda o: o[..., 0] > 1.0)
    assert metrics["penalty"] == pytest.approx(np.sqrt(0.5), rel=1e-4)


def test_a_state_is_worth_the_smaller_of_two_values():
    # of s + a and s, where a is -s and then 2 s
    critic = TwinCritic(1, 1, (), key=jax.random.key(0))
    twins = affine([[1.0, 1.0]], [0.0]), affine([[1.0, 0.0]], [0.0])
    critic = eqx.tree_at(lambda critic: (critic.first, critic.second), critic, twins)
    np.testing.assert_array_equal(StateValue(lambda observation: -observation, critic)(LOGGED), [0.0, 0.0])
    np.testing.assert_array_equal(StateValue(lambda observation: 2.0 * observation, critic)(LOGGED), [0.0, 10.0])
