from dataclasses import replace

import jax
import numpy as np

from madoc.data import Disturbance, disturb
from madoc.identification.noise import regression_noise
from robots import pendulum, recorded

TRUTH = {"body_mass.rod": 1.0, "dof_damping.pivot": 0.2, "actuator_gain.pivot": 1.0}


def test_noise_is_told_from_motion():
    task = pendulum()
    clean = recorded(task, TRUTH, 2000, jax.random.key(0))
    change = (clean.transitions.next_observation - clean.transitions.observation).std(0)
    assert (regression_noise(clean) < 1e-3 * change).all()
    for share in (0.01, 0.1):
        noisy = disturb(clean, Disturbance(noise=share), task, jax.random.key(1))
        np.testing.assert_allclose(regression_noise(noisy), share * change, rtol=0.15)


def test_episodes_of_one_row_tell_no_noise():
    rows = recorded(pendulum(), TRUTH, 50, jax.random.key(0))
    assert regression_noise(replace(rows, episode_starts=np.arange(50))).tolist() == [0.0, 0.0]
