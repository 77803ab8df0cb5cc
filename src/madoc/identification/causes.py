"""What a model may lack, in words: one table of causes, with what is told and done about each.

A cause whose words begin as these do is the same one of an element or a run, which follows in brackets. Terms that a
parameter of a spec adds have the words of its field (`parameters.FIELDS`) and are in no table here.
"""

from dataclasses import dataclass
from typing import Literal

DELAY = "actions that take effect later, by a delay or a lag of the actuator"
LAG = "commands that drives follow with a lag of first order"
EARLY = "actions that take effect before they are logged"
BELOW_MINIMUM = "a value below what is physically possible"
SATURATION = "a drive that saturates below the limit of its actions"
SPACING = "another time between rows than the spec says, by another rate or a clock that drifts"
TILTS = ("a base or a floor that is tilted towards x", "a base or a floor that is tilted towards y")
INTEGRATION = "the error of the model's integration step"
LATE_DRIVE = "a drive that acts later than the others"
LATE_SENSOR = "a sensor that reads late, as behind a filter"
UNLISTED = "a force that no listed term describes"
"""What a family of forces stands for, or a listed term of a value that no machine has."""
DRIFT = "a value that changes over the log"
WITHIN_RUNS = "a value that changes within each run"
ONE_RUN = "another value in one run"
CONSTANT = "a constant force, as friction that differs by direction"
LOADED = "friction that grows with the load"
SLOW = "friction that is larger at low speed"
WEAKENING = "a drive that weakens with speed"
DEAD_ZONE = "a drive that gives less at small commands, as with a dead zone"
BENT = "a drive whose force is not in proportion to its command"
RIPPLE = "a drive whose gain depends on where the joint is"
UNEVEN = "friction that depends on where the joint is"
PLACED = "a force that depends on where the joint is"
COUPLED = "a force that another joint's motion exerts"
BUILT_UP = "friction that builds up or falls off over a distance after each reversal, as of belts, seals and brakes"
FORCES = (CONSTANT, LOADED, SLOW, WEAKENING, DEAD_ZONE, BENT, RIPPLE, UNEVEN, PLACED, COUPLED, BUILT_UP)
"""Forces at a joint, the most usual first."""
BENT_ALL = "drives that give less, at larger commands, than in proportion to them"
CUBIC_ALL = "drives that give less at their largest commands, as when they saturate"
DEAD_ALL = "drives that all give less at small commands, as with a dead zone"
WEAKENING_ALL = "drives that all weaken with the speed at which they push"
NEAR_GROUND = "drives that give more near the ground"
OF_DRIVES = (BENT_ALL, CUBIC_ALL, DEAD_ALL, WEAKENING_ALL, NEAR_GROUND)
"""Forces of all drives together."""
WIND = "a constant force from outside, as wind"
PUSH = "a constant force or torque in the body's own frame"
SLOWED = "a resistance to the body's motion in proportion to its speed"
DRAGGED = "a resistance to the body's motion by the square of its speed"
OFF_CENTRE = "a force or torque in proportion to all that its drives exert, as of thrust off the centre"
OF_BODIES = (WIND, PUSH, SLOWED, DRAGGED, OFF_CENTRE)
"""Forces on a free body; its joint's name follows in brackets."""
CHANGE_MACHINE = (
    "no parameter of a spec adds it: find out whether the machine has it, and calibrate to motions in which it is small"
)
"""What to do about a force that a spec has no words for."""

Group = Literal["term", "late", "change", "force", "unlisted"]


@dataclass(frozen=True)
class Cause:
    """What is told and done about a cause.

    Attributes:
        group: A `term` of a parameter, of timing or of the base; a single drive or sensor that is `late`; a parameter
            that `change`s; a `force` that no parameter adds; or an `unlisted` one.
        do: What a user can do where no parameter of a spec adds it.
        unusual: Whether a more usual cause that explains nearly as much is named in its place.
    """

    group: Group = "term"
    do: str = ""
    unusual: bool = False


def _force(do: str = CHANGE_MACHINE) -> Cause:
    return Cause("force", do, unusual=True)


CAUSES: dict[str, Cause] = {
    EARLY: Cause(do="log each action with what was seen just before it", unusual=True),
    BELOW_MINIMUM: Cause(do="look for what acts against it: a force, a gain or a sign that the model has wrong"),
    SPACING: Cause(do="check control_step of the spec against the log's time column"),
    SATURATION: Cause(
        do="say what drives the joint (drive: of its action), or narrow low and high of the actions to what it "
        "follows, or log smaller actions"
    ),
    **dict.fromkeys(
        TILTS,
        Cause(do="level it, or tilt the gravity of the model (its option gravity) as the base is", unusual=True),
    ),
    LATE_DRIVE: Cause("late", unusual=True),
    LATE_SENSOR: Cause("late", "log it without its filter, or shift its column by that time", unusual=True),
    DRIFT: Cause("change", "calibrate to each run by itself"),
    WITHIN_RUNS: Cause(
        "change", "let the machine warm up before it is logged, or leave out the start of each run", unusual=True
    ),
    ONE_RUN: Cause("change", "find out what was different in that run, or leave it out", unusual=True),
    **dict.fromkeys((*FORCES, *OF_DRIVES, *OF_BODIES), _force()),
    LOADED: _force(
        "say under friction: of the spec that it grows with the load (model: M3, or M4 where Stribeck's is there)"
    ),
    SLOW: _force(
        "say under friction: of the spec that it is larger at rest (model: M2, or M4 where it grows with the load)"
    ),
    WEAKENING: _force("say what drives the joint (drive: of its action, whose back-EMF weakens it)"),
    WEAKENING_ALL: _force(
        "where they are motors of joints, say so (drive: of their actions, whose back-EMF weakens them)"
    ),
    CUBIC_ALL: _force(
        "where they are motors of joints, say what limits them (drive: of their actions: supply, current_limit or "
        "saturation)"
    ),
    UNLISTED: Cause(
        "unlisted",
        "look there for what the model leaves out; a parameter that acts like it would be wrong in its place",
        unusual=True,
    ),
}


def cause_of(words: str) -> Cause:
    """The entry of a cause; that of a parameter's term where there is none."""
    return next((each for beginning, each in CAUSES.items() if words.startswith(beginning)), Cause())
