"""Problems whose model lacks something, or whose spec or log says something wrong, and the words that name it."""

from collections.abc import Mapping

from adversary_cases.case import ENCODER, Case, Log, Plant, Robot, Spec
from adversary_cases.robots import ARM, BALL, BOX, CART, HULL, LEG, PENDULUM

FRICTION = "friction"
DRAG = "drag"
LATE = r"delay|\blags?\b|\blate\b"
RATE = r"\brates?\b|spacing|rows are|time steps?\b|control_step"
SIGN = r"\bsigns?\b|reversed|inverted"
UNIT = r"degree|\bunits?\b"
COLUMNS = "swap|exchange|other signal|other action|other joint"
GRAVITY = "gravity|constant"
INERTIA = r"inertia|\bmass\b|payload"
SPRING = "spring|stiffness"
OFFSET = r"offset|\bbias|constant"
GEAR = r"\bgear|\bgains?\b|\bscale"
RANGE = "outside|ends? of (its|their|the) range|beyond"
LOOSE = r"elastic|flexib|backlash|\bplay\b|second mass|spring"
LIMIT = "saturat|limit|clip"
DRIFT = r"drift|runs differ|between runs|\bthirds\b|change over"
SMALL = "small commands|in proportion"
COUPLED = "another joint"
PLACE = "where the joint is"
CLOCK = r"clock|drift|spacing|\brates?\b"
FORCE = r"constant|wind|external|offset|\bbias"
CONTACT = r"contact|\bwall|collision"
BASE = r"\bbase\b|accelerat|periodic"
TIMESTEP = "timestep|integration step"

POSITIONS = Log(velocities="none")
NOISY = Log(noise=0.02)
COUNTED = Log(noise=0.0, quantum=ENCODER, velocities="none")
SHORT = Log(runs=4, seconds=4.0)
THREE = ("length", "damping", "gain")
FRICTIONAL = ("length", "damping", "friction")


def in_all_conditions(robot: Robot, name: str, values: Mapping[str, float], cause: str) -> tuple[Case, ...]:
    """The same lack of the model under the conditions in which machines are logged and steered."""
    return (
        Case(robot, f"{name}-500hz", Plant(values), SHORT, Spec(rate=500), cause),
        Case(robot, f"{name}-encoder", Plant(values), COUNTED, cause=cause),
        Case(robot, f"{name}-closed-loop", Plant(values, closed_loop=True), cause=cause),
        Case(robot, f"{name}-process", Plant(values, process=0.01), cause=cause),
        Case(robot, f"{name}-fine", Plant(values, fine=5), cause=cause),
    )


