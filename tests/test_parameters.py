"""Parameters: the map between [-1, 1] and physical values, and what is refused."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from madoc.errors import MadocError
from madoc.parameters import FIELDS, INERTIA, PAYLOAD, Parameter, ParameterSpace

SPACE = ParameterSpace(
    (
        Parameter("gravity", "", -30.0, 0.0),
        Parameter("body_mass", "torso", 3.0, 5.0),
        Parameter("dof_damping", "foot_joint", 0.0, 3.0),
    )
)


def test_name_and_unit():
    assert SPACE.names == ("gravity", "body_mass.torso", "dof_damping.foot_joint")
    assert [parameter.unit for parameter in SPACE.parameters] == ["m/s²", "kg", "N·m·s/rad"]
    assert len(SPACE) == 3


def test_physical_values_worked_by_hand():
    np.testing.assert_array_equal(SPACE.to_physical([0.5, -0.5, 0.0]), [-7.5, 3.5, 1.5])
    np.testing.assert_array_equal(SPACE.to_unit([-7.5, 3.5, 1.5]), [0.5, -0.5, 0.0])
    np.testing.assert_array_equal(SPACE.middle, [-15.0, 4.0, 1.5])


def test_corners_are_the_ranges_exactly():
    np.testing.assert_array_equal(SPACE.to_physical(-np.ones(3)), SPACE.low)
    np.testing.assert_array_equal(SPACE.to_physical(np.ones(3)), SPACE.high)


@pytest.mark.parametrize("shape", [(3,), (7, 3), (2, 5, 3)])
def test_to_unit_inverts_to_physical_over_any_leading_axes(shape):
    unit = np.random.default_rng(0).uniform(-1.0, 1.0, shape)
    physical = SPACE.to_physical(unit)
    assert physical.shape == shape
    assert physical.dtype == np.float64
    assert ((physical >= SPACE.low) & (physical <= SPACE.high)).all()
    np.testing.assert_allclose(SPACE.to_unit(physical), unit, atol=1e-14)


def test_float32_becomes_float64():
    assert SPACE.to_physical(np.zeros(3, dtype=np.float32)).dtype == np.float64
    assert SPACE.to_unit(np.zeros(3, dtype=np.float32)).dtype == np.float64


def test_permuting_parameters_permutes_the_map():
    order = [2, 0, 1]
    permuted = SPACE.select([SPACE.names[index] for index in order])
    unit = np.array([0.1, -0.7, 0.9])
    np.testing.assert_array_equal(permuted.to_physical(unit[order]), SPACE.to_physical(unit)[order])


def test_select_keeps_the_order_given():
    assert SPACE.select(["dof_damping.foot_joint", "gravity"]).names == ("dof_damping.foot_joint", "gravity")


def test_select_refuses_a_name_that_is_not_there():
    with pytest.raises(MadocError, match=r"no parameter 'body_mass.head' here; there are: gravity, body_mass"):
        SPACE.select(["gravity", "body_mass.head"])


def test_vector_by_name_whatever_the_order():
    values = {"dof_damping.foot_joint": 1.0, "gravity": -9.81, "body_mass.torso": 4}
    np.testing.assert_array_equal(SPACE.vector(values), [-9.81, 4.0, 1.0])


def test_vector_refuses_a_missing_and_an_unknown_name():
    with pytest.raises(MadocError, match=r"no value for 'body_mass.torso'; expected values for exactly: gravity"):
        SPACE.vector({"gravity": -9.81})
    values = {"gravity": -9.81, "body_mass.torso": 4.0, "dof_damping.foot_joint": 1.0, "wind": 1.0}
    with pytest.raises(MadocError, match=r"unknown parameter 'wind'; expected values for exactly: gravity"):
        SPACE.vector(values)


def test_an_unknown_field_is_refused():
    with pytest.raises(MadocError, match=r"unknown parameter field 'mass'; nearest: body_mass, .* begins with body_"):
        Parameter("mass", "torso", 0.0, 1.0)


@pytest.mark.parametrize(
    ("field", "element", "sentence"),
    [
        ("gravity", "torso", "parameter field 'gravity' takes no element, got 'torso'"),
        ("body_mass", "", "parameter field 'body_mass' takes the name of a body, got ''"),
        ("geom_friction", "", "parameter field 'geom_friction' takes the name of a geom, got ''"),
    ],
)
def test_an_element_where_none_belongs_and_the_reverse(field, element, sentence):
    with pytest.raises(MadocError, match=sentence):
        Parameter(field, element, 0.0, 1.0)


@pytest.mark.parametrize(
    ("low", "high"), [(1.0, 1.0), (2.0, 1.0), (np.nan, 1.0), (0.0, np.nan), (0.0, np.inf), (-np.inf, 0.0)]
)
def test_a_range_must_be_finite_and_ordered(low, high):
    with pytest.raises(MadocError, match=r"range of gravity must be finite with low < high, got \["):
        Parameter("gravity", "", low, high)


@pytest.mark.parametrize("field", [name for name, field in FIELDS.items() if field.minimum == 0.0])
def test_a_range_below_the_physical_bound_is_refused(field):
    element = "x" if FIELDS[field].element else ""
    with pytest.raises(MadocError, match=rf"range of {field}(.x)? starts at -0.1 .*, below its physical bound 0.0"):
        Parameter(field, element, -0.1, 1.0)


def test_only_gravity_gain_zeros_bias_and_deviations_may_be_negative():
    found = [name for name, kind in FIELDS.items() if kind.minimum == -np.inf and name not in (*PAYLOAD, *INERTIA)]
    assert found == ["gravity", "jnt_ref", "actuator_gain", "signal_bias"]


def test_a_value_shared_by_elements():
    shared = Parameter("dof_damping", ("left_knee", "right_knee"), 0.0, 2.0)
    assert shared.elements == ("left_knee", "right_knee")
    assert shared.name == "dof_damping.left_knee+right_knee"
    assert replace(shared, label="knee_damping").name == "knee_damping"
    assert Parameter("dof_damping", "left_knee", 0.0, 2.0).elements == ("left_knee",)
    assert Parameter("gravity", "", -10.0, 0.0).elements == ()


def test_a_unit_of_its_own():
    assert Parameter("dof_damping", "rail", 0.0, 2.0, measured_in="N·s/m").unit == "N·s/m"
    with pytest.raises(MadocError, match=r"starts at -1.0 N·s/m, below its physical bound 0.0"):
        Parameter("dof_damping", "rail", -1.0, 2.0, measured_in="N·s/m")


def test_an_element_shared_with_itself_is_refused():
    with pytest.raises(MadocError, match=r"dof_damping.knee\+knee names an element twice"):
        Parameter("dof_damping", ("knee", "knee"), 0.0, 2.0)
    with pytest.raises(MadocError, match="takes the name of a joint"):
        Parameter("dof_damping", (), 0.0, 2.0)


def test_an_empty_space_and_a_repeated_name_are_refused():
    with pytest.raises(MadocError, match="needs at least one parameter, got none"):
        ParameterSpace(())
    with pytest.raises(MadocError, match="parameters named twice: gravity"):
        ParameterSpace((SPACE.parameters[0], SPACE.parameters[0]))


def test_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        SPACE.parameters[0].low = 0.0  # type: ignore[misc]


def test_values_by_name_or_in_order_are_one_vector():
    values = dict(zip(SPACE.names, SPACE.middle.tolist(), strict=True))
    turned = dict(reversed(values.items()))
    for given in (values, turned, SPACE.middle, SPACE.middle.tolist()):
        assert SPACE.vector(given).tolist() == SPACE.middle.tolist()
    several = np.stack([SPACE.low, SPACE.high])
    assert (SPACE.vector(several) == several).all()
    with pytest.raises(MadocError, match=r"parameter values \(.*\), got an array of shape \(1,\)"):
        SPACE.vector([1.0])


def test_an_estimate_is_at_an_end_where_it_stops_there_or_may_lie_beyond():
    space = ParameterSpace((Parameter("dof_armature", "hip", 0.1, 1.1), Parameter("dof_damping", "hip", 0.0, 1.0)))

    def ends(value, low, high):
        return space.at_end(np.array([value, value]), np.array([[low, high], [low, high]]))

    assert space.at_end(np.array([0.97, 0.99])) == ("dof_damping.hip",)
    assert space.at_end(np.array([-0.99, -0.99])) == ("dof_armature.hip",)  # a damping of 0 is a physical bound
    assert ends(1.0, 0.999, 1.0) == ("dof_armature.hip", "dof_damping.hip")  # it stops there
    assert ends(0.99, 0.9, 1.0) == ("dof_armature.hip", "dof_damping.hip")  # not known so well
    assert ends(0.99, 0.985, 1.0) == ()  # inside, and known to be
    assert ends(0.99, 0.985, 0.995) == ()  # the interval does not reach the end
