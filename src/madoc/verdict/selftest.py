"""A selftest: could this data find a truth? One is planted in the same model, the logged actions replayed in it."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem, Calibrator
from madoc.calibration.calibrate import calibrate
from madoc.calibration.result import CalibrationResult
from madoc.data import Dataset, Disturbance, disturb, hide_velocities
from madoc.data.dataset import starts_after
from madoc.errors import MadocError
from madoc.identification.states import logged_states
from madoc.simulation.base import Simulator
from madoc.simulation.rollout import reset_states
from madoc.types import Transitions

RECOVERABLE = 10.0
"""% of its range that a parameter may be off: a fifth of what mid-range is off at worst."""
INNER = 0.8
"""Planted truths lie in this share of [-1, 1], so that none is found by standing at the end of its range."""
STRETCH = 25
"""Control steps after which a replay begins anew at a logged state: open-loop, it would leave where the robot was."""
LONGEST = 1000
"""Control steps of a replay from the reset, where no logged state can be rebuilt."""


@dataclass(frozen=True)
class Planted:
    """One parameter of one planted truth, the first being 1; `interval` and `covered` where the method says one."""

    name: str
    unit: str
    truth: int
    planted: float
    found: float
    percent_of_range: float
    interval: list[float] | None = None
    covered: bool | None = None


@dataclass(frozen=True)
class Selftest:
    """What a selftest showed.

    Attributes:
        method: What was run.
        rows: Every parameter of every planted truth.
        recoverable: Names of parameters that were found every time.
        sentence: The same in words.
        noise: Put on the planted data, by signal, in its unit.
        control_steps: Simulated, of all runs.
    """

    method: str
    rows: tuple[Planted, ...]
    recoverable: tuple[str, ...]
    sentence: str
    noise: dict[str, float]
    control_steps: int

    @property
    def passed(self) -> bool:
        """Whether every parameter is recoverable."""
        return set(self.recoverable) == {row.name for row in self.rows}

    def to_json(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self) | {"passed": self.passed}


def plant(
    dataset: Dataset,
    simulator: Simulator,
    truth: Float[np.ndarray, " d"],
    *,
    noise: Float[np.ndarray, " observation"],
    key: PRNGKeyArray,
) -> Dataset:
    """The log as it would be if the simulator at `truth` were the robot: its actions, its starts, its noise.

    From a logged state every `STRETCH` rows; where none can be rebuilt, from resets at the beginning of each episode.
    Every replay is an episode, and ends where its simulation failed or the task ended. Where the log's velocities are
    differences of its positions, so are the planted ones.

    Args:
        dataset: Whose actions.
        simulator: What is planted in.
        truth: Physical values.
        noise: Deviation of the sensors' noise, in their units.
        key: Of the resets and the noise.

    Raises:
        MadocError: Not one row could be simulated.
    """
    of_start, of_noise = jax.random.split(key)
    system, task = simulator.bind(truth[None]), simulator.task
    if task.state_from_observation is None:
        first = dataset.episode_starts
        lengths = np.minimum(dataset.episode_ends - first, LONGEST)
        state = reset_states(simulator)(of_start, len(first))[None]
    else:
        states, rows = logged_states(dataset, task)
        chosen, lengths = _stretches(dataset, rows)
        first = rows[chosen]
        state = system.unbiased(states[None, chosen])
    logged = np.asarray(dataset.transitions.action)
    alive, frames = np.ones(len(first), dtype=bool), []
    for step in range(int(lengths.max())):
        action = logged[np.minimum(first + step, len(logged) - 1)][None]
        after = system.step(state, action)
        alive = alive & (step < lengths) & np.isfinite(after[0]).all(-1)
        safe = np.where(alive[None, :, None], after, state)
        ended = np.asarray(task.terminated(safe))[0] & alive
        frames.append((system.observe(state)[0], action[0], system.observe(safe)[0], ended, alive))
        alive, state = alive & ~ended, safe
    before, action, following, ended, valid = (np.swapaxes(np.stack(part), 0, 1) for part in zip(*frames, strict=True))
    if not valid.any():
        raise MadocError(f"{task.name}: no logged action could be simulated at a planted truth; check the ranges")
    drawn = np.asarray(jax.random.normal(of_noise, (len(first), before.shape[1] + 1, len(noise))), np.float64) * noise
    rows_at = [column[valid] for column in (before + drawn[:, :-1], action, following + drawn[:, 1:], ended)]
    last = valid & ~np.pad(valid, ((0, 0), (0, 1)))[:, 1:]
    ends = last[valid]
    zeros = np.zeros(len(ends))
    transitions = Transitions(rows_at[0], rows_at[1], zeros, rows_at[2], rows_at[3], ends & ~rows_at[3])
    origin = f"planted in {dataset.origin}"
    planted = Dataset(transitions, starts_after(ends), task.name, task.physics, origin, None, Disturbance())
    if dataset.disturbance.velocities != "differences":
        return planted
    # Of a robot of one's own velocities were put in behind its signals; the others show them by themselves.
    shown, hidden = (task, True) if task.source is None else (hide_velocities(task), False)
    if not hidden:
        seen = slice(shown.observation_size)
        cut = replace(
            transitions,
            observation=transitions.observation[:, seen],
            next_observation=transitions.next_observation[:, seen],
        )
        planted = replace(planted, transitions=cut)
    asked = Disturbance(hidden_velocities=hidden, velocities="differences")
    return replace(disturb(planted, asked, shown, of_noise), disturbance=Disturbance(velocities="differences"))


def selftest(
    methods: Sequence[Calibrator],
    dataset: Dataset,
    simulator: Simulator,
    *,
    noise: Float[np.ndarray, " observation"],
    signals: Sequence[str],
    keys: Sequence[PRNGKeyArray],
    budget: int,
    quiet: bool = True,
) -> Selftest:
    """Plant a truth a key, and calibrate to what it makes of the log with the first method that does not refuse.

    Raises:
        MadocError: Every method refuses, or nothing can be planted.
    """
    space, found, spent = simulator.parameters, [], 0
    name = ""
    for index, key in enumerate(keys, 1):
        of_truth, of_plant, of_method = jax.random.split(key, 3)
        truth = space.to_physical(
            np.asarray(jax.random.uniform(of_truth, (len(space),), minval=-INNER, maxval=INNER), np.float64)
        )
        problem = CalibrationProblem(plant(dataset, simulator, truth, noise=noise, key=of_plant), simulator)
        method = _first_willing(methods, problem, of_method)
        result = calibrate(method, problem, key=of_method, budget=budget, quiet=quiet)
        if result.status == "interrupted":
            raise KeyboardInterrupt  # what was broken off says nothing of the data
        if result.status == "diverged":
            raise MadocError(f"truth {index} could not be looked for: {result.sentence}")
        name, spent = result.method, spent + result.control_steps
        found += _rows(result, truth, index)
    worst = {
        parameter: max(row.percent_of_range for row in found if row.name == parameter) for parameter in space.names
    }
    recoverable = tuple(parameter for parameter, off in worst.items() if off <= RECOVERABLE)
    return Selftest(
        method=name,
        rows=tuple(found),
        recoverable=recoverable,
        sentence=_sentence(worst, recoverable, len(keys)) + _of_intervals(found),
        noise=dict(zip(signals, noise.tolist(), strict=True)),
        control_steps=spent,
    )


def _stretches(dataset: Dataset, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions in `rows` at which replays begin, and how long each is."""
    episode = dataset.episode_of(rows)
    chosen, lengths, until = [], [], -1
    for position, (row, end) in enumerate(zip(rows, dataset.episode_ends[episode], strict=True)):
        if row >= until:
            length = min(STRETCH, int(end - row))
            chosen.append(position)
            lengths.append(length)
            until = row + length
    return np.array(chosen), np.array(lengths)


