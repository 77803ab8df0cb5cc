"""Machines whose motion depends on contacts between bodies: friction, shocks, and a base that stands on its feet."""

from collections.abc import Mapping

from adversary_cases.case import Action, Free, Robot
from adversary_cases.robots import document, servos, states

PUSHER_SERVO = (200.0, 20.0)
"""Stiffness (N/m) and damping (N·s/m) of the pusher's servo."""
WIPER_SERVO = (40.0, 4.0)
"""Stiffness (N·m/rad) and damping (N·m·s/rad) of the wiper's servos."""
WALKER_SERVO = (80.0, 4.0)
"""Stiffness (N·m/rad) and damping (N·m·s/rad) of the walker's servos."""


def pusher_mjcf(value: Mapping[str, float]) -> str:
    """A carriage with two fingers, between which a block slides on a table."""
    world = f"""    <geom name="table" type="plane" size="5 5 1"/>
    <body name="carriage" pos="0 0 0.05">
      <joint name="rail" type="slide" axis="1 0 0" damping="{value["damping"]}"/>
      <inertial pos="0 0 0" mass="{value["mass_carriage"]}" diaginertia="0.01 0.01 0.01"/>
      <geom name="rear" type="sphere" size="0.02" pos="-0.1 0 0" contype="2" conaffinity="2"/>
      <geom name="front" type="sphere" size="0.02" pos="0.1 0 0" contype="2" conaffinity="2"/>
    </body>
    <body name="block" pos="0 0 0.05">
      <joint name="block_x" type="slide" axis="1 0 0"/>
      <joint name="block_z" type="slide" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="{value["mass_block"]}" diaginertia="0.002 0.002 0.002"/>
      <geom name="block" type="box" size="0.05 0.05 0.05" friction="{value["friction"]} 0.005 0.0001" priority="1"
        contype="3" conaffinity="3"/>
    </body>"""
    return document("pusher", 0.002, "0 0 -9.81", world, servos(("rail",), value["servo"], PUSHER_SERVO[1]))


def wiper_mjcf(value: Mapping[str, float]) -> str:
    """An arm of two links that presses a pad on a table and wipes it."""

    def link(name: str, mass: float) -> str:
        inertia = mass * 0.3**2 / 12
        return f"""<joint name="{name}" axis="0 1 0" damping="{value["damping"]}" armature="0.01"/>
        <inertial pos="0 0 -0.15" mass="{mass}" diaginertia="{inertia} {inertia} {inertia / 20}"/>"""

    world = f"""    <geom name="table" type="plane" size="5 5 1"/>
    <body name="upper" pos="0 0 0.58">
      {link("shoulder", value["mass_upper"])}
      <body name="fore" pos="0 0 -0.3">
        {link("elbow", value["mass_fore"])}
        <geom name="pad" type="sphere" size="0.03" pos="0 0 -0.3" friction="{value["friction"]} 0.005 0.0001"
          priority="1" solref="0.02 1"/>
      </body>
    </body>"""
    joints = "shoulder", "elbow"
    return document("wiper", 0.002, "0 0 -9.81", world, servos(joints, value["servo"], WIPER_SERVO[1]))


def walker_mjcf(value: Mapping[str, float]) -> str:
    """A trunk in a vertical plane on a fore and a hind leg of two joints each."""
    legs = []
    for name, place in (("fore", 0.3), ("hind", -0.3)):
        parts = []
        for part, mass in (("thigh", 0.7), ("calf", value["mass_calf"])):
            inertia = mass * 0.2**2 / 12
            parts.append(
                f'<joint name="{name}_{part}" axis="0 1 0" damping="{value["damping"]}" armature="0.01"/>\n'
                f'        <inertial pos="0 0 -0.1" mass="{mass}" diaginertia="{inertia} {inertia} {inertia / 20}"/>'
            )
        legs.append(f"""      <body name="{name}_thigh" pos="{place} 0 0">
        {parts[0]}
        <body name="{name}_calf" pos="0 0 -0.2">
          {parts[1]}
          <geom name="{name}_foot" type="sphere" size="0.02" pos="0 0 -0.2"
            friction="{value["friction"]} 0.005 0.0001" priority="1"/>
        </body>
      </body>""")
    world = f"""    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="trunk" pos="0 0 0.38">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="pitch" axis="0 1 0"/>
      <inertial pos="0 0 0" mass="{value["mass_trunk"]}" diaginertia="0.2 0.2 0.2"/>
{chr(10).join(legs)}
    </body>"""
    joints = "fore_thigh", "fore_calf", "hind_thigh", "hind_calf"
    return document("walker", 0.002, "0 0 -9.81", world, servos(joints, value["servo"], WALKER_SERVO[1]))


PUSHER = Robot(
    "pusher",
    pusher_mjcf,
    {"mass_carriage": 1.0, "mass_block": 0.8, "friction": 0.4, "damping": 3.0, "servo": 0},
    {
        "mass_block": Free("body_mass", "block", 0.3, 1.5),
        "friction": Free("geom_friction", "block", 0.1, 0.8),
        "damping": Free("dof_damping", "rail", 0.0, 6.0),
    },
    ("mass_block", "friction", "damping"),
    states("rail", "block_x", "block_z"),
    (Action("rail_target", -0.15, 0.15, "rail", *PUSHER_SERVO),),
    timestep=0.002,
    hold=0.4,
)
WIPER = Robot(
    "wiper",
    wiper_mjcf,
    {"mass_upper": 1.0, "mass_fore": 0.6, "friction": 0.5, "damping": 0.4, "servo": 0},
    {
        "mass_fore": Free("body_mass_and_inertia", "fore", 0.3, 1.0),
        "friction": Free("geom_friction", "pad", 0.1, 1.0),
        "damping": Free("dof_damping", "shoulder elbow", 0.0, 1.0),
    },
    ("mass_fore", "friction", "damping"),
    states("shoulder", "elbow"),
    (
        Action("shoulder_target", -0.3, 0.9, "shoulder", *WIPER_SERVO),
        Action("elbow_target", -1.2, -0.5, "elbow", *WIPER_SERVO),
    ),
    timestep=0.002,
    hold=0.3,
    start={0: 0.5, 1: -1.0},
)
WALKER = Robot(
    "walker",
    walker_mjcf,
    {"mass_trunk": 5.0, "mass_calf": 0.3, "friction": 0.6, "damping": 0.3, "servo": 0},
    {
        "mass_trunk": Free("body_mass", "trunk", 3.0, 8.0),
        "friction": Free("geom_friction", "fore_foot hind_foot", 0.2, 1.2),
        "damping": Free("dof_damping", "fore_thigh fore_calf hind_thigh hind_calf", 0.0, 1.0),
    },
    ("mass_trunk", "friction", "damping"),
    states("x", "z", "pitch", "fore_thigh", "fore_calf", "hind_thigh", "hind_calf"),
    tuple(
        Action(f"{leg}_{part}_target", *limits, f"{leg}_{part}", *WALKER_SERVO)
        for leg in ("fore", "hind")
        for part, limits in (("thigh", (0.4, 0.6)), ("calf", (-1.2, -0.8)))
    ),
    timestep=0.002,
    hold=0.3,
    start={1: 0.0, 3: 0.5, 4: -1.0, 5: 0.5, 6: -1.0},
)
