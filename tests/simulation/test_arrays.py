"""Any number of a model: written where MuJoCo documents it, refused where that means nothing, exported exactly."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.errors import MadocError
from madoc.parameters import Parameter, ParameterSpace
from madoc.simulation.mjcf import save_mjcf
from own_robots import write_robot
from robots import spring

LEG = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="trunk" pos="0 0 1">
      <freejoint name="root"/>
      <geom name="box" type="box" size=".2 .1 .05" pos=".02 0 0"/>
      <site name="imu" pos="0 0 .1"/>
      <body name="shin" pos="0.1 0 0">
        <joint name="knee" axis="0 1 0" range="-1 1"/>
        <geom name="foot" size=".04" pos="0 0 -.3"/>
        <geom name="calf" type="capsule" size=".02" fromto="0 0 0 0 0.01 -.3"/>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="cord" stiffness="10"><joint joint="knee" coef="1"/></fixed></tendon>
  <contact><pair name="step" geom1="foot" geom2="floor"/></contact>
  <equality><joint name="lock" joint1="knee" active="false"/></equality>
  <actuator><position name="servo" joint="knee" kp="10" forcerange="-5 5" ctrlrange="-1 1"/></actuator>
  <sensor><accelerometer name="acceleration" site="imu"/></sensor>
</mujoco>
"""

NUMBERS = {
    "geom_solref[0]": ("foot", lambda model: model.geom("foot").solref[0]),
    "geom_solimp[2]": ("foot", lambda model: model.geom("foot").solimp[2]),
    "geom_pos[2]": ("foot", lambda model: model.geom("foot").pos[2]),
    "body_pos[0]": ("shin", lambda model: model.body("shin").pos[0]),
    "body_gravcomp": ("shin", lambda model: model.body_gravcomp[2]),
    "jnt_range[1]": ("knee", lambda model: model.joint("knee").range[1]),
    "dof_solref[0]": ("knee", lambda model: model.dof_solref[6, 0]),
    "site_pos[0]": ("imu", lambda model: model.site("imu").pos[0]),
    "pair_friction[0]": ("step", lambda model: model.pair_friction[0, 0]),
    "pair_solref[0]": ("step", lambda model: model.pair_solref[0, 0]),
    "tendon_stiffness": ("cord", lambda model: model.tendon_stiffness[0]),
    "eq_data[0]": ("lock", lambda model: model.eq_data[0, 0]),
    "actuator_forcerange[1]": ("servo", lambda model: model.actuator("servo").forcerange[1]),
    "sensor_cutoff": ("acceleration", lambda model: model.sensor_cutoff[0]),
    "opt.density": ("", lambda model: model.opt.density),
    "opt.wind[1]": ("", lambda model: model.opt.wind[1]),
}
"""By number of the model, an element and where the number stands."""


def leg(parameter):
    """A trunk with one leg, one of whose numbers is a parameter."""
    base = spring(Parameter("dof_damping", "slide", 0.0, 2.0))
    return replace(
        base, spec=lambda: mujoco.MjSpec.from_string(LEG), parameters=ParameterSpace((parameter,)), observation_size=1
    )


@pytest.mark.parametrize("field", NUMBERS)
def test_a_number_is_written_where_mujoco_has_it_and_leaves_as_mjcf(field, tmp_path):
    element, held = NUMBERS[field]
    nominal = held(leg(Parameter(field, element, 0.0, 1.0)).model)
    simulator = simulation.make(leg(Parameter(field, element, nominal, nominal + 0.25)), threads=1)
    bound = simulator.model(np.array([nominal + 0.125]))
    assert held(bound) == nominal + 0.125
    (change,) = save_mjcf(simulator, np.array([nominal + 0.125]), tmp_path / "leg.xml")
    assert held(mujoco.MjModel.from_xml_path(str(tmp_path / "leg.xml"))) == pytest.approx(nominal + 0.125, rel=1e-12)
    assert change.old != change.new


