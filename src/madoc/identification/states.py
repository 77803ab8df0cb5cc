"""The simulator states that a log's rows were in, as exactly as the log's observations determine them."""

from dataclasses import dataclass, replace
from typing import Literal

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from madoc.data.dataset import Dataset
from madoc.data.velocities import moving_states
from madoc.errors import MadocError
from madoc.identification.windows import Windows, consecutive_rows, evenly, longest_fit, rows_that_fit, windows_at
from madoc.simulation.base import Simulator
from madoc.simulation.joints import deflection_values, deflections, loaded_deflections
from madoc.simulation.rollout import reset_states
from madoc.simulation.unobserved import Placed, on_the_floor, unseen_values
from madoc.tasks import Task

_PROBED = 64
"""Number of logged actions simulated from a reset where states are unknown; after so many the robot moves, so that
damping, friction and the like have an effect."""

Kind = Literal["exact", "approximate", "unknown"]
SINKING = 0.01
"""Depth in m below the floor that a base is followed to; contacts of robots give way by less."""
STRETCH, BEFORE = 100, 100
"""Number of rows of a stretch in which a base is followed, and of those before it from where on it is."""


@dataclass(frozen=True)
class LoggedStates:
    """The simulator states that a log's rows were in, as exactly as its observations determine them.

    Attributes:
        kind: `exact` where observations determine the states; `approximate` where they show every position and the
            velocities are finite differences of positions; `unknown` where some position is not observed, or no row
            can be rebuilt.
        states: One for each of `rows`. Of an `unknown` log they are initial guesses, with the model's initial value for
            positions that are not observed, and there are none if no position is observed.
        rows: The rows of the log the states belong to, ascending.
        reason: Why the states are not exact, as a sentence; empty if they are.
        physical_size: Number of values of (qpos, qvel), which come first in a state; pending actions follow.
        measured: Number of values of an observation, the first ones, that sensors measured; the others were derived
            from them by finite differences.
        placed: Which values of (qpos, qvel) are places and speeds of bases that no sensor shows, found from contacts.
        in_plane: Which of these are places in the plane, on which nothing depends: they are the model's own.
    """

    kind: Kind
    states: Float[np.ndarray, "states state"]
    rows: Int[np.ndarray, " states"]
    reason: str
    physical_size: int
    measured: int
    placed: Bool[np.ndarray, " physical"]
    in_plane: Bool[np.ndarray, " physical"]

    @property
    def starts_known(self) -> bool:
        """Whether rollouts can start where the log was: at exact states, or at ones approximate in velocity alone."""
        return self.kind != "unknown"

    def exact(self) -> tuple[Float[np.ndarray, "states state"], Int[np.ndarray, " states"]]:
        """The states and their rows.

        Raises:
            MadocError: The states are not exact.
        """
        if self.kind != "exact":
            raise MadocError(self.reason)
        return self.states, self.rows

    def guesses(self) -> tuple[Float[np.ndarray, "states state"], Int[np.ndarray, " states"]]:
        """Initial guesses of the states and their rows, whatever the kind.

        Raises:
            MadocError: No position is observed, or no row can be rebuilt.
        """
        if not len(self.rows):
            raise MadocError(self.reason)
        return self.states, self.rows


def states_of(dataset: Dataset, simulator: Simulator) -> LoggedStates:
    """Rebuild the states of a log as exactly as its observations allow."""
    task = simulator.task
    size = len(simulator.initial_state)
    physical = size - task.pending * simulator.action_size
    derived = task.velocities * (dataset.disturbance.velocities == "differences")
    rebuilt = LoggedStates(
        kind="unknown",
        states=np.zeros((0, size)),
        rows=np.zeros(0, np.int64),
        reason="",
        physical_size=physical,
        measured=task.observation_size - derived,
        placed=np.zeros(physical, bool),
        in_plane=np.zeros(physical, bool),
    )
    try:
        states, rows = logged_states(dataset, task)
        return replace(rebuilt, kind="exact", states=states, rows=rows)
    except MadocError as error:
        rebuilt = replace(rebuilt, reason=str(error))
    if task.state_from_observation is not None or task.posture is None:
        return rebuilt
    here, there = moving_states(dataset, task)
    placed = on_the_floor(task, here)
    guess, gears = completed(simulator, placed.states, there - here)
    try:
        states, rows = with_pending(dataset, task, guess, np.arange(len(dataset)))
    except MadocError as error:
        return replace(rebuilt, reason=str(error))
    if placed.found.any():
        states = _followed(dataset, simulator, states, rows, placed)
    guessed = placed.found[: task.model.nq].copy()
    guessed[gears] = True  # a gear gives little
    unseen = (unseen_values(task) & ~guessed).any()
    kind: Kind = "unknown" if unseen else "approximate"
    in_plane = placed.found & (np.arange(physical) < task.model.nq)
    in_plane[placed.heights] = False
    return replace(rebuilt, kind=kind, states=states, rows=rows, placed=placed.found, in_plane=in_plane)


