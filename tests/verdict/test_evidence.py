from dataclasses import replace

import jax
import numpy as np
import pytest
from planted_logs import ROBOTS, bench, log_of

from madoc.data import Disturbance, disturb, hide_velocities
from madoc.verdict.evidence import evidence, replay_errors, save_evidence
from madoc.verdict.fitted_starts import FITTED

STEP = 0.02


def test_whole_runs_start_as_measured_and_the_truth_follows_them(tmp_path):
    task, truth = ROBOTS["spring"]
    judged = bench(log_of("spring"), task)
    arrays = evidence(judged, task.parameters.vector(truth), control_step=STEP)
    save_evidence(tmp_path / "evidence.npz", arrays)
    with np.load(tmp_path / "evidence.npz", allow_pickle=False) as stored:
        found = {name: stored[name] for name in stored.files}
    assert found.keys() == arrays.keys()
    count, times, signals = found["measured"].shape
    assert (count, times, signals) == (2, 101, 2)  # a fifth of ten episodes of a hundred rows
    assert found["time"] == pytest.approx(STEP * np.arange(times))
    assert found["signals"].tolist() == ["observation[0]", "observation[1]"]
    assert (found["before"][:, 0] == found["measured"][:, 0]).all()
    assert found["after"] == pytest.approx(found["measured"], abs=1e-6)
    assert np.abs(found["before"] - found["measured"]).max() > 0.01
    assert np.abs(found["residual_after"]).max() < 1e-12 < np.abs(found["residual_before"]).max()
    assert found["names"].tolist() == [f"run {1 + row // 100}" for row in found["row"]]
    for name in ("measured", "before", "after"):  # the spring's first signal is its only position
        assert found[f"posture_{name}"] == pytest.approx(found[name][..., :1], abs=1e-7)


def test_a_run_is_empty_behind_its_end_and_cut_where_there_is_no_time(monkeypatch):
    task, truth = ROBOTS["spring"]
    judged = bench(log_of("spring"), task)
    held = judged.held_out
    uneven = replace(held, episode_starts=np.array([0, 70]))  # the second "run" is of two, and jumps at row 100
    uneven = replace(judged, held_out=uneven)
    arrays = evidence(uneven, task.parameters.vector(truth), control_step=STEP)
    assert arrays["measured"].shape[:2] == (2, 131)
    for name in ("measured", "before", "after", "posture_measured", "posture_after"):
        assert np.isfinite(arrays[name][0, :71]).all() and np.isnan(arrays[name][0, 71:]).all()
        assert np.isfinite(arrays[name][1]).all()
    assert arrays["after"][0, :71] == pytest.approx(arrays["measured"][0, :71], abs=1e-6)
    monkeypatch.setattr("madoc.verdict.evidence.ROWS", (50, 50))
    arrays = evidence(uneven, task.parameters.vector(truth), control_step=STEP)
    assert arrays["measured"].shape[:2] == (1, 51)


def hidden_arm(rows):
    """A log of an arm without velocities, the arm, and its truth."""
    task, truth = replace(ROBOTS["arm"][0], velocities=2), ROBOTS["arm"][1]
    log = disturb(log_of("arm", rows=rows), Disturbance(hidden_velocities=True), task, jax.random.key(0))
    task = hide_velocities(task)
    return log, task, task.parameters.vector(truth)


def test_where_positions_are_not_known_only_what_was_measured_is_there():
    log, task, values = hidden_arm(500)
    arrays = evidence(bench(log, replace(task, posture=None)), values, control_step=STEP)
    assert arrays.keys() == {"signals", "scale", "time", "names", "row", "measured"}
    assert arrays["measured"].shape[2] == 2


def test_runs_start_at_fitted_states_where_velocities_are_hidden():
    log, task, values = hidden_arm(1000)
    arrays = evidence(bench(log, task), values, control_step=STEP)
    assert arrays["fitted"] > 0 and "residual_after" not in arrays
    assert arrays["measured"].shape[2] == 2
    near, far = (np.nanmax(np.abs(arrays[when] - arrays["measured"])) for when in ("after", "before"))
    assert near < 0.01 * far


@pytest.mark.parametrize("hidden", [False, True])
def test_a_replay_at_the_estimate_has_the_errors_of_the_runs_that_were_kept(hidden):
    if hidden:
        log, task, values = hidden_arm(1000)
    else:
        (task, truth), log = ROBOTS["spring"], log_of("spring")
        values = task.parameters.vector(truth)
    judged, middle = bench(log, task), task.parameters.middle
    arrays = evidence(judged, middle, control_step=STEP)
    exact, kept = replay_errors(arrays, judged.simulator, np.stack([values, middle]))
    apart = (arrays["after"].astype(float) - arrays["measured"]) / arrays["scale"]
    assert kept == pytest.approx(np.sqrt(np.nanmean(apart**2)), rel=1e-4)
    assert exact < (0.5 if hidden else 1e-4) * kept  # hidden, runs start where the middle of the ranges fits best
    assert replay_errors({"measured": arrays["measured"]}, judged.simulator, middle[None]) is None


def test_noisy_runs_start_at_fitted_states_where_the_rest_is_judged_from_them():
    task, truth = ROBOTS["spring"]
    judged, values = bench(log_of("spring", noise=0.3), task), task.parameters.vector(truth)
    logged, fitted = (evidence(judged, values, control_step=STEP, fits_starts=fits) for fits in (False, True))
    assert (int(logged["fitted"]), int(fitted["fitted"]) % FITTED) == (0, 0) and fitted["fitted"] > 0
    errors = [np.abs(each["after"] - each["measured"])[..., 0].mean() for each in (logged, fitted)]
    assert errors[1] < 0.9 * errors[0]
    assert "residual_after" in fitted