def test_a_foot_that_is_moved_touches_where_it_is():
    """The trunk at 0.3 m: the foot, 0.34 m below it, is 4 cm in the floor; raised by 0.1 m it is in the air."""
    touching = []
    for height in (-0.3, -0.2):
        simulator = simulation.make(leg(Parameter("geom_pos[2]", "foot", -0.4, 0.0)), threads=1)
        model = simulator.model(np.array([height]))
        data = mujoco.MjData(model)
        data.qpos[2] = 0.3
        mujoco.mj_forward(model, data)
        touching.append({model.geom(int(geom)).name for geom in data.contact.geom.flat})
        state = np.concatenate([data.qpos, data.qvel])[None]
        assert (simulator.contacts(state, np.array([height])) > 0).all()
    assert "foot" in touching[0]
    assert "foot" not in touching[1]


def test_a_joint_of_many_degrees_has_a_row_for_each():
    model = simulation.make(leg(Parameter("dof_solref[0]", "root", 0.0, 1.0)), threads=1).model(np.array([0.5]))
    np.testing.assert_array_equal(model.dof_solref[:, 0], [*[0.5] * 6, 0.02])


@pytest.mark.parametrize(
    ("field", "element", "sentence"),
    [
        ("body_subtreemass", "shin", "body_subtreemass cannot be calibrated: MuJoCo computes it from other numbers"),
        ("dof_M0", "knee", "dof_M0 cannot be calibrated: MuJoCo computes it"),
        ("geom_size[0]", "foot", "geom_size cannot be calibrated: bounds of shapes are computed"),
        ("body_ipos[0]", "shin", "body_ipos cannot be calibrated: .* use payload_x or inertia"),
        ("jnt_axis[0]", "knee", "jnt_axis cannot be calibrated: a direction has a length of 1"),
        ("geom_user[0]", "foot", "MuJoCo's model has no numbers 'geom_user'"),
        ("site_pos[0]", "imuu", "the model has no site 'imuu'; nearest: imu"),
    ],
)
def test_a_number_that_cannot_be_calibrated(field, element, sentence):
    with pytest.raises(MadocError, match=sentence):
        simulation.make(leg(Parameter(field, element, 0.0, 1.0)), threads=1)


def test_what_mjcf_has_no_attribute_for_is_refused(tmp_path):
    simulator = simulation.make(leg(Parameter("geom_fluid[0]", "foot", 0.0, 1.0)), threads=1)
    with pytest.raises(MadocError, match=r"differs from the bound one in geom_fluid by 0\.5; this parameter"):
        save_mjcf(simulator, np.array([0.5]), tmp_path / "leg.xml")


def test_patterns_share_a_value_or_give_one_to_each(tmp_path):
    spec = write_robot(
        tmp_path,
        """\
madoc: 1
name: leg
model: leg.xml
control_step: 0.02
signals:
  - {name: knee, reads: position(knee)}
actions:
  - {name: servo, actuator: servo}
parameters:
  - {field: dof_armature, elements: "*", name: armature, low: 0, high: 1}
  - {field: dof_frictionloss, elements: ["kn*", "*ee"], low: 0, high: 1}
  - {field: body_mass, each: "*", low: 0.1, high: 1}
  - {field: geom_friction, each: ["fo*", box], name: grip, low: 0.1, high: 1}
  - {model: geom_solref, index: 0, element: foot, unit: s, low: 0.01, high: 0.1}
""",
        leg=LEG,
    )
    parameters = robots.load(spec).task.parameters.parameters
    assert [(row.name, row.elements) for row in parameters] == [
        ("armature", ("root", "knee")),
        ("dof_frictionloss.knee", ("knee",)),
        ("body_mass.trunk", ("trunk",)),
        ("body_mass.shin", ("shin",)),
        ("grip.foot", ("foot",)),
        ("grip.box", ("box",)),
        ("geom_solref[0].foot", ("foot",)),
    ]
    assert parameters[-1].unit == "s"