def completed(
    simulator: Simulator, states: Float[np.ndarray, "rows physical"], change: Float[np.ndarray, "rows physical"]
) -> tuple[Float[np.ndarray, "rows physical"], Int[np.ndarray, " gears"]]:
    """States with what is NaN in them as the model has it, and gears deflected by their load; also which gears are.

    `change` is that of the states in a control step.
    """
    nq = simulator.task.model.nq
    gears = deflection_values(simulator.task.model)[0]
    gears = gears[np.isnan(states[:, gears]).all(0)]
    filled = np.where(np.isnan(states), simulator.initial_state[: states.shape[1]], states)
    if len(gears):
        filled = _with_loaded_gears(simulator, filled, change[:, nq:] / simulator.control_step, gears)
    return filled, gears


def _with_loaded_gears(
    simulator: Simulator,
    states: Float[np.ndarray, "rows physical"],
    acceleration: Float[np.ndarray, "rows velocity"],
    gears: Int[np.ndarray, " gears"],
) -> Float[np.ndarray, "rows physical"]:
    """States with the deflections, at these places, that the gears' loads at mid-range make of the observed motion.

    Where an encoder shows the sum, the motor's shaft is turned back by them, so that the observations stay the same.
    """
    values, model, step = simulator.parameters.middle, simulator.task.model, 1e-3
    chosen = np.isin(deflection_values(model)[0], gears)
    motors = model.jnt_qposadr[deflections(model)[chosen] - 1]  # a gear's joint follows that which it is behind
    probe = np.tile(simulator.initial_state, (1 + 2 * len(gears), 1))
    probe[1 : 1 + len(gears), gears] += step * np.eye(len(gears))
    probe[1 + len(gears) :, gears] += step * np.eye(len(gears))
    probe[1 + len(gears) :, motors] -= step * np.eye(len(gears))
    seen = simulator.bind(values[None]).observe(probe[None])[0]
    alone, both = np.abs(seen[1:] - seen[0]).max(-1).reshape(2, -1)
    deflected = loaded_deflections(simulator.model(values), states, acceleration)[:, chosen]
    loaded = states.copy()
    loaded[:, gears] = deflected
    loaded[:, motors] -= np.where(both < alone / 2.0, deflected, 0.0)
    return loaded


def _followed(
    dataset: Dataset,
    simulator: Simulator,
    states: Float[np.ndarray, "rows state"],
    rows: Int[np.ndarray, " rows"],
    placed: Placed,
) -> Float[np.ndarray, "rows state"]:
    """The states with heights and speeds of bases as the simulator at mid-range leads to them from the row before.

    All other values are the log's at every row, so that an error of these does not last: in a few steps contacts give
    way as much as what they carry weighs (an observer of reduced order, Luenberger 1971). A step that fails, or leads
    farther into the floor than contacts give way, begins anew on it. Stretches of `STRETCH` rows are followed side by
    side, each from `BEFORE` rows before it.
    """
    system, model = simulator.bind(simulator.parameters.middle[None]), simulator.task.model
    action = np.asarray(dataset.transitions.action, np.float64)
    speeds = np.flatnonzero(placed.found[model.nq :]) + model.nq
    columns, followed = np.concatenate([placed.heights, speeds]), states.copy()
    follows = np.zeros(len(rows), bool)
    follows[consecutive_rows(dataset, rows) + 1] = True  # the row before is the one before in the log too
    first = np.maximum.accumulate(np.where(follows, 0, np.arange(len(rows))))
    begins = np.flatnonzero((np.arange(len(rows)) - first) % STRETCH == 0)
    ends, at = np.append(begins[1:], len(rows)), np.maximum(begins - BEFORE, first[begins])
    state = states[at]
    for _ in range(STRETCH + BEFORE):
        going = np.flatnonzero(at + 1 < ends)
        if not len(going):
            break
        after = system.step(state[None, going], action[None, rows[at[going]]])[0]
        at[going] += 1
        now = states[at[going]]
        sunk = (now[:, placed.heights] - after[:, placed.heights] <= SINKING).all(1)
        good = np.isfinite(after).all(1) & sunk
        now[np.ix_(good, columns)] = after[np.ix_(good, columns)]
        state[going] = now
        own = at[going] >= begins[going]
        followed[at[going][own]] = now[own]
    return followed


