"""Parameters that can be calibrated: their names, units and ranges, and their scaling to [-1, 1]."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, PRNGKeyArray
from numpy.typing import ArrayLike

from madoc.errors import MadocError, nearest_hint


@dataclass(frozen=True)
class Field:
    """A kind of parameter; its place in the model is in `simulation/write.py`.

    Attributes:
        element: `body`, `joint`, `geom`, `actuator`, `signal` or `action`; None for a parameter of the whole robot.
        unit: The unit; of a field of joints, that for a hinge.
        slide_unit: The unit for a slide joint, where it is another.
        minimum: Smallest value that is physically possible.
        maximum: Largest size of a value that any robot may have.
        missing: What a model lacks that has no such term, in words; empty where nobody looks for that.
        in_model: Whether the value is written into the MuJoCo model; if not, the simulator applies it around the model.
        of_all: Whether it may have no element, and is then one of the whole robot.
    """

    element: str | None
    unit: str
    minimum: float = -np.inf
    slide_unit: str = ""
    missing: str = ""
    maximum: float = 1e12
    in_model: bool = True
    of_all: bool = False


AT_END = 0.98
"""Position in [-1, 1] of its range; past it, to either side, a parameter is at the end of the range."""
ROUNDED = 1e-9
"""Distance in [-1, 1] from an end of a range, up to which an estimate stops at it, and an interval reaches it."""

PAYLOAD = ("payload_mass", "payload_x", "payload_y", "payload_z", "payload_gyration")
"""Fields of a load on a body: its mass, where its centre is in the body's frame, its radius of gyration."""
INERTIA = tuple(f"inertia_{part}" for part in ("alpha", "d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2", "t3"))
"""Fields of a body's ten inertial numbers, as deviations from the model's (Rucker and Wensing 2022); all 0 is that."""
_DRAG = "drag that grows with the square of the speed"
_ARMATURE = "inertia at the joint, as of a geared rotor"
FIELDS: dict[str, Field] = {
    "gravity": Field(None, "m/s²", missing="another gravity", maximum=1e4),
    "body_mass": Field("body", "kg", 0.0, missing="another mass, as of a payload"),
    "body_mass_and_inertia": Field("body", "kg", 0.0),
    "body_inertia": Field("body", "kg·m²", 0.0),
    "body_com": Field("body", "m", 0.0, missing="another centre of mass, as with a payload"),
    "body_distance": Field("body", "m", 0.0, missing="another length of the link before a body"),
    "payload_mass": Field("body", "kg", 0.0),
    **{f"payload_{axis}": Field("body", "m") for axis in "xyz"},
    "payload_gyration": Field("body", "m", 0.0),
    **{field: Field("body", "1", maximum=3.0) for field in INERTIA},
    "dof_frictionloss": Field("joint", "N·m", 0.0, "N", "Coulomb friction"),
    "dof_drag": Field("joint", "N·m·s²/rad²", 0.0, "N·s²/m²", _DRAG),
    "dof_damping": Field("joint", "N·m·s/rad", 0.0, "N·s/m", "viscous damping"),
    "dof_armature": Field("joint", "kg·m²", 0.0, "kg", _ARMATURE),
    "jnt_stiffness": Field("joint", "N·m/rad", 0.0, "N/m", "a spring"),
    "jnt_ref": Field("joint", "rad", slide_unit="m"),
    "geom_friction": Field("geom", "1", 0.0, missing="another friction at contacts"),
    "geom_friction_torsional": Field("geom", "m", 0.0),
    "geom_friction_rolling": Field("geom", "m", 0.0),
    "contact_time": Field("geom", "s", 0.0, missing="softer or harder contacts"),
    "contact_damping": Field("geom", "1", 0.0),
    "actuator_gain": Field("actuator", "1", missing="another gain of the actuator"),
    "actuator_kv": Field("actuator", "N·m·s/rad", 0.0, "N·s/m"),
    "drive_supply": Field("actuator", "V", 0.0),
    "drive_kt": Field("actuator", "N·m/A", 0.0),
    "drive_resistance": Field("actuator", "Ω", 1e-9),
    "drive_gain": Field("actuator", "1", 0.0),
    "drive_damping_gain": Field("actuator", "1", 0.0),
    "drive_duty_limit": Field("actuator", "1", 0.0, maximum=1.0),
    "drive_current_limit": Field("actuator", "A", 0.0),
    "drive_strength": Field("actuator", "1", 0.0, missing="another strength of the drive"),
    "drive_saturation": Field("actuator", "1/A", 0.0),
    "friction_stribeck": Field("joint", "N·m", 0.0, "N"),
    "friction_stribeck_speed": Field("joint", "rad/s", 1e-9, "m/s"),
    "friction_stribeck_exponent": Field("joint", "1", 0.0, maximum=100.0),
    **{
        f"friction_{rest}load{side}": Field("joint", "1", 0.0)
        for rest in ("", "stribeck_")
        for side in ("", "_motor", "_external")
    },
    "friction_quadratic_motor": Field("joint", "1/(N·m)", 0.0, "1/N"),
    "friction_quadratic_external": Field("joint", "1/(N·m)", 0.0, "1/N"),
    "gear_backlash": Field("joint", "rad", 0.0, "m"),
    "gear_stiffness": Field("joint", "N·m/rad", 0.0, "N/m"),
    "gear_damping": Field("joint", "N·m·s/rad", 0.0, "N·s/m"),
    "action_delay": Field("action", "s", 0.0, maximum=10.0, in_model=False, of_all=True),
    "action_lag": Field("action", "s", 0.0, maximum=10.0, in_model=False, of_all=True),
    "signal_bias": Field("signal", "1", missing="an offset of the sensor", in_model=False),
}
"""Every field a parameter can name.

`body_mass` leaves the inertia as it is (the paper's meaning), `body_mass_and_inertia` scales the inertia with the mass.
`body_inertia` is the largest moment of inertia about the centre of mass, the others keep their ratio to it; `body_com`
is how far the centre of mass is from the body's origin, in the direction it has; `body_distance` how far that origin is
from the parent's, in the direction it has: the length of the link between them. `actuator_gain` of a position or
velocity servo is its kp or kv, and moves the servo's bias with it; `actuator_kv` is the damping of a position servo.
`jnt_ref` is what a hinge or slide reads, and is commanded to, where the model as drawn has its zero. `action_delay` is
the time from an action to its effect, `action_lag` the time constant of a filter of first order that it passes, of all
actions or of one; `signal_bias` is what a sensor reads too much. `dof_drag` is damping that grows with
the square of the speed. `contact_time` and `contact_damping` are MuJoCo's `solref`: how long a contact takes to push
shapes apart, and 1 where it does so without a bounce. A payload adds to the body's own mass and inertia; its moment of
inertia about each axis is its mass times the square of its radius of gyration. `drive_*` are the numbers of a d.c.
drive, `friction_*` those of friction that depends on speed and load (`simulation/callbacks.py` has the equations);
`friction_load` and `friction_stribeck_load` are one value for the motor's and the external torque. `gear_*` are the
numbers of the gear behind a joint (`simulation/joints.py`); its backlash is the whole width of the play.
"""


