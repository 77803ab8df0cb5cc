"""Warnings that the estimate of any method may need."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from madoc.parameters import ParameterSpace


def at_end_of_range(scaled: Float[np.ndarray, " d"], space: ParameterSpace) -> tuple[str, ...]:
    """Warn of estimates, scaled to [-1, 1], that are at an end of their range; see `ParameterSpace.at_end`."""
    ends = space.at_end(scaled)
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
