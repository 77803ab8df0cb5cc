from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from madoc.calibration.madoc import slopes
from madoc.calibration.madoc.actors import initial_actors
from madoc.calibration.madoc.agents import OF_INNOVATIONS, AgentSettings

KEY = jax.random.key(0)


def slopes_of(derivatives, deviation, floor):
    """Slopes whose network gives these derivatives (channels, d) in every row."""
    unknown = slopes.no_slopes(2, *np.shape(derivatives), KEY)
    last = unknown.network.layers[-1]
    bias = jnp.ravel(jnp.asarray(derivatives, jnp.float32))
    network = eqx.tree_at(
        lambda each: (each.layers[-1].weight, each.layers[-1].bias), unknown.network, (0.0 * last.weight, bias)
    )
    return replace(unknown, network=network, deviation=jnp.asarray(deviation), floor=jnp.asarray(floor))


def test_innovations_are_seen_in_the_spread_of_the_actors_by_hand():
    # Deviations of 1 and 8 move the signal by 3 and 4, and 12 are of other causes: √(9 + 16 + 144) = 13.
    known = slopes_of([[3.0, 0.5]], [1.0, 8.0], [12.0])
    np.testing.assert_allclose(slopes.spreads(known, jnp.zeros((1, 2))), [[13.0]])
    seen = slopes.standardised(known, jnp.zeros((1, 2)), jnp.array([[26.0]]))
    np.testing.assert_allclose(seen, [[np.arcsinh(2.0)]], rtol=1e-6)


def test_rows_under_another_draw_by_hand():
    known = slopes_of([[3.0, 0.5]], [1.0, 8.0], [12.0])
    rows = {
        "pair": jnp.zeros((1, 2)),
        "following": jnp.arcsinh(jnp.array([[2.0]])),
        "parameters": jnp.array([[0.5, 0.0]]),
    }
    found = slopes.redrawn(known, rows, jnp.array([[0.0, 1.0]]))
    # An innovation of 26, less 3 · 0.5, and 0.5 · 1 more, is 25.
    np.testing.assert_allclose(found["following"], [[np.arcsinh(25.0 / 13.0)]], rtol=1e-5)
    np.testing.assert_array_equal(found["parameters"], [[0.0, 1.0]])
    same = slopes.redrawn(known, rows, rows["parameters"])
    np.testing.assert_allclose(same["following"], rows["following"], rtol=1e-5)


def test_derivatives_are_learnt_where_they_are_known():
    random = np.random.default_rng(0)
    pair = random.normal(size=(300, 2)).astype(np.float32)
    truth = np.stack([100.0 * pair[:, 0], 0.01 * pair[:, 1]], axis=1)[..., None]  # of two signals by one parameter
    given = truth.copy()
    given[0] = np.nan
    learnt = slopes.learn(slopes.no_slopes(2, 2, 1, KEY), pair, given, KEY)
    assert int(learnt.probed.written) == 299
    np.testing.assert_allclose(learnt.size[:, 0], [100.0, 0.01], rtol=0.2)
    rows = random.normal(size=(300, 2)).astype(np.float32)
    told = np.asarray(learnt.network(jnp.asarray(rows))) * np.asarray(learnt.size)[:, 0]
    for channel, scale in enumerate((100.0, 0.01)):
        assert np.abs(told[:, channel] - scale * rows[:, channel]).mean() < 0.15 * scale


def test_rows_of_which_nothing_is_known_change_no_size():
    unknown = slopes.no_slopes(2, 2, 1, KEY)
    still = slopes.learn(unknown, np.zeros((3, 2), np.float32), np.full((3, 2, 1), np.nan), KEY)
    assert int(still.probed.written) == 0
    assert np.asarray(still.size) == pytest.approx(1.0)
    assert np.isfinite(still.network(jnp.zeros((1, 2)))).all()


def test_counterfactual_credit_reaches_the_critics_of_groups_and_nothing_else_of_them():
    settings = AgentSettings(hidden=(8,), critic_hidden=(8,))
    sizes = {"window": 2, "observation": 1, "groups": 3, "resolution": OF_INNOVATIONS}
    agents = settings.init(actors=initial_actors(5), key=KEY, **sizes)
    members = jnp.array([[True, False, False, True, False], [False, True, True, False, True], [False] * 5])
    random = np.random.default_rng(1)
    columns = {"pair": 2, "following": 1, "parameters": 5}
    rows = {name: jnp.asarray(random.uniform(-1, 1, (40, size)), jnp.float32) for name, size in columns.items()}
    known = slopes_of([[3.0, 0.5, 1.0, -2.0, 0.1]], np.ones(5), [1.0])

    def slope(critics):
        terms = {"members": members, "mixing": "counterfactual", "slopes": known, "key": KEY}
        loss = settings.loss_of_critics(agents, rows, jnp.zeros(40), jnp.ones(40), **terms)
        return eqx.filter_grad(loss)(critics)

    found = eqx.filter_jit(slope)(agents.critics)
    for part in (found.weight, found.bias, *jax.tree.leaves(found.baseline)):
        np.testing.assert_array_equal(part, np.zeros_like(part))
    first = np.asarray(found.networks.layers[0].bias)
    assert (first != 0).any(-1).tolist() == [True, True, False]
