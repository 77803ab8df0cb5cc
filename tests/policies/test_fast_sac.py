"""What sets fast-sac apart from SAC: what an epoch's updates see, what networks see, and where batches come from."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from madoc import simulation
from madoc.errors import MadocError
from madoc.policies import FastSAC, PolicyProblem
from madoc.policies.fast_sac import SMALLEST_DEVIATION
from robots import ARM_TRUTH, recorded, two_link_arm

KEY = jax.random.key(0)
SMALL = FastSAC(
    hidden=(8, 8),
    batch=16,
    environments=4,
    epoch_steps=40,
    steps_per_update=5,
    warmup_steps=40,
    replay_capacity=400,
    judge_every=16,
    judge_episodes=2,
)


@pytest.fixture(scope="module")
def problem():
    simulator = simulation.make(two_link_arm(), threads=1)
    dataset = recorded(two_link_arm(), ARM_TRUTH, 100, jax.random.key(100))
    return PolicyProblem(simulator, simulator.parameters.middle, dataset)


def states(method, problem, epochs):
    found = [method.init(problem, KEY)]
    for _ in range(epochs):
        found.append(method.step(problem, found[-1])[0])
    return found


def weights(policy):
    return [np.asarray(leaf) for layer in policy.network.layers for leaf in (layer.weight, layer.bias)]


def same(one, other):
    return all(np.array_equal(a, b) for a, b in zip(weights(one), weights(other), strict=True))


def test_an_epoch_counts_its_updates_and_explores_first(problem):
    state = SMALL.init(problem, KEY)
    state, first = SMALL.step(problem, state)
    assert (first.stage, first.control_steps, first.updates, state.updates) == ("exploring", 40, 0, 0)
    state, second = SMALL.step(problem, state)
    assert (second.stage, second.control_steps, second.updates, state.updates) == ("learning", 40, 8, 8)
    assert np.isfinite(list(second.metrics.values())).all()


def test_updates_see_the_rows_from_before_the_epoch(problem):
    """Or the result would depend on which of two threads is faster."""
    state = states(SMALL, problem, 1)[-1]
    keys = jax.random.split(state.key, 4)
    expected, _ = SMALL._update(problem, state, keys[1])
    assert same(SMALL.step(problem, state)[0].learner.policy, expected.policy)


def test_networks_see_observations_standardised_by_all_that_were_seen(problem):
    state = states(SMALL, problem, 3)[-1]
    rows = np.asarray(state.interaction.replay.rows["observation"])[:120]
    for network in (state.learner.policy, state.learner.critic, state.learner.target_critic):
        np.testing.assert_allclose(network.offset, rows.mean(0), rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(network.scale, rows.std(0) + SMALLEST_DEVIATION, rtol=1e-4)
    plain = states(replace(SMALL, standardise=False), problem, 2)[-1]
    np.testing.assert_array_equal(plain.learner.policy.scale, 1.0)


def test_the_policy_is_updated_once_for_every_delay_of_the_critics(problem):
    state = states(SMALL, problem, 2)[-1]
    counts = (state.learner.critic_optimiser[0].count, state.learner.policy_optimiser[0].count)
    assert tuple(map(int, counts)) == (8, 4)


def test_a_share_of_each_batch_comes_from_the_log(problem):
    """With all of it from the log, what the environments saw makes no difference to an update."""
    all_logged = replace(SMALL, logged_share=1.0)
    state = states(all_logged, problem, 1)[-1]
    blank = jax.tree.map(jnp.zeros_like, state.interaction.replay.rows)
    forgetful = replace(state.interaction, replay=replace(state.interaction.replay, rows=blank))
    with_rows, _ = all_logged._update(problem, state, KEY)
    without, _ = all_logged._update(problem, replace(state, interaction=forgetful), KEY)
    assert same(with_rows.policy, without.policy)
    half = replace(SMALL, logged_share=0.5)
    with_rows, _ = half._update(problem, state, KEY)
    without, _ = half._update(problem, replace(state, interaction=forgetful), KEY)
    assert not same(with_rows.policy, without.policy)


def test_the_best_judged_policy_is_handed_back(problem):
    found = states(SMALL, problem, 7)
    judged = [state.judged for state in found if state.judged.last]
    assert [state.last for state in judged] == [16, 16, 32, 32]
    assert judged[-1].best_return == max(state.best_return for state in judged)
    assert same(SMALL.policy(found[-1]), judged[-1].best)
    unjudged = replace(SMALL, judge_every=0)
    last = states(unjudged, problem, 3)[-1]
    assert same(unjudged.policy(last), last.learner.policy)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"logged_share": 1.5}, "expected logged_share of FastSAC to be less than or equal to 1, got 1.5"),
        ({"policy_delay": 20}, "expected epoch_steps of at least 100, for .* an update of the policy, got 40"),
        ({"environments": 41}, "expected epoch_steps of at least 41, for a control step of each environment"),
    ],
)
def test_settings_that_cannot_work_are_refused(changes, sentence):
    with pytest.raises(MadocError, match=sentence):
        replace(SMALL, **changes)
