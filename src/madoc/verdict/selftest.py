"""A selftest: would this data recover true parameters? They are chosen, and the logged actions replayed under them."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem, Calibrator
from madoc.calibration.calibrate import calibrate
from madoc.calibration.result import CalibrationResult
from madoc.data import Dataset, Disturbance, disturb, hide_velocities, stride
from madoc.data.dataset import starts_after
from madoc.errors import MadocError
from madoc.identification.states import states_of
from madoc.identification.windows import successive_windows
from madoc.runs.budget import Budget
from madoc.simulation.base import Simulator
from madoc.simulation.rollout import reset_states
from madoc.tasks import Task
from madoc.types import Transitions

RECOVERABLE = 10.0
"""Largest error of a recovered parameter in % of its range: a fifth of the largest error of mid-range."""
INNER = 0.8
"""Largest |parameter| of a planted truth in [-1, 1], so that none is recovered by being at the end of its range."""
STRETCH = 25
"""Largest number of strides of a replay from a logged state; a longer one would leave the logged motion."""
LONGEST = 1000
"""Largest number of control steps of a replay from a reset, where states cannot be rebuilt."""


@dataclass(frozen=True)
class Planted:
    """One parameter of one planted truth, counted from 1; the last two are None where a method gives no intervals."""

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
    """Whether calibrations to planted data recovered what was planted, of every parameter and every truth in `rows`.

    `recoverable` parameters were recovered every time; `noise` is what was put on the planted signals, in their units.
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

    def to_json(self) -> dict[str, object]:
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

    Replays begin at a logged state every `STRETCH` strides; where states cannot be rebuilt, at a reset for each
    episode. Every replay is an episode, and ends where its simulation failed or the task ended. Where the log's
    velocities are finite differences of its positions, so are the planted ones.

    `truth` are physical parameters, `noise` is the standard deviation of the sensors' noise in their units.

    Raises:
        MadocError: Not one row could be simulated.
    """
    of_start, of_noise = jax.random.split(key)
    system, task = simulator.bind(truth[None]), simulator.task
    states = states_of(dataset, simulator)
    if states.kind != "exact":
        first = dataset.episode_starts
        lengths = np.minimum(dataset.episode_ends - first, LONGEST)
        state = reset_states(simulator)(of_start, len(first))[None]
    else:
        chosen, lengths = successive_windows(dataset, states.rows, STRETCH * stride(dataset))
        first = states.rows[chosen]
        state = system.unbiased(states.states[None, chosen])
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
    shape = len(first), before.shape[1] + 1, len(noise)
    drawn = np.asarray(jax.random.normal(of_noise, shape), np.float64) * noise
    ends, terminated = (valid & ~np.pad(valid, ((0, 0), (0, 1)))[:, 1:])[valid], ended[valid]
    transitions = Transitions(
        (before + drawn[:, :-1])[valid],
        action[valid],
        np.zeros(len(ends)),
        (following + drawn[:, 1:])[valid],
        terminated,
        ends & ~terminated,
    )
    origin = f"planted in {dataset.origin}"
    planted = Dataset(transitions, starts_after(ends), task.name, task.physics, origin, None, Disturbance())
    return planted if dataset.disturbance.velocities != "differences" else _with_differences(planted, task, of_noise)


def _with_differences(planted: Dataset, task: Task, key: PRNGKeyArray) -> Dataset:
    """The dataset with velocities that are finite differences of positions in place of the simulated ones."""
    # For a robot of one's own velocities were added behind its signals; the other robots observe them by themselves.
    shown, hidden = (task, True) if task.source is None else (hide_velocities(task), False)
    if not hidden:
        rows, seen = planted.transitions, slice(shown.observation_size)
        cut = replace(rows, observation=rows.observation[:, seen], next_observation=rows.next_observation[:, seen])
        planted = replace(planted, transitions=cut)
    asked = Disturbance(hidden_velocities=hidden, velocities="differences")
    return replace(disturb(planted, asked, shown, key), disturbance=Disturbance(velocities="differences"))


def selftest(
    methods: Sequence[Calibrator[Any]],
    dataset: Dataset,
    simulator: Simulator,
    *,
    noise: Float[np.ndarray, " observation"],
    signals: Sequence[str],
    keys: Sequence[PRNGKeyArray],
    budget: Budget | str | None = None,
    quiet: bool = True,
) -> Selftest:
    """Plant one truth for each key, and calibrate to its data with the first method that does not refuse it.

    Raises:
        MadocError: Every method refuses, or nothing can be planted.
    """
    space, rows, spent, name = simulator.parameters, list[Planted](), 0, ""
    for index, key in enumerate(keys, 1):
        of_truth, of_plant, of_method = jax.random.split(key, 3)
        truth = space.to_physical(
            np.asarray(jax.random.uniform(of_truth, (len(space),), minval=-INNER, maxval=INNER), np.float64)
        )
        problem = CalibrationProblem(plant(dataset, simulator, truth, noise=noise, key=of_plant), simulator)
        method = _first_willing(methods, problem, of_method)
        result = calibrate(method, problem, key=of_method, budget=budget, quiet=quiet)
        if result.status == "interrupted":
            raise KeyboardInterrupt  # an interrupted calibration is no test of the data
        if result.status == "diverged":
            raise MadocError(f"truth {index} could not be calibrated to: {result.sentence}")
        name, spent = result.method, spent + result.control_steps
        rows += _rows(result, truth, index)
    worst = {parameter: max(row.percent_of_range for row in rows if row.name == parameter) for parameter in space.names}
    recoverable = tuple(parameter for parameter, off in worst.items() if off <= RECOVERABLE)
    return Selftest(
        method=name,
        rows=tuple(rows),
        recoverable=recoverable,
        sentence=_sentence(worst, recoverable, len(keys)) + _of_intervals(rows),
        noise=dict(zip(signals, noise.tolist(), strict=True)),
        control_steps=spent,
    )


def _first_willing(
    methods: Sequence[Calibrator[Any]], problem: CalibrationProblem, key: PRNGKeyArray
) -> Calibrator[Any]:
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
    """How many of a method's intervals contain the truth, where it gives any."""
    covered = [row.covered for row in rows if row.covered is not None]
    return f"; {sum(covered)} of {len(covered)} 95 % intervals hold the truth" if covered else ""
