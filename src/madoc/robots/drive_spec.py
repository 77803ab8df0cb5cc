"""The parts of a spec that say what drives a joint, what gives and resists there, and what differs between runs."""

import re
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from madoc.errors import listed
from madoc.robots.document import Finite, Name, Part, Positive, refuse

Share = Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, le=1e12, allow_inf_nan=False)]
Term = Literal[
    "coulomb",
    "viscous",
    "stribeck",
    "load",
    "load_motor",
    "load_external",
    "stribeck_load",
    "stribeck_load_motor",
    "stribeck_load_external",
    "quadratic_motor",
    "quadratic_external",
]
_BASE: tuple[Term, ...] = ("coulomb", "viscous")
_APART: tuple[Term, ...] = ("load_motor", "load_external", "stribeck_load_motor", "stribeck_load_external")
MODELS: dict[str, tuple[Term, ...]] = {
    "M1": _BASE,
    "M2": (*_BASE, "stribeck"),
    "M3": (*_BASE, "load"),
    "M4": (*_BASE, "stribeck", "load", "stribeck_load"),
    "M5": (*_BASE, "stribeck", *_APART),
    "M6": (*_BASE, "stribeck", *_APART, "quadratic_motor", "quadratic_external"),
}
"""The terms of the models of friction of Duclusaud et al. 2025, by the names they have there."""


class DriveSpec(Part):
    """A d.c. motor, its supply, and the loop that sets its duty."""

    kind: Literal["dc"] = Field(description="A d.c. motor, or a brushless one in its equivalent, geared or not.")
    supply: Positive = Field(description="Voltage, V.")
    kt: Positive = Field(description="Torque constant at the joint, N·m/A, which is also its back-EMF, V·s/rad.")
    resistance: Positive = Field(description="Of the armature and its driver, Ω.")
    gain: Positive | None = Field(None, description="Duty per rad (or rad/s) of error; times the value of gain_from.")
    damping_gain: NotNegative = Field(0.0, description="Duty per rad/s of the joint's speed, which it brakes with.")
    duty_limit: Share = Field(1.0, description="Largest duty, of 1.")
    current_limit: Positive | None = Field(None, description="Largest current, A. Default: none.")
    strength: Positive = Field(1.0, description="Factor on the torque: of gears, magnets and temperature.")
    saturation: NotNegative = Field(0.0, description="Of torque by current, 1/A: at 1/saturation half of it is left.")
    enable: Name | None = Field(None, description="Column of the log: below 0.5 the drive is off, the joint is free.")
    supply_from: Name | None = Field(None, description="Column of the log with the measured supply, V.")
    supply_average: Positive | None = Field(
        None, description="Time over which readings of supply_from around a row are averaged, s. Default: none are."
    )
    gain_from: Name | None = Field(None, description="Condition whose value is the gain set in the firmware.")

    def check(self, means: str) -> None:
        """Refuse a gain that is missing or means nothing, as ValueError, and a command that is none of a drive."""
        refuse(
            means not in ("position", "velocity", "duty"), "expected means: position, velocity or duty beside drive:"
        )
        refuse(means != "duty" and self.gain is None, f"expected gain: of the drive, duty per error of {means}")
        averaged = self.supply_average is not None and self.supply_from is None
        refuse(averaged, "supply_average: means nothing without supply_from:")
        given = [key for key in ("gain", "gain_from") if getattr(self, key) is not None]
        refuse(means == "duty" and bool(given), f"{''.join(given[:1])}: means nothing beside means: duty")


