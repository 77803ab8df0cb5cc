"""Slopes: the derivatives J(s, a) of s' by the parameters, as a network.

To first order the innovation of a row simulated under ξ is J(s, a) (ξ - ξ̂): the network learns from all those rows, as
ξ is known, and from finite differences at a few. It serves twice. A row simulated under one draw can stand for any
other, s' + J (ξ' - ξ), so that critics and discriminators see as many draws as updates and not the few of an epoch;
that takes most of the noise from the actors' steps. And J tells how far the actors spread s' in each row: by standard
deviations of that, a parameter which moves s' in one row of a hundred is as large there as any. At the truth the
innovations of the log are 0 whatever J is, so its errors delay an estimate but do not shift it.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from madoc.learning import replay
from madoc.learning.networks import Network, adam, minimise

PROBED = 150
"""Logged rows whose derivatives are taken at each reference, of d control steps each."""
STEP = 0.05
"""Distance in [-1, 1] of the finite differences, from the reference towards the middle of the range."""
HIDDEN = (128, 128)
"""Units per layer of the network."""
UPDATES = 1000
"""Updates of the network at each reference."""
BATCH = 256
"""Simulated rows, and half as many with derivatives, in an update."""
RATE = 1e-3
"""Adam's learning rate."""
CAPACITY = 20_000
"""Number of simulated rows that are kept, those at earlier references included: derivatives differ little."""
PROBED_CAPACITY = 3_000
"""Number of rows with derivatives that are kept."""
TAIL = 30.0
"""Largest size of a derivative that is learnt, in multiples of its root mean square; impacts have larger ones."""
OUTLYING = 0.99
"""Quantile of the squares of a derivative beyond which they do not raise its root mean square."""
NEGLIGIBLE = 0.01
"""Smallest size of a derivative, relative to that of the parameter which moves the signal most."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Slopes:
    """What is known of J, and the units of standardised innovations. Changes of s' are in typical changes of a signal.

    Attributes:
        network: Features of (s, a) -> derivatives of all signals by all parameters in [-1, 1], in multiples of `size`.
        optimiser: State of its optimiser.
        size: Root mean square of each derivative where they were first taken.
        probed: Features of (s, a), and derivatives there in multiples of `size`.
        simulated: Features of (s, a), innovations, and how far the parameters in [-1, 1] were from the reference.
        deviation: Deviations of the actors in [-1, 1] when the reference was chosen.
        floor: The median of |e| over logged and simulated rows: the least spread of a signal.
    """

    network: Network
    optimiser: PyTree
    size: Float[Array, "channels d"]
    probed: replay.Replay
    simulated: replay.Replay
    deviation: Float[Array, " d"]
    floor: Float[Array, " channels"]


def no_slopes(pair: int, channels: int, parameters: int, key: PRNGKeyArray) -> Slopes:
    """An untrained network, and no rows."""
    network = Network(pair, channels * parameters, HIDDEN, key=key)
    return Slopes(
        network=network,
        optimiser=adam(RATE).init(eqx.filter(network, eqx.is_array)),
        size=jnp.ones((channels, parameters)),
        probed=replay.empty(PROBED_CAPACITY, pair=(pair,), slope=(channels, parameters)),
        simulated=replay.empty(CAPACITY, pair=(pair,), change=(channels,), moved=(parameters,)),
        deviation=jnp.ones(parameters),
        floor=jnp.ones(channels),
    )


def observe(
    slopes: Slopes,
    pair: Float[np.ndarray, "rows pair"],
    innovations: Float[np.ndarray, "rows channels"],
    moved: Float[np.ndarray, "rows d"],
) -> Slopes:
    """The slopes with more simulated rows; those without innovations are left out. The buffer given is consumed."""
    known: Bool[np.ndarray, " rows"] = np.isfinite(innovations).all(-1)
    change = np.where(known[:, None], innovations, 0.0)
    columns = {"pair": pair, "change": change, "moved": moved}
    rows = {name: column.astype(np.float32) for name, column in columns.items()}
    return replace(slopes, simulated=replay.add(slopes.simulated, rows, known))


def learn(
    slopes: Slopes,
    pair: Float[np.ndarray, "rows pair"],
    derivatives: Float[np.ndarray, "rows channels d"],
    key: PRNGKeyArray,
) -> Slopes:
    """The network after updates with these derivatives as well; rows where any is not finite are left out."""
    known: Bool[np.ndarray, " rows"] = np.isfinite(derivatives).all((1, 2))
    size = np.asarray(slopes.size)
    if not int(slopes.probed.written) and known.any():
        squares = derivatives[known] ** 2
        size = np.sqrt(np.minimum(squares, np.quantile(squares, OUTLYING, axis=0)).mean(0))
        size = np.maximum(size, NEGLIGIBLE * size.max(1, keepdims=True) + np.finfo(np.float32).tiny)
    scaled = np.where(known[:, None, None], np.clip(derivatives / size, -TAIL, TAIL), 0.0)
    probed = replay.add(slopes.probed, {"pair": pair, "slope": scaled.astype(np.float32)}, known)
    slopes = replace(slopes, size=jnp.asarray(size, jnp.float32), probed=probed)
    if not int(probed.written):
        return slopes
    network, optimiser = _fit(slopes, key)
    return replace(slopes, network=network, optimiser=optimiser)


@eqx.filter_jit
def _fit(slopes: Slopes, key: PRNGKeyArray) -> tuple[Network, PyTree]:
    """Updates of the network. Both losses are tolerant of long tails: Huber's, and squares of differences of asinh."""

    def loss_of(network: Network, key: PRNGKeyArray) -> Array:
        keys = jax.random.split(key)
        probed, rows = (
            replay.sample(slopes.probed, keys[0], BATCH // 2),
            replay.sample(slopes.simulated, keys[1], BATCH),
        )
        missed = jnp.abs(_derivatives(slopes, network, probed["pair"]) - probed["slope"])
        predicted = jnp.einsum(
            "rcd,rd->rc", slopes.size[None] * _derivatives(slopes, network, rows["pair"]), rows["moved"]
        )
        left = jnp.arcsinh(predicted / slopes.floor[None]) - jnp.arcsinh(rows["change"] / slopes.floor[None])
        return jnp.where(missed < 1.0, 0.5 * missed**2, missed - 0.5).mean() + 0.5 * (left**2).mean()

    network, optimiser, _ = minimise(
        loss_of, slopes.network, slopes.optimiser, key, optimiser=adam(RATE), count=UPDATES
    )
    return network, optimiser


def _derivatives(slopes: Slopes, network: Network, pair: Float[Array, "rows pair"]) -> Float[Array, "rows channels d"]:
    """Derivatives in multiples of `size`."""
    return network(pair).reshape(len(pair), *slopes.size.shape)


def spreads(slopes: Slopes, pair: Float[Array, "rows pair"]) -> Float[Array, "rows channels"]:
    """The standard deviation of an innovation under the actors, √(Σ_j (J_cj σ_j)² + floor_c²), as a Kalman filter's."""
    effect = _derivatives(slopes, slopes.network, pair) * (slopes.size * slopes.deviation[None])[None]
    return jnp.sqrt((effect**2).sum(-1) + slopes.floor[None] ** 2)


@eqx.filter_jit
def standardised(
    slopes: Slopes, pair: Float[Array, "rows pair"], innovation: Float[Array, "rows channels"]
) -> Float[Array, "rows channels"]:
    """Features of innovations: asinh of each in its spread, as few are far larger than was expected."""
    return jnp.arcsinh(innovation / spreads(slopes, pair))


def redrawn(slopes: Slopes, rows: dict[str, Array], draws: Float[Array, "rows d"]) -> dict[str, Array]:
    """Simulated rows as they were under other draws of the parameters in [-1, 1], to first order."""
    slope = _derivatives(slopes, slopes.network, rows["pair"]) * slopes.size[None]
    moved = jnp.einsum("rcd,rd->rc", slope, draws - rows["parameters"]) / spreads(slopes, rows["pair"])
    return rows | {"parameters": draws, "following": jnp.arcsinh(jnp.sinh(rows["following"]) + moved)}