def _first_willing(methods: Sequence[Calibrator], problem: CalibrationProblem, key: PRNGKeyArray) -> Calibrator:
    refusal: MadocError | None = None
    for method in methods:
        try:
            method.init(problem, key)
        except MadocError as error:
            refusal = refusal or error
            continue
        return method
    raise refusal or MadocError("expected at least one method, got none")


def _rows(result: CalibrationResult, truth: np.ndarray, index: int) -> list[Planted]:
    rows = []
    for (name, row), value in zip(result.parameters.items(), truth.tolist(), strict=True):
        covered = None if row.interval is None else row.interval[0] <= value <= row.interval[1]
        percent = 100.0 * abs(row.estimate - value) / (row.high - row.low)
        rows.append(Planted(name, row.unit, index, value, row.estimate, percent, row.interval, covered))
    return rows


def _sentence(worst: dict[str, float], recoverable: tuple[str, ...], truths: int) -> str:
    planted = "the planted truth" if truths == 1 else f"each of {truths} planted truths"
    if len(recoverable) == len(worst):
        off = max(worst.values())
        return (
            f"this data could find every parameter: {planted} came back to within {off:.2g} % of its range "
            f"(at most {RECOVERABLE:g} % is asked)"
        )
    lost = ", ".join(f"{name} ({off:.0f} %)" for name, off in worst.items() if name not in recoverable)
    return (
        f"this data could not find {lost} in {planted} to within {RECOVERABLE:g} % of the range; do not believe a "
        "calibration of it: leave it out, or log motions that excite it"
    )


def _of_intervals(rows: Sequence[Planted]) -> str:
    """How many of a method's intervals hold the truth, where it has any."""
    covered = [row.covered for row in rows if row.covered is not None]
    return f"; {sum(covered)} of {len(covered)} 95 % intervals hold the truth" if covered else ""
