import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from affine import affine, layered
from madoc.learning.networks import (
    Network,
    descend,
    drop,
    falling_adam,
    minimise,
    moving_average,
    scan_updates,
)


def test_network_is_affine_relu_affine(compiled):
    network = layered(([[1, 2], [-1, 0]], [0.5, 0.25]), ([[3, 5]], [-4]))
    # row (1, 1):  hidden (3.5, -0.75) -> relu (3.5, 0)     -> 10.5 + 0 - 4    = 6.5
    # row (-2, 0): hidden (-1.5, 2.25) -> relu (0, 2.25)    -> 0 + 11.25 - 4   = 7.25
    # row (0, 0):  hidden (0.5, 0.25)                       -> 1.5 + 1.25 - 4  = -1.25, no ReLU at the end
    rows = jnp.array([[1.0, 1.0], [-2.0, 0.0], [0.0, 0.0]])
    outputs = compiled(network)(rows)
    np.testing.assert_allclose(outputs, [[6.5], [7.25], [-1.25]], rtol=1e-6)


def test_network_takes_any_leading_axes():
    network = Network(3, 2, (8,), key=jax.random.key(0))
    rows = jax.random.normal(jax.random.key(1), (4, 5, 3))
    whole = network(rows)
    assert whole.shape == (4, 5, 2)
    np.testing.assert_allclose(whole[2, 3], network(rows[2, 3]), rtol=1e-5, atol=1e-6)


def test_hidden_sizes_are_the_layers():
    network = Network(3, 2, (7, 5), key=jax.random.key(0))
    assert [layer.weight.shape for layer in network.layers] == [(7, 3), (5, 7), (2, 5)]


def test_dropout_acts_only_with_a_key():
    plain = Network(4, 3, (16, 16), key=jax.random.key(0))
    dropping = Network(4, 3, (16, 16), key=jax.random.key(0), dropout=0.5)
    rows = jax.random.normal(jax.random.key(1), (6, 4))
    np.testing.assert_array_equal(dropping(rows), plain(rows))
    np.testing.assert_array_equal(plain(rows, jax.random.key(2)), plain(rows))
    assert not np.allclose(dropping(rows, jax.random.key(2)), plain(rows))
    assert not np.allclose(dropping(rows, jax.random.key(2)), dropping(rows, jax.random.key(3)))


def test_dropout_scales_what_it_keeps(compiled):
    # 0.2 is 51 of 256 bytes, rounded; 100 units of 1 summed: (units kept) / (205 / 256), never dropped itself
    network = layered((np.zeros((100, 1)), np.ones(100)), (np.ones((1, 100)), [0]), dropout=0.2)
    outputs = compiled(network)(jnp.zeros((2000, 1)), jax.random.key(0))[:, 0]
    kept = np.asarray(outputs) * 205 / 256
    np.testing.assert_allclose(kept, np.round(kept), atol=1e-3)
    # binomial(100, 0.8008): mean 80.08, std 4; the mean of 2000 rows has std 0.09
    assert kept.mean() == pytest.approx(80.08, abs=0.3)
    assert kept.std() == pytest.approx(4, rel=0.1)


def test_each_unit_is_dropped_by_its_own_byte():
    # four masks come from one random number: neighbours must be as independent as strangers
    kept = np.asarray(drop(jnp.ones((3000, 6)), 0.5, jax.random.key(0)) > 0).astype(float)
    np.testing.assert_allclose(np.corrcoef(kept.T), np.eye(6), atol=0.08)


def test_dropout_is_drawn_anew_in_every_layer():
    eye = np.eye(200)
    network = layered((eye, np.ones(200)), (eye, np.zeros(200)), (eye, np.zeros(200)), dropout=0.5)
    outputs = np.asarray(network(jnp.zeros((50, 200)), jax.random.key(0)))
    # kept by both layers: a quarter, scaled by 4; the same mask twice would keep a half
    assert set(np.unique(outputs)) == {0.0, 4.0}
    assert (outputs > 0).mean() == pytest.approx(0.25, abs=0.02)


def _descent(optimiser):
    def update(carry, key):
        network, state = carry
        rows = jax.random.normal(key, (8, 2))

        def loss_of(network):
            return ((network(rows)[:, 0] - rows.sum(-1)) ** 2).mean()

        loss, gradients = eqx.filter_value_and_grad(loss_of)(network)
        return descend(optimiser, gradients, state, network), {"loss": loss, "first": rows[0, 0]}

    return update


