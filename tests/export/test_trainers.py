"""Configurations for mjlab and Isaac Lab: that they are Python, what they say, and what they say is lost."""

import ast
from dataclasses import replace

import pytest

from madoc.calibration.result import ParameterEstimate
from madoc.export import Exported, Robot, save_isaac_lab, save_mjlab
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
    assert "CHANGED = ('dof_armature',)" in text and "MADE_BY_MJLAB = ('fl', 'fr')" in text
    assert "a delay of 4 physics steps is 0.5 ms more than estimated" in text and "density" in text


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


@pytest.mark.parametrize("save", [save_mjlab, save_isaac_lab])
def test_a_name_of_the_users_cannot_end_the_docstring(save, tmp_path):
    path = tmp_path / "robot.py"
    save(path, ROBOT, PARAMETERS)
    assert "signal_bias.a '''quote'''" in ast.get_docstring(ast.parse(path.read_text()))
