"""Innovations: what an observation differs by from the simulator's own prediction of it at a reference estimate.

A discriminator that sees s' - s has to learn the robot's motion more exactly than a parameter changes it, and some
change it by a hundredth of its usual size. The innovation e = s' - f(s, a; ξ̂), in filtering the term for a measurement
less its prediction (Kailath 1968), is without that motion: where ξ̂ is the truth it is 0 in logged rows, and about J (ξ
- ξ̂) in rows simulated under ξ. `slopes` learns J, in whose spread e is seen. The reference ξ̂ is renewed from time to
time, and the spread with it, so that parameters of small effect are seen once those of large effect are known. Not in
the paper; an observation has to determine the state. Discriminators begin with s' - s: while simulated rows are seldom
where logged ones are, the few logged rows that are predicted say too little.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.madoc import slopes
from madoc.calibration.madoc.actors import Actors, squashed
from madoc.calibration.madoc.beginning import told
from madoc.calibration.madoc.slopes import Slopes
from madoc.calibration.madoc.watch import Watch, overlaps
from madoc.learning.features import Scaling
from madoc.simulation.base import Simulator
from madoc.simulation.rollout import Rollout
from madoc.types import Transitions

RENEWAL = 20
"""Epochs of calibration from one reference to the next."""
ROWS = 5000
"""Logged rows that are predicted at each reference; of them alone is s' seen until the next."""
OVERLAP = 0.3
"""Mean overlap of logged and simulated (s, a), in [0, 1], from which discriminators go on to innovations."""
LOUDEST = 0.03
"""Noise of the sensors, in typical changes of a signal, above which a prediction from a reading tells too little."""
FINEST = 1e-4
"""Smallest scale of a channel, in its typical changes: finer differences are rounding, of the log or the model."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Reference:
    """The parameters at which s' is predicted, and logged rows beside their prediction.

    Attributes:
        parameters: In physical units.
        pair: Features of (s, a) of the logged rows.
        following: Features of their innovations.
        age: Epochs since it was chosen; negative before the first is.
        slopes: The derivatives of s', and the spreads by which features are innovations.
    """

    parameters: Float[np.ndarray, " d"]
    pair: Float[Array, "rows pair"]
    following: Float[Array, "rows observation"]
    age: int
    slopes: Slopes

    @property
    def size(self) -> float:
        """Root mean square, over channels, of the least spread of an innovation in typical changes of a signal.

        It is taken for the unit of the features, whose spreads differ from row to row.
        """
        return float(np.sqrt(np.mean(np.asarray(self.slopes.floor, np.float64) ** 2)))


@dataclass(frozen=True)
class Seen:
    """Simulated rows as discriminators see them.

    Attributes:
        reference: What they are measured from.
        following: Features of their innovations, NaN where there are none; None before the first reference.
        control_steps: Control steps that predictions took, those of logged rows included.
        failures: Rows among them whose simulation failed.
    """

    reference: Reference
    following: Float[np.ndarray, "steps systems rows observation"] | None
    control_steps: int
    failures: int


def obstacle(problem: CalibrationProblem, window: int, noise: Float[np.ndarray, " observation"]) -> str:
    """Why innovations cannot be had from this log, as a clause; empty if they can.

    Args:
        problem: The log and the simulator.
        window: Rows that discriminators see before s'.
        noise: Standard deviation of the noise that simulated observations are given, as the log's have it.
    """
    if problem.states.kind != "exact":
        return "an observation does not determine the state"
    if problem.dataset.disturbance.velocities == "differences":
        return "velocities are differences of positions, so an observation does not determine the state"
    if problem.simulator.task.pending:
        return "actions take effect with a delay, so an observation and an action do not determine the next"
    if problem.dataset.disturbance.shuffled == "next_observations":
        return "the log's next observations are shuffled"
    if np.median(noise / problem.typical_change) > LOUDEST:
        share = f"{100 * LOUDEST:g} % of a signal's typical change"
        return f"the sensors' noise is more than {share}, and a prediction amplifies it"
    return "" if window == 1 else f"discriminators see windows of {window} rows"


def no_reference(problem: CalibrationProblem, scaling: Scaling, key: PRNGKeyArray) -> Reference:
    """The reference before the first: no row of the log is seen."""
    rows, channels, space = min(ROWS, len(problem.states.rows)), len(scaling.next_scale), problem.simulator.parameters
    pair, following = jnp.zeros((rows, len(scaling.pair_offset))), jnp.zeros((rows, channels))
    unknown = slopes.no_slopes(pair.shape[1], channels, len(space), key)
    return Reference(space.middle, pair, following, -1, unknown)


def seen(
    problem: CalibrationProblem,
    scaling: Scaling,
    reference: Reference,
    actors: Actors,
    draws: Float[np.ndarray, "systems d"],
    rollout: Rollout,
    key: PRNGKeyArray,
) -> Seen:
    """An epoch's rows, simulated under `draws`, from the reference or, where it is due, a new one at the actors' mean.

    A new reference at which no row of the log, or none of the rollout, can be predicted is not taken: the next epoch is
    to find another.
    """
    (mean, deviation), space = squashed(actors), problem.simulator.parameters
    estimate = space.to_physical(mean)
    pair = scaling.features(rollout.transitions)[0]
    following = _of_rollout(problem, estimate if _due(reference) else reference.parameters, rollout)
    steps, failures = rollout.valid.size, _failed(problem, rollout.transitions, following, rollout.valid)
    if not _due(reference):
        learnt = _observed(problem, reference.slopes, pair, following, draws - space.to_unit(reference.parameters))
        aged = replace(reference, age=reference.age + 1, slopes=learnt)
        return Seen(aged, _features(problem, learnt, pair, following), steps, failures)
    of_rows, of_slopes = jax.random.split(key)
    rows, logged = _of_log(problem, estimate, len(reference.pair), of_rows)
    steps, failures = steps + len(logged), failures + _failed(problem, rows, logged, np.ones(len(logged), bool))
    scale = _scale(problem, logged, following)
    if scale is not None:
        kept = np.resize(np.flatnonzero(np.isfinite(logged).all(-1)), len(logged))
        known, logged = scaling.features(rows.take(kept))[0], logged[kept]
        probed = slice(min(slopes.PROBED, len(kept)))
        derivatives = _derivatives(problem, mean, rows.take(kept[probed]), logged[probed])
        learnt = replace(
            _observed(problem, reference.slopes, pair, following, draws - mean),
            deviation=jnp.asarray(deviation, jnp.float32),
            floor=jnp.asarray(scale / problem.typical_change, jnp.float32),
        )
        learnt = slopes.learn(learnt, known[probed], derivatives, of_slopes)
        seen_of_log = jnp.asarray(_features(problem, learnt, known, logged))
        new = Reference(estimate, jnp.asarray(known), seen_of_log, 0, learnt)
        steps += len(derivatives) * len(mean)
        return Seen(new, _features(problem, learnt, pair, following), steps, failures)
    if reference.age < 0:
        return Seen(reference, None, steps, failures)
    following = _of_rollout(problem, reference.parameters, rollout)
    failures += _failed(problem, rollout.transitions, following, rollout.valid)
    steps += rollout.valid.size
    return Seen(reference, _features(problem, reference.slopes, pair, following), steps, failures)


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


def _due(reference: Reference) -> bool:
    return not 0 <= reference.age < RENEWAL - 1


def _of_rollout(
    problem: CalibrationProblem, parameters: Float[np.ndarray, " d"], rollout: Rollout
) -> Float[np.ndarray, "steps systems rows observation"]:
    found = innovations(problem.simulator, parameters, rollout.transitions)
    return np.where(rollout.valid[..., None], found, np.nan)


def _of_log(
    problem: CalibrationProblem, parameters: Float[np.ndarray, " d"], count: int, key: PRNGKeyArray
) -> tuple[Transitions, Float[np.ndarray, "rows observation"]]:
    """Rows of the log, drawn without repetition, and their innovations."""
    chosen = np.asarray(jax.random.choice(key, problem.states.exact()[1], (count,), replace=False))
    rows = problem.dataset.transitions.take(chosen)
    return rows, innovations(problem.simulator, parameters, rows)


def _scale(
    problem: CalibrationProblem,
    logged: Float[np.ndarray, "rows observation"],
    simulated: Float[np.ndarray, "*rows observation"],
) -> Float[np.ndarray, " observation"] | None:
    """The median |e| of logged and simulated innovations together; None where there are none of either.

    It is a median, as innovations at impacts are a hundred times those in flight.
    """
    known = [each[np.isfinite(each).all(-1)] for each in (logged, _flat(simulated))]
    if not all(map(len, known)):
        return None
    return np.maximum(np.median(np.abs(np.concatenate(known)), axis=0), FINEST * problem.typical_change)


def _derivatives(
    problem: CalibrationProblem,
    point: Float[np.ndarray, " d"],
    rows: Transitions,
    known: Float[np.ndarray, "rows observation"],
) -> Float[np.ndarray, "rows observation d"]:
    """Derivatives of s' by the parameters in [-1, 1], in typical changes; `known` are the innovations at the point.

    They are one-sided differences, of d control steps a row.
    """
    moves = np.where(point > 0.0, -slopes.STEP, slopes.STEP)
    points = problem.simulator.parameters.to_physical(point + np.diag(moves))
    moved = [innovations(problem.simulator, values, rows) for values in points]
    return (known[..., None] - np.stack(moved, axis=-1)) / moves / problem.typical_change[:, None]


def _failed(
    problem: CalibrationProblem,
    rows: Transitions,
    found: Float[np.ndarray, "*rows observation"],
    valid: Bool[np.ndarray, "*rows"],
) -> int:
    """Valid rows without innovations though their state can be rebuilt."""
    rebuildable = problem.simulator.task.rebuildable
    known = valid if rebuildable is None else valid & np.asarray(rebuildable(np.asarray(rows.observation)))
    return int((~np.isfinite(found).all(-1) & known).sum())


def _flat(column: np.ndarray | Array) -> Float[np.ndarray, "rows channels"]:
    """All rows of a column on one axis, in float64."""
    return np.asarray(column, dtype=np.float64).reshape(-1, column.shape[-1])


def _observed(
    problem: CalibrationProblem,
    learnt: Slopes,
    pair: Float[np.ndarray, "*rows pair"],
    found: Float[np.ndarray, "steps systems rows observation"],
    moved: Float[np.ndarray, "systems d"],
) -> Slopes:
    of_rows = np.broadcast_to(moved[:, None], (*found.shape[:-1], moved.shape[1]))
    return slopes.observe(learnt, _flat(pair), _flat(found) / problem.typical_change, _flat(of_rows))


def _features(
    problem: CalibrationProblem,
    learnt: Slopes,
    pair: Float[np.ndarray, "*rows pair"],
    found: Float[np.ndarray, "*rows observation"],
) -> Float[np.ndarray, "*rows observation"]:
    change = (_flat(found) / problem.typical_change).astype(np.float32)
    features = slopes.standardised(learnt, jnp.asarray(pair.reshape(-1, pair.shape[-1])), jnp.asarray(change))
    return np.asarray(features).reshape(found.shape)


def may_begin(problem: CalibrationProblem, watched: Watch) -> bool:
    """Whether simulated rows are where logged ones are: by the discriminators, or by a prior of every parameter."""
    known = told(problem)
    return (known is not None and bool(known.all())) or overlaps(watched, OVERLAP)
