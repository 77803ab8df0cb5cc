"""Which single term that the model lacks would explain its residuals: a score test of one added term at a time.

Windows of the log are simulated at the estimate, their initial states fitted. What neither initial states nor the
calibrated parameters can explain of the residuals is regressed on the same part of each candidate's effect (Rao 1948).
Standard errors are robust to residuals that are correlated within a window or larger in some windows than in others
(Liang and Zeger 1986), so that contacts and process noise do not pass for a term.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from madoc import simulation
from madoc.data.dataset import Dataset
from madoc.identification.gauss_newton import damped_step, eliminate, triangular_factors
from madoc.identification.linearisation import DIFFERENCE, WindowSlopes, difference_points, slopes_of_windows
from madoc.identification.losses import loss_slope, scale_of
from madoc.identification.noise import channel_noise
from madoc.identification.replay import Readings, slopes_at
from madoc.identification.states import LoggedStates
from madoc.identification.windows import disjoint_windows, evenly, longest_fit
from madoc.parameters import FIELDS, Parameter, ParameterSpace
from madoc.simulation.base import Simulator
from madoc.simulation.write import nominal_values

WINDOWS = 120
"""Largest number of windows that are simulated; their standard errors vary by about 10 % with so many."""
STEPS = 20
"""Length of a window in control steps, 1 or more: in longer ones small errors of the model grow beyond their slopes."""
NEGLIGIBLE = 1e-5
"""Residual in typical changes of a step; below it there is nothing to explain."""
_CHANGE = 1e-3
"""Change of a candidate, as a share of what would balance the joint's typical torque, for its one-sided difference."""
_STATE_DAMPING = 1e-9
"""Relative damping of initial states, far below the rounding of their differences."""
_DAMPING = 1e-6
"""Relative damping of a step of the parameters."""
_FITS = 4
"""Gauss-Newton steps of parameters and of initial states, which begin at the estimate and at logged states."""
_OUTLYING = 3.0
"""Mean squared residual of a window over the median window's; above it the window holds an event of its own."""
_DISTINCT = 1e-3
"""Share of a candidate's squared effect that calibrated parameters cannot imitate; below it the two are one."""
_FEWEST = 12
"""Fewest windows beyond the number of parameters for which a standard error is worth anything."""

CAUSES = {
    "dof_frictionloss": "Coulomb friction",
    "dof_drag": "drag that grows with the square of the speed",
    "dof_damping": "viscous damping",
    "dof_armature": "inertia that goes with the acceleration of a joint",
    "jnt_stiffness": "a spring",
    "actuator_gain": "another gain of the actuator",
    "signal_bias": "an offset of the sensor",
    "gravity": "another gravity",
}
"""What a candidate of each field stands for, in words."""
DELAY = "actions that take effect later, by a delay or a lag of the actuator"
SPACING = "rows that are farther apart in time than the spec says"
INTEGRATION = "the error of the model's integration step"
DRIFT = "a value that changes over the log"
SUSPICIOUS = 2.0
"""|t| from which a term cannot be excluded: 5 % of terms that are not missing reach it by chance."""


@dataclass(frozen=True)
class MissingTerm:
    """A term that the model lacks, as the residuals suggest it.

    Attributes:
        cause: What the term stands for, in words.
        parameter: The parameter of the spec that adds it, as `dof_frictionloss.hinge`; empty if there is none.
        value: Its estimated value, in `unit`: of a parameter its value in the model.
        standard_error: Of the value.
        unit: Unit of the value.
        explained: Share of the squared residuals that it explains, those of initial states and parameters taken away.
        t: Its change from the model over the standard error.
        shifts: By how much each calibrated parameter would move if the term were included, in half-widths of its
            95 % interval.
    """

    cause: str
    parameter: str
    value: float
    standard_error: float
    unit: str
    explained: float
    t: float
    shifts: dict[str, float]


