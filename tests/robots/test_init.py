"""The first spec: written from a model, loadable as it is, and its comments true when they are made lines."""

import re
import shutil
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.errors import MadocError
from madoc.robots.init import write_spec
from madoc.robots.proposals import MOST, RECIPES
from own_robots import CART
from robots import ARM, SPRING

URDF = """<robot name="r"><link name="base"/><link name="rod"><inertial><mass value="1"/><origin xyz="0 0 -.5"/>
<inertia ixx=".1" iyy=".1" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge joint" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="5" velocity="2"/></joint></robot>"""

FLYING = """<mujoco><worldbody><body name="box"><freejoint name="root"/><geom type="box" size=".1 .1 .1" mass="1"/>
<site name="imu"/><body name="no"><joint name="off" type="ball"/><geom size=".1" mass=".2" pos="0 0 1"/>
<body><joint name="left-knee" type="slide"/><joint/><geom size=".1" mass=".3"/></body></body></body></worldbody>
<actuator><motor name="left-knee" joint="left-knee" ctrlrange="-2 3" ctrllimited="true"/><motor joint="left-knee"/>
</actuator>
<sensor><accelerometer name="imu" site="imu"/><jointpos name="knee" joint="left-knee"/></sensor></mujoco>"""

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
MODELS = {"arm": ARM, "spring": SPRING, "cart": CART, "pendulum": URDF, "flying": FLYING}


def written(folder, text, file="model.xml"):
    (folder / file).write_text(text)
    write_spec(folder / file, folder / "model.yaml")
    return folder / "model.yaml"


@pytest.mark.parametrize("name", MODELS)
def test_it_loads_and_so_do_its_comments(tmp_path, name):
    path = written(tmp_path, MODELS[name])
    first = robots.load(path)
    text = path.read_text()
    items = re.sub(r"(?m)^(  |)# ((- \{|log:|  \w+:|(reward|end|goals|reset):).*)$", r"\1\2", text)
    assert items.count("# ") < text.count("# ")
    path.write_text(items)
    whole = robots.load(path)
    assert len(whole.spec.parameters) > len(first.spec.parameters)
    assert whole.spec.parameters[-1].field == "signal_bias"
    assert "action_delay" in [row.field for row in whole.spec.parameters]
    assert all(len(line) <= 220 for line in text.splitlines())


def test_of_the_arm(tmp_path):
    robot = robots.load(written(tmp_path, ARM))
    assert [(row.name, row.unit, row.reads) for row in robot.signals] == [
        ("shoulder", "rad", "position(shoulder)"),
        ("elbow", "rad", "position(elbow)"),
        ("shoulder_speed", "rad/s", "velocity(shoulder)"),
        ("elbow_speed", "rad/s", "velocity(elbow)"),
    ]
    assert [row.name for row in robot.actions] == ["shoulder_command", "elbow_command"]
    assert robot.task.parameters.names == (
        *("body_mass.upper", "body_mass.fore", "dof_damping.shoulder", "dof_damping.elbow"),
    )
    assert robot.task.parameters.high.tolist() == [2.0, 1.0, 0.4, 0.2]
    assert robot.task.state_from_observation is not None
    assert robot.spec.control_step == 0.02


def test_of_a_spring(tmp_path):
    space = robots.load(written(tmp_path, SPRING)).task.parameters
    assert space.names == ("body_mass.cart", "jnt_stiffness.slide", "dof_damping.slide")
    assert (space.low[1], space.high[1], space.parameters[1].unit) == (2.0, 8.0, "N/m")


def test_of_a_model_without_actuators(tmp_path):
    (action,) = robots.load(written(tmp_path, URDF, "model.urdf")).actions
    assert (action.name, action.low, action.high, action.unit) == ("hinge joint_target", -3.0, 3.0, "rad")
    assert "limit: 5," in (tmp_path / "model.yaml").read_text(), "the effort of the URDF"
    (tmp_path / "model.yaml").unlink()
    (action,) = robots.load(written(tmp_path, CART)).actions
    assert (action.name, action.unit) == ("rail_force", "N")
    assert "write the motor's largest force" in (tmp_path / "model.yaml").read_text()


def test_of_strange_names_and_free_joints(tmp_path):
    path = written(tmp_path, FLYING)
    robot = robots.load(path)
    assert robot.task.observation_size == 7 + 4 + 1 + 6 + 3 + 1
    assert robot.task.signals[:8] == (*(f"root_{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")), "off_qw")
    assert robot.actions[0].name == "left-knee_command"
    assert (robot.actions[0].low, robot.actions[0].high) == (-2.0, 3.0)
    assert robot.notes == ("no action drives the model's actuators number 1: their control is always 0",)
    text = path.read_text()
    assert "1 joint of the model cannot be used here" in text
    assert "1 actuator of the model cannot be used here" in text
    assert "body_mass, element: left-knee" in text or 'body_mass, element: "left-knee"' in text