_PENDULUM = (
    *in_all_conditions(PENDULUM, "friction-0.1", {"friction": 0.1}, FRICTION),
    Case(PENDULUM, "drag-0.1-positions", Plant(drag=0.1), POSITIONS, cause=DRAG),
    Case(PENDULUM, "lag-10ms-positions", Plant(lag=0.01), POSITIONS, cause=LATE),
    Case(PENDULUM, "lag-10ms-process", Plant(lag=0.01, process=0.01), cause=LATE),
    Case(PENDULUM, "delay-0.5-closed-loop", Plant(delay=0.5, closed_loop=True), cause=LATE),
    Case(PENDULUM, "range-closed-loop", Plant({"damping": 0.6}, closed_loop=True), cause=RANGE),
    *(Case(PENDULUM, f"friction-{size}", Plant({"friction": size}), cause=FRICTION) for size in (0.02, 0.05, 0.1, 0.2)),
    *(
        Case(PENDULUM, f"friction-{size}-noisy", Plant({"friction": size}), NOISY, cause=FRICTION)
        for size in (0.02, 0.05, 0.2)
    ),
    *(
        Case(PENDULUM, f"friction-{size}-positions", Plant({"friction": size}), POSITIONS, cause=FRICTION)
        for size in (0.05, 0.2)
    ),
    Case(PENDULUM, "friction-0.1-100hz", Plant({"friction": 0.1}), spec=Spec(rate=100), cause=FRICTION),
    Case(PENDULUM, "stribeck-0.1", Plant(stribeck=0.1), cause=FRICTION),
    Case(PENDULUM, "stribeck-0.3", Plant(stribeck=0.3), cause=FRICTION),
    Case(PENDULUM, "drag-0.02", Plant(drag=0.02), cause=DRAG),
    Case(PENDULUM, "drag-0.1", Plant(drag=0.1), cause=DRAG),
    *(Case(PENDULUM, f"lag-{ms}ms", Plant(lag=ms / 1000), cause=LATE) for ms in (5, 10, 20)),
    Case(PENDULUM, "lag-10ms-noisy", Plant(lag=0.01), NOISY, cause=LATE),
    *(Case(PENDULUM, f"delay-{rows}", Plant(delay=rows), cause=LATE) for rows in (0.5, 1, 3)),
    Case(PENDULUM, "delay-0.5-noisy", Plant(delay=0.5), NOISY, cause=LATE),
    Case(PENDULUM, "sign-command", log=Log(scale={"torque": -1}), cause=SIGN),
    Case(PENDULUM, "sign-speed", log=Log(scale={"hinge_speed": -1}), cause=SIGN),
    Case(PENDULUM, "degrees", log=Log(degrees=True), cause=UNIT),
    *(
        Case(PENDULUM, f"rate-{share}", Plant(spacing=1 + share / 100), spec=Spec(free=THREE), cause=RATE)
        for share in (3, 5, 9)
    ),
    Case(PENDULUM, "rate-5-unseen", Plant(spacing=1.05), Log(nominal_time=True), Spec(free=THREE), cause=RATE),
    Case(PENDULUM, "rate-10-unseen", Plant(spacing=1.1), Log(nominal_time=True), cause=RATE),
    Case(PENDULUM, "gravity", spec=Spec({"gravity": -9.0}), cause=GRAVITY),
    Case(PENDULUM, "payload", Plant({"payload": 0.1}), cause=INERTIA),
    Case(PENDULUM, "runs-payload", Plant(by_run=({}, {"payload": 0.05}, {"payload": 0.1})), cause=DRIFT),
    Case(PENDULUM, "inertia", Plant({"armature": 0.02}), cause=INERTIA),
    Case(PENDULUM, "spring", Plant({"spring": 0.5}), cause=SPRING),
    Case(PENDULUM, "spring-2", Plant({"spring": 2.0}), cause=SPRING),
    Case(PENDULUM, "offset-0.05", log=Log(offset={"hinge": 0.05}), cause=OFFSET),
    Case(PENDULUM, "offset-0.2", log=Log(offset={"hinge": 0.2}), cause=OFFSET),
    Case(PENDULUM, "gear", Plant({"gain": 1.3}), cause=GEAR),
    Case(
        PENDULUM,
        "gear-invisible",
        Plant({"gain": 1.3}),
        spec=Spec(free=("mass", "damping")),
        cause=GEAR,
        invisible=True,
    ),
    Case(PENDULUM, "backlash", Plant({"play": 0.03}, fine=5), cause=LOOSE),
    Case(PENDULUM, "elastic", Plant({"flex": 40.0}, fine=5), cause=LOOSE),
    Case(PENDULUM, "range-just", Plant({"damping": 0.52}), cause=RANGE),
    Case(PENDULUM, "range-end", Plant({"damping": 0.2}), spec=Spec(ranges={"damping": (0.0, 0.19)}), cause=RANGE),
    Case(PENDULUM, "range-far", Plant({"damping": 1.0}), cause=RANGE),
    Case(PENDULUM, "range-length", Plant({"length": 0.73}), cause=RANGE),
    Case(PENDULUM, "limit", Plant(limit=0.5), cause=LIMIT),
    Case(PENDULUM, "drift-damping", Plant(by_run=tuple({"damping": d} for d in (0.15, 0.2, 0.25))), cause=DRIFT),
    Case(PENDULUM, "drift-friction", Plant(by_run=tuple({"friction": f} for f in (0.2, 0.1, 0.0))), cause=DRIFT),
    Case(
        PENDULUM,
        "runs-alternate",
        Plant(by_run=({"damping": 0.22}, {"damping": 0.28}) * 6),
        Log(runs=12, seconds=3.0),
        cause=DRIFT,
    ),
    *(
        Case(PENDULUM, f"friction-{size}-stretches", Plant({"friction": size}), Log(dropped=0.2), cause=FRICTION)
        for size in (0.05, 0.1)
    ),
    Case(PENDULUM, "filtered-speed", log=Log(velocities="filtered"), cause=LATE),
    Case(PENDULUM, "filtered-positions", log=Log(positions="filtered", velocities="none"), cause=LATE),
    Case(PENDULUM, "presliding-0.05", Plant(presliding=0.05), cause=FRICTION),
    Case(PENDULUM, "presliding-0.1", Plant(presliding=0.1), spec=Spec(free=FRICTIONAL), cause=FRICTION),
    Case(PENDULUM, "clock-drift", Plant(drift=0.08), Log(nominal_time=True), cause=CLOCK),
    Case(
        PENDULUM, "dropped-rows", log=Log(nominal_time=True, dropped=0.03), cause="dropped|missing rows|lost|" + CLOCK
    ),
    Case(PENDULUM, "clipped-speed", log=Log(clip={"hinge_speed": 3.0}), cause=LIMIT),
    Case(PENDULUM, "base-sways", Plant(sway=1.5), cause=BASE),
    Case(PENDULUM, "contact", Plant({"wall": 0.7}), cause=CONTACT),
    Case(PENDULUM, "wind", Plant(wind=0.3), cause=FORCE),
    Case(PENDULUM, "wind-0.03", Plant(wind=0.03), cause=FORCE),
    Case(PENDULUM, "loaded", Plant(loaded=0.06), spec=Spec(free=FRICTIONAL), cause=FRICTION),
    Case(PENDULUM, "warming", Plant(warming=0.1), spec=Spec(free=FRICTIONAL), cause=DRIFT),
    Case(PENDULUM, "uneven", Plant(uneven=0.08), spec=Spec(free=FRICTIONAL), cause=PLACE),
    Case(PENDULUM, "ripple", Plant(ripple=0.15), cause=PLACE),
    Case(PENDULUM, "sag", Plant(sag=0.1), spec=Spec(free=THREE), cause=DRIFT),
    Case(PENDULUM, "dead-zone", Plant(dead_zone=0.03), spec=Spec(free=THREE), cause=SMALL),
    Case(PENDULUM, "coarse", Plant(coarse=0.1), spec=Spec(free=THREE), cause=SMALL),
)

