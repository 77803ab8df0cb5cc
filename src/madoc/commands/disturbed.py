"""Options that put into data what real logs suffer from."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from madoc.data import Disturbance


@dataclass(frozen=True)
class Disturbed:
    """What is put into the data; an estimate made from it says so."""

    noise: float = 0.0
    """Observation noise as a share of a step's typical change: 0.1 is 10 %."""
    hide_velocities: bool = False
    """Observations without velocities: states cannot be rebuilt, and methods that need them refuse."""
    velocities: Literal["logged", "differences"] = "logged"
    """differences puts velocities from positions where the data has none; methods that take states for true warn."""
    shuffle: Literal["none", "rows", "next_observations"] = "none"
    """rows loses the order of the rows (s, a, s'); next_observations also which s' belongs to which row."""


def disturbance_of(asked: Disturbed, *, friction: float = 1.0) -> "Disturbance":
    """The options as the data has them."""
    from madoc.data import Disturbance

    return Disturbance(asked.noise, asked.hide_velocities, asked.shuffle, friction, asked.velocities)