def test_scan_updates_is_a_loop_over_split_keys():
    optimiser = optax.adam(1e-2)
    network = Network(2, 1, (8,), key=jax.random.key(0))
    carry = (network, optimiser.init(eqx.filter(network, eqx.is_array)))
    update, key = _descent(optimiser), jax.random.key(1)
    scanned, means = scan_updates(update, carry, key, 7)
    looped, seen = carry, []
    step = eqx.filter_jit(update)
    for each in jax.random.split(key, 7):
        looped, metrics = step(looped, each)
        seen.append(metrics)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), scanned, looped)
    for name in ("loss", "first"):
        assert means[name] == pytest.approx(np.mean([metrics[name] for metrics in seen]), rel=1e-4)
    assert not np.allclose(scanned[0].layers[0].weight, network.layers[0].weight)


def test_scan_updates_hands_static_parts_through():
    carry, _ = scan_updates(
        lambda carry, key: ((carry[0] + 1, carry[1]), {}), (jnp.zeros(()), "word"), jax.random.key(0), 3
    )
    assert carry[1] == "word"
    assert carry[0] == 3


def test_descend_takes_one_step_of_the_optimiser(compiled):
    optimiser = optax.sgd(0.5)
    network = affine([[2.0, -1.0]], [3.0])
    gradients = affine([[1.0, 4.0]], [-2.0])
    step = compiled(lambda gradients, state, network: descend(optimiser, gradients, state, network))
    moved, _ = step(gradients, optimiser.init(eqx.filter(network, eqx.is_array)), network)
    np.testing.assert_allclose(moved.layers[0].weight, [[1.5, -3.0]])  # 2 - 0.5·1, -1 - 0.5·4
    np.testing.assert_allclose(moved.layers[0].bias, [4.0])  # 3 + 0.5·2


def test_the_rate_falls_along_half_a_cosine():
    # Adam's step on a gradient that stays 1 is the rate: 0.5 of it after half the updates, 0 after all
    optimiser = falling_adam(0.1, 4)
    state, steps = optimiser.init(jnp.zeros(())), []
    for _ in range(6):
        step, state = optimiser.update(jnp.ones(()), state)
        steps.append(-float(step))
    np.testing.assert_allclose(steps, [0.1, 0.0853553, 0.05, 0.0146447, 0.0, 0.0], atol=1e-6)


def test_moving_average_by_hand(compiled):
    slow, fast = affine([[1.0, 2.0]], [0.0]), affine([[3.0, -2.0]], [10.0])
    blended = compiled(moving_average)(slow, fast, 0.25)
    np.testing.assert_allclose(blended.layers[0].weight, [[1.5, 1.0]])  # 1 + 0.25·2, 2 - 0.25·4
    np.testing.assert_allclose(blended.layers[0].bias, [2.5])


def test_moving_average_ends():
    slow, fast = {"a": jnp.array([1.0, 0.1]), "n": jnp.array(3)}, {"a": jnp.array([2.0, 0.7]), "n": jnp.array(9)}
    np.testing.assert_array_equal(moving_average(slow, fast, 0.0)["a"], slow["a"])
    np.testing.assert_allclose(moving_average(slow, fast, 1.0)["a"], fast["a"], rtol=1e-6)
    assert moving_average(slow, fast, 1.0)["n"] == 3  # counters are not averaged


def test_minimise_descends_by_hand_and_draws_by_each_key():
    # Loss w², rate 0.25: w halves in each step, from 4 to 2 to 1; the mean loss of the steps is (16 + 4) / 2.
    sgd = optax.sgd(0.25)
    weight = jnp.asarray(4.0)
    weight, _, loss = minimise(lambda w, key: w**2, weight, sgd.init(weight), jax.random.key(0), optimiser=sgd, count=2)
    assert (weight, loss) == (1.0, 10.0)
    start, drawn = jnp.zeros(()), jax.vmap(jax.random.normal)(jax.random.split(jax.random.key(1), 3))
    moved, _, _ = minimise(
        lambda w, key: w * jax.random.normal(key), start, sgd.init(start), jax.random.key(1), optimiser=sgd, count=3
    )
    assert moved == pytest.approx(-0.25 * float(drawn.sum()), rel=1e-5)
