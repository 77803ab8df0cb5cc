"""Parameters into a model: found by name, written, and everything derived from them recomputed."""

import copy

import mujoco
import numpy as np
import pytest

import madoc.tasks
from madoc.errors import MadocError
from madoc.parameters import FIELDS, INERTIA, PAYLOAD, Parameter
from madoc.simulation.cpu import CpuSimulator
from madoc.simulation.inertials import MASS_FLOOR
from madoc.simulation.write import (
    body_reach,
    element_names,
    find_elements,
    free_joints,
    nominal_values,
    write_parameters,
)
from robots import ARM

WRITTEN = {
    "gravity": lambda model, _: model.opt.gravity[2],
    "body_mass": lambda model, body: model.body_mass[body],
    "body_mass_and_inertia": lambda model, body: model.body_mass[body],
    "body_inertia": lambda model, body: model.body_inertia[body].max(),
    "body_com": lambda model, body: np.linalg.norm(model.body_ipos[body]),
    "body_distance": lambda model, body: np.linalg.norm(model.body_pos[body]),
    "dof_damping": lambda model, joint: model.dof_damping[model.jnt_dofadr[joint]],
    "dof_drag": lambda model, joint: model.dof_dampingpoly[model.jnt_dofadr[joint], 0],
    "dof_armature": lambda model, joint: model.dof_armature[model.jnt_dofadr[joint]],
    "dof_frictionloss": lambda model, joint: model.dof_frictionloss[model.jnt_dofadr[joint]],
    "jnt_stiffness": lambda model, joint: model.jnt_stiffness[joint],
    "geom_friction": lambda model, geom: model.geom_friction[geom, 0],
    "geom_friction_torsional": lambda model, geom: model.geom_friction[geom, 1],
    "geom_friction_rolling": lambda model, geom: model.geom_friction[geom, 2],
    "contact_time": lambda model, geom: model.geom_solref[geom, 0],
    "contact_damping": lambda model, geom: model.geom_solref[geom, 1],
    "jnt_ref": lambda model, joint: model.qpos0[model.jnt_qposadr[joint]],
    "actuator_gain": lambda model, actuator: model.actuator_gainprm[actuator, 0],
    "actuator_kv": lambda model, actuator: -model.actuator_biasprm[actuator, 2],
}
"""Where each field's value stands in a model."""

IN_MODEL = [
    name
    for name, field in FIELDS.items()
    if field.in_model and name not in (*PAYLOAD, *INERTIA) and name.split("_")[0] not in ("drive", "friction", "gear")
]
"""Fields of a plain model whose numbers are apart; test_joints.py has what a spec adds."""


@pytest.fixture
def two_link_arm():
    """The arm with a limited shoulder."""
    spec = mujoco.MjSpec.from_string(ARM)
    spec.joints[0].limited, spec.joints[0].range = True, [-1.0, 1.0]
    return spec.compile()


def written(model, parameter, value):
    """The model with one value written."""
    write_parameters(model, mujoco.MjData(model), [parameter], np.array([value]))
    return model


@pytest.mark.parametrize("field", IN_MODEL)
def test_every_field_is_written_where_it_belongs_and_moves_the_robot(everything, field):
    name = next(name for name in everything.parameters.names if name.split(".")[0] == field)
    simulator = CpuSimulator(everything.with_parameters([name]), threads=1)
    (parameter,) = simulator.parameters.parameters
    ends = []
    # Standing on the floor and moving in every joint, so that friction, damping and stiffness have a say.
    state = simulator.initial_state
    state[1:6] += [-0.05, 0.05, -0.1, 0.05, 0.0]
    state[6:] = [1.0, -0.5, 0.5, -1.0, 1.0, -2.0]
    for value in (parameter.low, parameter.high):
        system = simulator.bind(np.array([[value]]))
        found = WRITTEN[field](system.models[0], find_elements(system.models[0], parameter)[0])
        assert found == pytest.approx(max(value, MASS_FLOOR if "mass" in field else -np.inf), rel=1e-15)
        assert nominal_values(system.models[0], parameter) == (found,)
        ends.append(system.step(state[None, None], np.full((1, 1, 3), 0.5)))
    assert np.isfinite(ends).all()
    # Hopper does not turn about the vertical.
    assert (ends[0] != ends[1]).any() == (field != "geom_friction_torsional")


