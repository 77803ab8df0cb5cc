"""Whether the model, anywhere in the box, predicts the log better than "nothing changes" does."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from scipy.stats import qmc

from madoc.data import Dataset
from madoc.data.findings import Finding
from madoc.diagnosis.channels import Channel
from madoc.identification.replay import window_residuals
from madoc.identification.states import LoggedStates
from madoc.identification.windows import Windows, drawn, horizons, longest_fit, rows_that_fit, windows_at
from madoc.simulation.base import Simulator
from madoc.types import generator

WINDOWS = (16, 64)
"""Smallest and largest number of windows replayed."""
PHYSICS_STEPS = 200_000
"""Number of physics steps of all replays, beyond which there are fewer windows: a heavy model's take their time."""
CORNERS, DRAWS = 8, 24
"""Number of corners of the box of parameters that are tried, and of points inside it."""
HALF = 0.5
"""Share in [0, 1] of the moving signals; if no draw explains so many, the finding is fatal and about the model."""
CLEARLY = 0.7
"""Ratio in [0, 1] of the errors with and without a change of the actions; below it the change is suggested."""
WORST = 10.0
"""Largest error of a signal, relative to that of "nothing changes"; larger ones are clipped to it."""


@dataclass(frozen=True)
class Explanation:
    """Prediction errors relative to those of "nothing changes": 0 is perfect, from 1 on the model is of no use.

    Attributes:
        horizons: Numbers of control steps ahead.
        draws: Parameters tried, in [-1, 1]; the first is mid-range, then corners, then draws from the box.
        errors: By draw, horizon and signal; 1 where the simulation failed, NaN for a signal that never moves.
    """

    horizons: tuple[int, ...]
    draws: Float[np.ndarray, "draws d"]
    errors: Float[np.ndarray, "draws horizons signals"]

    @property
    def overall(self) -> Float[np.ndarray, "draws horizons"]:
        """Root mean square of the errors over signals, each clipped to `WORST`."""
        return np.sqrt(np.nanmean(np.minimum(self.errors, WORST) ** 2, axis=-1))

    @property
    def best(self) -> int:
        """Index of the draw with the smallest geometric mean of the errors over horizons."""
        return int(np.argmin(np.log(np.maximum(self.overall, 1e-12)).mean(-1)))


def explain(
    dataset: Dataset,
    simulator: Simulator,
    logged: LoggedStates,
    draws: Float[np.ndarray, "draws d"],
    *,
    key: PRNGKeyArray,
) -> Explanation:
    """Replay windows of the log from its exact states at each of the draws, in [-1, 1]; the first is mid-range."""
    states, rows = logged.exact()
    lengths = horizons(dataset)
    steps = longest_fit(dataset, rows, max(lengths))
    affordable = PHYSICS_STEPS // (len(draws) * steps * simulator.task.frame_skip)
    chosen = drawn(rows_that_fit(dataset, rows, steps), int(np.clip(affordable, *WINDOWS)), key)
    compared = tuple(length for length in lengths if length <= steps) or (steps,)
    windows = windows_at(dataset, states[chosen], rows[chosen], steps)
    errors = _errors(dataset, simulator, windows, rows[chosen], draws, compared)
    return Explanation(compared, draws, errors)


def box_draws(count: int, key: PRNGKeyArray) -> Float[np.ndarray, "draws d"]:
    """Mid-range, some corners of the box, and a scrambled Halton sequence inside it."""
    random = generator(key)
    corners = 2.0 * random.integers(0, 2, (CORNERS, count)) - 1.0
    inside = 2.0 * qmc.Halton(count, rng=random).random(DRAWS) - 1.0
    return np.concatenate([np.zeros((1, count)), np.unique(corners, axis=0), inside])


