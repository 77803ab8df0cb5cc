"""The machines: MJCF of given values, what is logged and commanded, and what a spec may calibrate."""

from collections.abc import Mapping
from math import cos, sin

from adversary_cases.case import Action, Free, Robot, Signal


def document(name: str, timestep: float, gravity: str, world: str, actuators: str) -> str:
    """An MJCF file."""
    return f"""<mujoco model="{name}">
  <compiler angle="radian"/>
  <option timestep="{timestep}" integrator="implicitfast" gravity="{gravity}"/>
  <worldbody>
{world}
  </worldbody>
  <actuator>
{actuators}
  </actuator>
</mujoco>
"""


def pendulum_mjcf(value: Mapping[str, float]) -> str:
    """A point mass on a rod; 0 rad hangs down. `flex` puts a spring, `play` a gap, between encoder and rod."""
    length = value["length"]
    loose = ""
    if value["flex"]:
        loose = f'<joint name="flex" axis="0 1 0" stiffness="{value["flex"]}" damping="0.02"/>'
    if value["play"]:
        loose = f'<joint name="flex" axis="0 1 0" limited="true" range="{-value["play"]} {value["play"]}"/>'
    wall = ""
    if value["wall"]:
        wall = f'<geom name="wall" type="plane" pos="{length * value["wall"]} 0 0" zaxis="-1 0 0" size="1 1 1"/>'
    weight = f"""
      <inertial pos="0 0 {-length}" mass="{value["mass"]}" diaginertia="1e-6 1e-6 1e-6"/>
      <geom name="weight" type="sphere" size="0.03" pos="0 0 {-length}" contype="{int(bool(wall))}" conaffinity="0"/>"""
    payload = ""
    if value["payload"]:
        payload = f"""
      <body name="payload" pos="0 0 {-1.6 * length}"><inertial pos="0 0 0" mass="{value["payload"]}"
        diaginertia="1e-6 1e-6 1e-6"/></body>"""
    rotor = '<inertial pos="0 0 0" mass="0.05" diaginertia="2e-3 2e-3 2e-3"/>'
    link = f'{rotor}<body name="link">{loose}{weight}{payload}</body>' if loose else weight + payload
    world = f"""    {wall}
    <body name="pendulum">
      <joint name="hinge" axis="0 1 0" damping="{value["damping"]}" frictionloss="{value["friction"]}"
        armature="{value["armature"]}" stiffness="{value["spring"]}"/>{link}
    </body>"""
    motor = f'    <motor name="torque" joint="hinge" gear="{value["gain"]}" ctrllimited="true" ctrlrange="-4 4"/>'
    return document("pendulum", 0.005, f"0 0 {value['gravity']}", world, motor)


def arm_mjcf(value: Mapping[str, float]) -> str:
    """Two links that hang in a vertical plane, a motor on each joint."""

    def inertial(mass: float, length: float) -> str:
        inertia = mass * length**2 / 12
        return f'<inertial pos="0 0 {-length / 2}" mass="{mass}" diaginertia="{inertia} {inertia} {inertia / 50}"/>'

    def joint(name: str) -> str:
        return (
            f'<joint name="{name}" axis="0 1 0" damping="{value["damping_" + name]}" '
            f'frictionloss="{value["friction_" + name]}" armature="{value["armature_" + name]}" '
            f'stiffness="{value["spring_" + name]}"/>'
        )

    payload = ""
    if value["payload"]:
        payload = f"""
        <body name="payload" pos="0 0 -0.4"><inertial pos="0 0 0" mass="{value["payload"]}"
          diaginertia="1e-5 1e-5 1e-5"/></body>"""
    world = f"""    <body name="upper">
      {joint("shoulder")}
      {inertial(value["mass_upper"], 0.5)}
      <body name="fore" pos="0 0 -0.5">
        {joint("elbow")}
        {inertial(value["mass_fore"], 0.4)}{payload}
      </body>
    </body>"""
    motors = "\n".join(
        f'    <motor name="{name}_motor" joint="{name}" gear="{value["gain_" + name]}" ctrllimited="true" '
        f'ctrlrange="{-limit} {limit}"/>'
        for name, limit in (("shoulder", 4), ("elbow", 2))
    )
    return document("arm", 0.005, f"0 0 {value['gravity']}", world, motors)


