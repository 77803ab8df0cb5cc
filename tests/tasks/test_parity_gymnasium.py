"""Modern tasks against Gymnasium's v5 environments, step by step along random episodes."""

import gymnasium
import jax
import numpy as np
import pytest

import madoc.tasks

ENVIRONMENTS = {
    "hopper": ("Hopper-v5", {}),
    "halfcheetah": ("HalfCheetah-v5", {}),
    # v5 raised the friction of the left foot; D4RL, the paper and our task have the model of v2 to v4.
    "walker2d": ("Walker2d-v5", {"xml_file": "walker2d.xml"}),
    # D4RL's Ant: contact forces are always zero, observed or paid for.
    "ant": ("Ant-v5", {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0.0}),
}

STATE_TOLERANCE = 1e-9
"""Gymnasium starts the contact solver from the last step's solution, we start from 0; measured: 1e-12."""

ANT_SPEED_TOLERANCE = 0.1
"""m/s. Gymnasium's Ant takes its speed from the torso's Cartesian position, which MuJoCo leaves at the last
stage of the integrator; ours comes from the state. Measured: 0.062."""


@pytest.fixture(params=ENVIRONMENTS)
def robot(request, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # loading HalfCheetah's old model, MuJoCo writes a log into the working directory
    name, options = ENVIRONMENTS[request.param]
    with gymnasium.make(name, **options) as environment:
        # MuJoCo 3.5 began to add margins; the environments are older, and our floor's margin is 0.
        environment.unwrapped.model.geom("floor").margin = 0.0
        yield madoc.tasks.make(request.param, "modern"), environment


def test_observation_reward_and_termination_along_random_episodes(robot, nominal):
    task, environment = robot
    bare, system = environment.unwrapped, nominal(task)
    environment.action_space.seed(0)
    falls = 0
    for episode in range(5):
        observation, _ = environment.reset(seed=episode)
        state = bare.state_vector()
        np.testing.assert_array_equal(task.observe(state), observation)
        for _ in range(100):
            action = environment.action_space.sample().astype(np.float64)
            observation, reward, terminated, _, info = environment.step(action)
            next_state = system.step(state[None, None], action[None, None])[0, 0]
            np.testing.assert_allclose(task.observe(next_state), observation, rtol=0, atol=STATE_TOLERANCE)
            assert task.terminated(next_state) == terminated

            reached = bare.state_vector()
            np.testing.assert_array_equal(task.observe(reached), observation)
            speed = (reached[0] - state[0]) / bare.dt
            assert abs(speed - info["x_velocity"]) <= (ANT_SPEED_TOLERANCE if task.name == "ant" else 0.0)
            expected = reward - info["x_velocity"] + speed
            assert task.reward(state, action, reached) == pytest.approx(expected, abs=1e-12)
            assert task.reward(state, action, next_state) == pytest.approx(expected, abs=1e-9)
            state = reached
            if terminated:
                falls += 1
                break
    assert (falls > 0) == (task.name != "halfcheetah")  # how many is chance: of the Ant 5 to MuJoCo 3, 3 from 4.0 on


def test_health_agrees_far_from_where_random_episodes_go(robot):
    task, environment = robot
    bare = environment.unwrapped
    randomness = np.random.default_rng(0)
    scale = np.where(np.arange(len(bare.state_vector())) < 3, 0.6, 40.0)
    states = np.concatenate([bare.init_qpos, bare.init_qvel]) + scale * randomness.normal(size=(2000, len(scale)))
    ended = task.terminated(states)
    for state, end in zip(states, ended, strict=True):
        bare.data.qpos[:], bare.data.qvel[:] = np.split(state, [bare.model.nq])
        assert end == (task.name != "halfcheetah" and not bare.is_healthy)
    assert ended.any() == (task.name != "halfcheetah")
    assert not ended.all()


def test_models_agree_in_everything_that_moves_them(robot):
    task, environment = robot
    ours, theirs = task.compile(), environment.unwrapped.model
    for field in (
        "body_mass",
        "body_inertia",
        "body_ipos",
        "dof_damping",
        "dof_armature",
        "jnt_stiffness",
        "jnt_range",
        "geom_friction",
        "geom_margin",
        "geom_solref",
        "actuator_gear",
        "actuator_ctrlrange",
        "qpos0",
    ):
        np.testing.assert_allclose(getattr(ours, field), getattr(theirs, field), rtol=1e-12, err_msg=field)
    assert ours.opt.timestep * task.frame_skip == pytest.approx(environment.unwrapped.dt)
    np.testing.assert_allclose(ours.opt.gravity, theirs.opt.gravity)


def test_resets_are_spread_as_gymnasiums(robot):
    task, environment = robot
    bare = environment.unwrapped
    ours = np.asarray(task.reset_noise(jax.random.key(0), 2000), dtype=np.float64)
    theirs = []
    for seed in range(60):
        environment.reset(seed=seed)
        theirs.append(bare.state_vector() - np.concatenate([bare.init_qpos, bare.init_qvel]))
    for part in (slice(None, bare.model.nq), slice(bare.model.nq, None)):
        assert ours[:, part].std() == pytest.approx(np.std(np.array(theirs)[:, part]), rel=0.1)
        assert abs(ours[:, part].mean()) < 0.1 * ours[:, part].std()