def explanation_findings(
    explanation: Explanation, channels: tuple[Channel, ...], exchanged: tuple[Finding, ...]
) -> list[Finding]:
    """Findings on signals that no draw explains; one fatal finding if these are half of the signals or more.

    It says which columns are `exchanged`, if any are found to be.
    """
    names = [channel.name for channel in channels if channel.kind == "signal"]
    live = ~np.isnan(explanation.errors).all((0, 1))
    lost = [name for name, error in zip(names, explanation.errors.min((0, 1)), strict=True) if error >= 1.0]
    better = f"{_ahead(explanation.horizons)} rows ahead better than 'nothing changes' does"
    remedy = "look at its column, sign and unit in the spec, and at the model"
    if lost and len(lost) >= HALF * live.sum():
        what = f"no draw from the box predicts {', '.join(lost)} {better}"
        remedy = remedy.replace("its column, sign", "columns, signs")
        return [Finding("fatal", what, "the model", exchanged[0].what if exchanged else remedy)]
    overall = explanation.overall
    if not lost and (overall[0] >= 1.0).all() and (overall.min(0) < 1.0).any():
        what = "at mid-range it is no better than 'nothing changes', in parts of the box it is"
        return [Finding("note", what, "the model")]
    return [Finding("warning", f"no draw from the box predicts it {better}", name, remedy) for name in lost]


def action_findings(
    dataset: Dataset,
    simulator: Simulator,
    logged: LoggedStates,
    explanation: Explanation,
    *,
    told: Collection[str] = (),
    key: PRNGKeyArray,
) -> list[Finding]:
    """Findings on actions that the model explains clearly better if they are a row later or a row earlier.

    Where actions are told of already they are not tried later.
    """
    task, (states, rows) = simulator.task, logged.exact()
    at = min(1, len(explanation.horizons) - 1)
    horizon = explanation.horizons[at]
    chosen = drawn(rows_that_fit(dataset, rows, horizon, margin=1), WINDOWS[1], key)
    if not len(chosen):
        return []
    windows = windows_at(dataset, states[chosen], rows[chosen], horizon)
    best = np.argsort(explanation.overall[:, at])[:3]
    draws = explanation.draws[np.unique(np.append(best, 0))]

    def error(actions: np.ndarray) -> float:
        changed = Windows(windows.states, actions, windows.following)
        errors = _errors(dataset, simulator, changed, rows[chosen], draws, (horizon,))
        return float(np.sqrt(np.nanmean(np.minimum(errors, WORST) ** 2, axis=-1)).min())

    changes = []
    action, stretch = np.asarray(dataset.transitions.action), rows[chosen][:, None] + np.arange(horizon)
    later = "a row later than they are logged", "add the parameter action_delay"
    earlier = "a row before they are logged", "log each action with what was seen just before it"
    for shift, (when, remedy) in ((-1, later), (1, earlier)):
        if shift > 0 or not (task.pending or told):
            what = f"the model explains the log clearly better if actions take effect {when}"
            changes.append((action[stretch + shift], Finding("warning", what, "actions", remedy)))
    plain = error(windows.actions)
    return [finding for actions, finding in changes if error(actions) < CLEARLY * plain]


def _errors(
    dataset: Dataset,
    simulator: Simulator,
    windows: Windows,
    rows: Int[np.ndarray, " windows"],
    draws: Float[np.ndarray, "draws d"],
    compared: tuple[int, ...],
) -> Float[np.ndarray, "draws horizons signals"]:
    width = simulator.task.observation_size
    flat = window_residuals(simulator, windows, draws, np.ones(width))
    at = np.array(compared) - 1
    residuals = flat.reshape(len(draws), len(windows), windows.steps, width)[:, :, at]
    seen = np.asarray(dataset.transitions.observation)[rows]
    still = windows.following[:, at] - seen[:, None]
    residuals = np.where(np.isfinite(residuals), residuals, still)
    power = (still**2).mean(0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(np.where(power > 0.0, (residuals**2).mean(1) / power, np.nan))


def _ahead(horizons: tuple[int, ...]) -> str:
    *first, last = map(str, horizons)
    return f"{', '.join(first)} or {last}" if first else last
