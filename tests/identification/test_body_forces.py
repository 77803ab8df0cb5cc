"""Forces on free bodies and of all drives, by hand."""

import numpy as np
import pytest
from test_noise import body_task
from test_responses import WHOLE, of_windows

from madoc.identification.body_forces import FreeBody, free_bodies, of_all_drives, on_body
from madoc.identification.causes import (
    BENT_ALL,
    CUBIC_ALL,
    DEAD_ALL,
    DRAGGED,
    NEAR_GROUND,
    OFF_CENTRE,
    PUSH,
    SLOWED,
    WEAKENING_ALL,
    WIND,
)
from madoc.identification.responses import responses_of

HALF = np.sqrt(0.5)


def test_forces_of_all_drives():
    # Two drives on one degree of freedom: 1 and 7 N, then 7 and -1 N, so that each has a root mean square of 5 N.
    drives, speed = np.array([[[[1.0], [7.0]], [[7.0], [-1.0]]]]), np.array([[[2.0], [-2.0]]])
    found = of_all_drives(drives, speed, np.array([[1.0, 0.5]]))
    assert found[BENT_ALL][0, :, 0] == pytest.approx([-50.0 / 5.0, -48.0 / 5.0])
    assert found[CUBIC_ALL][0, :, 0] == pytest.approx([-(1.0 + 7.0**3) / 25.0, -(7.0**3 - 1.0) / 25.0])
    assert found[DEAD_ALL][0, :, 0] == pytest.approx([-5.0 * (np.tanh(2.0) + 1.0), -5.0 * (1.0 - np.tanh(2.0))])
    # All push at 2 m/s, with the motion or against it: by their root mean square that is 1 or -1.
    assert found[WEAKENING_ALL][0, :, 0] == pytest.approx([-8.0, 8.0])
    assert found[NEAR_GROUND][0, :, 0] == pytest.approx([8.0 * 1.0 / 2.5, 6.0 * 4.0 / 2.5])
    assert NEAR_GROUND not in of_all_drives(drives, speed, None)


def turned(**values):
    """A body a quarter turn about z, so that its x axis is the world's y: at 1 m, under 2 N along its z axis."""
    vectors = {"velocity": (3.0, 0.0, 0.0), "turning": (0.0, 0.0, 2.0), "force": (0.0, 0.0, 2.0), "torque": (0.0,) * 3}
    given = {name: np.array([[each]]) for name, each in {**vectors, **values}.items()}
    return FreeBody("root", 0, np.array([[[HALF, 0.0, 0.0, HALF]]]), **given, height=np.ones((1, 1)))


def test_forces_on_a_body():
    body, found = turned(), {}
    for cause, force, torque in on_body(body):
        found.setdefault(cause, []).append(np.concatenate([force, torque], axis=-1)[0, 0])
    world, still = np.stack(found[WIND]), np.stack(found[SLOWED])
    assert world[:, :3] == pytest.approx(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert (world[:, 3:] == 0.0).all()
    assert np.stack(found[PUSH])[[0, 2, 4, 1, 3, 5]] == pytest.approx(np.eye(6))
    assert np.stack(found[OFF_CENTRE]) == pytest.approx(np.stack(found[PUSH]))  # the thrust is its root mean square
    assert still == pytest.approx(-np.eye(6)[[0, 5]])
    assert np.stack(found[DRAGGED]) == pytest.approx(still)
    assert (body.typical_force, body.typical_torque) == (pytest.approx(2.0), 1.0)


def test_a_force_of_the_bodys_frame_acts_along_the_worlds_axes():
    body = turned()
    found = body.generalised(np.array([[[1.0, 0.0, 0.0]]]), np.array([[[0.0, 5.0, 0.0]]]), 7)
    assert found[0, 0] == pytest.approx([0.0, 1.0, 0.0, 0.0, 5.0, 0.0, 0.0])


def test_the_motion_of_a_free_body_is_told_in_its_own_frame(tmp_path):
    """A force of 1 N along the body's y axis at 0.1 m before its middle, behind a quarter turn."""
    state = np.concatenate([[0.0, 0.0, 1.5, HALF, 0.0, 0.0, HALF], [0.0, 3.0, 0.0, 0.1, 0.2, 0.3]])
    simulator, readings = of_windows(body_task(tmp_path), np.ones((2, 1, 1)))
    (body,) = free_bodies(simulator, responses_of(simulator, readings, -np.ones(1), np.stack([state, state]), WHOLE))
    assert body.name == "root"
    assert body.velocity[0, 0] == pytest.approx([3.0, 0.0, 0.0])
    assert body.turning[0, 0] == pytest.approx([0.1, 0.2, 0.3])
    assert body.force[0, 0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)
    assert body.torque[0, 0] == pytest.approx([0.0, 0.0, 0.1])
    assert body.height[0, 0] == 1.5
