"""The spec file of a robot: its keys and their types, checked before any model is read."""

import math
from functools import lru_cache
from typing import Annotated, Literal

import mujoco
from pydantic import BeforeValidator, Field, WithJsonSchema, field_validator, model_validator

from madoc.errors import nearest_hint
from madoc.parameters import FIELDS, INERTIA, Parameter
from madoc.robots.document import (
    Document,
    File,
    Finite,
    Name,
    Part,
    Positive,
    Unit,
    read_document,
    refuse,
    validated,
)
from madoc.robots.drive_spec import ConditionSpec, DriveSpec, FrictionSpec, GearSpec
from madoc.simulation.arrays import array_names
from madoc.tasks import TASKS

SHORTEST_TIMESTEP = 1e-6
"""Shortest timestep in s: contacts of rigid bodies last a thousand times as long."""
LONGEST_STEP = 60.0
"""Longest control step in s."""

SCALES: dict[str, float] = {
    **dict.fromkeys(("deg", "deg/s", "°", "°/s"), math.pi / 180.0),
    **dict.fromkeys(("mm", "mm/s", "mN·m", "mNm", "N·mm", "Nmm", "mN"), 1e-3),
    **dict.fromkeys(("cm", "cm/s"), 1e-2),
    "km/h": 1.0 / 3.6,
}
"""Units that are converted, each as a multiple of its SI unit."""

Names = Annotated[
    list[Name],
    Field(min_length=1),
    BeforeValidator(lambda given: [given] if isinstance(given, str) else given),
    WithJsonSchema({"type": ["string", "array"], "items": {"type": "string"}, "minItems": 1}),
]
Duration = Annotated[float, Field(allow_inf_nan=False, ge=SHORTEST_TIMESTEP, le=LONGEST_STEP)]


class SignalSpec(Part):
    """One number of an observation."""

    name: Name = Field(description="What a log's column is called, unless `log: columns:` says otherwise.")
    reads: str = Field(
        description="position(JOINT), velocity(JOINT), sensor(NAME), one value of several as sensor(NAME)[2], or an "
        "expression of them: + - * / **, sin cos tan asin acos atan atan2 sqrt abs exp tanh min max where, pi."
    )
    unit: Unit | None = Field(None, description="For people. Default: that of the joint, where `reads` is one.")


class ActionSpec(Part):
    """One number of an action: what the log's column means."""

    name: Name
    joint: Name | None = Field(None, description="The joint it drives; an actuator is added to the model.")
    actuator: Name | None = Field(None, description="The model's own actuator that gets it as its control.")
    means: Literal["torque", "force", "position", "velocity", "duty"] | None = Field(
        None,
        description="With `joint`: torque (N·m; of a slide, force in N), a servo's target, or a drive's duty.",
    )
    low: Finite | None = Field(None, description="Smallest value, in `unit`. Default: the actuator's ctrlrange.")
    high: Finite | None = Field(None, description="Largest value, in `unit`. Default: the actuator's ctrlrange.")
    kp: Positive | None = Field(None, description="Stiffness of a position servo, N·m/rad (of a slide, N/m).")
    kd: Finite | None = Field(None, ge=0, description="Damping of a servo, N·m·s/rad (of a slide, N·s/m).")
    limit: Positive | None = Field(None, description="Largest torque or force of a servo, N·m (of a slide, N).")
    drive: DriveSpec | None = Field(None, description="What drives the joint, where it is no ideal servo or motor.")
    unit: Unit | None = Field(
        None, description=f"Of low, high and the log: an SI unit, or one that is converted, {', '.join(SCALES)}."
    )

    @model_validator(mode="after")
    def _consistent(self) -> "ActionSpec":
        neither_or_both = (self.joint is None) == (self.actuator is None)
        refuse(neither_or_both, "expected either joint: or actuator:, got both or neither")
        given = [key for key in ("means", "kp", "kd", "limit", "drive") if getattr(self, key) is not None]
        if self.actuator is not None and given:
            raise ValueError(f"{given[0]}: belongs to joint:, the actuator {self.actuator!r} has its own in the model")
        if self.joint is not None:
            refuse(self.means is None, "expected means: torque, force, position or velocity beside joint:")
            refuse(self.low is None or self.high is None, "expected low: and high: beside joint:")
            self._check_servo([key for key in given if key != "means"])
        refuse((self.low is None) != (self.high is None), "expected both low: and high:, got one of them")
        if self.low is not None and self.high is not None:
            refuse(self.low >= self.high, f"expected low below high, got {self.low:g} and {self.high:g}")
        return self

    def _check_servo(self, given: list[str]) -> None:
        """Refuse what a drive, a servo or a motor lacks, and what means nothing beside it."""
        if self.drive is not None:
            refuse(given != ["drive"], f"{given[0]}: means nothing beside drive:, which has the numbers of its loop")
            self.drive.check(str(self.means))
            return
        refuse(self.means == "duty", "expected drive: beside means: duty")
        refuse(self.means == "position" and self.kp is None, "expected kp: of a position servo, or drive:")
        refuse(self.means == "velocity" and not self.kd, "expected kd: above 0 of a velocity servo, or drive:")
        refuse(self.means == "velocity" and self.kp is not None, "kp: means nothing beside means: velocity")
        if self.means in ("torque", "force") and given:
            raise ValueError(f"{given[0]}: means nothing beside means: {self.means}")


