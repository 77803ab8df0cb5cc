"""What acting in simulated systems keeps: moments of what was seen, and the policy that is handed back.

Mean and deviation of rows that come in batches are those of all rows at a time. The policy is the best where it can be
judged, else the last.
"""

from dataclasses import replace

import jax
import numpy as np

from madoc import simulation
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.policies import PolicyProblem
from madoc.policies.h2o import H2O
from madoc.policies.interaction import Judged, Moments
from robots import ARM_TRUTH, recorded, two_link_arm


def test_the_highest_mean_return_is_kept_and_the_first_of_equals():
    first, second, third = (TanhGaussianPolicy(1, 1, (), key=jax.random.key(seed)) for seed in range(3))
    untrained = Judged.none(first)
    assert untrained.handed_back(second) is second
    assert [untrained.due(spent, 100) for spent in (99, 100)] == [False, True]
    assert not untrained.due(100, 0)
    judged = untrained.including(second, -5.0, 100).including(third, -5.0, 200)
    assert judged.handed_back(first) is second
    assert (judged.best_return, judged.last) == (-5.0, 200)
    assert judged.including(third, -4.0, 300).handed_back(first) is third


def test_h2o_hands_back_the_best_in_its_simulator():
    simulator = simulation.make(two_link_arm(), threads=1)
    problem = PolicyProblem(
        simulator, simulator.parameters.middle, recorded(two_link_arm(), ARM_TRUTH, 100, jax.random.key(100))
    )
    small = {"hidden": (8,), "batch": 16, "environments": 2, "epoch_steps": 20, "updates_per_step": 0.2}
    method = H2O(**small, warmup_steps=20, replay_capacity=200, judge_every=20, judge_episodes=2)
    state, seen = method.init(problem, jax.random.key(0)), []
    for _ in range(6):
        state, epoch = method.step(problem, state)
        seen.append((epoch.metrics.get("judged_return", -1e9), state.learning.learner.policy))
        assert epoch.control_steps - epoch.unbudgeted == 20
    best, policy = max(seen, key=lambda pair: pair[0])
    assert method.policy(state) is policy is not seen[-1][1]
    assert state.judged.best_return == best
    last = replace(method, judge_every=0)
    assert last.policy(replace(state, judged=Judged.none(policy))) is state.learning.learner.policy


def test_batches_add_up_to_all_rows():
    rows = np.random.default_rng(0).normal([3.0, -100.0], [0.1, 20.0], (70, 2))
    moments = Moments.none(2)
    for batch in np.split(rows, [1, 1, 30]):  # one of them is empty
        moments = moments.including(batch)
    assert moments.count == 70
    np.testing.assert_allclose(moments.mean, rows.mean(0))
    np.testing.assert_allclose(moments.deviation, rows.std(0))


def test_before_the_first_row_nothing_is_scaled():
    moments = Moments.none(3)
    np.testing.assert_array_equal(moments.mean, np.zeros(3))
    np.testing.assert_array_equal(moments.deviation, np.ones(3))
