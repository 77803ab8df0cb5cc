"""Configurations for mjlab and Isaac Lab: that they are Python, what they say, and what they say is lost."""

import ast
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from madoc.calibration.result import ParameterEstimate
from madoc.export.parameter_files import Exported
from madoc.export.trainers import Robot, save_isaac_lab, save_mjlab
from madoc.parameters import Parameter
from madoc.simulation.configuration import JointActuator

SERVO = JointActuator("fl", "fl_knee", True, 40.0, 1.0, 23.7, 0.01, 0.2, 0.1)
ROBOT = Robot(
    name="leg",
    actuators=(
        SERVO,
        replace(SERVO, name="fr", joint="fr_knee"),
        JointActuator("m", "hip", False, 0, 0, None, 0, 0, 0),
    ),
    start={"fl_knee": -1.5},
    physics={"timestep": "0.002"},
    decimation=5,
    timestep=0.002,
    delay=0.0075,
    fields=("dof_armature", "opt.gravity"),
    lost=("the option density is 1.2 and mjlab has none",),
)


ACTUATOR_FIELDS = {"joint_names_expr", "stiffness", "damping", "armature", "friction", "dynamic_friction"}
ACTUATOR_FIELDS |= {"viscous_friction", "effort_limit", "effort_limit_sim"}
WHERE = {"joint_ids", "env_ids"}
ISAAC_LAB = {
    "ImplicitActuatorCfg": ACTUATOR_FIELDS,
    "DelayedPDActuatorCfg": ACTUATOR_FIELDS | {"min_delay", "max_delay"},
    "write_joint_armature_to_sim_index": {"armature"} | WHERE,
    "write_joint_friction_coefficient_to_sim_index": {"joint_friction_coeff", "joint_dynamic_friction_coeff"} | WHERE,
    "write_joint_viscous_friction_coefficient_to_sim_index": {"joint_viscous_friction_coeff"} | WHERE,
    "write_joint_stiffness_to_sim_index": {"stiffness"} | WHERE,
    "write_joint_damping_to_sim_index": {"damping"} | WHERE,
}
"""Names and keywords in isaac-sim/IsaacLab: isaaclab/actuators/actuator_base_cfg.py and actuator_pd_cfg.py (e579469),
isaaclab_physx/assets/articulation/articulation.py (b4e94b5)."""


def exported(field, element, estimate):
    parameter = Parameter(field, element, 0.0, 10.0)
    row = ParameterEstimate(estimate=estimate, std=0.1, low=0.0, high=10.0, unit=parameter.unit)
    return Exported(parameter, row, (0.0,))


PARAMETERS = (
    exported("dof_armature", ("fl_knee", "fr_knee"), 0.01),
    exported("actuator_gain", "fl", 40.0),
    exported("body_mass", "trunk", 5.0),
    exported("signal_bias", 'a """quote"""', 0.3),
)


def calls(path, name):
    """Keyword arguments of each call of a function in a file, evaluated where they are literals."""
    tree = ast.parse(path.read_text())
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and getattr(node.func, "id", "") == name]
    return [{word.arg: ast.literal_eval(word.value) for word in call.keywords} for call in found]


def test_mjlab_gets_servos_of_equal_numbers_together_and_other_actuators_as_they_are(tmp_path):
    path = tmp_path / "mjlab_robot.py"
    save_mjlab(path, ROBOT, PARAMETERS)
    (servos,) = calls(path, "BuiltinPositionActuatorCfg")
    assert servos == {
        "target_names_expr": ("fl_knee", "fr_knee"),
        "stiffness": 40.0,
        "damping": 1.0,
        "effort_limit": 23.7,
        "armature": 0.01,
        "frictionloss": 0.2,
        "viscous_damping": 0.1,
        "delay_min_lag": 4,
        "delay_max_lag": 4,
    }
    (motor,) = calls(path, "XmlActuatorCfg")
    assert motor["target_names_expr"] == ("hip",)
    text = path.read_text()
    assert "draws do not reach opt.gravity" in text
    assert "CHANGED = ('dof_armature',)" in text and "MADE_BY_MJLAB = ('fl', 'fr')" in text
    assert "a delay of 4 physics steps is 0.5 ms more than estimated" in text and "density" in text