_ARM = (
    *in_all_conditions(ARM, "friction-0.1", {"friction_shoulder": 0.1, "friction_elbow": 0.05}, FRICTION),
    Case(ARM, "drag-noisy", Plant(drag=0.03), NOISY, cause=DRAG),
    Case(ARM, "delay-0.5", Plant(delay=0.5), cause=LATE),
    Case(ARM, "rate-9", Plant(spacing=1.09), cause=RATE),
    *(
        Case(ARM, f"friction-{size}", Plant({"friction_shoulder": size, "friction_elbow": size / 2}), cause=FRICTION)
        for size in (0.05, 0.2)
    ),
    Case(ARM, "friction-0.1-noisy", Plant({"friction_shoulder": 0.1, "friction_elbow": 0.05}), NOISY, cause=FRICTION),
    Case(ARM, "friction-0.1-positions", Plant({"friction_shoulder": 0.1}), POSITIONS, cause=FRICTION),
    Case(ARM, "drag", Plant(drag=0.03), cause=DRAG),
    Case(ARM, "lag-10ms", Plant(lag=0.01), cause=LATE),
    Case(ARM, "lag-elbow-5ms", Plant(last_lag=0.005), cause=LATE),
    Case(ARM, "lag-elbow-5ms-fine", Plant(last_lag=0.005, fine=5), cause=LATE),
    Case(ARM, "lag-elbow-2ms-fine", Plant(last_lag=0.002, fine=5), cause=LATE),
    Case(ARM, "delay-1", Plant(delay=1), cause=LATE),
    Case(ARM, "sign-elbow", log=Log(scale={"elbow": -1, "elbow_speed": -1}), cause=SIGN),
    Case(ARM, "sign-motor", log=Log(scale={"elbow_motor": -1}), cause=SIGN),
    Case(ARM, "swapped-joints", log=Log(swap=("shoulder", "elbow")), cause=COLUMNS),
    Case(
        ARM,
        "swapped-motors",
        log=Log(swap=("shoulder_motor", "elbow_motor"), clip={"shoulder_motor": 2.0}),
        cause=COLUMNS,
    ),
    Case(ARM, "degrees", log=Log(degrees=True), cause=UNIT),
    Case(ARM, "rate-5", Plant(spacing=1.05), cause=RATE),
    Case(ARM, "gravity", spec=Spec({"gravity": 0.0}), cause=GRAVITY),
    Case(ARM, "payload", Plant({"payload": 0.2}), cause=INERTIA),
    Case(ARM, "runs-alternate", Plant(by_run=({}, {"payload": 0.1}) * 3), cause=DRIFT),
    Case(ARM, "runs-payload", Plant(by_run=tuple({"payload": p} for p in (0.0, 0.1, 0.2))), cause=DRIFT),
    Case(ARM, "inertia", Plant({"armature_shoulder": 0.03, "armature_elbow": 0.02}), cause=INERTIA),
    Case(ARM, "spring", Plant({"spring_elbow": 0.8}), cause=SPRING),
    Case(ARM, "offset-elbow", log=Log(offset={"elbow": 0.1}), cause=OFFSET),
    Case(ARM, "gear-elbow", Plant({"gain_elbow": 1.25}), cause=GEAR),
    Case(ARM, "gear-invisible", Plant({"gain_elbow": 1.3, "gain_shoulder": 1.3}), cause=GEAR, invisible=True),
    Case(ARM, "range-just", Plant({"mass_fore": 1.04}), cause=RANGE),
    Case(ARM, "range-far", Plant({"mass_fore": 1.6}), cause=RANGE),
    Case(ARM, "limit", Plant(limit=0.5), cause=LIMIT),
    Case(ARM, "base-sways", Plant(sway=1.5), cause=BASE),
    Case(ARM, "wind-0.05", Plant(wind=0.05), cause=FORCE),
    Case(ARM, "loaded", Plant(loaded=0.06), cause=FRICTION),
    Case(ARM, "warming", Plant(warming=0.1), cause=DRIFT + "|" + FRICTION),
    Case(ARM, "sag", Plant(sag=0.1), cause=DRIFT),
    Case(ARM, "dead-zone", Plant(dead_zone=0.03), cause=SMALL),
    Case(ARM, "coarse-closed-loop", Plant(coarse=0.1, closed_loop=True), cause=SMALL),
    Case(ARM, "presliding", Plant(presliding=0.08), cause=FRICTION),
    Case(ARM, "filtered-positions", log=Log(positions="filtered", velocities="none"), cause=LATE),
    Case(ARM, "coupled", Plant(coupled=0.04), cause=COUPLED),
    Case(ARM, "coupled-positions", Plant(coupled=0.04), POSITIONS, cause=COUPLED),
)

