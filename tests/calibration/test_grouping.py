import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from affine import affine
from madoc.calibration.madoc import grouping
from madoc.calibration.madoc.grouping import LATENT, GroupingVAE
from madoc.learning import replay

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


OPTIMISER = optax.adam(3e-3)


def untrained(hidden=(32, 32), seed=0):
    vae = GroupingVAE(4, 3, 2, hidden, key=jax.random.key(seed))
    return vae, OPTIMISER.init(eqx.filter(vae, eqx.is_array))


def simulated_rows(affects, count=4000, seed=0):
    """Rows of (s, a), s' - s where parameter i adds to channel affects[i] alone."""
    random = np.random.default_rng(seed)
    pair = random.normal(size=(count, 3))
    identity = random.integers(0, len(affects), count)
    value = random.uniform(-1, 1, count)
    drawn = np.zeros((count, len(affects)))
    drawn[np.arange(count), identity] = value
    following = 0.3 * pair[:, :2]
    following[np.arange(count), np.asarray(affects)[identity]] += value
    columns = {"pair": pair, "following": following, "parameters": drawn, "identity": identity}
    ring = replay.empty(count, pair=(3,), following=(2,), parameters=(len(affects),), identity=())
    flat = {name: replay.flatten_rows(column, 1) for name, column in columns.items()}
    return replay.add(ring, flat, np.ones(count, bool))


@pytest.mark.parametrize("affects", [(0, 0, 1, 1), (0, 1, 0, 1), (1, 0, 0, 0)])
def test_parameters_of_one_effect_become_one_group(affects):
    vae, state = untrained()
    vae, _, _ = grouping.train(
        vae, state, simulated_rows(affects), jax.random.key(1), optimiser=OPTIMISER, batch=256, count=800
    )
    expected = [0 if channel == affects[0] else 1 for channel in affects]
    np.testing.assert_array_equal(grouping.cluster(vae.embeddings(), 2, seed=0), expected)


def test_training_lowers_the_loss_and_traces_once(traced):
    vae, state = untrained(hidden=(8,))
    rows = simulated_rows((0, 0, 1, 1), count=500)
    settings = {"optimiser": OPTIMISER, "batch": 64, "count": 20}
    keys = list(jax.random.split(jax.random.key(1), 11))
    vae, state, first = grouping.train(vae, state, rows, keys[0], **settings)
    before = traced()
    for key in keys[1:]:
        vae, state, last = grouping.train(vae, state, rows, key, **settings)
    assert traced() == before
    assert last < 0.8 * first
    assert state[0].count == 220


def hand_made():
    """Two parameters, one (s, a) channel, one s' channel, every number chosen."""
    vae = GroupingVAE(2, 1, 1, (), key=jax.random.key(0))
    encoder = affine(np.stack([np.full(LATENT, 0.5), np.full(LATENT, -1.0)], axis=1), np.zeros(LATENT))
    decoder = affine(np.concatenate([[2.0], np.full(LATENT, 1 / LATENT), np.full(LATENT, 1 / LATENT)])[None], [0.1])
    return eqx.tree_at(lambda vae: (vae.encoder, vae.decoder), vae, (encoder, decoder))


def test_reconstruction_loss_by_hand(compiled):
    # s' = 2 (s, a) + mean of the repeated ξ_i + mean of the embedding + 0.1
    # row 0, identity 0: 2·1 + 0.3 + 0.5 + 0.1 = 2.9;  row 1, identity 1: 2·0 - 0.2 - 1 + 0.1 = -1.1
    pair, value, identity = jnp.array([[1.0], [0.0]]), jnp.array([0.3, -0.2]), jnp.array([0, 1])
    np.testing.assert_allclose(hand_made()(pair, value, identity), [[2.9], [-1.1]], rtol=1e-5)
    # against (2.4, -1): mean(0.5², 0.1²) = 0.13
    loss = compiled(grouping.reconstruction_loss)(hand_made(), pair, jnp.array([[2.4], [-1.0]]), value, identity)
    assert loss == pytest.approx(0.13, rel=1e-4)


def test_embeddings_are_one_a_parameter():
    vae, _ = untrained()
    assert vae.embeddings().shape == (4, LATENT)
    np.testing.assert_allclose(hand_made().embeddings()[:, 0], [0.5, -1.0])


def test_training_shows_the_value_of_the_moved_parameter_alone():
    # what the other columns of `parameters` hold must not matter
    rows = simulated_rows((0, 0, 1, 1), count=200)
    identity = np.asarray(rows.rows["identity"], int)
    own = np.eye(4, dtype=bool)[identity]
    garbled = jnp.where(own, rows.rows["parameters"], 99.0)
    other = replay.Replay(rows.rows | {"parameters": garbled}, rows.written)
    vae, state = untrained(hidden=(8,))
    settings = {"optimiser": OPTIMISER, "batch": 32, "count": 5}
    trained, _, _ = grouping.train(vae, state, rows, jax.random.key(0), **settings)
    same, _, _ = grouping.train(vae, state, other, jax.random.key(0), **settings)
    jax.tree.map(np.testing.assert_array_equal, trained, same)
