"""Warnings that the estimate of any method may need."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float


def at_end_of_range(
    scaled: Float[np.ndarray, " d"], names: tuple[str, ...], *, beyond: float = 0.98
) -> tuple[str, ...]:
    """Warn of estimates, scaled to [-1, 1], whose absolute value is larger than `beyond`."""
    ends = [name for name, value in zip(names, scaled, strict=True) if abs(value) > beyond]
    return (f"at the end of its range: {', '.join(ends)}; widen the range or doubt the model",) if ends else ()


def exploded(failures: int, control_steps: int) -> tuple[str, ...]:
    """Warn of simulated rows, or windows of them, that diverged, if any did."""
    if not failures:
        return ()
    return (
        f"{failures:,} simulated rows or windows exploded, in {control_steps:,} control steps, and were left out; "
        "the ranges may hold impossible parameters",
    )


def without_repeats(warnings: Iterable[str], doubts: Iterable[str]) -> list[str]:
    """The warnings of a method, then the doubts about the data that the method does not state already."""
    own = list(dict.fromkeys(warnings))
    return [*own, *(doubt for doubt in doubts if not any(doubt.endswith(sentence) for sentence in own))]