_BOX = (
    Case(BOX, "fine", Plant(fine=5), cause=TIMESTEP),
    Case(BOX, "fine-exact", Plant(fine=5), Log(noise=0.0), cause=TIMESTEP),
    Case(BOX, "slope", Plant({"slope": 0.08}), cause=GRAVITY),
    Case(BOX, "drag", Plant(drag=1.0), cause=DRAG),
    Case(BOX, "damping", Plant({"damping": 2.0}), cause="damping|viscous"),
    Case(BOX, "delay-2", Plant(delay=2), cause=LATE),
    Case(BOX, "lag-20ms", Plant(lag=0.02), cause=LATE),
    Case(BOX, "sign-command", log=Log(scale={"push": -1}), cause=SIGN),
    Case(BOX, "spring", Plant({"spring": 6.0}), cause=SPRING),
    Case(BOX, "contact", Plant({"wall": 1.0}), cause=CONTACT),
    Case(BOX, "range-just", Plant({"mass": 2.6}), cause=RANGE),
    Case(BOX, "runs-friction", Plant(by_run=tuple({"friction": f} for f in (0.5, 0.65, 0.8))), cause=DRIFT),
)

_BALL = (
    Case(BALL, "drag", Plant(drag=0.1), cause=DRAG),
    Case(BALL, "gravity", spec=Spec({"gravity": -9.0}), cause=GRAVITY),
    Case(BALL, "delay-2", Plant(delay=2), cause=LATE),
    Case(BALL, "wind", Plant(wind=0.4), cause=FORCE),
    Case(BALL, "contact", Plant({"wall": 1.0}), cause=CONTACT),
    Case(BALL, "contact-soft", Plant({"contact_stiffness": 1000.0}), cause=CONTACT),
    Case(BALL, "offset-floor", Plant({"floor": 0.05}), cause="floor|" + OFFSET),
    Case(BALL, "rate-5", Plant(spacing=1.05), cause=RATE),
    Case(BALL, "sign-push", log=Log(scale={"push": -1}), cause=SIGN),
)