@pytest.mark.parametrize("field", IN_MODEL)
def test_only_the_named_element_changes(everything, field):
    parameter = next(parameter for parameter in everything.parameters.parameters if parameter.field == field)
    before, model = everything.compile(), written(everything.compile(), parameter, parameter.high)
    arrays = {
        "body_mass": "body_mass",
        "body_mass_and_inertia": "body_mass",
        "geom_friction": "geom_friction",
        "jnt_ref": "qpos0",
        "actuator_gain": "actuator_gainprm",
        "actuator_kv": "actuator_biasprm",
        "body_com": "body_ipos",
        "body_distance": "body_pos",
        "dof_drag": "dof_dampingpoly",
        **dict.fromkeys(("contact_time", "contact_damping"), "geom_solref"),
        **dict.fromkeys(("geom_friction_torsional", "geom_friction_rolling"), "geom_friction"),
    }
    if field == "gravity":
        np.testing.assert_array_equal(model.opt.gravity, [0.0, 0.0, parameter.high])
    else:
        changed = np.argwhere(getattr(model, arrays.get(field, field)) != getattr(before, arrays.get(field, field)))
        assert len({element for element, *_ in changed}) == 1


def test_a_shifted_zero_leaves_the_arm_where_it_hangs_and_moves_what_it_reads(two_link_arm):
    """An encoder that reads 0.3 where the drawing has 0: at 0.3 gravity pulls as it did at 0, and the limits move."""
    model = two_link_arm
    before = mujoco.MjData(model)
    before.qpos[0] = 0.2
    mujoco.mj_forward(model, before)
    shifted = written(copy.copy(model), Parameter("jnt_ref", "shoulder", -1.0, 1.0), 0.3)
    after = mujoco.MjData(shifted)
    after.qpos[0] = 0.5
    mujoco.mj_forward(shifted, after)
    np.testing.assert_allclose(after.qfrc_bias, before.qfrc_bias, rtol=0, atol=1e-15)
    np.testing.assert_allclose(shifted.jnt_range[0] - model.jnt_range[0], 0.3, rtol=1e-15)


