"""Innovations: what an observation differs by from the simulator's own prediction of it at a reference estimate.

A discriminator that sees s' - s has to learn the robot's motion more exactly than a parameter changes it, and some
change it by a hundredth of its usual size. The innovation e = s' - f(s, a; ξ̂), in filtering the term for a measurement
less its prediction (Kailath 1968), is without that motion: where ξ̂ is the truth it is 0 in logged rows, and about
J (ξ - ξ̂) in rows simulated under ξ. The reference ξ̂ is renewed from time to time, and the scale of e with it, so that
parameters of small effect are seen once those of large effect are known. Not in the paper; an observation has to
determine the state.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.errors import MadocError
from madoc.learning.features import Scaling
from madoc.simulation.base import Simulator
from madoc.types import Transitions

RENEWAL = 20
"""Epochs of calibration from one reference to the next."""
ROWS = 5000
"""Logged rows that are predicted at each reference; they are all that discriminators see of the log until the next."""
IMPACTS = 0.99
"""Quantile of the squared innovations of a channel beyond which they do not raise its scale."""
LINEAR = 3.0
"""Features are asinh(3 e / scale) / 3: linear up to a third of the scale, logarithmic beyond, as innovations at impacts
are a hundred times those in flight."""
UNMOVED = 1e-9
"""Scale, in typical changes of a channel, below which its innovations are rounding."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Reference:
    """The parameters at which s' is predicted, and logged rows beside their prediction.

    Attributes:
        parameters: In physical units.
        scale: Scale of each channel's innovations; 0 where they are rounding, and its features 0.
        pair: Features of (s, a) of the logged rows.
        following: Features of their innovations.
    """

    parameters: Float[np.ndarray, " d"]
    scale: Float[np.ndarray, " observation"]
    pair: Float[Array, "rows pair"]
    following: Float[Array, "rows observation"]

    def features(self, innovations: Float[np.ndarray, "*rows observation"]) -> Float[np.ndarray, "*rows observation"]:
        """Innovations as discriminators see them, float32."""
        return _features(innovations, self.scale)

    def size(self, typical_change: Float[np.ndarray, " observation"]) -> float:
        """Root mean square, over channels, of the scale in typical changes of a row: the unit of the features."""
        share = (self.scale / typical_change)[self.scale > 0.0]
        return float(np.sqrt(np.mean(share**2))) if len(share) else 1.0


def obstacle(problem: CalibrationProblem, window: int) -> str:
    """Why innovations cannot be had from this log, as a sentence; empty if they can."""
    if problem.states.kind != "exact":
        return problem.states.reason
    if problem.simulator.task.pending:
        return "actions take effect with a delay, so an observation and an action do not determine the next"
    if problem.dataset.disturbance.shuffled == "next_observations":
        return "the log's next observations are shuffled"
    return "" if window == 1 else f"discriminators see windows of {window} rows"


def no_reference(problem: CalibrationProblem, scaling: Scaling) -> Reference:
    """The reference before there is one: no row of the log is seen."""
    rows, channels = _count(problem), len(scaling.next_scale)
    pair, following = jnp.zeros((rows, len(scaling.pair_offset))), jnp.zeros((rows, channels))
    return Reference(problem.simulator.parameters.middle, np.zeros(channels), pair, following)


def innovations(
    simulator: Simulator, parameters: Float[np.ndarray, " d"], rows: Transitions
) -> Float[np.ndarray, "*rows observation"]:
    """The innovations s' - f(s, a; parameters) of any rows, in the observation's units; they take a control step a row.

    NaN where a row's state cannot be rebuilt from its observation, or its simulation fails.
    """
    task, shape = simulator.task, rows.observation.shape
    observation, action = (_flat(column) for column in (rows.observation, rows.action))
    assert task.state_from_observation is not None
    system = simulator.bind(parameters[None])
    state = system.unbiased(np.asarray(task.state_from_observation(observation), dtype=np.float64)[None])
    known = np.isfinite(state).all(-1)
    if task.rebuildable is not None:
        known &= np.asarray(task.rebuildable(observation))
    state = np.where(known[..., None], state, simulator.initial_state)
    following = system.step(state, action[None])
    known &= np.isfinite(following).all(-1)
    predicted = system.observe(np.where(known[..., None], following, state))
    predicted = np.where(known[..., None], predicted, np.nan)
    return np.asarray(rows.next_observation, dtype=np.float64) - predicted.reshape(shape)


def renewed(
    problem: CalibrationProblem,
    scaling: Scaling,
    parameters: Float[np.ndarray, " d"],
    simulated: Float[np.ndarray, "*rows observation"],
    key: PRNGKeyArray,
) -> Reference:
    """A reference at these parameters, with other rows of the log; it takes a control step for each of them.

    The scale is that of logged innovations and of the `simulated` ones, at the same parameters, together.

    Raises:
        MadocError: No logged row can be predicted.
    """
    chosen = np.asarray(jax.random.choice(key, problem.states.exact()[1], (_count(problem),), replace=False))
    rows = problem.dataset.transitions.take(chosen)
    logged = innovations(problem.simulator, parameters, rows)
    finite = np.flatnonzero(np.isfinite(logged).all(-1))
    if not len(finite):
        raise MadocError(
            f"all of {len(chosen)} logged rows diverged in the simulator at the estimate, so that there are no "
            "innovations; narrow the ranges of the parameters, or take --set features=standardised"
        )
    kept = np.resize(finite, len(chosen))
    rows, logged = rows.take(kept), logged[kept]
    simulated = _flat(simulated)
    squares = np.concatenate([logged, simulated[np.isfinite(simulated).all(-1)]]) ** 2
    scale = np.sqrt(np.minimum(squares, np.quantile(squares, IMPACTS, axis=0)).mean(0))
    scale = np.where(scale > UNMOVED * problem.typical_change, scale, 0.0)
    pair = jnp.asarray(scaling.features(rows)[0])
    return Reference(parameters, scale, pair, jnp.asarray(_features(logged, scale)))


def _count(problem: CalibrationProblem) -> int:
    """Number of logged rows at each reference."""
    return min(ROWS, len(problem.states.rows))


def _flat(column: np.ndarray | Array) -> Float[np.ndarray, "rows channels"]:
    """All rows of a column on one axis, in float64."""
    return np.asarray(column, dtype=np.float64).reshape(-1, column.shape[-1])


def _features(
    innovations: Float[np.ndarray, "*rows observation"], scale: Float[np.ndarray, " observation"]
) -> Float[np.ndarray, "*rows observation"]:
    units = np.divide(innovations, scale, out=np.zeros_like(innovations), where=scale > 0.0)
    return (np.arcsinh(LINEAR * units) / LINEAR).astype(np.float32)
