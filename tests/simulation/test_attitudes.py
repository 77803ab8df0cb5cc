"""Differences of attitudes: by hand, and as the inverse of small rotations."""

import mujoco
import numpy as np
import pytest

from madoc.simulation.attitudes import differences, moved

HALF = np.sqrt(0.5)
ATTITUDES = ((1, 2, 3, 4),)


def test_a_quarter_turn_by_hand():
    # From a quarter turn about z to half a turn about z: v = sin(45°) about z, whatever the sign of a quaternion.
    before, after = np.array([3.0, HALF, 0.0, 0.0, HALF, 1.0]), np.array([5.0, 0.0, 0.0, 0.0, -1.0, 1.5])
    assert differences(ATTITUDES, after, before) == pytest.approx([2.0, 0.0, 0.0, 0.0, HALF, 0.5])
    assert differences((), after, before) == pytest.approx(after - before)
    assert differences(((3, 4, 5, 6),), after, before) == pytest.approx(after - before)  # of fewer values than that


def test_a_rotation_is_in_the_frame_of_the_body():
    # Behind a quarter turn about z, a small rotation about the body's x is one about the world's y.
    before, world = np.array([0.0, HALF, 0.0, 0.0, HALF]), np.zeros(4)
    mujoco.mju_mulQuat(world, np.array([np.cos(0.05), 0.0, np.sin(0.05), 0.0]), before[1:])
    after = np.array([0.0, *world])
    assert differences(ATTITUDES, after, before) == pytest.approx([0.0, 0.0, np.sin(0.05), 0.0, 0.0])


def test_lengths_do_not_count():
    random = np.random.default_rng(0)
    some, others = random.standard_normal((2, 7, 5))
    longer = 3.0 * some
    longer[:, 0] = some[:, 0]
    assert differences(ATTITUDES, longer, others) == pytest.approx(differences(ATTITUDES, some, others))


def test_moved_is_the_inverse_of_differences():
    random = np.random.default_rng(0)
    readings, by = random.standard_normal((6, 5)), 0.1 * random.standard_normal((3, 6, 5))
    found = differences(ATTITUDES, moved(ATTITUDES, readings, by), readings)
    assert found == pytest.approx(by * (1.0, 0.0, 1.0, 1.0, 1.0))
    assert moved(ATTITUDES, readings, by)[..., 1:] ** 2 @ np.ones(4) == pytest.approx(np.ones((3, 6)))
