import jax
import numpy as np
import pytest

from madoc.calibration.madoc import grouping

WIDTH = 16
"""Of the embeddings made up here."""


def test_one_at_a_time_moves_one_parameter_a_draw():
    draws = grouping.one_at_a_time(jax.random.key(0), 200)
    assert draws.shape == (200, 200)
    np.testing.assert_array_equal(draws, np.diag(np.diag(draws)))
    moved = np.diag(draws)
    assert np.abs(moved).max() <= 1
    assert len(np.unique(moved)) == 200
    # uniform on [-1, 1]: mean 0, std 1/√3 = 0.577, the mean of 200 has std 0.04
    assert moved.mean() == pytest.approx(0, abs=0.15)
    assert moved.std() == pytest.approx(0.577, abs=0.08)


def islands(labels, seed=0):
    """Embeddings in tight, far islands, one a label."""
    random = np.random.default_rng(seed)
    centres = 10 * random.normal(size=(max(labels) + 1, WIDTH))
    return centres[list(labels)] + 0.1 * random.normal(size=(len(labels), WIDTH))


@pytest.mark.parametrize("labels", [(0, 1, 1, 0, 2), (0, 1, 2, 3, 0), (0, 0, 0, 1)])
@pytest.mark.parametrize("seed", range(3))
def test_cluster_labels_groups_by_first_appearance(labels, seed):
    found = grouping.cluster(islands(labels), len(set(labels)), seed=seed)
    np.testing.assert_array_equal(found, labels)


def test_permuting_parameters_permutes_groups():
    labels = np.array([0, 1, 1, 0, 2, 3, 3, 2])
    embeddings, random = islands(labels), np.random.default_rng(1)
    for _ in range(5):
        order = random.permutation(8)
        found = grouping.cluster(embeddings[order], 4, seed=0)
        together = labels[order][:, None] == labels[order][None]
        np.testing.assert_array_equal(found[:, None] == found[None], together)
        first_seen = list(dict.fromkeys(found.tolist()))
        assert first_seen == [0, 1, 2, 3]


def test_as_many_groups_as_parameters_is_each_its_own():
    np.testing.assert_array_equal(grouping.cluster(islands((0, 1, 2, 3)), 4, seed=0), [0, 1, 2, 3])
    np.testing.assert_array_equal(grouping.cluster(islands((0, 1, 2, 3)), 1, seed=0), [0, 0, 0, 0])


def test_vote_takes_the_most_frequent_scheme():
    a, b, c = [0, 1, 0], [0, 0, 1], [0, 1, 1]
    np.testing.assert_array_equal(grouping.vote(np.array([c, a, b, b, a, b])), b)
    np.testing.assert_array_equal(grouping.vote(np.array([a])), a)


def test_the_earliest_of_equals_wins_the_vote():
    a, b, c = [0, 1, 0], [0, 0, 1], [0, 1, 1]
    np.testing.assert_array_equal(grouping.vote(np.array([a, b])), a)
    np.testing.assert_array_equal(grouping.vote(np.array([b, a])), b)
    np.testing.assert_array_equal(grouping.vote(np.array([c, b, a, a, b])), b)


def test_members_by_hand():
    np.testing.assert_array_equal(
        grouping.members(np.array([0, 1, 0, 2]), 3),
        [[True, False, True, False], [False, True, False, False], [False, False, False, True]],
    )
    assert (grouping.members(np.array([0, 1, 0, 2]), 3).sum(0) == 1).all()
