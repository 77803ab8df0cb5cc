"""Actuators and options of a model, as those who configure robots for training call them."""

import mujoco
import pytest

from madoc.simulation.configuration import base_pose, floating_beside, joint_actuators, physics_options, start_position

MODEL = """<mujoco>
<option timestep="0.004" integrator="RK4" cone="elliptic" density="1.2"><flag contact="disable"/></option>
<worldbody><body name="a"><joint name="hip" ref="30" armature="0.01" frictionloss="0.2" damping="0.3"/>
<geom size="0.1"/>
<body name="b"><joint name="knee"/><geom size="0.1"/></body></body></worldbody>
<actuator><position name="servo" joint="hip" kp="40" kv="2" forcerange="-9 9"/>
<position name="geared" joint="knee" kp="40" gear="2"/><motor name="motor" joint="knee"/>
<position name="uneven" joint="knee" kp="40" forcerange="-1 2"/></actuator></mujoco>"""


def test_position_servos_are_told_from_other_actuators():
    model = mujoco.MjModel.from_xml_string(MODEL)
    servo, geared, motor, uneven = joint_actuators(model, ["servo", "geared", "motor", "uneven"])
    assert (servo.servo, servo.stiffness, servo.damping, servo.effort_limit) == (True, 40.0, 2.0, 9.0)
    assert (servo.joint, servo.armature, servo.friction, servo.viscous) == ("hip", 0.01, 0.2, 0.3)
    assert not any(each.servo for each in (geared, motor, uneven)) and motor.joint == "knee"


def test_options_have_the_names_of_mjlab_and_what_it_cannot_say_is_told():
    model = mujoco.MjModel.from_xml_string(MODEL)
    source, lost = physics_options(model)
    assert (source["timestep"], source["cone"], source["disableflags"]) == ("0.004", "'elliptic'", "('contact',)")
    assert source["integrator"] == "'implicitfast'" and "rk4" in lost[0] and "density" in lost[1]
    assert start_position(model)["hip"] == pytest.approx(0.5236, abs=1e-4)


def test_an_actuator_says_what_its_command_is_and_what_it_acts_on():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body pos="0 0 0.4" quat="0 1 0 0"><freejoint/><geom size="0.1"/><site name="rotor"/>
        <body><joint name="hip"/><geom size="0.1"/></body></body></worldbody>
        <tendon><fixed name="rope"><joint joint="hip" coef="1"/></fixed></tendon><actuator>
        <position name="position" joint="hip" gear="2"/><velocity name="velocity" joint="hip"/>
        <intvelocity name="integrated" joint="hip" actrange="-1 1"/><motor name="pull" tendon="rope"/>
        <damper name="damper" joint="hip" ctrlrange="0 1"/><motor name="thrust" site="rotor"/></actuator></mujoco>"""
    )
    found = {each.name: each for each in joint_actuators(model, [model.actuator(index).name for index in range(6)])}
    means = {name: each.means for name, each in found.items()}
    assert means == {
        "position": "position",
        "velocity": "velocity",
        "integrated": "velocity",
        "pull": "effort",
        "damper": "effort",
        "thrust": "effort",
    }
    assert [(each.joint, each.tendon, each.site) for each in found.values()][2:] == [
        ("hip", "", ""),
        ("", "rope", ""),
        ("hip", "", ""),
        ("", "", "rotor"),
    ]
    assert base_pose(model) == ((0.0, 0.0, 0.4), (0.0, 1.0, 0.0, 0.0))
    assert base_pose(mujoco.MjModel.from_xml_string(MODEL)) is None


def test_what_floats_beside_a_robot_is_told():
    cube = '<body name="{}"><freejoint/><geom size="0.1"/></body>'
    arm = '<body name="arm"><joint/><geom size="0.1"/></body>'
    for bodies, beside in (
        (arm + cube.format("cube"), ["cube"]),
        (cube.format("dog") + cube.format(""), ["body 2"]),
        (arm, []),
    ):
        model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
        assert floating_beside(model) == beside
