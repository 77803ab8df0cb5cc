"""Families of forces: what spans them, by hand, and on robots."""

import numpy as np
import pytest
from test_body_forces import turned
from test_noise import body_task
from test_responses import WHOLE, of_windows

from madoc.identification.responses import responses_of
from madoc.identification.unlisted_forces import CONSTANT, families, of_body, of_joint
from robots import spring


def test_functions_of_a_joint_by_hand():
    # At ±0.1 rad, always at 2 rad/s under ±3 N·m: all are ±1 in their own units.
    position, speed, exerted = np.array([[0.1, -0.1]]), np.full((1, 2), 2.0), np.array([[3.0, -3.0]])
    found = of_joint(position, speed, exerted, {"other": (np.array([[1.0, 3.0]]), np.zeros((1, 2)))}, turns=True)
    sign, ones = np.array([[1.0, -1.0]]), np.ones((1, 2))
    assert found[CONSTANT] == pytest.approx(ones)
    assert found["its position"] == pytest.approx(sign)
    assert found["its speed"] == pytest.approx(ones)
    assert found["the position of other"] == pytest.approx(-sign)
    assert found["the square of what its drive exerts"] == pytest.approx(sign)
    assert found["its position times what its drive exerts"] == pytest.approx(ones)
    assert found["its position times the position of other"] == pytest.approx(-ones)
    assert found["the load in the direction of its motion"] == pytest.approx(np.tanh(10.0) * ones)
    assert "what its drive exerts times its position" not in found  # every product is there once
    wide = of_joint(20.0 * position, speed, exerted, {}, turns=True)
    assert wide["the sine of its position"] == pytest.approx(np.sin(2.0) * sign)


def test_functions_of_a_free_body_by_hand():
    along, about = (of_body(turned(), 0, turning=turning) for turning in (False, True))
    for name in (
        "its velocity along x",
        "its turning about z",
        "the force of its drives along z",
        "its nearness to the ground",
    ):
        assert along[name] == pytest.approx(np.ones((1, 1)))
    assert along["the world's y axis"] == pytest.approx(np.ones((1, 1)))
    assert "the force of its drives along x" not in along  # drives exert none
    assert along["the force of its drives along z times its velocity along x"] == pytest.approx(np.ones((1, 1)))
    assert "the force of its drives along z times its turning about z" not in along
    assert about["the force of its drives along z times its turning about z"] == pytest.approx(np.ones((1, 1)))


def test_families_of_a_spring_and_of_a_free_body(tmp_path):
    simulator, readings = of_windows(spring(), np.ones((2, 4, 1)))
    state = np.array([[0.1, 0.0], [-0.2, 0.3]])
    (found,) = families(simulator, responses_of(simulator, readings, np.zeros(len(simulator.parameters)), state, WHOLE))
    assert found.place == simulator.task.model.joint(0).name
    assert found.forces.shape == (2, 4, 1, len(found.quantities))
    state = np.concatenate([[0.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0], [0.0, 3.0, 0.0, 0.1, 0.2, 0.3]])
    simulator, readings = of_windows(body_task(tmp_path), np.ones((2, 4, 1)))
    every = list(families(simulator, responses_of(simulator, readings, -np.ones(1), np.stack([state, state]), WHOLE)))
    places = [f"root, {kind} its {axis} axis" for axis in "xyz" for kind in ("along", "about")]
    assert [each.place for each in every] == places
    assert [each.unit for each in every] == ["N", "N·m"] * 3
    about = every[1]
    assert (about.forces[:, :, np.arange(6) != 3] == 0.0).all()