def box_mjcf(value: Mapping[str, float]) -> str:
    """A box that a force pushes along a plane. `slope` tilts gravity, in rad; x points down the slope."""
    tilt = value["slope"]
    gravity = f"{-value['gravity'] * sin(tilt)} 0 {value['gravity'] * cos(tilt)}"
    wall = '<geom name="wall" type="plane" pos="0.6 0 0" zaxis="-1 0 0" size="5 5 1"/>' if value["wall"] else ""
    world = f"""    <geom name="floor" type="plane" size="5 5 1"/>{wall}
    <body name="box" pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0" damping="{value["damping"]}" stiffness="{value["spring"]}"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="{value["mass"]}" diaginertia="0.01 0.01 0.01"/>
      <geom name="box" type="box" size="0.1 0.1 0.1" friction="{value["friction"]} 0.005 0.0001" priority="1"/>
    </body>"""
    motor = f'    <motor name="push" joint="x" gear="{value["gain"]}" ctrllimited="true" ctrlrange="-25 25"/>'
    return document("box", 0.005, gravity, world, motor)


def ball_mjcf(value: Mapping[str, float]) -> str:
    """A ball that bounces on a plane, pushed sideways and up or down."""
    wall = '<geom name="wall" type="plane" pos="0.7 0 0" zaxis="-1 0 0" size="5 5 1"/>' if value["wall"] else ""
    world = f"""    <geom name="floor" type="plane" pos="0 0 {value["floor"]}" size="5 5 1"/>{wall}
    <body name="ball">
      <joint name="x" type="slide" axis="1 0 0" damping="{value["damping"]}"/>
      <joint name="z" type="slide" axis="0 0 1" damping="{value["damping"]}"/>
      <inertial pos="0 0 0" mass="{value["mass"]}" diaginertia="0.001 0.001 0.001"/>
      <geom name="ball" type="sphere" size="0.1" friction="{value["friction"]} 0.005 0.0001" priority="1"
        solref="{-value["contact_stiffness"]} -6"/>
    </body>"""
    motors = """    <motor name="push" joint="x" ctrllimited="true" ctrlrange="-4 4"/>
    <motor name="lift" joint="z" ctrllimited="true" ctrlrange="-6 6"/>"""
    return document("ball", 0.002, f"0 0 {value['gravity']}", world, motors)


def hull_mjcf(value: Mapping[str, float]) -> str:
    """A neutrally buoyant hull with a free base and linear drag: two thrusters that push and turn, one that dives."""
    mass = value["mass"]
    payload = ""
    if value["payload"]:
        payload = f"""
      <body name="payload" pos="0.3 0.1 0"><inertial pos="0 0 0" mass="{value["payload"]}"
        diaginertia="0.001 0.001 0.001"/></body>"""
    world = f"""    <body name="hull">
      <joint name="base" type="free" damping="{value["damping"]}" armature="{value["armature"]}"/>
      <inertial pos="0 0 0" mass="{mass}" diaginertia="{0.05 * mass} {0.12 * mass} {0.14 * mass}"/>
      <geom name="hull" type="capsule" fromto="-0.5 0 0 0.5 0 0" size="0.12" contype="0" conaffinity="0"/>
      <site name="left" pos="-0.4 0.25 0"/><site name="right" pos="-0.4 -0.25 0"/>
      <site name="dive" pos="0.05 0 0"/>{payload}
    </body>"""
    thrusters = (
        ("left", f"{value['gain_left']} 0 0 0 0 0"),
        ("right", f"{value['gain']} 0 0 0 0 0"),
        ("dive", f"0 0 {value['gain']} 0 0 0"),
    )
    motors = "\n".join(
        f'    <motor name="{name}" site="{name}" gear="{gear}" ctrllimited="true" ctrlrange="-8 8"/>'
        for name, gear in thrusters
    )
    return document("hull", 0.01, f"0 0 {value['gravity']}", world, motors)


def servos(joints: tuple[str, ...], stiffness: float, damping: float) -> str:
    """Position servos of the machine, which the spec adds to the user's model; none if they have no stiffness."""
    if not stiffness:
        return ""
    return "\n".join(
        f'    <position name="{joint}_target" joint="{joint}" kp="{stiffness}" kv="{damping}"/>' for joint in joints
    )


LEG_SERVO = (60.0, 1.0)
"""Stiffness (N·m/rad) and damping (N·m·s/rad) of the leg's servos."""