def test_what_has_no_name_is_named_by_its_owner(tmp_path):
    named = CART.replace("</mujoco>", '<actuator><motor joint="rail"/></actuator></mujoco>')
    robot = robots.load(written(tmp_path, named))
    assert robot.actions[0].actuator == "rail"
    (tmp_path / "model.yaml").unlink()
    robot = robots.load(written(tmp_path, CART.replace('name="rail" ', "")))
    assert robot.task.signals == ("cart", "cart_speed")


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass':UserWarning")
@pytest.mark.parametrize("name", ["hopper", "half_cheetah", "ant", "walker2d"])
def test_of_gymnasiums_models(tmp_path, name):
    path = tmp_path / "mine.yaml"
    write_spec(ASSETS / f"{name}.xml", path)
    robot = robots.load(path)
    assert robot.spec.name == ("my_hopper" if name == "hopper" else robot.spec.name)
    assert len(robot.task.parameters) <= MOST
    assert not any("root" in parameter for parameter in robot.task.parameters.names), "a root is no joint of a machine"
    assert "# - {field: geom_friction, element" in path.read_text()
    assert "# - {field: actuator_gain, element: " in path.read_text()


def test_a_model_may_lie_deep(tmp_path):
    deep = tmp_path.joinpath(*["folder_of_a_long_name"] * 12)
    deep.mkdir(parents=True)
    shutil.copy(ASSETS / "hopper.xml", deep)
    write_spec(deep / "hopper.xml", tmp_path / "mine.yaml")
    assert robots.load(tmp_path / "mine.yaml").spec.name == "my_hopper"


@pytest.mark.parametrize(
    ("model", "sentence"),
    [
        ("<mujoco/>", "nothing in .*model.xml moves: it has no joint"),
        (
            CART.replace('name="rail" ', "").replace('name="cart"', ""),
            "no joint of .*model.xml has a name, and a spec reads",
        ),
        (
            CART.replace("</mujoco>", '<actuator><motor joint="rail"/><motor joint="rail"/></actuator></mujoco>'),
            "no action of .*model.xml can be written: no actuator has a name",
        ),
        ("<mujoco>", "model model.xml cannot be read"),
    ],
)
def test_what_no_spec_can_be_made_of(tmp_path, model, sentence):
    with pytest.raises(MadocError, match=sentence):
        written(tmp_path, model)
    assert [file.name for file in tmp_path.iterdir()] == ["model.xml"]


def test_nothing_is_overwritten(tmp_path):
    path = written(tmp_path, CART)
    with pytest.raises(MadocError, match=r"model.yaml exists already; choose another --out, or delete it"):
        write_spec(tmp_path / "model.xml", path)
    with pytest.raises(MadocError, match=r"there is no folder .*nowhere to write x.yaml into"):
        write_spec(tmp_path / "model.xml", tmp_path / "nowhere" / "x.yaml")
    with pytest.raises(MadocError, match=r"there is no model file .*other.xml: it is missing"):
        write_spec(tmp_path / "other.xml", tmp_path / "x.yaml")


LEGS = """<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body name="trunk" pos="0 0 .3"><freejoint name="base"/>
<geom size=".1" mass="8"/>{}</body></worldbody>{}</mujoco>"""
LEG = """<body name="{0}_thigh" pos="{1} {2} 0"><joint name="{0}_hip" axis="0 1 0" range="-60 60" armature="0.01"/>
<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.2" mass="1"/><body name="{0}_shin" pos="0 0 -.2">
<joint name="{0}_knee" axis="0 1 0" range="-120 0" armature="0.02"/>
<geom name="{0}_foot" type="capsule" size=".02" fromto="0 0 0 0 0 -.2" mass=".2"/></body></body>"""
SERVO = '<position name="{0}_{1}" joint="{0}_{1}" kp="{2}" kv="1" forcerange="-20 20" ctrlrange="-2 2"/>'


def quadruped(*, driven=True):
    """A trunk with four legs of two joints, and servos with 20 N·m."""
    corners = {"FL": (0.2, 0.1), "FR": (0.2, -0.1), "RL": (-0.2, 0.1), "RR": (-0.2, -0.1)}
    servos = "".join(SERVO.format(leg, *joint) for leg in corners for joint in (("hip", 40), ("knee", 60)))
    legs = "".join(LEG.format(leg, *place) for leg, place in corners.items())
    return LEGS.format(legs, f"<actuator>{servos}</actuator>" if driven else "")


def test_legs_share_values_and_a_servos_drive_comes_first(tmp_path):
    path = written(tmp_path, quadruped())
    found = [(row.field, tuple(row.elements or (row.element,)), row.high) for row in robots.load(path).spec.parameters]
    assert found == [
        ("dof_armature", ("*_hip",), 0.2),  # 1 % s² of 20 N·m
        ("dof_armature", ("*_knee",), 0.2),
        ("dof_frictionloss", ("*_hip",), 2.0),  # a tenth of it
        ("dof_frictionloss", ("*_knee",), 2.0),
        ("actuator_gain", ("*_hip",), 120.0),  # three times kp
        ("actuator_gain", ("*_knee",), 180.0),
        ("actuator_kv", ("*_hip",), 4.0),  # a tenth of kp, s
        ("actuator_kv", ("*_knee",), 6.0),
        ("action_delay", (None,), 0.02),
        ("body_mass", ("trunk",), 16.0),
    ]
    text = path.read_text()
    assert "# The body of base moves freely: a log has to tell where it is." in text
    assert "no floor" not in text