@dataclass(frozen=True)
class _Candidate:
    """A term that is tried: its value in the model, its unit change, and the least value that is physical."""

    cause: str
    parameter: str
    unit: str
    nominal: float
    reference: float
    least: float


def missing_terms(
    dataset: Dataset,
    logged: LoggedStates,
    simulator: Simulator,
    point: Float[np.ndarray, " d"],
    half_widths: Float[np.ndarray, " d"],
    scale: Float[np.ndarray, " observation"],
) -> tuple[tuple[MissingTerm, ...], int]:
    """Candidates that a log is consistent with, the most significant first, and the control steps spent.

    Only terms are returned whose sign is physical, such as friction that takes energy out.

    Args:
        dataset: The log that was calibrated to.
        logged: What it says of states; those must not be `unknown`.
        simulator: The model with its calibrated parameters.
        point: The estimate in [-1, 1]. An estimate that is not at the minimum is led there first, as residuals of wrong
            parameters would pass for missing terms.
        half_widths: Half of each parameter's 95 % interval in [-1, 1].
        scale: Typical change of each signal in a step.
    """
    readings, states, before = _windows(dataset, logged, scale)
    if len(readings) < _FEWEST + len(point):
        return (), 0
    point = _refitted(simulator, readings, states, point)
    added = list(_candidates(dataset, logged, simulator, point, scale))
    space = ParameterSpace((*simulator.parameters.parameters, *(parameter for _, parameter in added)))
    wide = simulation.make(replace(simulator.task, parameters=space))
    at_nominal = np.concatenate([point, -np.ones(len(added))])
    for _ in range(_FITS):
        (around,) = slopes_at(wide, readings, at_nominal[None], states[None], parameters=False)
        fit = eliminate(around, np.ones_like(around.residuals), np.full(len(readings), _STATE_DAMPING))
        moved = states + readings.in_state_units(fit.states_step(np.zeros(0)), states.shape[1])
        better = _costs(readings.residuals(wide, at_nominal[None], moved[None])[0, 0]) < _costs(around.residuals)
        states = np.where((better & around.whole)[:, None], moved, states)
    parameters = _by_calibrated(wide, readings, at_nominal, states, len(point))
    names, effects = _effects(simulator, wide, readings, before, at_nominal, states, added)
    slopes = replace(parameters, by_parameters=np.concatenate([parameters.by_parameters, effects], axis=-1))
    finite = slopes.whole & np.isfinite(effects).all((1, 2))
    columns = 1 + 2 * len(point) + len(readings.spread)
    spent = (_FITS * (2 * columns + 2) + columns + len(names)) * len(readings) * readings.steps
    reduced = _without_states(slopes, readings, finite)
    if reduced is None:
        return (), spent
    terms = _scores(*reduced, simulator.parameters, half_widths, names)
    return tuple(sorted(terms, key=lambda term: -abs(term.t))), spent


def _windows(
    dataset: Dataset, logged: LoggedStates, scale: Float[np.ndarray, " observation"]
) -> tuple[Readings, Float[np.ndarray, "windows state"], Float[np.ndarray, "windows action"]]:
    """Windows that share no observation, guesses of their initial states, and the actions before them."""
    steps = longest_fit(dataset, logged.rows, STEPS)
    later = logged.rows > dataset.episode_starts[dataset.episode_of(logged.rows)]
    rows, states = logged.rows[later], logged.states[later]
    chosen = evenly(disjoint_windows(dataset, rows, steps), WINDOWS) if len(rows) else np.zeros(0, np.int64)
    readings = Readings.at(dataset, logged, rows[chosen], steps, scale)
    return readings, states[chosen], np.asarray(dataset.transitions.action, np.float64)[rows[chosen] - 1]


