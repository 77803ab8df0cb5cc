import jax
import numpy as np
import pytest
from sklearn.metrics import adjusted_rand_score

import calibrating
from madoc import simulation
from madoc.calibration import CalibrationProblem
from madoc.calibration.madoc import effects
from madoc.identification.states import probing_windows
from robots import ARM_TRUTH, SPRING_TRUTH, recorded, spring, two_link_arm


def test_shared_effects_by_hand():
    # The first signal is moved by parameters 0 and 1, whatever the sign and size; the second by parameter 2 alone.
    jacobian = np.array([[[3.0, -4.0, 0.0], [0.0, 0.0, 1e-2]], [[-30.0, 40.0, 0.0], [0.0, 0.0, 0.0]]])
    expected = [[0.72, 0.96, 0.0], [0.96, 1.28, 0.0], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(effects.shared_effects(jacobian), expected, atol=1e-5)


def test_affinity_by_hand_and_its_embedding():
    moment = np.array([[4.0, 3.0, 0.0], [3.0, 9.0, 0.0], [0.0, 0.0, 0.0]])
    unrelated = effects.UNRELATED
    expected = [[1.0, 0.5, unrelated], [0.5, 1.0, unrelated], [unrelated, unrelated, 1.0]]
    np.testing.assert_allclose(effects.affinity(moment), expected)
    vectors = effects.embedding(moment)
    np.testing.assert_allclose(vectors @ vectors.T, expected, atol=1e-12)


def planted(labels, seed=0, states=400, signals=6):
    """Moments of ten stretches, where the parameters of a group move the same two signals."""
    random = np.random.default_rng(seed)
    moved = np.array([[signal // 2 == label for label in labels] for signal in range(signals)])
    jacobian = random.normal(size=(states, signals, len(labels))) * np.where(moved, 1.0, 0.1)
    return np.stack([effects.shared_effects(part) for part in np.array_split(jacobian, 10)])


@pytest.mark.parametrize("labels", [(0, 1, 1, 0, 2, 2, 0), (0, 1, 0, 1, 1), (0, 0, 1, 1, 2, 2, 2, 1)])
def test_planted_groups_are_found_with_their_number(labels):
    found = effects.partition(planted(labels))
    np.testing.assert_array_equal(found.labels, labels)
    assert found.stability == 1.0


def test_a_given_number_is_kept_and_few_parameters_are_one_group():
    blocks = planted((0, 1, 1, 0, 2, 2, 0))
    assert [effects.partition(blocks, count=count).labels.max() + 1 for count in (1, 2, 5, 7)] == [1, 2, 5, 7]
    assert effects.partition(blocks[:, :4, :4]).labels.tolist() == [0, 0, 0, 0]
    assert [effects.most_groups(count) for count in (1, 4, 5, 8, 14, 40)] == [1, 1, 2, 3, 6, 8]


def test_where_nothing_is_alike_the_groups_are_unstable():
    random = np.random.default_rng(0)
    blocks = np.stack([effects.shared_effects(random.normal(size=(5, 3, 12))) for _ in range(10)])
    assert effects.partition(blocks).stability < 0.9


def arm_moments(seed):
    task = two_link_arm()
    problem = CalibrationProblem(
        recorded(task, ARM_TRUTH, 2000, jax.random.key(seed)), simulation.make(task, threads=1)
    )
    windows = probing_windows(problem.states, problem.dataset, problem.simulator, steps=1, count=1000)
    jacobian, failures = effects.sensitivities(problem.simulator, windows, problem.typical_change)
    assert failures == 0
    return np.stack([effects.shared_effects(part) for part in np.array_split(jacobian, 10)])


def test_groups_of_a_robot_are_those_of_another_log():
    first, second = (effects.partition(arm_moments(seed), seed=seed) for seed in (0, 1))
    assert adjusted_rand_score(first.labels, second.labels) == 1.0
    assert min(first.stability, second.stability) > 0.9


def test_groups_by_physics_are_found_from_fewer_rows_than_epochs():
    task = spring()
    dataset = recorded(task, SPRING_TRUTH, 12, jax.random.key(0))
    method, problem = (
        calibrating.madoc(groups="physics", group_count=2, grouping_epochs=30),
        CalibrationProblem(dataset, simulation.make(task)),
    )
    state = method.init(problem, jax.random.key(1))
    fractions = []
    while state.grouped < method.grouping_epochs:
        state, epoch = method.step(problem, state)
        fractions.append(epoch.fraction)
    assert np.diff(fractions).min() > 0.0  # the bar goes on
    assert fractions[-1] == 1.0
    assert state.grouping.moments.any((1, 2)).sum() == 12
    whole = effects.partition(state.grouping.moments[:12], count=2, seed=0)
    np.testing.assert_array_equal(state.labels, whole.labels)
    assert len(set(state.labels.tolist())) == 2
    assert state.stability == pytest.approx(whole.stability, abs=0.3)  # of other draws
