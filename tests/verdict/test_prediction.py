from dataclasses import replace

import jax
import numpy as np
import pytest
from planted_logs import ROBOTS, log_of

from madoc import simulation
from madoc.data import Disturbance, disturb
from madoc.data.dataset import Dataset
from madoc.identification.windows import HORIZONS
from madoc.verdict.prediction import nearby_best, replays_of

TASK, TRUTH = ROBOTS["spring"]
SIMULATOR = simulation.make(TASK, threads=1)
SCALE = np.array([0.1, 0.2])


def test_residuals_are_simulated_less_logged_in_steps_changes():
    replays = replays_of(log_of("spring", rows=300), SIMULATOR, SCALE, HORIZONS)
    assert replays.horizons == (1, 5, 20)
    points = np.stack([np.zeros(3), TASK.parameters.to_unit(TASK.parameters.vector(TRUTH))])
    residuals = replays.residuals(points)
    assert residuals.shape == (2, len(replays.windows), 20, 2)
    assert np.abs(residuals[1]).max() < 1e-10
    step = SIMULATOR.bind(TASK.parameters.middle[None]).step(
        replays.windows.states[None, :1], replays.windows.actions[None, :1, 0]
    )
    assert residuals[0, 0, 0] == pytest.approx((step[0, 0] - replays.windows.following[0, 0]) / SCALE)


def test_a_failed_window_counts_as_the_worst_that_did_not():
    replays = replace(replays_of(log_of("spring", rows=300), SIMULATOR, SCALE, HORIZONS), horizons=(2,))
    residuals = np.full((1, 3, 2, 2), 0.5)
    residuals[0, 0, 1], residuals[0, 1, 1] = (-7.0, 0.1), np.nan
    assert replays.magnitudes(residuals)[:, 0, 0].tolist() == [[7.0, 0.1], [7.0, 1.0], [0.5, 0.5]]


def test_horizons_that_no_episode_lasts_are_left_out():
    short = log_of("spring", rows=600)
    single = disturb(short, Disturbance(shuffled="rows"), TASK, jax.random.key(0))
    assert replays_of(single, SIMULATOR, SCALE, HORIZONS).horizons == (1,)
    assert isinstance(short, Dataset)


def test_nearby_the_truth_is_found():
    replays = replays_of(log_of("spring", rows=300), SIMULATOR, SCALE, HORIZONS)
    truth = TASK.parameters.to_unit(TASK.parameters.vector(TRUTH))
    points, spent = nearby_best(replays, np.clip(truth + 0.2, -1, 1))
    assert points[-1] == pytest.approx(truth, abs=1e-4)
    assert spent % (7 * len(replays.windows)) == 0
    assert 2 <= spent / (7 * len(replays.windows)) <= 8