class FrictionSpec(Part):
    """Friction of a joint, or of each of several; a term without a number is calibrated."""

    joint: Name | None = Field(None, description="The joint.")
    joints: list[Name] | None = Field(None, min_length=1, description="Several, each with values of its own.")
    model: Literal["M1", "M2", "M3", "M4", "M5", "M6"] | None = Field(
        None,
        description="M1: Coulomb and viscous. M2: and Stribeck. M3: M1 and in proportion to the load. M4: M2, M3, and "
        "Stribeck by the load. M5: as M4, apart for the motor's and the external torque. M6: and quadratic.",
    )
    terms: list[Term] | None = Field(None, min_length=1, description="The terms, where no model has these.")
    up_to: Positive | None = Field(
        None, description="Largest Coulomb and Stribeck friction, N·m, and viscous friction at 1 rad/s."
    )
    coulomb: NotNegative | None = Field(None, description="N·m.")
    viscous: NotNegative | None = Field(None, description="N·m·s/rad.")
    stribeck: NotNegative | None = Field(None, description="What friction at rest is larger by, N·m.")
    stribeck_speed: Positive | None = Field(None, description="Speed at which 1/e of it is left, rad/s.")
    stribeck_exponent: Positive | None = Field(None, description="How suddenly it falls with the speed.")
    load: NotNegative | None = Field(None, description="Ratio to the torque that the gearbox carries.")
    load_motor: NotNegative | None = Field(None, description="Ratio to the motor's torque.")
    load_external: NotNegative | None = Field(None, description="Ratio to the external torque, as of gravity.")
    stribeck_load: NotNegative | None = Field(None, description="As load, at rest.")
    stribeck_load_motor: NotNegative | None = Field(None, description="As load_motor, at rest.")
    stribeck_load_external: NotNegative | None = Field(None, description="As load_external, at rest.")
    quadratic_motor: NotNegative | None = Field(None, description="At rest, by the square, while driven back; 1/(N·m).")
    quadratic_external: NotNegative | None = Field(None, description="At rest, by the square, while driving; 1/(N·m).")

    @model_validator(mode="after")
    def _consistent(self) -> "FrictionSpec":
        refuse((self.joint is None) == (self.joints is None), "expected either joint: or joints:, got both or neither")
        refuse((self.model is None) == (self.terms is None), "expected either model: or terms:, got both or neither")
        for both in ("load", "stribeck_load"):
            apart = {f"{both}_motor", f"{both}_external"} & {*self.chosen}
            refuse(both in self.chosen and bool(apart), f"{both} is {' and '.join(sorted(apart))} in one; keep one")
        known = [*self.chosen, *self.shape]
        for name in (*Term.__args__, "stribeck_speed", "stribeck_exponent"):  # type: ignore[attr-defined]
            if getattr(self, name) is not None and name not in known:
                raise ValueError(f"{name}: is no term of {self.model or 'these terms'}, which are {listed(known, 20)}")
        return self

    @property
    def chosen(self) -> tuple[Term, ...]:
        """The terms."""
        return MODELS[self.model] if self.model else tuple(self.terms or ())

    @property
    def shape(self) -> tuple[str, ...]:
        """How terms of rest fall with the speed, where there are any."""
        falls = any(term.startswith(("stribeck", "quadratic")) for term in self.chosen)
        return ("stribeck_speed", "stribeck_exponent") if falls else ()

    @property
    def names(self) -> tuple[str, ...]:
        """The joints."""
        return tuple(self.joints or [str(self.joint)])


class GearSpec(Part):
    """What gives between the motor of a joint and its link: a spring with a dead band, and a damper beside it."""

    joint: Name = Field(description="The joint; its armature, friction and actuators are before the gear.")
    stiffness: Positive = Field(
        description="N·m/rad (of a slide, N/m), of teeth, belts or cables outside the backlash."
    )
    damping: NotNegative = Field(description="N·m·s/rad (of a slide, N·s/m).")
    backlash: NotNegative = Field(0.0, description="Whole width of the play, rad (of a slide, m).")
    armature: Positive | None = Field(
        None, description="Inertia of the motor behind its reduction, kg·m² (of a slide, kg). Default: the model's."
    )
    encoder: Literal["motor", "link"] = Field(
        description="Where position and velocity of the joint are measured, for signals and for the loop of its drive."
    )


class ConditionSpec(Part):
    """A number that is the same throughout a run and may differ between runs, as the gain set in a firmware."""

    name: Name = Field(description="What drives and parameters call it; the log's column, without `file_name`.")
    values: list[Finite] = Field(min_length=1, max_length=100, description="All that occur.")
    file_name: Name | None = Field(
        None, description="Text of a log's file name in which * stands for the value, as gain* of gain400_walk.csv."
    )

    @field_validator("file_name")
    @classmethod
    def _one_star(cls, pattern: str | None) -> str | None:
        refuse(pattern is not None and pattern.count("*") != 1, f"expected one * in file_name:, got {pattern!r}")
        return pattern

    def value_in(self, name: str) -> float | None:
        """The value in a file name; None where it has none."""
        before, _, after = (self.file_name or "*").partition("*")
        found = re.search(rf"{re.escape(before)}([-+]?\d+(?:\.\d+)?){re.escape(after)}", name)
        return float(found.group(1)) if found else None

    @model_validator(mode="after")
    def _distinct(self) -> "ConditionSpec":
        refuse(len(set(self.values)) < len(self.values), f"values: of {self.name} has one twice; keep each once")
        return self