def leg_mjcf(value: Mapping[str, float]) -> str:
    """A leg with position servos below a trunk on a vertical rail, its foot on the floor.

    The user's model has no servos, for the spec adds them; `servo` is their stiffness in the machine.
    """

    def link(name: str, length: float, mass: float) -> str:
        inertia = mass * length**2 / 12
        return f"""<joint name="{name}" axis="0 1 0" damping="{value["damping"]}" armature="{value["armature"]}"
          frictionloss="{value["friction"]}" stiffness="{value["spring"]}"/>
        <inertial pos="0 0 {-length / 2}" mass="{mass}" diaginertia="{inertia} {inertia} {inertia / 20}"/>"""

    world = f"""    <geom name="floor" type="plane" pos="0 0 {value["floor"]}" size="5 5 1"/>
    <body name="trunk" pos="0 0 0.5">
      <joint name="rail" type="slide" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="{value["mass_trunk"]}" diaginertia="0.02 0.02 0.02"/>
      <body name="thigh">
        {link("hip", 0.25, value["mass_thigh"])}
        <body name="shank" pos="0 0 -0.25">
          {link("knee", 0.25, value["mass_shank"])}
          <geom name="foot" type="sphere" size="0.025" pos="0 0 -0.25" friction="0.6 0.005 0.0001"/>
        </body>
      </body>
    </body>"""
    return document(
        "leg", 0.002, f"0 0 {value['gravity']}", world, servos(("hip", "knee"), value["servo"], LEG_SERVO[1])
    )


def cart_mjcf(value: Mapping[str, float]) -> str:
    """A cart on a rail between springs, pushed by a force."""
    world = f"""    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0" damping="{value["damping"]}" stiffness="{value["stiffness"]}"
        frictionloss="{value["friction"]}"/>
      <inertial pos="0 0 0" mass="{value["mass"]}" diaginertia="0.01 0.01 0.01"/>
    </body>"""
    motor = f'    <motor name="force" joint="slide" gear="{value["gain"]}" ctrllimited="true" ctrlrange="-5 5"/>'
    return document("cart", 0.005, "0 0 -9.81", world, motor)


def states(*joints: str) -> tuple[Signal, ...]:
    """Position and velocity of joints of one degree of freedom."""
    return (
        *(Signal(joint, joint) for joint in joints),
        *(Signal(f"{joint}_speed", joint, "velocity") for joint in joints),
    )