def _refitted(
    simulator: Simulator,
    readings: Readings,
    states: Float[np.ndarray, "windows state"],
    point: Float[np.ndarray, " d"],
) -> Float[np.ndarray, " d"]:
    """The nearest parameters that explain the windows best; those given if no step of the search helps."""
    damping, best, least = np.full(len(readings), _STATE_DAMPING), point, np.inf
    for _ in range(_FITS):
        (around,) = slopes_at(simulator, readings, point[None], states[None])
        if not around.whole.any():
            break
        fixed = eliminate(around, np.ones_like(around.residuals), damping).reduced.residuals[around.whole]
        cost = float(np.median((fixed**2).mean(-1)))
        if cost < least:
            best, least = point, cost
        scale = scale_of(around.residuals[around.whole], "cauchy")
        weights = loss_slope((around.residuals / scale) ** 2, "cauchy") * around.whole[:, None]
        left = eliminate(around, weights, damping)
        step = damped_step(*triangular_factors(left.reduced, 1.0, "linear"), point, _DAMPING)
        states = states + readings.in_state_units(left.states_step(step), states.shape[1])
        point = point + step
    return best


def _candidates(
    dataset: Dataset,
    logged: LoggedStates,
    simulator: Simulator,
    point: Float[np.ndarray, " d"],
    scale: Float[np.ndarray, " observation"],
) -> Iterator[tuple[_Candidate, Parameter]]:
    """Terms that a spec can add and does not calibrate: one a joint, actuator or sensor.

    The reference of a term is the value with which it would balance the torque that typically accelerates the joint.
    """
    values = simulator.parameters.to_physical(point)
    model, task = simulator.model(values), simulator.task
    nominal_of = partial(nominal_values, model)
    calibrated = {(each.field, element) for each in simulator.parameters.parameters for element in each.elements}
    position, speed = (logged.states[:, : model.nq], logged.states[:, model.nq : model.nq + model.nv])
    change = np.diff(speed, axis=0)[np.diff(logged.rows) == 1]
    acceleration = np.sqrt((change**2).mean(0)) / simulator.control_step if len(change) else np.ones(model.nv)
    for joint in range(model.njnt):
        view = model.joint(joint)
        if len(view.damping) != 1 or not view.name:
            continue
        dof, address = int(view.dofadr[0]), int(view.qposadr[0])
        inertia, fast = float(model.dof_M0[dof]), max(float(np.sqrt((speed[:, dof] ** 2).mean())), 1e-9)
        far = max(float(position[:, address].std()), 1e-9)
        torque = max(inertia * float(acceleration[dof]), 1e-12)
        references = {
            "dof_frictionloss": torque,
            "dof_drag": torque / fast**2,
            "dof_damping": torque / fast,
            "jnt_stiffness": torque / far,
            "dof_armature": inertia,
        }
        for field, reference in references.items():
            if (field, view.name) not in calibrated:
                yield _candidate(nominal_of, field, view.name, reference)
    for channel in task.actions:
        if ("actuator_gain", channel.actuator) not in calibrated:
            gain = abs(float(model.actuator(channel.actuator).gainprm[0])) or 1.0
            yield _candidate(nominal_of, "actuator_gain", channel.actuator, gain)
    if not any(each.field == "gravity" for each in simulator.parameters.parameters) and abs(model.opt.gravity[2]) > 0:
        yield _candidate(nominal_of, "gravity", "", float(abs(model.opt.gravity[2])))
    if task.source is not None:
        for signal, typical in zip(task.signals[: logged.measured], scale, strict=False):
            if ("signal_bias", signal) not in calibrated:
                yield _candidate(nominal_of, "signal_bias", signal, float(typical))


def _candidate(
    nominal_of: Callable[[Parameter], tuple[float, ...]], field: str, element: str, reference: float
) -> tuple[_Candidate, Parameter]:
    """A term, and the parameter whose range begins at its value in the model and is `reference` wide."""
    parameter = Parameter(field, element, 0.0, reference)
    nominal = nominal_of(parameter)[0]
    parameter = replace(parameter, low=nominal, high=nominal + reference)
    kind = FIELDS[field]
    return _Candidate(CAUSES[field], parameter.name, kind.unit, nominal, reference, kind.minimum), parameter


