from dataclasses import replace

import jax
import numpy as np
import pytest
from planted_logs import ROBOTS, bench, log_of

from madoc.data import Disturbance, disturb, hide_velocities
from madoc.verdict.evidence import evidence, save_evidence

STEP = 0.02


def test_stretches_start_as_measured_and_the_truth_follows_them(tmp_path):
    task, truth = ROBOTS["spring"]
    judged = bench(log_of("spring"), task)
    arrays = evidence(judged, task.parameters.vector(truth), control_step=STEP)
    save_evidence(tmp_path / "evidence.npz", arrays)
    with np.load(tmp_path / "evidence.npz", allow_pickle=False) as stored:
        found = {name: stored[name] for name in stored.files}
    assert found.keys() == arrays.keys()
    count, times, signals = found["measured"].shape
    assert (count, times, signals) == (2, 101, 2)
    assert found["time"] == pytest.approx(STEP * np.arange(times))
    assert found["signals"].tolist() == ["observation[0]", "observation[1]"]
    assert (found["before"][:, 0] == found["measured"][:, 0]).all()
    assert found["after"] == pytest.approx(found["measured"], abs=1e-12)
    assert np.abs(found["before"] - found["measured"]).max() > 0.01
    assert np.abs(found["residual_after"]).max() < 1e-12 < np.abs(found["residual_before"]).max()
    assert len(found["episode"]) == len(found["row"]) == count


def test_where_no_state_can_be_rebuilt_only_what_was_measured_is_there():
    task = replace(ROBOTS["arm"][0], velocities=2)
    log = disturb(log_of("arm", rows=500), Disturbance(hidden_velocities=True), task, jax.random.key(0))
    arrays = evidence(bench(log, hide_velocities(task)), task.parameters.middle, control_step=STEP)
    assert arrays.keys() == {"signals", "scale", "time", "episode", "row", "measured"}
    assert arrays["measured"].shape[2] == 2