def logged_states(dataset: Dataset, task: Task) -> tuple[Float[np.ndarray, "states state"], Int[np.ndarray, " states"]]:
    """Simulator states of the rows whose observation determines them, and which rows those are.

    Root positions that never enter the dynamics are 0. Pending actions are those of the rows before, so the first rows
    of an episode have no state if states carry any. Sensors are taken to have no bias; `System.unbiased` corrects it.

    Raises:
        MadocError: The task's observation does not determine its state, or no row can be rebuilt.
    """
    if task.state_from_observation is None:
        wanted = "a state_from_observation" if task.source is None else "signals of every position and velocity"
        raise MadocError(
            f"an observation of {task.name} does not determine its state, so nothing can start at logged "
            f"states; give the task {wanted}, take least-squares, which estimates states where positions are known, or "
            "start rollouts from the task's reset: madoc or oted with starts=policy"
        )
    observation = np.asarray(dataset.transitions.observation, dtype=np.float64)
    rows = np.arange(len(observation))
    if task.rebuildable is not None:
        rows = np.flatnonzero(task.rebuildable(observation))
    if not len(rows):
        raise MadocError(
            f"none of the {len(observation)} logged states of {task.name} can be rebuilt from its "
            f"observation (every row has a clipped value) in {dataset.origin}; start rollouts from the "
            "task's reset"
        )
    rebuilt = np.asarray(task.state_from_observation(observation[rows]), dtype=np.float64)
    return with_pending(dataset, task, rebuilt, rows)


def states_observed_as(
    dataset: Dataset, task: Task, rows: Int[np.ndarray, " rows"], observation: Float[np.ndarray, "all observation"]
) -> Float[np.ndarray, "rows state"]:
    """The states of the given rows had the log's observations been others; NaN where they cannot be rebuilt."""
    other = replace(dataset, transitions=replace(dataset.transitions, observation=observation))
    states, rebuilt = logged_states(other, task)
    place = np.minimum(np.searchsorted(rebuilt, rows), len(rebuilt) - 1)
    return np.where((rebuilt[place] == rows)[:, None], states[place], np.nan)


def with_pending(
    dataset: Dataset, task: Task, states: Float[np.ndarray, "rows physical"], rows: Int[np.ndarray, " rows"]
) -> tuple[Float[np.ndarray, "states state"], Int[np.ndarray, " states"]]:
    """Append the pending actions to (qpos, qvel), and keep the rows whose episode has enough rows before them.

    Raises:
        MadocError: No row has enough rows before it.
    """
    age = rows - dataset.episode_starts[dataset.episode_of(rows)]
    states, rows = states[age >= task.pending], rows[age >= task.pending]
    if not len(rows):
        raise MadocError(
            f"a state of {task.name} carries the {task.pending} actions before it, and no episode of {dataset.origin} "
            "has so many before a row; give it data with its rows in order, or a shorter action_delay or action_lag"
        )
    action = np.asarray(dataset.transitions.action, dtype=np.float64)
    return np.concatenate([states, *(action[rows - back] for back in range(1, task.pending + 1))], axis=-1), rows


def probing_rows(
    logged: LoggedStates, dataset: Dataset, simulator: Simulator
) -> tuple[Float[np.ndarray, "rows state"], Float[np.ndarray, "rows action"]]:
    """States and actions at which to test whether a parameter matters.

    They are the logged ones, exact or approximate. Where states are unknown they are the states that the first logged
    actions lead to from a reset at mid-range parameters: at rest many parameters have no effect.
    """
    action = np.asarray(dataset.transitions.action)
    if logged.starts_known:
        return logged.states, action[logged.rows]
    actions = action.astype(np.float64)[np.arange(_PROBED) % len(dataset)]
    system = simulator.bind(simulator.parameters.middle[None])
    state = first = reset_states(simulator)(jax.random.key(0), 1)[None]
    visited = []
    for taken in actions:
        visited.append(state[0, 0])
        state = system.step(state, taken[None, None])
        state = state if np.isfinite(state).all() else first
    return np.stack(visited), actions


def probing_windows(logged: LoggedStates, dataset: Dataset, simulator: Simulator, *, steps: int, count: int) -> Windows:
    """At most `count` windows from states as in `probing_rows`, each under `steps` logged actions.

    They are shorter if no episode is as long. Where states are unknown the logged observations do not belong to them,
    and only derivatives by the parameters are of use.
    """
    if logged.starts_known:
        steps = longest_fit(dataset, logged.rows, steps)
        chosen = evenly(rows_that_fit(dataset, logged.rows, steps), count)
        return windows_at(dataset, logged.states[chosen], logged.rows[chosen], steps)
    rows = np.arange(len(dataset))
    steps = longest_fit(dataset, rows, steps)
    rows = evenly(rows_that_fit(dataset, rows, steps), min(count, _PROBED))
    states, _ = probing_rows(logged, dataset, simulator)
    return windows_at(dataset, states[evenly(np.arange(_PROBED), len(rows))], rows, steps)