def _by_calibrated(
    wide: Simulator,
    readings: Readings,
    at: Float[np.ndarray, " k"],
    states: Float[np.ndarray, "windows state"],
    count: int,
) -> WindowSlopes:
    """Residuals and their derivatives by the calibrated parameters and the initial states."""
    points = np.concatenate(
        [difference_points(at[:count]), np.broadcast_to(at[count:], (1 + 2 * count, len(at) - count))], axis=1
    )
    by_points = readings.residuals(wide, points, np.repeat(states[None], len(points), axis=0))[:, 0]
    shift = readings.in_state_units(DIFFERENCE * np.eye(len(readings.spread)), states.shape[1])
    by_shifts = readings.residuals(wide, at[None], (states + shift[:, None]).reshape(1, -1, states.shape[1]))[0]
    return slopes_of_windows(points[:, :count], by_points, by_shifts)


def _effects(
    simulator: Simulator,
    wide: Simulator,
    readings: Readings,
    before: Float[np.ndarray, "windows action"],
    at: Float[np.ndarray, " k"],
    states: Float[np.ndarray, "windows state"],
    added: list[tuple[_Candidate, Parameter]],
) -> tuple[list[_Candidate], Float[np.ndarray, "windows values terms"]]:
    """Every candidate and the derivative of the residuals by it, in its reference."""
    count, base = len(added), readings.residuals(wide, at[None], states[None])[0, 0]
    points = np.repeat(at[None], count, axis=0)
    points[np.arange(count), len(at) - count + np.arange(count)] += 2.0 * _CHANGE
    by_candidate = readings.residuals(wide, points, np.repeat(states[None], count, axis=0))[:, 0] - base
    candidates, effects = [candidate for candidate, _ in added], list(by_candidate / _CHANGE)
    point, step = at[: len(at) - count], simulator.control_step
    earlier = np.concatenate([before[:, None], readings.actions[:, :-1]], axis=1)
    late = replace(readings, actions=readings.actions + 0.1 * (earlier - readings.actions))
    stretched = simulation.make(simulator.task.with_time_step(1.0 + _CHANGE))
    finer = simulation.make(simulator.task.with_time_step(0.25, substeps=4))
    for cause, parameter, nominal, reference, least, other, inputs, change in (
        (DELAY, "action_delay", 0.0, step, -np.inf, simulator, late, 0.1),
        (SPACING, "", step, step, 0.0, stretched, readings, _CHANGE),
        (INTEGRATION, "", 0.0, 1.0, -np.inf, finer, readings, 1.0),
    ):
        if any(each.field == parameter for each in simulator.parameters.parameters):
            continue
        moved = inputs.residuals(other, point[None], states[None])[0, 0]
        candidates.append(_Candidate(cause, parameter, "" if cause == INTEGRATION else "s", nominal, reference, least))
        effects.append((moved - base) / change)
    return candidates, np.stack(effects, axis=-1)


def _costs(residuals: Float[np.ndarray, "windows values"]) -> Float[np.ndarray, " windows"]:
    with np.errstate(over="ignore", invalid="ignore"):
        cost = (residuals**2).mean(-1)
    return np.where(np.isfinite(cost), cost, np.inf)


def _without_states(
    slopes: WindowSlopes, readings: Readings, whole: Bool[np.ndarray, " windows"]
) -> tuple[Float[np.ndarray, "kept values"], Float[np.ndarray, "kept values columns"]] | None:
    """Residuals and derivatives in units of the noise that no initial state explains; None if there is nothing left.

    Windows with an event of their own, as a contact that begins, are left out.
    """
    shape = (int(whole.sum()), readings.steps + 1, len(readings.scale))
    if not shape[0] or np.abs(slopes.residuals[whole]).max() < NEGLIGIBLE:
        return None
    damping = np.full(len(whole), _STATE_DAMPING)
    first = eliminate(slopes, np.ones_like(slopes.residuals), damping)
    noise = channel_noise(
        first.reduced.residuals[whole, : shape[1] * shape[2]].reshape(shape), first.spare[whole].reshape(shape)
    )
    left = eliminate(slopes.over(np.tile(noise, shape[1])), np.ones_like(slopes.residuals), damping).reduced
    cost = (left.residuals**2).mean(-1)
    kept = whole & (cost <= _OUTLYING * np.median(cost[whole]))
    return left.residuals[kept], left.jacobian[kept]


