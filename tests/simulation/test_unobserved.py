"""Velocities by differences of positions, and free bases that stand on their contacts."""

from dataclasses import replace

import mujoco
import numpy as np

from madoc import tasks
from madoc.data import hide_velocities
from madoc.simulation.unobserved import (
    missing_velocities,
    on_the_floor,
    unseen_positions,
    velocities_between,
    with_velocities,
)
from robots import spring


def test_a_quaternions_velocity_is_how_far_it_turned():
    task = tasks.make("ant")
    model = task.compile()
    before = np.tile(np.concatenate([model.qpos0, np.zeros(model.nv)]), (2, 1))
    after = before.copy()
    after[:, 3:7] = [np.cos(0.1), 0.0, 0.0, np.sin(0.1)]  # 0.2 rad about z
    after[:, 0] += 0.3
    found = velocities_between(task, before, after, np.array([1.0, 2.0]))
    seconds = task.frame_skip * model.opt.timestep * np.array([1.0, 2.0])
    np.testing.assert_allclose(found[:, 5] * seconds, 0.2)
    np.testing.assert_allclose(found[:, 0] * seconds, 0.3)
    assert not found[:, 6:].any()
    random = np.random.default_rng(0)
    before[:, 3:7], after[:, 3:7] = random.standard_normal((2, 2, 4))
    for each in (before, after):
        each[:, 3:7] /= np.linalg.norm(each[:, 3:7], axis=1, keepdims=True)
    found = velocities_between(task, before, after, np.array([1.0, 2.0]))
    for row, time in enumerate(seconds):
        expected = np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, expected, time, *(each[row, : model.nq] for each in (before, after)))
        np.testing.assert_allclose(found[row], expected, atol=1e-9)


def test_velocities_go_where_there_are_none():
    task = hide_velocities(tasks.make("hopper"))
    states = np.arange(12.0)[None].repeat(2, 0)
    states[0, 7:] = np.nan
    found = with_velocities(task, states, np.array([[np.nan, 20.0, 30.0, 40.0, 50.0, 60.0]] * 2))
    np.testing.assert_array_equal(found[0], [0, 1, 2, 3, 4, 5, 6, 20, 30, 40, 50, 60])
    np.testing.assert_array_equal(found[1], np.arange(12))


def test_what_hidden_velocities_leave_unseen():
    for name, unseen in (("hopper", ("rootx",)), ("halfcheetah", ("rootx",))):
        task = hide_velocities(tasks.make(name))
        assert unseen_positions(task) == unseen
        positions = task.compile().nq
        np.testing.assert_array_equal(missing_velocities(task), positions + np.arange(task.compile().nv))
    assert unseen_positions(tasks.make("hopper")) == ()


WHEEL = """<mujoco><worldbody>
  <geom type="plane" size="5 5 0.1" pos="0 0 {floor}"/>
  <body pos="0 0 3"><freejoint name="base"/><geom size="0.1" pos="0 0 -0.2" {geom}/></body>
</worldbody></mujoco>"""
PLANAR = """<mujoco><worldbody>
  <geom type="plane" size="5 5 0.1"/>
  <body><joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
    <joint name="pitch" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.2"/></body>
</worldbody></mujoco>"""
HALF_TURN = (0.0, 1.0, 0.0, 0.0)  # about x: the ball is above the body's origin


def placed(states, *, floor=0.0, geom=""):
    """States of a body with a ball of 0.1 m that is 0.2 m below its origin; all but attitude and turning is hidden."""
    hidden = np.array([np.nan] * 3 + [0.0] * 4 + [np.nan] * 3 + [0.0] * 3)
    return on_the_floor(seen(WHEEL.format(floor=floor, geom=geom), hidden), np.array(states, np.float64) + hidden)


def seen(model, hidden):
    """A robot of which the values that are NaN in `hidden` are not observed."""
    return replace(
        spring(), spec=lambda: mujoco.MjSpec.from_string(model), observation_size=1, posture=lambda observation: hidden
    )


def of(attitude, turning):
    return [0.0] * 3 + list(attitude) + [0.0] * 3 + list(turning)


def test_the_lowest_geom_stands_on_the_floor():
    found = placed([of((1, 0, 0, 0), (0, 0, 0)), of(HALF_TURN, (0, 0, 0))], floor=0.5)
    np.testing.assert_allclose(found.states[:, 2], [0.8, 0.4], atol=1e-9)
    np.testing.assert_array_equal(np.flatnonzero(found.found), [0, 1, 2, 7, 8, 9])
    np.testing.assert_array_equal(found.heights, [2])


def test_what_stands_does_not_move():
    found = placed([of((1, 0, 0, 0), (0, 2.0, 0)), of((1, 0, 0, 0), (0, 0, 2.0))])
    # Turning about y by 2 rad/s with the lowest point 0.3 m below moves the origin by 0.6 m/s along x.
    np.testing.assert_allclose(found.states[:, 7:10], [[0.6, 0.0, 0.0], [0.0, 0.0, 0.0]], atol=1e-9)


def test_what_cannot_touch_the_floor_is_not_placed():
    found = placed([of((1, 0, 0, 0), (0, 0, 0))], geom='contype="0" conaffinity="0"')
    assert not found.found.any() and np.isnan(found.states[0, 2])


def test_a_planar_robot_is_placed_by_its_slides():
    turning = np.array([[0.0, 0.0, np.pi, 0.0, 0.0, 2.0], [0.0, 0.0, 0.0, 0.0, 0.0, 2.0]])
    found = on_the_floor(seen(PLANAR, np.array([np.nan, np.nan, 0.0, np.nan, np.nan, 0.0])), turning)
    np.testing.assert_allclose(found.states[:, 1], [-0.1, 0.3], atol=1e-9)  # the ball is above, then below its origin
    np.testing.assert_allclose(found.states[:, 3:5], [[-0.2, 0.0], [0.6, 0.0]], atol=1e-9)
    np.testing.assert_array_equal(np.flatnonzero(found.found), [0, 1, 3, 4])
    np.testing.assert_array_equal(found.heights, [1])
    flying = on_the_floor(seen(PLANAR, np.array([np.nan, 0.0, 0.0, np.nan, np.nan, 0.0])), turning)
    np.testing.assert_array_equal(np.flatnonzero(flying.found), [0, 3])  # the change of its height tells its speed
