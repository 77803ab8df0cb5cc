"""Problems whose model is right, in the conditions under which machines are logged."""

from adversary_cases.case import ENCODER, Case, Log, Plant, Robot, Spec
from adversary_cases.contact_robots import PUSHER, WALKER, WIPER
from adversary_cases.robots import ARM, BALL, BOX, CART, HULL, LEG, PENDULUM

NO_NOISE = Log(noise=0.0)


def usual(robot: Robot, *, share: float = 0.02) -> tuple[Case, ...]:
    """Conditions that every robot meets; `share` is the random force of much process noise."""
    return (
        Case(robot, "plain"),
        Case(robot, "exact", log=NO_NOISE),
        Case(robot, "noisy", log=Log(noise=0.02)),
        Case(robot, "positions", log=Log(velocities="none")),
        Case(robot, "process-little", Plant(process=share / 10)),
        Case(robot, "process-much", Plant(process=share)),
        Case(robot, "fine", Plant(fine=5)),
        Case(robot, "fine-exact", Plant(fine=5), NO_NOISE),
        Case(robot, "100hz", spec=Spec(rate=100)),
        Case(robot, "few", log=Log(runs=3, seconds=3.0)),
    )


_NOT = {**dict.fromkeys(("ball", "hull", "leg"), ("few", "100hz")), "box": ("few", "100hz", "fine", "fine-exact")}
"""Conditions that a robot does not meet. Integrated five times more finely, the box slides otherwise than the user's
model can say: at the true values one row's prediction is off by 0.7 typical changes of the speed. That is a deception.
"""
_OF_CONTACTS = ("plain", "positions", "fine", "fine-exact")
_LONG = ("length", "damping", "friction", "armature")  # with the gain as well, the log would tell only ratios
_EIGHT = tuple(ARM.catalogue)

_SPECIAL = (
    *(
        Case(robot, name, plant, log, spec)
        for robot in (PENDULUM, ARM)
        for name, plant, log, spec in (
            ("500hz", Plant(), Log(runs=4, seconds=4.0), Spec(rate=500)),
            (
                "500hz-encoder",
                Plant(),
                Log(runs=4, seconds=4.0, noise=0.0, quantum=ENCODER, velocities="differenced"),
                Spec(rate=500),
            ),
            ("encoder", Plant(), Log(noise=0.0, quantum=ENCODER, velocities="none"), Spec()),
            ("closed-loop", Plant(closed_loop=True, process=0.01), Log(), Spec()),
            ("closed-loop-positions", Plant(closed_loop=True), Log(velocities="none"), Spec()),
            ("jitter", Plant(), Log(jitter=0.3), Spec()),
            ("current", Plant(), Log(action_noise=0.01), Spec()),
            ("in-degrees", Plant(), Log(degrees=True), Spec(degrees=True)),
            ("dropped", Plant(), Log(dropped=0.02), Spec()),
        )
    ),
    Case(PENDULUM, "at-mid-range", Plant({"length": 0.5, "damping": 0.25})),
    *(Case(robot, "stretches", log=Log(dropped=0.2)) for robot in (PENDULUM, ARM)),
    Case(PENDULUM, "many", spec=Spec(free=_LONG)),
    Case(PENDULUM, "many-noisy", log=Log(noise=0.02), spec=Spec(free=_LONG)),
    Case(PENDULUM, "friction", spec=Spec(free=("length", "damping", "friction"))),
    Case(ARM, "many", spec=Spec(free=_EIGHT)),
    Case(LEG, "many", spec=Spec(free=tuple(LEG.catalogue))),
    Case(CART, "closed-loop", Plant(closed_loop=True, process=0.02)),
    Case(CART, "500hz", log=Log(runs=4, seconds=4.0), spec=Spec(rate=500)),
    Case(BALL, "500hz", log=Log(runs=4, seconds=4.0), spec=Spec(rate=500)),
)

HONEST = (
    *(case for robot in (PENDULUM, ARM, CART) for case in usual(robot)),
    *(case for robot in (BOX, BALL, HULL, LEG) for case in usual(robot) if case.name not in _NOT[robot.name]),
    *(case for robot in (PUSHER, WIPER, WALKER) for case in usual(robot) if case.name in _OF_CONTACTS),
    *_SPECIAL,
)
