import mujoco
import numpy as np

from madoc import tasks
from madoc.data import hide_velocities
from madoc.simulation.velocities import missing_velocities, unseen_positions, velocities_between, with_velocities


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