_HULL = (
    Case(HULL, "drag", Plant(drag=6.0), cause=DRAG),
    Case(HULL, "wind", Plant(wind=1.5), cause=FORCE),
    Case(HULL, "gear-left", Plant({"gain_left": 0.8}), cause=GEAR),
    Case(HULL, "gravity", Plant({"gravity": -0.05}), cause=GRAVITY),
    Case(HULL, "lag-100ms", Plant(lag=0.1), cause=LATE),
    Case(HULL, "inertia", Plant({"armature": 2.0}), cause=INERTIA),
    Case(HULL, "payload", Plant({"payload": 1.5}), cause=INERTIA),
    Case(HULL, "swapped-thrusters", log=Log(swap=("left", "right")), cause=COLUMNS),
)

_LEG = (
    Case(LEG, "friction-0.3", Plant({"friction": 0.3}), cause=FRICTION),
    Case(LEG, "delay-1", Plant(delay=1), cause=LATE),
    Case(LEG, "gear-servo", Plant({"servo": 40.0}), cause="kp|" + GEAR + "|" + SPRING),
    Case(LEG, "spring", Plant({"spring": 5.0}), cause=SPRING),
    Case(LEG, "offset-floor", Plant({"floor": 0.04}), cause="floor|" + CONTACT),
)

_CART = (
    *in_all_conditions(CART, "friction-0.2", {"friction": 0.2}, FRICTION),
    *(Case(CART, f"rate-{share}", Plant(spacing=1 + share / 100), cause=RATE) for share in (5, 9)),
    Case(CART, "lag-10ms", Plant(lag=0.01), cause=LATE),
    Case(CART, "range-far", Plant({"mass": 4.0}), cause=RANGE),
    Case(CART, "friction-0.2", Plant({"friction": 0.2}), cause=FRICTION),
    Case(CART, "friction-0.2-noisy", Plant({"friction": 0.2}), NOISY, cause=FRICTION),
    Case(CART, "drag", Plant(drag=1.0), cause=DRAG),
    Case(CART, "delay-0.5", Plant(delay=0.5), cause=LATE),
    Case(CART, "wind", Plant(wind=0.8), cause=FORCE),
    Case(CART, "presliding", Plant(presliding=0.3), cause=FRICTION),
    Case(CART, "dead-zone", Plant(dead_zone=0.03), cause=SMALL),
    Case(CART, "dead-zone-closed-loop", Plant(dead_zone=0.03, closed_loop=True), cause=SMALL),
    Case(CART, "gear-invisible", Plant({"gain": 1.25}), cause=GEAR, invisible=True),
    Case(
        CART, "unit-invisible", log=Log(scale={"slide": 1.1, "slide_speed": 1.1}), cause="unit|" + GEAR, invisible=True
    ),
)

DECEPTIONS = (*_PENDULUM, *_ARM, *_BOX, *_BALL, *_HULL, *_LEG, *_CART)