KINDS_OF_ARRAYS = {
    **{kind: kind for kind in ("body", "geom", "site", "pair", "tendon", "actuator", "sensor")},
    **dict.fromkeys(("dof", "jnt", "qpos", "qpos0"), "joint"),
    "eq": "equality",
    "opt": None,
}
"""By the first word of the name of a model's array, the kind of element that has a row of it; None for an option."""
_NUMBER = re.compile(r"(?P<array>(?P<first>opt(?=\.)|[a-z]+0?(?=_)|qpos0)[._]?\w*)(\[(?P<index>\d+)\])?")
_AT_LEAST_0 = ("mass", "damping", "stiffness", "frictionloss", "armature", "friction", "density", "viscosity")
"""Ends of the names of arrays whose numbers are not negative."""


def array_of(field: str) -> tuple[str, int | None]:
    """The array of a model, and the place in an element's row, that a field such as `geom_solref[0]` names."""
    found = _NUMBER.fullmatch(field)
    if found is None or found["first"] not in KINDS_OF_ARRAYS:
        raise MadocError(
            f"unknown parameter field {field!r}; {nearest_hint(field, FIELDS)}; or a number of MuJoCo's model as "
            f"geom_solref[0], whose array begins with {'_, '.join(KINDS_OF_ARRAYS)}."
        )
    return found["array"], None if found["index"] is None else int(found["index"])


