"""Whether the model, anywhere in the box, tells what happens next better than "nothing changes" does."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from scipy.stats import qmc

from madoc.data import Dataset
from madoc.data.findings import Finding
from madoc.diagnosis.channels import Channel, action_names
from madoc.identification.replay import window_residuals
from madoc.identification.windows import HORIZONS, Windows, drawn, longest_fit, rows_that_fit, windows_at
from madoc.simulation import CpuSimulator
from madoc.tasks import Task

WINDOWS = 64
"""Windows replayed, at most."""
CORNERS, DRAWS = 8, 24
HALF = 0.5
"""Share of the live signals from which what no draw explains is the model, not a signal."""
CLEARLY = 0.7
"""A change of the actions that lowers the error below this share is worth a word."""
WORST = 10.0
"""An error relative to "nothing changes" counts as no more."""


@dataclass(frozen=True)
class Explanation:
    """Prediction errors relative to those of "nothing changes": 0 is perfect, from 1 on the model says nothing.

    Attributes:
        horizons: Control steps ahead.
        draws: Parameters tried, in [-1, 1]; the first is mid-range, then corners, then draws from the box.
        errors: By draw, horizon and signal; 1 where the simulation failed, NaN for a signal that never moves.
        control_steps: Simulated.
    """

    horizons: tuple[int, ...]
    draws: Float[np.ndarray, "draws d"]
    errors: Float[np.ndarray, "draws horizons signals"]
    control_steps: int

    @property
    def overall(self) -> Float[np.ndarray, "draws horizons"]:
        """Root mean square over signals, none counting more than tenfold."""
        return np.sqrt(np.nanmean(np.minimum(self.errors, WORST) ** 2, axis=-1))

    @property
    def best(self) -> int:
        """The draw that is best over all horizons."""
        return int(np.argmin(np.log(np.maximum(self.overall, 1e-12)).mean(-1)))


def explain(
    dataset: Dataset,
    simulator: CpuSimulator,
    states: Float[np.ndarray, "states state"],
    rows: Int[np.ndarray, " states"],
    *,
    key: PRNGKeyArray,
) -> Explanation:
    """Replay stretches of the log from its states, at mid-range, in corners and in draws of the box.

    Args:
        dataset: The log.
        simulator: The model.
        states: Rebuilt from the log.
        rows: The rows of the log they were rebuilt from.
        key: Draws the stretches and the box.
    """
    of_windows, of_box = jax.random.split(key)
    steps = longest_fit(dataset, rows, max(HORIZONS))
    chosen = drawn(rows_that_fit(dataset, rows, steps), WINDOWS, of_windows)
    horizons = tuple(horizon for horizon in HORIZONS if horizon <= steps)
    windows = windows_at(dataset, states[chosen], rows[chosen], steps)
    draws = box_draws(len(simulator.parameters), of_box)
    errors = _errors(dataset, simulator, windows, rows[chosen], draws, horizons)
    return Explanation(horizons, draws, errors, len(draws) * len(windows) * steps)


def box_draws(count: int, key: PRNGKeyArray) -> Float[np.ndarray, "draws d"]:
    """Mid-range, some corners, and a scrambled Halton sequence in between."""
    of_corners, of_inside = jax.random.split(key)
    corners = np.array(2.0 * jax.random.bernoulli(of_corners, 0.5, (CORNERS, count)) - 1.0, np.float64)
    seed = int(jax.random.randint(of_inside, (), 0, 2**31 - 1))
    inside = 2.0 * qmc.Halton(count, rng=np.random.default_rng(seed)).random(DRAWS) - 1.0
    return np.concatenate([np.zeros((1, count)), np.unique(corners, axis=0), inside])


def explanation_findings(found: Explanation, channels: tuple[Channel, ...]) -> list[Finding]:
    """Signals that no draw explains: half of them or more, and the model is not this log's."""
    names = [channel.name for channel in channels if channel.kind == "signal"]
    live = ~np.isnan(found.errors).all((0, 1))
    reached = np.full(len(names), np.inf)
    reached[live] = found.errors[..., live].min((0, 1))
    lost = [name for name, error, moves in zip(names, reached, live, strict=True) if moves and error >= 1.0]
    ahead = _ahead(found.horizons)
    remedy = "look at its column, sign and unit in the spec, and at the model"
    if len(lost) >= HALF * live.sum() and lost:
        what = f"no draw from the box tells {', '.join(lost)} {ahead} steps ahead better than 'nothing changes' does"
        return [Finding("fatal", what, "the model", remedy.replace("its column, sign", "columns, signs"))]
    what = f"no draw from the box tells it {ahead} steps ahead better than 'nothing changes' does"
    findings = [Finding("warning", what, name, remedy) for name in lost]
    if not lost and (found.overall[0] >= 1.0).all() and (found.overall.min(0) < 1.0).any():
        findings.append(
            Finding(
                "note", "at mid-range it is no better than 'nothing changes', in parts of the box it is", "the model"
            )
        )
    return findings