def test_a_shifted_zero_leaves_fixed_tendons_as_long_in_space():
    text = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/><geom size=".1"/></body></worldbody>
    <tendon><fixed name="cord" stiffness="10" springlength="0" range="-.4 .4"><joint joint="hinge" coef="2"/></fixed>
    </tendon></mujoco>"""
    forces = []
    for shift in (0.0, 0.3):
        model = written(mujoco.MjModel.from_xml_string(text), Parameter("jnt_ref", "hinge", -1.0, 1.0), shift)
        data = mujoco.MjData(model)
        data.qpos[0] = 0.1 + shift
        mujoco.mj_forward(model, data)
        assert data.nefc == 0  # within its limits
        forces.append(data.qfrc_passive[0])
    np.testing.assert_allclose(forces, -10 * 2 * 0.1 * 2, rtol=1e-12)


def test_only_an_actuator_of_fixed_gain_has_a_gain_to_write():
    text = """<mujoco><worldbody><body><joint name="hinge"/><geom size=".1"/></body></worldbody>
    <actuator><damper name="brake" joint="hinge" kv="2" ctrlrange="0 1"/></actuator></mujoco>"""
    with pytest.raises(MadocError, match=r"actuator_gain: the force of actuator 'brake' is not its command times"):
        written(mujoco.MjModel.from_xml_string(text), Parameter("actuator_gain", "brake", 0.0, 1.0), 0.5)


def test_rounding_gives_a_centre_of_mass_no_direction():
    text = """<mujoco><worldbody><body name="ring"><joint name="hinge"/><geom size=".1" pos="{} 0 0"/></body>
    </worldbody></mujoco>"""
    moved = written(mujoco.MjModel.from_xml_string(text.format(1e-3)), Parameter("body_com", "ring", 0.0, 1.0), 0.05)
    np.testing.assert_allclose(moved.body("ring").ipos, (0.05, 0.0, 0.0), rtol=1e-12)
    with pytest.raises(MadocError, match="has no direction"):
        written(mujoco.MjModel.from_xml_string(text.format(1e-11)), Parameter("body_com", "ring", 0.0, 1.0), 0.05)


def test_a_contact_of_given_stiffness_has_no_time_constant():
    text = """<mujoco><worldbody><body><joint/><geom name="sole" size=".1" solref="-100 -5"/></body>
    </worldbody></mujoco>"""
    with pytest.raises(MadocError, match=r"the solref of geom 'sole' is a stiffness and a damping"):
        written(mujoco.MjModel.from_xml_string(text), Parameter("contact_time", "sole", 0.0, 1.0), 0.05)


def test_only_a_position_servo_has_a_damping_of_its_own(two_link_arm):
    with pytest.raises(MadocError, match=r"actuator_kv: actuator 'shoulder' is not a position servo; use dof_damping"):
        written(two_link_arm, Parameter("actuator_kv", "shoulder", 0.0, 1.0), 0.5)


def test_body_mass_leaves_the_inertia_and_its_sibling_scales_it():
    task = madoc.tasks.make("hopper")
    before = task.compile()
    alone = written(task.compile(), Parameter("body_mass", "thigh", 1.0, 9.0), 2 * before.body("thigh").mass[0])
    both = written(
        task.compile(), Parameter("body_mass_and_inertia", "thigh", 1.0, 9.0), 2 * before.body("thigh").mass[0]
    )
    np.testing.assert_array_equal(alone.body_inertia, before.body_inertia)
    np.testing.assert_allclose(both.body("thigh").inertia, 2 * before.body("thigh").inertia)
    np.testing.assert_array_equal(both.body("torso").inertia, before.body("torso").inertia)
    assert alone.body("thigh").mass == both.body("thigh").mass


def test_derived_constants_follow_the_mass():
    model = written(madoc.tasks.make("hopper").compile(), Parameter("body_mass", "foot", 1.0, 99.0), 50.0)
    assert model.body_subtreemass[0] == pytest.approx(model.body_mass.sum())
    assert model.body("foot").subtreemass[0] == 50.0
    fresh = madoc.tasks.make("hopper").spec()
    fresh.body("foot").mass = 50.0
    np.testing.assert_allclose(model.dof_invweight0, fresh.compile().dof_invweight0)
    np.testing.assert_allclose(model.body_invweight0, fresh.compile().body_invweight0)


@pytest.mark.parametrize("field", ["body_mass", "body_mass_and_inertia"])
def test_a_mass_has_a_floor(field):
    model = written(madoc.tasks.make("hopper").compile(), Parameter(field, "thigh", 0.0, 1.0), 0.0)
    assert model.body("thigh").mass[0] == MASS_FLOOR
    assert (model.body("thigh").inertia > 0).all()


def test_a_body_of_less_than_a_gram_keeps_its_mass():
    text = '<mujoco><worldbody><body name="fly"><joint/><geom size=".01" mass="8e-4"/></body></worldbody></mujoco>'
    for mass in (8e-4, 5e-5):
        model = written(mujoco.MjModel.from_xml_string(text), Parameter("body_mass", "fly", 0.0, 1.0), mass)
        assert model.body("fly").mass[0] == mass


def test_half_cheetah_at_the_low_end_of_every_mass_does_not_explode():
    simulator = CpuSimulator(madoc.tasks.make("halfcheetah"), threads=1)
    system = simulator.bind(simulator.parameters.low[None])
    assert np.isfinite(system.step(simulator.initial_state[None, None], np.zeros((1, 1, 6)))).all()


def test_a_body_may_be_named_by_its_joint():
    model = madoc.tasks.make("ant").compile()
    (body,) = find_elements(model, Parameter("body_mass", "ankle_1", 0.0, 1.0))
    assert mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body) in (None, "")
    assert body == model.jnt_bodyid[model.joint("ankle_1").id] == 4
    assert written(model, Parameter("body_mass", "ankle_1", 0.0, 1.0), 0.5).body_mass[4] == 0.5


def test_the_paper_counts_bodies_and_joints_as_we_name_them():
    # Tables 6, 7 and 9, Jiang et al. 2024: body_mass 1, 2, ... and dof_damping 3, 4, ... (Ant 6, 7, 8, 9).
    first_dof = {"hopper": 3, "halfcheetah": 3, "walker2d": 3, "ant": 6}
    for name, dof in first_dof.items():
        task = madoc.tasks.make(name)
        model = task.compile()
        found = {"gravity": [], "body_mass": [], "dof_damping": []}
        for parameter in task.parameters.parameters:
            found[parameter.field].extend(find_elements(model, parameter))
        assert found["gravity"] == [-1]
        assert found["body_mass"] == list(range(1, 1 + len(found["body_mass"])))
        dofs = [model.jnt_dofadr[joint] for joint in found["dof_damping"]]
        assert dofs == list(range(dof, dof + len(dofs)))


@pytest.mark.parametrize(
    ("parameter", "sentence"),
    [
        (("body_mass", "tigh"), r"body_mass.tigh: the model has no body 'tigh'; nearest: thigh"),
        (("dof_damping", "foot"), r"dof_damping.foot: the model has no joint 'foot'; nearest: foot_joint"),
        (("geom_friction", "xyz"), r"geom_friction.xyz: the model has no geom 'xyz'; there are: floor, torso_geom"),
    ],
)
def test_an_unknown_element_names_the_nearest(parameter, sentence):
    with pytest.raises(MadocError, match=sentence):
        find_elements(madoc.tasks.make("hopper").compile(), Parameter(*parameter, 0.0, 1.0))


def test_element_names():
    model = madoc.tasks.make("hopper").compile()
    assert element_names(model, "body") == ["world", "torso", "thigh", "leg", "foot"]
    assert element_names(model, "joint")[3:] == ["thigh_joint", "leg_joint", "foot_joint"]


def test_a_free_joint_is_damped_in_all_its_degrees():
    model = written(madoc.tasks.make("ant").compile(), Parameter("dof_damping", "root", 0.0, 1.0), 0.25)
    np.testing.assert_array_equal(model.dof_damping[:6], 0.25)
    np.testing.assert_array_equal(model.dof_damping[6:], 1.0)


def test_a_massless_body_cannot_be_scaled():
    model = madoc.tasks.make("hopper").compile()
    with pytest.raises(MadocError, match="body_mass_and_inertia: body 'world' has no mass to scale; use body_mass"):
        written(model, Parameter("body_mass_and_inertia", "world", 0.0, 1.0), 1.0)


def test_a_body_reaches_as_far_as_spheres_about_its_geoms():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="a"><freejoint name="free"/><geom size="0.1" pos="0 0 -0.5"/>
        <geom type="box" size="0.2 0.1 0.2" pos="0.3 0 0"/><body name="b"><joint name="j"/>
        <inertial pos="0 0 1" mass="1" diaginertia="1 1 1"/></body></body></worldbody></mujoco>"""
    )
    assert body_reach(model, Parameter("body_com", "a", 0.0, 1.0)) == pytest.approx(0.6)
    assert body_reach(model, Parameter("body_com", "b", 0.0, 1.0)) == np.inf
    assert [joint.name for joint in free_joints(model)] == ["free"]