@lru_cache(maxsize=1024)
def field_of(name: str) -> Field:
    """The entry of `FIELDS`, or one for a number of MuJoCo's model: `geom_solref[0]`, `opt.density`.

    Raises:
        MadocError: It is neither.
    """
    if name in FIELDS:
        return FIELDS[name]
    array, _ = array_of(name)
    first = array.partition(".")[0] if "." in array else array.partition("_")[0]
    return Field(KINDS_OF_ARRAYS[first], "", 0.0 if array.endswith(_AT_LEAST_0) else -np.inf)


@dataclass(frozen=True)
class Parameter:
    """One physical quantity of the simulator that may be calibrated, and the range it is searched in.

    Attributes:
        field: A key of `FIELDS`, or a number of a MuJoCo model such as `geom_solref[0]` or `opt.density`.
        element: Name of the body, joint, geom, actuator, signal and so on (a body without a name may be named by its
            joint). A tuple of names shares one value; a parameter of the whole robot, as gravity, has an empty name.
        low: Lower end of the range, in `unit`.
        high: Upper end of the range, in `unit`.
        label: The parameter's name; if empty, it is `field.element`.
        measured_in: The unit of a slide joint, a signal or a number of the model; if empty, it is the field's.
        when: The condition of a run and its value under which it holds; None holds always.
    """

    field: str
    element: str | tuple[str, ...]
    low: float
    high: float
    label: str = ""
    measured_in: str = ""
    when: tuple[str, float] | None = None

    def __post_init__(self) -> None:
        kind = self.kind
        none = self.elements == ()
        if ((kind.element is None) != none and not (none and kind.of_all)) or "" in self.elements:
            article = "an" if kind.element and kind.element[0] in "aeiou" else "a"
            wanted = "no element" if kind.element is None else f"the name of {article} {kind.element}"
            raise MadocError(f"parameter field {self.field!r} takes {wanted}, got {self.element!r}")
        if len(set(self.elements)) < len(self.elements):
            raise MadocError(f"{self.name} names an element twice; a shared value needs each only once")
        if not (np.isfinite(self.low) and np.isfinite(self.high) and self.low < self.high):
            raise MadocError(f"range of {self.name} must be finite with low < high, got [{self.low}, {self.high}]")
        if self.low < kind.minimum:
            raise MadocError(
                f"range of {self.name} starts at {self.low} {self.unit}, below its physical bound {kind.minimum}"
            )
        if max(-self.low, self.high) > kind.maximum:
            raise MadocError(
                f"range of {self.name} reaches {max(-self.low, self.high):g} {self.unit}, beyond its physical bound "
                f"{kind.maximum:g}"
            )

    @property
    def kind(self) -> Field:
        """What its field is."""
        return field_of(self.field)

    @property
    def elements(self) -> tuple[str, ...]:
        """The elements that share the value; empty for a parameter of the whole robot."""
        if isinstance(self.element, tuple):
            return self.element
        return (self.element,) if self.element else ()

    @property
    def name(self) -> str:
        """The label, or `field.element` such as `dof_damping.foot_joint`; several elements are joined with `+`.

        Behind it stands its condition, as in `drive_strength.elbow[supply=12]`.
        """
        name = self.label or ".".join([self.field, *(["+".join(self.elements)] if self.elements else [])])
        return name if self.when is None else f"{name}[{self.when[0]}={self.when[1]:g}]"

    @property
    def unit(self) -> str:
        """The physical unit of the value and of its range."""
        return self.measured_in or self.kind.unit or "1"


