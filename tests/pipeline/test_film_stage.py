"""Films: which run and which frames, and what the files hold."""

import io

import numpy as np
import pytest
from PIL import Image

from madoc import simulation
from madoc.pipeline.film_stage import COLUMNS, FRAMES, _leave, _longest_run
from madoc.simulation import pictures as drawing
from robots import spring

STEP = 0.5


def evidence(lengths, times):
    """Runs of one signal that have these numbers of readings, the value of which is the row."""
    measured = np.tile(np.arange(float(times))[:, None], (len(lengths), 1, 1))
    for run, length in enumerate(lengths):
        measured[run, length:] = np.nan
    postures = {f"posture_{name}": measured + more for more, name in enumerate(("measured", "before", "after"))}
    return postures | {"measured": measured, "time": STEP * np.arange(times)}


def test_the_longest_run_is_shown_up_to_its_end_or_twelve_seconds():
    panels, ghost, time = _longest_run(evidence([3, 5], 7))
    assert ghost[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0] and time.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert panels["your model as given"][:, 0].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert panels["calibrated"][-1, 0] == 6.0
    _, ghost, time = _longest_run(evidence([500], 500))
    assert (len(ghost), time[-1]) == (25, 12.0)
    assert len(_longest_run(evidence([500], 500) | {"time": 0.01 * np.arange(500)})[1]) == FRAMES


def test_a_film_is_left_as_sheets_and_as_an_animated_picture(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    simulator = simulation.make(spring(), threads=1)
    frames = COLUMNS + 2
    moving = np.stack([np.linspace(-0.05, 0.05, frames), np.zeros(frames)], axis=1)
    still = np.where(np.arange(frames)[:, None] < 3, np.zeros((frames, 2)), np.nan)
    time = STEP * np.arange(frames)
    mean = simulator.parameters.middle
    picture = _leave(tmp_path / "film", simulator, mean, {"moving": moving, "ends": still}, time)
    with np.load(tmp_path / "film.npz", allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    assert arrays["names"].tolist() == ["moving", "ends"] and arrays["time"] == pytest.approx(time)
    width, height = arrays["size"].tolist()
    sheet = np.asarray(Image.open(io.BytesIO(arrays["sheet_1"].tobytes())))
    assert sheet.shape == (2 * height, COLUMNS * width, 3)
    there = [(sheet[:height, width * at : width * (at + 1)] < 200).any() for at in range(5)]
    assert there == [True, True, True, False, False]
    with Image.open(picture) as animated:
        assert (animated.n_frames, animated.size) == (frames, (2 * width, height))


def test_the_camera_keeps_what_was_measured_in_the_picture(tmp_path, monkeypatch):
    asked = {}
    monkeypatch.setattr(
        "madoc.pipeline.film_stage.pictures", lambda *words, **named: asked.update(camera=words[2]) or drawn
    )
    drawn = np.zeros((1, 3, 4, 4, 3), np.uint8)
    simulator = simulation.make(spring(), threads=1)
    ghost, astray = np.zeros((3, 2)), np.array([[0.0, 0.0], [100.0, 0.0], [1000.0, 0.0]])
    _leave(tmp_path / "film", simulator, simulator.parameters.middle, {"astray": astray}, np.arange(3.0), ghost=ghost)
    near = asked["camera"]
    _leave(tmp_path / "film", simulator, simulator.parameters.middle, {"astray": ghost}, np.arange(3.0), ghost=ghost)
    assert near.distance < 3.0 * asked["camera"].distance
    assert isinstance(near, drawing.Camera)
