"""Sentences that any method may have to say of its estimate."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

_AT_END = 0.98
"""Of [-1, 1]: from here on an estimate stands at the end of its range."""


def at_end_of_range(unit: Float[np.ndarray, " d"], names: tuple[str, ...]) -> tuple[str, ...]:
    """Which estimates in [-1, 1] stand at an end."""
    found = [name for name, value in zip(names, unit, strict=True) if abs(value) > _AT_END]
    return (f"at the end of its range: {', '.join(found)}; widen the range or doubt the model",) if found else ()


def exploded(failures: int, control_steps: int) -> tuple[str, ...]:
    """How many simulated rows failed."""
    if not failures:
        return ()
    return (
        f"{failures} of {control_steps:,} simulated rows exploded and were left out; "
        "the ranges may hold impossible parameters",
    )


def told_once(warnings: Iterable[str], doubts: Iterable[str]) -> list[str]:
    """What a method and what the data's check warn of; what both do only in the method's words."""
    own = list(dict.fromkeys(warnings))
    return [*own, *(doubt for doubt in doubts if not any(doubt.endswith(sentence) for sentence in own))]
