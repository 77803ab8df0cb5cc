"""SAC's, CQL's and H2O's losses and gradients beside those of another implementation.

The numbers in `ELSEWHERE` were computed once with PyTorch 2.13.0 in float64, from the papers' equations and its own
distributions, losses and derivatives, on the networks and rows that `net` and `rows` below make: weights and rows are
sines and cosines, and so are the "normal" draws, so that nothing depends on a random number generator. A loss comes
with the norms of its gradient by two weight matrices: for critics the first twin's first layer and the second twin's
last, for the actor its first and its last.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from affine import layered
from madoc.learning import sac_losses, tanh_gaussian
from madoc.learning.sac_losses import TwinCritic
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.policies import cql, h2o

ELSEWHERE = {
    "soft_target": [0.1492636, -0.265457, -0.9878966, -1.243325, -0.03467786, 0.8268372],
    "hard_target": [-0.2290532, -0.7807069, -0.9878966, -0.8901178, -0.4238568, 0.8268372],
    "sac_critic": [0.7325584, 0.3520878, 0.1652461],
    "sac_actor": [0.04887368, 0.2692381, 0.4393935],
    "cql": [10.26021, 1.76065, 0.800003, 0.5015693],
    "h2o": [1.57324, -0.1547821, 0.8078263, 0.508461],
    "ratio_clipped": [1, 1, 0.4189808],
}


def waves(start, *shape):
    count = int(np.prod(shape))
    return (0.7 * np.sin(1.3 * (start + np.arange(count)) + 0.5)).reshape(shape)


def net(start, inputs, outputs, hidden=4):
    first = waves(start, hidden, inputs), waves(start + 100, hidden)
    return layered(first, (waves(start + 200, outputs, hidden), waves(start + 300, outputs)))


def rows(start, count, width):
    return jnp.asarray(np.cos(0.9 * (start + np.arange(count * width))).reshape(count, width), jnp.float32)


def twins(first, second):
    made = TwinCritic(3, 2, (4,), key=jax.random.key(0))
    return eqx.tree_at(lambda critic: (critic.first, critic.second), made, (net(first, 5, 1), net(second, 5, 1)))


POLICY = eqx.tree_at(lambda policy: policy.network, TanhGaussianPolicy(3, 2, (4,), key=jax.random.key(0)), net(1, 3, 4))
CRITIC, TARGET_CRITIC = twins(11, 21), twins(31, 41)
OBSERVATION, FOLLOWING, ACTION = rows(1, 6, 3), rows(50, 6, 3), 0.9 * rows(90, 6, 2)
REWARD, TERMINATED = rows(120, 6, 1)[:, 0], jnp.array([0.0, 0, 1, 0, 0, 1])
TEMPERATURE, DISCOUNT = jnp.asarray(0.3), 0.9


@pytest.fixture
def draws(monkeypatch):
    """Puts given numbers in the place of normal draws."""

    def put(numbers):
        queue = [numbers] if isinstance(numbers, jax.Array) else list(numbers)
        monkeypatch.setattr(tanh_gaussian.jax.random, "normal", lambda key, shape: queue.pop(0).reshape(shape))

    return put


def targets(temperature):
    action, density = tanh_gaussian.sample(*POLICY.distribution(FOLLOWING), jax.random.key(0))
    value = jnp.minimum(*TARGET_CRITIC(FOLLOWING, action))
    return sac_losses.soft_target(REWARD, TERMINATED, value, density, temperature=temperature, discount=DISCOUNT)


def loss_and_slopes(loss_of, module, weights):
    loss, slopes = eqx.filter_value_and_grad(loss_of)(module)
    return [loss, *(jnp.linalg.norm(weight) for weight in weights(slopes))]


def critic_weights(critic):
    return critic.first.layers[0].weight, critic.second.layers[1].weight


def close(found, name):
    np.testing.assert_allclose(np.asarray(found), ELSEWHERE[name], rtol=2e-5, atol=2e-6)


def test_targets(draws):
    for name, temperature in (("soft_target", TEMPERATURE), ("hard_target", jnp.asarray(0.0))):
        draws(rows(200, 6, 2))
        close(targets(temperature), name)


def test_sac(draws):
    soft = jnp.array(ELSEWHERE["soft_target"])
    close(
        loss_and_slopes(
            lambda critic: sac_losses.critic_loss(critic, OBSERVATION, ACTION, soft), CRITIC, critic_weights
        ),
        "sac_critic",
    )
    draws(rows(230, 6, 2))
    close(
        loss_and_slopes(
            lambda policy: sac_losses.actor_loss(
                policy, CRITIC, OBSERVATION, temperature=TEMPERATURE, noise=jax.random.key(0)
            )[0],
            POLICY,
            lambda slopes: [layer.weight for layer in slopes.network.layers],
        ),
        "sac_actor",
    )


def test_cql(draws, monkeypatch):
    drawn = [jnp.stack([rows(start, 6, 2), rows(start + 20, 6, 2)]) for start in (300, 400, 500)]
    monkeypatch.setattr(cql.jax.random, "uniform", lambda key, shape, minval, maxval: drawn[0].reshape(shape))
    draws(drawn[1:])
    proposed = cql.proposals(POLICY, OBSERVATION, FOLLOWING, samples=2, key=jax.random.key(0))
    hard = jnp.array(ELSEWHERE["hard_target"])

    def loss_of(critic):
        return cql.cql_loss(critic, OBSERVATION, ACTION, hard, proposed, weight=5.0)

    loss, *slopes = loss_and_slopes(lambda critic: loss_of(critic)[0], CRITIC, critic_weights)
    close([loss, loss_of(CRITIC)[1], *slopes], "cql")


def test_h2o():
    hard = jnp.array(ELSEWHERE["hard_target"])
    real, simulated = ((OBSERVATION[part], ACTION[part], hard[part]) for part in (slice(0, 3), slice(3, 6)))
    settings = {"ratio": jnp.array([0.2, 1.0, 1e-5]), "gap": jnp.array([0.5, 0.01, 2.0]), "weight": 0.01}

    def loss_of(critic):
        return h2o.h2o_loss(critic, real, simulated, **settings)

    loss, *slopes = loss_and_slopes(lambda critic: loss_of(critic)[0], CRITIC, critic_weights)
    close([loss, loss_of(CRITIC)[1], *slopes], "h2o")


def test_h2o_dynamics_ratio():
    """From the two-class logits f_sa and f_sas, whose softmaxes the other implementation divides."""
    logits = rows(650, 3, 2)
    close(h2o.dynamics_ratio(logits[:, 0] - logits[:, 1]), "ratio_clipped")