def test_mjlab_gets_actuators_by_their_command_and_what_they_act_on_and_a_floating_base_where_it_is(tmp_path):
    path, motor = tmp_path / "mjlab_robot.py", ROBOT.actuators[2]
    others = (
        replace(motor, name="turn", joint="drum", means="velocity"),
        replace(motor, name="pull", joint="", tendon="rope"),
        replace(motor, name="thrust", joint="", site="rotor.1"),
        replace(motor, name="glue", joint=""),
        replace(motor, name="moment", joint="", site="rotor.1"),
    )
    robot = replace(ROBOT, actuators=(motor, *others), base=((0.0, 0.0, 0.3), (1.0, 0.0, 0.0, 0.0)), delay=0.0)
    save_mjlab(path, robot, PARAMETERS)
    text = path.read_text().replace("TransmissionType.TENDON", "'tendon'").replace("TransmissionType.SITE", "'site'")
    (tmp_path / "literal.py").write_text(text)
    found = calls(tmp_path / "literal.py", "XmlActuatorCfg")
    assert [(each["target_names_expr"], each["command_field"], each.get("transmission_type")) for each in found] == [
        (("hip",), "effort", None),
        (("drum",), "velocity", None),
        (("rope",), "effort", "tendon"),
        (("rotor\\.1",), "effort", "site"),
    ]
    assert "commands glue" in text and "commands moment" in text and "import TransmissionType" in text
    assert "pos=(0.0, 0.0, 0.3)" in text and "rot=(1.0, 0.0, 0.0, 0.0)" in text
    save_mjlab(path, replace(ROBOT, actuators=()), PARAMETERS)
    assert "import \n" not in path.read_text() and "ACTUATORS = (\n)" in path.read_text()
    ast.parse(path.read_text())


def test_isaac_lab_gets_what_its_joints_have_and_is_told_the_rest(tmp_path):
    path = tmp_path / "isaac_lab_robot.py"
    save_isaac_lab(path, ROBOT, PARAMETERS)
    servos, motor = calls(path, "DelayedPDActuatorCfg")
    assert (
        servos["joint_names_expr"] == ["fl_knee", "fr_knee"] and servos["dynamic_friction"] == servos["friction"] == 0.2
    )
    assert (servos["min_delay"], servos["max_delay"], motor["stiffness"]) == (4, 4, 0.0)
    text = path.read_text()
    assert "DRAWN = [('armature', ['fl_knee', 'fr_knee'], 0), ('stiffness', ['fl_knee'], 1)]" in text
    assert "body_mass.trunk = 5 kg has to go into the robot's USD file" in text


@pytest.mark.parametrize("delay", [0.0, 0.0075])
def test_isaac_lab_is_asked_for_by_its_published_names_alone(tmp_path, delay):
    path = tmp_path / "isaac_lab_robot.py"
    fields = ("dof_armature", "dof_frictionloss", "dof_damping")
    rows = [exported(field, "fl_knee", 0.01) for field in fields]
    rows += [exported(field, "fl", 40.0) for field in ("actuator_gain", "actuator_kv")]
    save_isaac_lab(path, replace(ROBOT, delay=delay), rows)
    tree = ast.parse(path.read_text())
    imported = {name.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for name in node.names}
    kind = "DelayedPDActuatorCfg" if delay else "ImplicitActuatorCfg"
    assert imported == {"Path", kind, "ManagerTermBase"}
    (servos, _) = calls(path, kind)
    assert servos.keys() <= ISAAC_LAB[kind] and ("effort_limit" in servos) == bool(delay)
    asked = {
        node.func.attr: {word.arg for word in node.keywords if word.arg} | WHERE  # by **where
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "").startswith("write_")
    }
    assert len(asked) == 3 and all(words == ISAAC_LAB[name] for name, words in asked.items())
    assert ("write_joint_{what}_to_sim_index" in path.read_text()) == (delay == 0.0)
    (drawn,) = (node.value for node in tree.body if getattr(getattr(node, "targets", [None])[0], "id", "") == "DRAWN")
    quantities = [what for what, _, _ in ast.literal_eval(drawn)]
    assert quantities == ["armature", "friction", "viscous_friction", "stiffness", "damping"]


