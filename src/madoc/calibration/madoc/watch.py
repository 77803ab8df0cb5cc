"""Monitoring of Madoc without the truth: the best estimate so far, a stopping rule, and warnings."""

import math
from dataclasses import dataclass, replace

import jax
import numpy as np

from madoc.calibration.base import at_end_of_range
from madoc.calibration.madoc.agents import Actors, AgentSettings
from madoc.parameters import ParameterSpace
from madoc.types import Metrics

SMOOTHING = 0.1
"""Weight of the newest epoch in the exponential moving averages."""
PROGRESS = 0.02
"""Relative decrease of the mismatch that counts as progress. Madoc stops after `patience` epochs without any."""
SETTLING = 30
"""Number of epochs in which discriminators and blur settle; mismatches of those epochs are not compared."""
LEAST_REWARD = 0.7
"""Smallest ratio of the mean |reward| to its set value at which the mismatch of an epoch is used."""
CLOSE = 0.1
"""Relative excess over the lowest mismatch up to which an estimate is as good as the best; the latest one is kept."""
GAIN_SMOOTHING = 0.02
"""Weight of the newest epoch in the averages of what the estimate gains over mid-range: that of about 100 epochs."""
SURE = 2.0
"""Standard errors by which the estimate must gain over mid-range."""
SATURATED = 0.5
"""Share of rows whose reward is at its bound above which a warning is given."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Watch:
    """Running averages over epochs, and the best estimate so far.

    Attributes:
        best: The actors' moving average when the mismatch was last close to its lowest.
        epochs: Number of calibration epochs so far.
        mismatch: Distance of simulated from logged rows in units of the features of s': the blur times the mean
            |reward| over its set value. Without a blur it is the mean |reward|.
        at_bound: Share of rows whose reward is at its bound.
        best_mismatch: The lowest mismatch since they are compared.
        milestone: The mismatch at the last progress.
        milestone_epoch: The epoch of the last progress.
        gain: By how much rows at the actors' mean look more like logged ones than rows at mid-range do, on average.
        gain_squared: Average square of that.
    """

    best: Actors
    epochs: int = 0
    mismatch: float = 0.0
    at_bound: float = 0.0
    best_mismatch: float = 0.0
    milestone: float = 0.0
    milestone_epoch: int = 0
    gain: float = 0.0
    gain_squared: float = 0.0


def observe(watch: Watch, metrics: Metrics, average: Actors, gain: float, settings: AgentSettings) -> Watch:
    """The watch after one more epoch, whose estimate is kept unless an earlier mismatch was clearly lower.

    `gain` is how much more rows at the actors' mean look like logged ones than rows at mid-range do. It counts, and
    mismatches are compared, once the discriminators have settled; mismatches if the mean |reward| is near its set
    value too, or the blur is at its lower limit. Before that, without a blur, and while rewards are at their bound
    under the largest blur, the latest estimate is kept. Without a blur, `metrics` need not have any.
    """
    size, at_bound, steered_to = metrics["reward_size"], metrics["reward_at_bound"], settings.reward_size
    rate = GAIN_SMOOTHING if watch.epochs > SETTLING else 1.0
    mismatch = metrics["blur"] * size / steered_to if steered_to else size
    if watch.epochs:
        mismatch = watch.mismatch + SMOOTHING * (mismatch - watch.mismatch)
        at_bound = watch.at_bound + SMOOTHING * (at_bound - watch.at_bound)
    watch = replace(
        watch,
        epochs=watch.epochs + 1,
        mismatch=mismatch,
        at_bound=at_bound,
        gain=watch.gain + rate * (gain - watch.gain),
        gain_squared=watch.gain_squared + rate * (gain**2 - watch.gain_squared),
    )
    latest = _mark(replace(watch, best=average, best_mismatch=mismatch))
    if not steered_to:
        return latest
    blur = metrics["blur"]
    if watch.epochs <= SETTLING or (blur > 0.99 * settings.largest_blur and at_bound > SATURATED):
        return latest
    if size < LEAST_REWARD * steered_to and blur > 1.01 * settings.smallest_blur:
        return watch
    lowest = min(mismatch, watch.best_mismatch)
    best = average if mismatch <= (1.0 + CLOSE) * lowest else watch.best
    watch = replace(watch, best=best, best_mismatch=lowest)
    return _mark(watch) if mismatch < (1.0 - PROGRESS) * watch.milestone else watch


def _mark(watch: Watch) -> Watch:
    return replace(watch, milestone=watch.mismatch, milestone_epoch=watch.epochs)


def stalled(watch: Watch, patience: int) -> str | None:
    """A sentence once the mismatch has not become smaller for `patience` epochs."""
    waited = watch.epochs - watch.milestone_epoch
    if waited < patience:
        return None
    return f"the mismatch of simulated and logged rows has stayed at {watch.best_mismatch:.3g} for {waited} epochs"


def beats_mid_range(watch: Watch) -> bool:
    """Whether rows at the estimate look more like logged ones than rows at mid-range, beyond what chance may do.

    An exponential average with the rate r has the variance r / (2 - r) of one term.
    """
    variance = max(0.0, watch.gain_squared - watch.gain**2) * GAIN_SMOOTHING / (2.0 - GAIN_SMOOTHING)
    return watch.gain > SURE * math.sqrt(variance)


def settled(watch: Watch) -> bool:
    """Whether the discriminators have had the epochs that they need, and the estimate is better than mid-range."""
    return watch.epochs >= SETTLING and beats_mid_range(watch)


def warnings(watch: Watch, scaled: np.ndarray, space: ParameterSpace) -> tuple[str, ...]:
    """Warnings about the estimate `scaled` (d,) in [-1, 1], one sentence each."""
    sentences = []
    if watch.epochs < SETTLING:
        sentences.append(
            f"{watch.epochs} epochs of calibration are fewer than the {SETTLING} in which the discriminators settle; "
            "give it a larger budget"
        )
    elif not beats_mid_range(watch):
        sentences.append(
            "rows simulated at the estimate do not look more like the log's than rows at mid-range do, so it is no "
            "better than mid-range as far as can be told"
        )
    if watch.at_bound > SATURATED:
        sentences.append(
            f"the discriminators are sure of {watch.at_bound:.0%} of the simulated rows (reward at its bound), "
            "so the reward has no slope; narrow the ranges"
        )
    return *sentences, *at_end_of_range(scaled, space)
