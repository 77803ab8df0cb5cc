"""Combinations of parameters that a log tells though it leaves each open, worked by hand."""

import numpy as np
import pytest

from madoc.identification.combinations import combinations
from madoc.identification.information import NORMAL_95
from madoc.parameters import Parameter, ParameterSpace

BOX = 1.0 / 3.0


def space(*rows):
    return ParameterSpace(tuple(Parameter(field, "a", low, high, label=name) for name, field, low, high in rows))


def covariance_of(space, told, error):
    """In physical units: `told` is known to `error`, both in [-1, 1], what is perpendicular to it is open."""
    told = np.array(told) / np.linalg.norm(told)
    half = (space.high - space.low) / 2.0
    scaled = BOX * (np.eye(len(told)) - np.outer(told, told)) + error**2 * np.outer(told, told)
    return half[:, None] * scaled * half


def test_a_geared_joint_tells_the_sum_of_its_inertias():
    """Inertia J + 36 j: with ranges of 0.72 and 0.02, both terms weigh alike in [-1, 1]."""
    joint = space(("joint", "dof_armature", 0.0, 0.72), ("rotor", "body_inertia", 0.0, 0.02))
    (found,) = combinations(joint, np.array([0.36, 0.01]), covariance_of(joint, [1.0, 1.0], 0.01))
    assert found.kind == "sum"
    assert found.parameters["joint"] / found.parameters["rotor"] == pytest.approx(1 / 36)
    by_joint = 1.0 / found.parameters["joint"]
    assert found.estimate * by_joint == pytest.approx(0.36 + 36 * 0.01)
    # One direction of [-1, 1] is (1, 1) / √2: the sum of both has √2 times its error, in halves of 0.36.
    assert (found.interval[1] - found.estimate) * by_joint == pytest.approx(NORMAL_95 * 0.01 * np.sqrt(2) * 0.36)
    (few,) = combinations(joint, np.array([0.36, 0.01]), covariance_of(joint, [1.0, 1.0], 0.01), 2.23)
    assert np.ptp(few.interval) == pytest.approx(np.ptp(found.interval) * 2.23 / NORMAL_95)


def test_a_mass_on_a_rod_tells_their_product():
    """m·l at (1, 0.5): d(ml)/(ml) = dm/m + dl/l, with halves of 0.5 and 0.25 the weights in [-1, 1] are alike."""
    rod = space(("mass", "body_mass", 0.5, 1.5), ("length", "body_com", 0.25, 0.75))
    (found,) = combinations(rod, np.array([1.0, 0.5]), covariance_of(rod, [1.0, 1.0], 0.02))
    assert (found.name, found.kind, found.unit) == ("mass·length", "product", "kg·m")
    assert found.estimate == pytest.approx(0.5)
    # The error of ln(ml) is 0.5 · √2 · 0.02.
    assert found.interval[1] == pytest.approx(0.5 * np.exp(NORMAL_95 * 0.5 * np.sqrt(2) * 0.02))


def test_a_ratio_has_its_divisor_last():
    ratio = space(("gain", "actuator_gain", 0.5, 1.5), ("mass", "body_mass", 1.0, 3.0))
    (found,) = combinations(ratio, np.array([1.0, 2.0]), covariance_of(ratio, [1.0, -1.0], 0.02))
    assert found.name == "gain/mass"
    assert found.estimate == pytest.approx(0.5)


def test_known_parameters_are_in_no_combination_and_what_is_open_alone_tells_nothing():
    three = space(("mass", "body_mass", 0.5, 1.5), ("length", "body_com", 0.25, 0.75), ("gain", "actuator_gain", 0, 2))
    covariance = covariance_of(three, [1.0, 1.0, 0.0], 0.02)
    covariance[2, :], covariance[:, 2] = 0.0, 0.0
    (found,) = combinations(three, np.array([1.0, 0.5, 1.0]), covariance)
    assert set(found.parameters) == {"mass", "length"}
    assert combinations(three, np.ones(3), np.diag([BOX, 1e-6, 1e-6])) == ()
    assert combinations(three, np.ones(3), 1e-6 * np.eye(3)) == ()