def _scores(
    residuals: Float[np.ndarray, "windows values"],
    jacobian: Float[np.ndarray, "windows values columns"],
    space: ParameterSpace,
    half_widths: Float[np.ndarray, " d"],
    candidates: list[_Candidate],
) -> Iterator[MissingTerm]:
    """The score test of every candidate, where residuals leave enough windows for one.

    The first columns of the Jacobian are the calibrated parameters', the others the candidates'. If the error of the
    integration step is significant, it is taken away before the others are tested.
    """
    windows, count = len(residuals), len(space)
    if windows < _FEWEST + count:
        return
    parameters, effects = jacobian[..., :count], jacobian[..., count:]
    explained_already = parameters
    for index in sorted(range(len(candidates)), key=lambda index: candidates[index].cause != INTEGRATION):
        term = _score(residuals, explained_already, effects[..., index], parameters, half_widths, candidates[index])
        if term is None:
            continue
        if term.cause == INTEGRATION and abs(term.t) >= SUSPICIOUS:
            explained_already = np.concatenate([parameters, effects[..., index : index + 1]], axis=-1)
        yield replace(term, shifts=dict(zip(space.names, term.shifts.values(), strict=True)))
    time = np.linspace(-1.0, 1.0, windows)
    for index, name in enumerate(space.names):
        width = float(space.high[index] - space.low[index]) / 2.0
        candidate = _Candidate(DRIFT, name, space.parameters[index].unit, 0.0, width, -np.inf)
        for shape in (time, time < -1.0 / 3.0, time > 1.0 / 3.0):
            effect = (shape - np.mean(shape))[:, None] * parameters[..., index]
            term = _score(residuals, explained_already, effect, parameters, half_widths, candidate)
            if term is not None:
                yield replace(term, shifts={name: term.value / width / float(half_widths[index])})


def _score(
    residuals: Float[np.ndarray, "windows values"],
    explained_already: Float[np.ndarray, "windows values columns"],
    effect: Float[np.ndarray, "windows values"],
    parameters: Float[np.ndarray, "windows values d"],
    half_widths: Float[np.ndarray, " d"],
    candidate: _Candidate,
) -> MissingTerm | None:
    """One candidate's change, its cluster-robust standard error, and how it would move the calibrated parameters.

    None if the columns that explain residuals already imitate the effect, or if the value is not physical.
    """
    windows, count = len(residuals), explained_already.shape[-1]
    basis, _ = np.linalg.qr(explained_already.reshape(-1, count))
    column, y = effect.reshape(-1), residuals.reshape(-1)
    z, y = column - basis @ (basis.T @ column), y - basis @ (basis.T @ y)
    power = float(z @ z)
    if power <= _DISTINCT * float(column @ column):
        return None
    change = -float(z @ y) / power
    scores = (z * (y + change * z)).reshape(windows, -1).sum(-1)
    error = float(np.sqrt((scores**2).sum() * windows / (windows - count - 1))) / power
    value = candidate.nominal + change * candidate.reference
    if not error > 0.0 or value < candidate.least:
        return None
    shift = np.linalg.lstsq(parameters.reshape(len(column), -1), -column * change, rcond=None)[0]
    return MissingTerm(
        cause=candidate.cause,
        parameter=candidate.parameter,
        value=value,
        standard_error=error * candidate.reference,
        unit=candidate.unit,
        explained=change**2 * power / float(y @ y),
        t=change / error,
        shifts={str(index): float(each) for index, each in enumerate(shift / half_widths)},
    )
