"""Disturbances of logged data, as options of the command line and as they are kept with the data."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Suppress, arg

from madoc.errors import MadocError

Shuffled = Literal["none", "rows", "next_observations"]
Velocities = Literal["logged", "differences"]


@dataclass(frozen=True)
class Disturbance:
    """Disturbances put into the data, to try methods; of a machine's log only --velocities may be of use.

    An estimate made from it names them in its warnings.
    """

    noise: float = 0.0
    """Observation noise as a share of a step's typical change: 0.1 is 10 %."""
    hidden_velocities: Annotated[bool, arg(name="hide-velocities")] = False
    """Observations without velocities: states cannot be rebuilt, and methods that need them refuse."""
    shuffled: Annotated[Shuffled, arg(name="shuffle")] = "none"
    """rows loses the order of the rows (s, a, s'); next_observations also which s' belongs to which row."""
    friction: Suppress[float] = 1.0
    """Friction of the target's contacts as a multiple of the model's: a gap that no parameter closes."""
    velocities: Velocities = "logged"
    """differences puts velocities from positions where the data has none; methods that take states for true warn."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.noise) and self.noise >= 0):
            raise MadocError(f"expected noise as a share of a step's change, 0 or more, got {self.noise}")
        if not (math.isfinite(self.friction) and self.friction > 0):
            raise MadocError(f"expected friction as a positive multiple of the model's, got {self.friction}")

    def joined(self, other: "Disturbance") -> "Disturbance":
        """This disturbance followed by another one."""
        return Disturbance(
            noise=math.hypot(self.noise, other.noise),
            hidden_velocities=self.hidden_velocities or other.hidden_velocities,
            shuffled=other.shuffled if self.shuffled == "none" else self.shuffled,
            friction=self.friction * other.friction,
            velocities=other.velocities if self.velocities == "logged" else self.velocities,
        )

    def sentences(self) -> tuple[str, ...]:
        """Warnings for an estimate made from the data, one for each disturbance."""
        sentences = []
        if self.noise:
            sentences.append(
                f"the data carries observation noise of {100 * self.noise:g} % of a step's change: states rebuilt from "
                "it are not exact, and methods that take them for true are biased"
            )
        if self.velocities == "differences":
            sentences.append(
                "the data's velocities are differences of positions: states rebuilt from them are not exact, and "
                "methods that take them for true are biased"
            )
        elif self.hidden_velocities:
            sentences.append(
                "the data hides velocities: its states cannot be rebuilt, and a clone acts on positions alone"
            )
        if self.shuffled == "rows":
            sentences.append("the data's rows are in random order: nothing longer than one row can be replayed")
        if self.shuffled == "next_observations":
            sentences.append(
                "the data's next observations are not those of their rows: only their distribution is known"
            )
        if self.friction != 1.0:
            sentences.append(
                f"the target's friction is {self.friction:g} times the simulator's: the estimate will make up for it"
            )
        return tuple(sentences)
