"""Madoc watches itself: is the reward saturated, is it still getting closer, which estimate was best. No truth."""

from dataclasses import dataclass, replace

import jax
import numpy as np

from madoc.calibration.madoc.actors import Actors
from madoc.types import Metrics

SMOOTHING = 0.1
"""Share of an epoch in the running averages."""
PROGRESS = 0.02
"""A mismatch smaller by this share is progress."""
SETTLING = 30
"""Epochs in which discriminators and blur find each other."""
TELLING = 0.7
"""Share of the steered reward size below which a blur is still being found, or can no longer be."""
CLOSE = 0.25
"""A mismatch within this share of the lowest is as good: the later estimate is the better one."""
AT_END = 0.95
"""In [-1, 1], past which a parameter is said to stand at the end of its range: entropy keeps it from the end itself."""
SATURATED = 0.5
"""Share of rows at the reward's bound past which a user is warned."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Watch:
    """Running averages over epochs, and the best estimate so far.

    Attributes:
        epochs: Calibration epochs watched.
        mismatch: How far simulated rows are from logged ones: the blur at which the discriminators would be as
            unsure as they are steered to be (its size times |reward| over what that is steered to), or the mean
            |reward| where there is no blur.
        at_bound: Share of rows whose reward stands at its bound.
        best_mismatch: The lowest `mismatch` since it could be told.
        milestone: The mismatch when it last fell by a share worth the name, ...
        milestone_epoch: ... and when that was.
        best: The actors' moving average when the mismatch was last close to its lowest.
    """

    epochs: int
    mismatch: float
    at_bound: float
    best_mismatch: float
    milestone: float
    milestone_epoch: int
    best: Actors


def begin_watch(actors: Actors) -> Watch:
    """Before the first epoch."""
    return Watch(0, 0.0, 0.0, 0.0, 0.0, 0, actors)


def observe(
    watch: Watch, metrics: Metrics, average: Actors, *, steered_to: float, blur_range: tuple[float, float]
) -> Watch:
    """Take in one epoch; keep its estimate unless the mismatch has been clearly lower.

    A blur says something once the discriminators have settled and it has left its largest; and while they can tell
    at it, that is while the mean |reward| is near the size it is `steered_to` (0 where there is no blur), or the
    blur can become no smaller. Before that, and without a blur, the latest estimate is the best.
    """
    blur, size, at_bound = metrics["blur"], metrics["reward_size"], metrics["reward_at_bound"]
    mismatch = blur * size / steered_to if steered_to else size
    if watch.epochs:
        mismatch = watch.mismatch + SMOOTHING * (mismatch - watch.mismatch)
        at_bound = watch.at_bound + SMOOTHING * (at_bound - watch.at_bound)
    watch = replace(watch, epochs=watch.epochs + 1, mismatch=mismatch, at_bound=at_bound)
    smallest, largest = blur_range
    if not steered_to or watch.epochs <= SETTLING or blur > 0.99 * largest:
        return _mark(replace(watch, best=average, best_mismatch=mismatch))
    if size < TELLING * steered_to and blur > 1.01 * smallest:
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
    return (
        f"the reward has nothing left to say: the mismatch has stayed at {watch.best_mismatch:.3g} for {waited} epochs"
    )


def warnings(watch: Watch, unit: np.ndarray, names: tuple[str, ...]) -> tuple[str, ...]:
    """What a user should know of the estimate `unit` (d,) in [-1, 1], one sentence each."""
    found = []
    if watch.epochs < SETTLING:
        found.append(
            f"{watch.epochs} epochs of calibration are fewer than the {SETTLING} in which the discriminators settle; "
            "give it a larger budget"
        )
    if watch.at_bound > SATURATED:
        found.append(
            f"the discriminators are sure of {watch.at_bound:.0%} of the simulated rows (reward at its bound), "
            "so the reward has no slope; start rollouts at logged states, or narrow the ranges"
        )
    at_end = [name for name, value in zip(names, unit, strict=True) if abs(value) > AT_END]
    if at_end:
        found.append(f"at the end of its range: {', '.join(at_end)}; widen the range or doubt the model")
    return tuple(found)