def test_rows_of_the_model_are_found_again_in_a_scene_with_other_bodies_and_a_floor(tmp_path):
    path = tmp_path / "mjlab_robot.py"
    save_mjlab(path, ROBOT, PARAMETERS)
    rows = rows_in_scene(path, ("servo",))
    legs = """<mujoco><worldbody><geom name="own floor" type="plane" size="1 1 1"/><body><freejoint/><geom size="0.1"/>
    <body name="leg"><joint name="hip"/><geom size="0.1"/></body></body></worldbody>
    <actuator><motor name="push" joint="hip"/><position name="servo" joint="hip"/></actuator></mujoco>"""
    alone = mujoco.MjModel.from_xml_string(legs)
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body><joint type='slide'/><geom size='1'/></body></worldbody></mujoco>"
    )
    robot = mujoco.MjSpec.from_string(legs)
    robot.actuators[1].name = "hip"  # as mjlab names the servo that it adds again
    spec.attach(robot, prefix="robot/", frame=spec.worldbody.add_frame())
    scene = spec.compile()
    found = {
        field: rows(field, alone, scene, "robot").tolist()
        for field in (
            "body_mass",
            "dof_armature",
            "jnt_stiffness",
            "qpos0",
            "qpos_spring",
            "geom_friction",
            "actuator_gear",
        )
    }
    assert found["body_mass"] == [-1, 2, 3] and found["dof_armature"] == [*range(1, 8)]
    assert found["jnt_stiffness"] == [1, 2] and found["qpos0"] == found["qpos_spring"] == [*range(1, 9)]
    floor, *geoms = found["geom_friction"]
    assert scene.geom(floor).name == "robot/own floor" and [scene.geom_bodyid[row] for row in geoms] == [2, 3]
    assert [scene.actuator(row).name for row in found["actuator_gear"]] == ["robot/push", "robot/hip"]


def test_a_fixed_base_is_found_on_the_body_that_mjlab_puts_it_on(tmp_path):
    path = tmp_path / "mjlab_robot.py"
    save_mjlab(path, ROBOT, PARAMETERS)
    arm = """<mujoco><worldbody><body name="upper"><joint name="shoulder"/><geom name="upper" size="0.1"/>
    <body name="fore"><joint/><geom size="0.1"/></body></body></worldbody></mujoco>"""
    spec = mujoco.MjSpec()
    base = spec.worldbody.add_body(name="robot/mocap_base", mocap=True)
    spec.attach(mujoco.MjSpec.from_string(arm), prefix="robot/", frame=base.add_frame())
    alone, scene = mujoco.MjModel.from_xml_string(arm), spec.compile()
    rows = rows_in_scene(path, set())
    assert rows("body_mass", alone, scene, "robot").tolist() == [-1, 2, 3]
    assert rows("dof_damping", alone, scene, "robot").tolist() == [0, 1]
    assert rows("geom_size", alone, scene, "robot").tolist() == [0, 1]


def rows_in_scene(path, made_by_mjlab):
    """The function of that name in a file that imports mjlab."""
    tree = ast.parse(path.read_text())
    (function,) = (node for node in tree.body if getattr(node, "name", "") == "rows_in_scene")
    names = {"np": np, "MADE_BY_MJLAB": made_by_mjlab}
    exec(compile(ast.Module([function], []), str(path), "exec"), names)
    return names["rows_in_scene"]


@pytest.mark.parametrize("save", [save_mjlab, save_isaac_lab])
def test_a_name_of_the_users_cannot_end_the_docstring(save, tmp_path):
    path = tmp_path / "robot.py"
    save(path, ROBOT, PARAMETERS)
    assert "signal_bias.a '''quote'''" in ast.get_docstring(ast.parse(path.read_text()))