PENDULUM = Robot(
    "pendulum",
    pendulum_mjcf,
    {"mass": 0.7, "length": 0.5, "damping": 0.2, "friction": 0, "gain": 1, "armature": 0, "spring": 0, "gravity": -9.81}
    | dict.fromkeys(("flex", "play", "wall", "payload"), 0.0),
    {
        "mass": Free("body_mass", "pendulum", 0.3, 1.2),
        "length": Free("body_com", "pendulum", 0.3, 0.7),
        "damping": Free("dof_damping", "hinge", 0.0, 0.5),
        "friction": Free("dof_frictionloss", "hinge", 0.0, 0.5),
        "gain": Free("actuator_gain", "torque", 0.5, 1.5),
        "armature": Free("dof_armature", "hinge", 0.0, 0.1),
    },
    ("length", "damping"),
    states("hinge"),
    (Action("torque", -4.0, 4.0, "hinge"),),
    gains=(6.0, 0.8),
)
ARM = Robot(
    "arm",
    arm_mjcf,
    {"mass_upper": 1.2, "mass_fore": 0.6, "damping_shoulder": 0.4, "damping_elbow": 0.2, "payload": 0, "gravity": -9.81}
    | {"gain_shoulder": 1, "gain_elbow": 1}
    | {f"{name}_{joint}": 0 for name in ("friction", "armature", "spring") for joint in ("shoulder", "elbow")},
    {
        "mass_upper": Free("body_mass_and_inertia", "upper", 0.5, 2.0),
        "mass_fore": Free("body_mass_and_inertia", "fore", 0.25, 1.0),
        "damping_shoulder": Free("dof_damping", "shoulder", 0.0, 0.8),
        "damping_elbow": Free("dof_damping", "elbow", 0.0, 0.4),
        "friction_shoulder": Free("dof_frictionloss", "shoulder", 0.0, 0.4),
        "friction_elbow": Free("dof_frictionloss", "elbow", 0.0, 0.2),
        "armature_shoulder": Free("dof_armature", "shoulder", 0.0, 0.1),
        "armature_elbow": Free("dof_armature", "elbow", 0.0, 0.05),
    },
    ("mass_upper", "mass_fore", "damping_shoulder", "damping_elbow"),
    states("shoulder", "elbow"),
    (Action("shoulder_motor", -4.0, 4.0, "shoulder"), Action("elbow_motor", -2.0, 2.0, "elbow")),
    gains=(6.0, 0.6),
)
BOX = Robot(
    "box",
    box_mjcf,
    {"mass": 1.4, "friction": 0.7, "gain": 1, "damping": 0, "spring": 0, "slope": 0, "wall": 0, "gravity": -9.81},
    {"mass": Free("body_mass", "box", 0.5, 2.5), "friction": Free("geom_friction", "box", 0.1, 1.2)},
    ("mass", "friction"),
    states("x", "z"),
    (Action("push", -25.0, 25.0, "x"),),
    hold=0.3,
)
BALL = Robot(
    "ball",
    ball_mjcf,
    {"mass": 0.7, "damping": 0.25, "friction": 0.1, "contact_stiffness": 3000, "floor": 0, "wall": 0, "gravity": -9.81},
    {"mass": Free("body_mass", "ball", 0.3, 1.2), "damping": Free("dof_damping", "x z", 0.0, 0.8)},
    ("mass", "damping"),
    states("x", "z"),
    (Action("push", -4.0, 4.0, "x"), Action("lift", -6.0, 6.0, "z")),
    timestep=0.002,
    start={1: 0.8},
)
HULL = Robot(
    "hull",
    hull_mjcf,
    {"mass": 12, "damping": 6, "armature": 0, "gain": 1, "gain_left": 1, "payload": 0, "gravity": 0},
    {"mass": Free("body_mass_and_inertia", "hull", 5.0, 25.0), "damping": Free("dof_damping", "base", 1.0, 12.0)},
    ("mass", "damping"),
    (
        *(
            Signal(name, "base", "position", index)
            for index, name in enumerate(("x", "y", "z", "qw", "qx", "qy", "qz"))
        ),
        *(Signal(name, "base", "velocity", index) for index, name in enumerate(("vx", "vy", "vz", "wx", "wy", "wz"))),
    ),
    tuple(Action(name, -8.0, 8.0) for name in ("left", "right", "dive")),
    timestep=0.01,
    control_step=0.05,
    hold=0.8,
)
LEG = Robot(
    "leg",
    leg_mjcf,
    {
        "mass_trunk": 2,
        "mass_thigh": 0.6,
        "mass_shank": 0.3,
        "damping": 0.3,
        "armature": 0.02,
        "friction": 0,
        "spring": 0,
    }
    | {"servo": 0, "floor": 0, "gravity": -9.81},
    {
        "mass_trunk": Free("body_mass", "trunk", 1.0, 3.0),
        "mass_thigh": Free("body_mass_and_inertia", "thigh", 0.3, 1.0),
        "mass_shank": Free("body_mass_and_inertia", "shank", 0.15, 0.6),
        "damping": Free("dof_damping", "hip knee", 0.0, 1.0),
        "armature": Free("dof_armature", "hip knee", 0.0, 0.05),
    },
    ("mass_trunk", "damping", "armature"),
    states("rail", "hip", "knee"),
    (
        Action("hip_target", 0.2, 1.0, "hip", *LEG_SERVO),
        Action("knee_target", -1.8, -0.6, "knee", *LEG_SERVO),
    ),
    timestep=0.002,
    hold=0.3,
    start={0: -0.03, 1: 0.5, 2: -1.0},
)
CART = Robot(
    "cart",
    cart_mjcf,
    {"mass": 1.5, "damping": 0.8, "stiffness": 15, "friction": 0, "gain": 1},
    {
        "mass": Free("body_mass", "cart", 0.5, 3.0),
        "damping": Free("dof_damping", "slide", 0.0, 2.0),
        "stiffness": Free("jnt_stiffness", "slide", 5.0, 30.0),
    },
    ("mass", "damping", "stiffness"),
    states("slide"),
    (Action("force", -5.0, 5.0, "slide"),),
    gains=(10.0, 2.0),
)