@dataclass(frozen=True)
class ParameterSpace:
    """The parameters to calibrate, in order, each within its range; scaled, they fill the cube [-1, 1]^d."""

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
        """Lower ends of the ranges, shape (d,), physical units."""
        return np.array([parameter.low for parameter in self.parameters], dtype=np.float64)

    @property
    def high(self) -> np.ndarray:
        """Upper ends of the ranges, shape (d,), physical units."""
        return np.array([parameter.high for parameter in self.parameters], dtype=np.float64)

    @property
    def middle(self) -> np.ndarray:
        """Middles of the ranges, shape (d,), physical units: the uncalibrated simulator."""
        return self.to_physical(np.zeros(len(self)))

    def __len__(self) -> int:
        return len(self.parameters)

    def to_physical(self, unit: ArrayLike) -> np.ndarray:
        """Map [-1, 1] to physical units; shape (..., d), float64."""
        return self.low + (np.asarray(unit, dtype=np.float64) + 1.0) * 0.5 * (self.high - self.low)

    def to_unit(self, physical: ArrayLike) -> np.ndarray:
        """Map physical units to [-1, 1]; shape (..., d), float64."""
        return 2.0 * (np.asarray(physical, dtype=np.float64) - self.low) / (self.high - self.low) - 1.0

    def at_end(
        self, unit: Float[np.ndarray, " d"], interval: Float[np.ndarray, "d 2"] | None = None
    ) -> tuple[str, ...]:
        """Names of the parameters that stand at an end of their range, where the true value may lie beyond it.

        The physical minimum of a field, such as a damping of 0, is no such end. Nor is one that the 95 % interval, low
        and high as the values in [-1, 1], does not reach, nor one at which the estimate does not stop, if that is known
        to be so near (`AT_END`).
        """
        reached = np.ones(len(unit), bool)
        if interval is not None:
            stops = np.abs(unit) > 1.0 - ROUNDED
            known = np.abs(interval - unit[:, None]).max(1) < 1.0 - AT_END
            reached = (np.abs(interval) > 1.0 - ROUNDED).any(1) & (stops | ~known)
        return tuple(
            row.name
            for row, value, reaches in zip(self.parameters, unit.tolist(), reached.tolist(), strict=True)
            if reaches and abs(value) > AT_END and not (value < 0.0 and row.low <= row.kind.minimum)
        )

    def select(self, names: Sequence[str]) -> "ParameterSpace":
        """The space of the named parameters, in the order given.

        Raises:
            MadocError: A name is not in the space.
        """
        known = dict(zip(self.names, self.parameters, strict=True))
        missing = [name for name in names if name not in known]
        if missing:
            raise MadocError(f"no parameter {missing[0]!r} here; there are: {', '.join(known)}")
        return replace(self, parameters=tuple(known[name] for name in names))

    def vector(self, values: Mapping[str, float] | ArrayLike) -> np.ndarray:
        """Physical values, by name or in the space's order, as an array of shape (..., d), float64.

        Raises:
            MadocError: A parameter is missing or unknown, or the last axis has another length.
        """
        if isinstance(values, Mapping):
            missing = [name for name in self.names if name not in values]
            extra = [name for name in values if name not in self.names]
            if missing or extra:
                what = f"no value for {missing[0]!r}" if missing else f"unknown parameter {extra[0]!r}"
                raise MadocError(f"{what}; expected values for exactly: {', '.join(self.names)}")
            return np.array([float(values[name]) for name in self.names])
        vector = np.array(values, dtype=np.float64)
        if vector.shape[-1:] != (len(self),):
            raise MadocError(
                f"expected {len(self)} parameter values ({', '.join(self.names)}), got an array of shape {vector.shape}"
            )
        return vector

    def summed(
        self, values: Float[np.ndarray, "systems parameters"], field: str, names: Sequence[str]
    ) -> Float[np.ndarray, "systems _"]:
        """The values of a field by name, 0 where none is calibrated; those without an element count for all."""
        sums = np.zeros((len(values), max(1, len(names))))
        for parameter, column in zip(self.parameters, values.T, strict=True):
            if parameter.field == field:
                places = [names.index(element) for element in parameter.elements] or slice(None)
                sums[:, places] += column[:, None]
        return sums


@runtime_checkable
class ParameterDistribution(Protocol):
    """A distribution of the parameters, from which a learner draws new systems in every epoch or episode."""

    def draw(self, key: PRNGKeyArray, count: int) -> Float[np.ndarray, "count parameters"]:
        """Physical values of `count` systems, within the ranges."""