class ParameterSpec(Part):
    """One value to calibrate, and the range it is searched in."""

    field: str | None = Field(
        None, description=f"One of: {', '.join(FIELDS)}.", json_schema_extra={"enum": [*FIELDS, "inertia"]}
    )
    model: Name | None = Field(
        None, description="Instead of a field, an array of MuJoCo's mjModel, as geom_solref, or an option, as opt.wind."
    )
    index: Annotated[int, Field(ge=0)] | None = Field(None, description="With `model`: which number of an element.")
    unit: Unit | None = Field(None, description="With `model`: the unit of that number, for people. Default: 1.")
    element: Name | None = Field(None, description="Name of the body, joint, geom, actuator, signal and so on.")
    elements: Names | None = Field(None, description="Several that share one value: a list of names or patterns.")
    each: Names | None = Field(None, description="Several that have a value each: a list of names or patterns.")
    name: Name | None = Field(None, description="Its own name; with `each`, what the element's comes behind.")
    by: Name | None = Field(None, description="Condition: a value for each of its values, all in the same range.")
    low: Finite
    high: Finite

    @field_validator("field")
    @classmethod
    def _known(cls, field: str) -> str:
        if field in (*FIELDS, "inertia"):
            return field
        of_model = field in array_names(mujoco.MjModel.from_xml_string("<mujoco/>"))
        hint = f"an array of MuJoCo's model is given by model: {field}" if of_model else nearest_hint(field, FIELDS)
        raise ValueError(f"expected a field that can be calibrated, got {field!r}; {hint}")

    @model_validator(mode="after")
    def _consistent(self) -> "ParameterSpec":
        refuse((self.field is None) == (self.model is None), "expected either field: or model:, got both or neither")
        given = [key for key in ("element", "elements", "each") if getattr(self, key) is not None]
        refuse(len(given) > 1, f"expected one of element:, elements: and each:, got {' and '.join(given)}")
        for key in ("index", "unit"):
            refuse(self.model is None and getattr(self, key) is not None, f"{key}: belongs to model:, not to field:")
        if self.by is not None and self.field in FIELDS and not FIELDS[self.field].in_model:
            raise ValueError(f"by: means nothing beside {self.field}, which is not in the model; leave it out")
        for field in self.fields:
            self.parameter(field, self.names)  # pydantic reports what it refuses, as a MadocError is a ValueError
        return self

    @property
    def fields(self) -> tuple[str, ...]:
        """The field, the ten of an inertia, or the number of the model as `geom_solref[0]`."""
        if self.field is not None:
            return INERTIA if self.field == "inertia" else (self.field,)
        return (f"{self.model}" if self.index is None else f"{self.model}[{self.index}]",)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the elements, or patterns of them."""
        return (self.element,) if self.element else tuple(self.elements or self.each or ())

    def parameter(self, field: str, elements: tuple[str, ...], unit: str = "") -> Parameter:
        """The parameter of a field and of one or several elements, in the unit of its field or in another."""
        element = elements[0] if len(elements) == 1 else elements or ""
        if self.elements and len(self.elements) == 1 and len(elements) > 1 and not self.name:
            label = f"{field}.{self.elements[0]}"  # the pattern says what all of them are
        elif self.name:
            added = [self.name, field if len(self.fields) > 1 else "", str(element) if self.each else ""]
            label = ".".join(filter(None, added))
        else:
            label = ""
        return Parameter(field, element, self.low, self.high, label, unit or self.unit or "")


class LogSpec(Part):
    """How a log of this robot is laid out."""

    time: Name = Field("time", description="Column of timestamps, s.")
    columns: dict[Name, Name] = Field({}, description="Our names of signals and actions -> the log's columns.")
    resample: Literal["hold", "linear"] | None = Field(
        None,
        description="Bring other rates to control_step: hold the last value, or interpolate signals. Only if asked.",
    )
    tolerance: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.1, description="How far a time step may be from control_step, as a share of it."
    )


class GoalSpec(Part):
    """One number that is drawn anew for every episode and holds throughout, as a target to reach."""

    name: Name = Field(description="What the reward, the end and other goals call it.")
    drawn: str | Finite = Field(
        description="An expression of uniform(LOW, HIGH), normal(MEAN, DEVIATION), goals above."
    )


class RobotSpec(Part):
    """A robot of one's own, as Madoc's spec file describes it."""

    madoc: Literal[1] = Field(description="Version of this format.")
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$", max_length=60)] = Field(
        description="Letters, digits, _ . and -."
    )
    model: File = Field(description="MJCF or URDF, relative to this file.")
    control_step: Duration = Field(description="Time between two actions, s; a whole multiple of the timestep.")
    timestep: Duration | None = Field(None, description="Of the physics, s. Default: the model's.")
    signals: list[SignalSpec] = Field(min_length=1, description="The observation, in this order.")
    actions: list[ActionSpec] = Field(description="The action, in this order; [] of a machine without a drive.")
    friction: list[FrictionSpec] = Field([], description="Friction of joints, whose terms are calibrated too.")
    gears: list[GearSpec] = Field([], description="Backlash and elasticity between motors and links.")
    conditions: list[ConditionSpec] = Field([], description="What differs between runs and is known.")
    parameters: list[ParameterSpec] = Field(min_length=1, description="What can be calibrated.")
    groups: Annotated[int, Field(ge=1, le=1000)] | None = Field(
        None, description="Groups Madoc's VAE forms. Default: min(4, d)."
    )
    log: LogSpec = Field(default_factory=lambda: LogSpec.model_validate({}))
    reward: str | None = Field(
        None,
        description="An expression of signals, after the step, actions and goals, by name, and of position(JOINT) and "
        "velocity(JOINT); needed to learn a policy.",
    )
    end: str | None = Field(
        None,
        description="A condition of signals and goals, as height < 0.2: an episode ends after a step where it holds.",
    )
    goals: list[GoalSpec] = Field(
        [], description="What is drawn for each episode; a policy observes goals behind the signals."
    )
    reset: dict[str, str | Finite] = Field(
        {},
        description="position(JOINT) or velocity(JOINT) -> where an episode begins: an expression as of goals. "
        "Default: as the model does.",
    )
    python: File | None = Field(
        None,
        description="A Python file in the folder of this one. Its functions reward, end and reset take the place of "
        "these keys. It is run only with --allow-code.",
    )
    max_episode_steps: Annotated[int, Field(ge=1, le=10_000_000)] = Field(
        1000, description="Control steps of a simulated episode."
    )

    @field_validator("name")
    @classmethod
    def _new(cls, name: str) -> str:
        refuse(name in TASKS, f"{name!r} is a robot of Madoc's own; choose another name")
        return name


@lru_cache(maxsize=32)
def read_spec(content: bytes, file: str) -> tuple[RobotSpec, Document]:
    """A spec and the lines of its parts, parsed once; the first mistake is refused with its line."""
    document = read_document(content, file)
    otherwise = "expected keys and values, as `name: my_robot`; write one with: madoc init MODEL"
    return validated(document, RobotSpec, otherwise), document
