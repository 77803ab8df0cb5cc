"""Calibratable parameters: their names, units, ranges, and the one map between [-1, 1] and physical values."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from madoc.errors import MadocError


@dataclass(frozen=True)
class Field:
    """What may be written into a model: which kind of element it belongs to, its unit and its physical bound."""

    element: str | None
    unit: str
    minimum: float = -np.inf


FIELDS: dict[str, Field] = {
    "gravity": Field(None, "m/s²"),
    "body_mass": Field("body", "kg", 0.0),
    "body_mass_and_inertia": Field("body", "kg", 0.0),
    "dof_damping": Field("joint", "N·m·s/rad", 0.0),
    "dof_armature": Field("joint", "kg·m²", 0.0),
    "dof_frictionloss": Field("joint", "N·m", 0.0),
    "jnt_stiffness": Field("joint", "N·m/rad", 0.0),
    "geom_friction": Field("geom", "1", 0.0),
    "actuator_gain": Field("actuator", "1"),
}
"""Every field a parameter can name. Units are those of a hinge; a slide joint reads N for N·m and m for rad."""


@dataclass(frozen=True)
class Parameter:
    """One physical quantity of the simulator that may be calibrated, and the range it is searched in.

    Attributes:
        field: A key of `FIELDS`. `body_mass` leaves the inertia as it is (the paper's meaning);
            `body_mass_and_inertia` scales the inertia with the mass.
        element: Name of the body, joint, geom or actuator (a body without a name may be named by its joint);
            empty for gravity.
        low: Lower end of the range, in `unit`.
        high: Upper end of the range, in `unit`.
    """

    field: str
    element: str
    low: float
    high: float

    def __post_init__(self) -> None:
        if self.field not in FIELDS:
            raise MadocError(f"unknown parameter field {self.field!r}; expected one of {', '.join(FIELDS)}")
        kind = FIELDS[self.field]
        if (kind.element is None) != (self.element == ""):
            wanted = "no element" if kind.element is None else f"the name of a {kind.element}"
            raise MadocError(f"parameter field {self.field!r} takes {wanted}, got {self.element!r}")
        if not (np.isfinite(self.low) and np.isfinite(self.high) and self.low < self.high):
            raise MadocError(f"range of {self.name} must be finite with low < high, got [{self.low}, {self.high}]")
        if self.low < kind.minimum:
            raise MadocError(
                f"range of {self.name} starts at {self.low} {kind.unit}, below its physical bound {kind.minimum}"
            )

    @property
    def name(self) -> str:
        """`field.element`, for example `dof_damping.foot_joint`; plain `gravity`."""
        return f"{self.field}.{self.element}" if self.element else self.field

    @property
    def unit(self) -> str:
        """The physical unit of the value and of its range."""
        return FIELDS[self.field].unit


@dataclass(frozen=True)
class ParameterSpace:
    """An ordered box of parameters. The only place that maps the unit cube [-1, 1]^d to physical values."""

    parameters: tuple[Parameter, ...]

    def __post_init__(self) -> None:
        if not self.parameters:
            raise MadocError("a parameter space needs at least one parameter, got none")
        repeated = sorted({name for name in self.names if self.names.count(name) > 1})
        if repeated:
            raise MadocError(f"parameters named twice: {', '.join(repeated)}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names in order, shape (d,)."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def low(self) -> np.ndarray:
        """Lower ends, shape (d,), physical units."""
        return np.array([parameter.low for parameter in self.parameters])

    @property
    def high(self) -> np.ndarray:
        """Upper ends, shape (d,), physical units."""
        return np.array([parameter.high for parameter in self.parameters])

    @property
    def middle(self) -> np.ndarray:
        """Mid-range values, shape (d,): the uncalibrated simulator."""
        return self.to_physical(np.zeros(len(self)))

    def __len__(self) -> int:
        return len(self.parameters)

    def to_physical(self, unit: ArrayLike) -> np.ndarray:
        """Map [-1, 1] to physical units; shape (..., d), float64."""
        return self.low + (np.asarray(unit, dtype=np.float64) + 1.0) * 0.5 * (self.high - self.low)

    def to_unit(self, physical: ArrayLike) -> np.ndarray:
        """Map physical units to [-1, 1]; shape (..., d), float64. The inverse of `to_physical`."""
        return 2.0 * (np.asarray(physical, dtype=np.float64) - self.low) / (self.high - self.low) - 1.0

    def select(self, names: Sequence[str]) -> "ParameterSpace":
        """The same space with only the named parameters, in the order given.

        Raises:
            MadocError: A name is not in the space.
        """
        known = dict(zip(self.names, self.parameters, strict=True))
        missing = [name for name in names if name not in known]
        if missing:
            raise MadocError(f"no parameter {missing[0]!r} here; there are: {', '.join(known)}")
        return replace(self, parameters=tuple(known[name] for name in names))

    def vector(self, values: dict[str, float]) -> np.ndarray:
        """Physical values by name as one vector of shape (d,).

        Raises:
            MadocError: A parameter has no value, or a value names no parameter.
        """
        missing = [name for name in self.names if name not in values]
        extra = [name for name in values if name not in self.names]
        if missing or extra:
            what = f"no value for {missing[0]!r}" if missing else f"unknown parameter {extra[0]!r}"
            raise MadocError(f"{what}; expected values for exactly: {', '.join(self.names)}")
        return np.array([float(values[name]) for name in self.names])
