"""The first spec: written from a model, loadable as it is, and its comments true when they are made lines."""

import re
import shutil
from pathlib import Path

import gymnasium
import pytest

from madoc import robots
from madoc.errors import MadocError
from madoc.robots.init import write_spec
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
    assert [row.field for row in whole.spec.parameters][-2:] == ["action_delay", "signal_bias"]
    assert all(len(line) <= 140 for line in text.splitlines())


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
    assert (action.name, action.low, action.high, action.unit) == ("hinge joint_torque", -5.0, 5.0, "N·m")
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
    assert len(robot.task.parameters) <= 16
    assert not any("root" in parameter for parameter in robot.task.parameters.names), "a root is no joint of a machine"
    assert "# - {field: geom_friction, element: floor" in path.read_text()
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
        ("<mujoco/>", "no joint of .*model.xml has a name"),
        (
            CART.replace('name="rail" ', "").replace('name="cart"', ""),
            "no joint of .*model.xml has a name, and a spec reads",
        ),
        (
            CART.replace("</mujoco>", '<actuator><motor joint="rail"/><motor joint="rail"/></actuator></mujoco>'),
            "no actuator of .*model.xml has a name",
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