def test_what_nobody_drives_gets_the_commands_of_servos(tmp_path):
    """The eight joints carry 12.8 kg; the knee's lever is 0.1 m: 12.56 N·m, which a servo reaches at 0.1 rad."""
    robot = robots.load(written(tmp_path, quadruped(driven=False)))
    assert [row.unit for row in robot.actions] == 8 * ["rad"]
    knee = robot.spec.actions[1]
    assert (knee.name, knee.means, knee.low) == ("FL_knee_target", "position", -2.0944)
    assert (knee.kp, knee.limit) == (130.0, None)


def test_joints_of_a_hand_share_what_they_have_in_common(tmp_path):
    """Eleven fingers of one joint, ten of them alike: two lines a field, not eleven."""
    finger = '<body><joint name="f{0}" axis="0 1 0" armature="{1}"/><geom size=".02" mass=".1" pos="0 0 .1"/></body>'
    servo = '<position name="f{0}" joint="f{0}" kp="2" kv=".1" ctrlrange="-1 1" forcerange="-1 1"/>'
    fingers = "".join(finger.format(number, 0.01 if number else 0.02) for number in range(11))
    fingers += '<body><joint name="rail" type="slide" range="-1 1" limited="true"/><geom size=".02"/></body>'
    servos = "".join(servo.format(number) for number in [*range(11)]) + servo.replace("f{0}", "rail")
    text = f"<mujoco><worldbody>{fingers}</worldbody><actuator>{servos}</actuator></mujoco>"
    found = robots.load(written(tmp_path, text)).task.parameters.parameters
    armatures = {row.name: len(row.elements) for row in found if row.field == "dof_armature"}
    assert armatures == {"dof_armature.f0": 1, "dof_armature.f1+9": 10, "dof_armature.rail": 1}
    gains = [(len(row.elements), row.unit) for row in found if row.field == "actuator_gain"]
    assert gains == [(11, "N·m/rad"), (1, "N/m")], "of one number, but not of one unit"


def test_a_recipe_gives_the_ranges_of_its_machines(tmp_path):
    (tmp_path / "model.xml").write_text(quadruped(driven=False))
    for recipe, field, high in (("direct-drive-leg", "dof_frictionloss", 1.0), ("hobby-servo", "dof_armature", 0.05)):
        write_spec(tmp_path / "model.xml", tmp_path / f"{recipe}.yaml", recipe=recipe)
        robot = robots.load(tmp_path / f"{recipe}.yaml")
        assert {row.high for row in robot.task.parameters.parameters if row.field == field} == {high}
        assert f"# Ranges of {recipe}: of " in (tmp_path / f"{recipe}.yaml").read_text()
    assert robot.spec.actions[0].limit == 3.25
    with pytest.raises(MadocError, match="there is no recipe 'servo'; nearest: hobby-servo"):
        write_spec(tmp_path / "model.xml", tmp_path / "x.yaml", recipe="servo")


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("name", MODELS)
def test_every_recipe_of_every_model_loads(tmp_path, name, recipe):
    (tmp_path / "model.xml").write_text(MODELS[name])
    write_spec(tmp_path / "model.xml", tmp_path / "model.yaml", recipe=recipe)
    assert robots.load(tmp_path / "model.yaml").task.parameters


def test_what_a_log_of_the_model_needs_is_said(tmp_path):
    text = """<mujoco><worldbody><body name="hand"><freejoint name="free"/><geom name="palm" size=".1"/></body>
    <body name="arm"><joint name="lift" type="slide" axis="0 0 1" range="-1 1"/>
    <geom name="tip" size=".1" pos="0 0 .15"/>
    </body><body name="tracker" mocap="true"><geom size=".01" contype="0" conaffinity="0"/></body></worldbody>
    <equality><weld name="grip" body1="hand" body2="tracker"/></equality></mujoco>"""
    found = written(tmp_path, text).read_text()
    assert "# The model has no floor" in found
    assert "# In the model's first pose these touch: palm and tip." in found
    assert "# Equalities hold: grip." in found
    assert "# Mocap bodies stay where the model has them: tracker." in found


def test_a_tracker_of_no_body_stays_where_it_is(tmp_path):
    """Held by a stiff weld, the hand stays with the tracker at 0.5 m and does not fall."""
    text = """<mujoco><worldbody><body name="hand" pos="0 0 .5"><joint name="lift" type="slide" axis="0 0 1"/>
    <geom size=".1"/></body><body name="tracker" mocap="true" pos="0 0 .5"/></worldbody>
    <equality><weld body1="hand" body2="tracker"/></equality></mujoco>"""
    task = robots.load(written(tmp_path, text)).task
    system = simulation.make(task, threads=1).bind(task.parameters.middle)
    state = system.roll_out(np.zeros((1, 1, 2)), np.zeros((1, 1, 25, 1)))
    assert abs(state[0, 0, -1, 0]) < 1e-3