def action_findings(
    dataset: Dataset,
    simulator: CpuSimulator,
    states: Float[np.ndarray, "states state"],
    rows: Int[np.ndarray, " states"],
    found: Explanation,
    *,
    key: PRNGKeyArray,
) -> tuple[list[Finding], int]:
    """Whether the log would be explained clearly better with an action reversed, a row later or a row earlier.

    Returns:
        What was found, and the control steps spent.
    """
    task = simulator.task
    horizon = found.horizons[min(1, len(found.horizons) - 1)]
    chosen = drawn(rows_that_fit(dataset, rows, horizon, margin=1), WINDOWS, key)
    if not len(chosen):
        return [], 0
    windows = windows_at(dataset, states[chosen], rows[chosen], horizon)
    best = np.argsort(found.overall[:, min(1, len(found.horizons) - 1)])[:3]
    draws = found.draws[np.unique(np.append(best, 0))]

    def error(actions: np.ndarray) -> float:
        changed = Windows(windows.states, actions, windows.following)
        errors = _errors(dataset, simulator, changed, rows[chosen], draws, (horizon,))
        return float(np.sqrt(np.nanmean(np.minimum(errors, WORST) ** 2, axis=-1)).min())

    plain = error(windows.actions)
    findings, tried = [], 1
    for index, name in enumerate(action_names(task)):
        reversed_actions = _reversed(windows.actions, task, index)
        if reversed_actions is None:
            continue
        tried += 1
        if error(reversed_actions) < CLEARLY * plain:
            what = "with its sign reversed the model explains the log clearly better"
            findings.append(Finding("warning", what, name, "reverse it in the spec or in the log"))
    stretch = rows[chosen][:, None] + np.arange(horizon)
    logged = np.asarray(dataset.transitions.action)
    shifts = {
        -1: ("actions take effect a row later than they are logged", "add the parameter action_delay"),
        1: ("actions take effect a row before they are logged", "log each action with what was seen just before it"),
    }
    for shift, (what, remedy) in shifts.items():
        if task.pending and shift < 0:
            continue
        tried += 1
        if error(logged[stretch + shift]) < CLEARLY * plain:
            findings.append(
                Finding("warning", f"the model explains the log clearly better if {what}", "actions", remedy)
            )
    return findings, tried * len(draws) * len(windows) * horizon


def _errors(
    dataset: Dataset,
    simulator: CpuSimulator,
    windows: Windows,
    rows: Int[np.ndarray, " windows"],
    draws: Float[np.ndarray, "draws d"],
    horizons: tuple[int, ...],
) -> Float[np.ndarray, "draws horizons signals"]:
    width = simulator.task.observation_size
    flat = window_residuals(simulator, windows, draws, np.ones(width))
    at = np.array(horizons) - 1
    residuals = flat.reshape(len(draws), len(windows), windows.steps, width)[:, :, at]
    seen = np.asarray(dataset.transitions.observation)[rows]
    still = windows.following[:, at] - seen[:, None]
    residuals = np.where(np.isfinite(residuals), residuals, still)
    power = (still**2).mean(0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(np.where(power > 0.0, (residuals**2).mean(1) / power, np.nan))


def _reversed(actions: Float[np.ndarray, "windows steps action"], task: Task, index: int) -> np.ndarray | None:
    """The actions with one of them negated in its unit; None where that leaves its range or changes nothing."""
    if task.actions:
        channel = task.actions[index]
        if abs(channel.low + channel.high) > 1e-9 * (channel.high - channel.low):
            return None
    if not actions[..., index].any():
        return None
    changed = actions.copy()
    changed[..., index] *= -1.0
    return changed


def _ahead(horizons: tuple[int, ...]) -> str:
    *first, last = map(str, horizons)
    return f"{', '.join(first)} or {last}" if first else last
