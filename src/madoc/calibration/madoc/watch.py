"""Monitoring of Madoc without the truth: the best estimate so far, a stopping rule, and warnings."""

from dataclasses import dataclass, replace

import jax
import numpy as np

from madoc.calibration.cautions import at_end_of_range
from madoc.calibration.madoc.actors import Actors
from madoc.types import Metrics

SMOOTHING = 0.1
"""Weight of the newest epoch in the exponential moving averages."""
PROGRESS = 0.02
"""Relative decrease of the mismatch that counts as progress. Madoc stops after `patience` epochs without any."""
SETTLING = 30
"""Number of epochs in which discriminators and blur settle; mismatches of those epochs are not compared."""
LEAST_REWARD = 0.7
"""Smallest ratio of the mean |reward| to its set value at which the mismatch of an epoch is used."""
CLOSE = 0.25
"""Relative excess over the lowest mismatch up to which an estimate is as good as the best; the latest one is kept."""
AT_END = 0.95
"""Absolute value in [-1, 1] above which a warning names the parameter; entropy keeps estimates below 1."""
SATURATED = 0.5
"""Share of rows whose reward is at its bound above which a warning is given."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Watch:
    """Running averages over epochs, and the best estimate so far.

    Attributes:
        epochs: Number of calibration epochs so far.
        mismatch: Distance of simulated from logged rows in typical changes of a signal: the blur times the mean
            |reward| over its set value. Without a blur it is the mean |reward|.
        began: Epoch from which mismatches are of the same features of s'.
        overlap: Mean overlap of logged and simulated (s, a).
        at_bound: Share of rows whose reward is at its bound.
        best_mismatch: The lowest mismatch since they are compared.
        milestone: The mismatch at the last progress.
        milestone_epoch: The epoch of the last progress.
        best: The actors' moving average when the mismatch was last close to its lowest.
    """

    epochs: int
    mismatch: float
    began: int
    overlap: float
    at_bound: float
    best_mismatch: float
    milestone: float
    milestone_epoch: int
    best: Actors


def begin_watch(actors: Actors) -> Watch:
    """The watch before the first epoch."""
    return Watch(0, 0.0, 0, 0.0, 0.0, 0.0, 0.0, 0, actors)


def begin_again(watch: Watch) -> Watch:
    """The watch where discriminators go on to other features of s', with which earlier mismatches do not compare."""
    return _mark(replace(watch, began=watch.epochs))


def overlaps(watch: Watch, least: float) -> bool:
    """Whether discriminators have settled, and simulated rows are where logged ones are."""
    return settled(watch) and watch.overlap >= least


def observe(
    watch: Watch,
    metrics: Metrics,
    average: Actors,
    *,
    steered_to: float,
    blur_range: tuple[float, float],
    unit: float = 1.0,
) -> Watch:
    """The watch after one more epoch, whose estimate is kept unless an earlier mismatch was clearly lower.

    `unit` is the unit of the blur in typical changes of a signal. Without a blur, `metrics` need not have any.

    Mismatches are compared once the discriminators have settled, provided that the mean |reward| is near `steered_to`,
    its set value, or the blur is at its lower limit. Before that, without a blur (`steered_to` is then 0), and while
    rewards are at their bound under the largest blur, the latest estimate is kept.
    """
    size, at_bound = metrics["reward_size"], metrics["reward_at_bound"]
    mismatch = unit * metrics["blur"] * size / steered_to if steered_to else size
    overlap = metrics["overlap"]
    if watch.epochs > watch.began:
        mismatch = watch.mismatch + SMOOTHING * (mismatch - watch.mismatch)
        at_bound = watch.at_bound + SMOOTHING * (at_bound - watch.at_bound)
        overlap = watch.overlap + SMOOTHING * (overlap - watch.overlap)
    watch = replace(watch, epochs=watch.epochs + 1, mismatch=mismatch, overlap=overlap, at_bound=at_bound)
    latest = _mark(replace(watch, best=average, best_mismatch=mismatch))
    if not steered_to:
        return latest
    (smallest, largest), blur = blur_range, metrics["blur"]
    if watch.epochs - watch.began <= SETTLING or (blur > 0.99 * largest and at_bound > SATURATED):
        return latest
    if size < LEAST_REWARD * steered_to and blur > 1.01 * smallest:
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


def settled(watch: Watch) -> bool:
    """Whether the discriminators, which begin anew with other features of s', have had the epochs that they need."""
    return watch.epochs - watch.began >= SETTLING


def warnings(
    watch: Watch, scaled: np.ndarray, names: tuple[str, ...], *, may_start_logged: bool = False
) -> tuple[str, ...]:
    """Warnings about the estimate `scaled` (d,) in [-1, 1], one sentence each.

    `may_start_logged` says that rollouts start at resets and could start at logged states.
    """
    sentences = []
    if not settled(watch):
        sentences.append(
            f"{watch.epochs - watch.began} epochs of calibration {'with innovations ' * (watch.began > 0)}are fewer "
            f"than the {SETTLING} in which the discriminators settle; give it a larger budget"
        )
    if watch.at_bound > SATURATED:
        sentences.append(
            f"the discriminators are sure of {watch.at_bound:.0%} of the simulated rows (reward at its bound), "
            f"so the reward has no slope; {'start rollouts at logged states, or ' * may_start_logged}narrow the ranges"
        )
    return *sentences, *at_end_of_range(scaled, names, beyond=AT_END)
