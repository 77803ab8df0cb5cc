"""The ten inertial numbers of a body: a payload adds to them, deviations from the model leave a body that can exist."""

import mujoco
import numpy as np
import pytest

from madoc.errors import MadocError
from madoc.parameters import INERTIA, PAYLOAD, Parameter
from madoc.simulation.inertials import deviation, pseudo_inertia, write_pseudo_inertia
from madoc.simulation.write import nominal_values, write_parameters

ARM = """
<mujoco>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0"/>
      <geom type="capsule" size="0.04" fromto="0 0 0 0 0 -0.5" mass="1"/>
      <body name="hand" pos="0 0 -0.5" euler="0 30 0">
        <joint name="wrist" axis="1 0 0"/>
        <inertial pos="0.01 0.02 -0.1" mass="0.5" fullinertia="0.003 0.002 0.004 0.0002 -0.0001 0.0003"/>
        <geom type="box" size="0.02 0.03 0.1" pos="0.01 0.02 -0.1"/>
        <geom type="sphere" size="0.02" pos="0 0 -0.2"/>
        {load}
      </body>
    </body>
  </worldbody>
</mujoco>
"""
LOAD = '<body pos="0.05 -0.02 -0.15"><inertial pos="0 0 0" mass="0.4" diaginertia="3.6e-4 3.6e-4 3.6e-4"/></body>'
"""0.4 kg with a radius of gyration of 3 cm: 0.4 · 0.03² = 3.6e-4 kg·m²."""
AXES = 1e-7
"""What MuJoCo 3.8 leaves of a torque by stopping its search for principal axes at 1e-12 kg·m²; 3.17 leaves 1e-12."""


def arm(load=""):
    return mujoco.MjModel.from_xml_string(ARM.format(load=load))


def written(model, values):
    """The model with values of fields of its hand."""
    parameters = [Parameter(field, "hand", 0.0, 1.0) for field in values]
    write_parameters(model, mujoco.MjData(model), parameters, np.array(list(values.values())))
    return model


def torques(model):
    """Inverse dynamics at some position, velocity and acceleration."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qacc[:] = [0.4, -0.7], [1.0, -2.0], [3.0, 5.0]
    mujoco.mj_inverse(model, data)
    return data.qfrc_inverse.copy()


def test_the_pseudo_inertia_of_a_body_by_hand():
    """2 kg at z = 1 with moments 3, 4, 5: half their sum is 6, so Σ is 3, 2, 1 about the centre; 2 · 1² is added."""
    text = """<mujoco><worldbody><body name="b"><joint/><inertial pos="0 0 1" mass="2" diaginertia="3 4 5"/></body>
    </worldbody></mujoco>"""
    found = pseudo_inertia(mujoco.MjModel.from_xml_string(text), 1)
    np.testing.assert_allclose(found, np.diag([3.0, 2.0, 3.0, 2.0]) + 2.0 * np.eye(4)[[0, 1, 3, 2]] * [0, 0, 1, 1])


def test_writing_what_was_read_changes_nothing():
    model = arm()
    before = torques(model)
    write_pseudo_inertia(model, 2, pseudo_inertia(model, 2))
    np.testing.assert_allclose(torques(model), before, rtol=AXES)
    assert model.body_mass[2] == 0.5
    np.testing.assert_allclose(np.sort(model.body_inertia[2]), np.sort(arm().body_inertia[2]), rtol=1e-12)


def test_a_payload_is_what_a_body_welded_to_the_hand_is():
    values = dict(zip(PAYLOAD, (0.4, 0.05, -0.02, -0.15, 0.03), strict=True))
    loaded = written(arm(), values)
    np.testing.assert_allclose(torques(loaded), torques(arm(LOAD)), rtol=AXES)
    assert loaded.body_subtreemass[1] == pytest.approx(1.9)
    assert [nominal_values(arm(), Parameter(field, "hand", 0.0, 1.0)) for field in PAYLOAD] == 5 * [(0.0,)]


def test_shapes_stay_where_they_are():
    before, after = arm(), written(arm(), {"payload_mass": 1.0, "payload_x": 0.2, "payload_y": 0.1})
    places = []
    for model in (before, after):
        data = mujoco.MjData(model)
        data.qpos[:] = 0.3
        mujoco.mj_forward(model, data)
        places.append((data.geom_xpos.copy(), data.geom_xmat.copy()))
    np.testing.assert_allclose(places[1][0], places[0][0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(places[1][1], places[0][1], rtol=0, atol=1e-15)


def test_the_deviation_alpha_scales_mass_and_inertia():
    """Mass and all moments grow by exp(2 alpha), and the centre stays."""
    model = written(arm(), {"inertia_alpha": 0.1})
    np.testing.assert_allclose(model.body_mass[2], 0.5 * np.exp(0.2), rtol=1e-12)
    np.testing.assert_allclose(np.sort(model.body_inertia[2]), np.sort(arm().body_inertia[2]) * np.exp(0.2), rtol=1e-9)
    np.testing.assert_allclose(model.body_ipos[2], arm().body_ipos[2], rtol=1e-12)


def test_the_factor_is_that_of_the_paper():
    found = deviation(np.log(2.0), np.log(3.0), 0.0, 0.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
    np.testing.assert_allclose(found, [[6, 8, 12, 14], [0, 2, 10, 16], [0, 0, 2, 18], [0, 0, 0, 2]], rtol=1e-15)


@pytest.mark.parametrize("seed", range(5))
def test_any_deviation_is_a_body_that_can_exist(seed):
    """Mass and moments are positive, no moment is larger than the sum of the others, and MuJoCo compiles it."""
    drawn = np.random.default_rng(seed).uniform(-1.0, 1.0, 10)
    model = arm()
    parameters = [Parameter(field, "hand", -1.0, 1.0) for field in INERTIA]
    write_parameters(model, mujoco.MjData(model), parameters, drawn)
    moments = np.sort(model.body_inertia[2])
    assert model.body_mass[2] > 0
    assert moments[0] > 0
    assert moments[2] <= moments[:2].sum()
    assert np.linalg.eigvalsh(pseudo_inertia(model, 2)).min() > 0


def test_a_body_without_extent_has_no_logarithm():
    text = """<mujoco><worldbody><body name="hand"><joint axis="1 0 0"/><inertial pos="0 0 1" mass="2"
    diaginertia="1 1 2"/></body></worldbody></mujoco>"""
    with pytest.raises(MadocError, match="inertia: body 'hand' has no mass, or no extent in some direction"):
        written(mujoco.MjModel.from_xml_string(text), {"inertia_alpha": 0.1})


def test_a_free_body_whose_mass_matrix_is_diagonal_takes_no_payload():
    text = """<mujoco><worldbody><body name="hand"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
    with pytest.raises(MadocError, match=r"body 'hand' has its centre of mass at its origin, .* add an empty <body/>"):
        written(mujoco.MjModel.from_xml_string(text), {"payload_mass": 0.1})
    off = text.replace("<freejoint/>", '<freejoint/><inertial pos="0 0 1e-4" mass="1" diaginertia="1 1 1.5"/>')
    loaded = written(mujoco.MjModel.from_xml_string(off), {"payload_mass": 1.0, "payload_x": 0.2})
    data = mujoco.MjData(loaded)
    mujoco.mj_forward(loaded, data)
    np.testing.assert_allclose(data.qfrc_bias[4], -9.81 * 0.2, rtol=1e-9)  # 1 kg at 0.2 m pulls about y
