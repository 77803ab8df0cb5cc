"""Recordings of held-out runs, read back by Rerun."""

import socket
import sys
import urllib.request

import numpy as np
import pytest

from madoc import simulation
from madoc.errors import MadocError
from madoc.export.recording import save_recordings, serve_recordings
from robots import spring

SIMULATOR = simulation.make(spring(), threads=1)


@pytest.fixture
def rerun():
    return pytest.importorskip("rerun", reason="rerun-sdk is not installed")


def evidence():
    """Two runs of three readings, of which the second has two."""
    position = np.arange(6.0).reshape(2, 3, 1)
    position[1, 2] = np.nan
    motions = {
        name: np.concatenate([position + more, position], 2)
        for more, name in enumerate(("measured", "before", "after"))
    }
    postures = {f"posture_{name}": each[..., :1] for name, each in motions.items()}
    about = {"signals": np.array(["place [m]", "speed"]), "names": np.array(["a.csv", "b.csv"])}
    return about | motions | postures | {"time": np.array([0.0, 0.5, 1.0])}


def test_each_run_has_signals_and_the_robot_over_time(rerun, tmp_path):
    from rerun.chunk import RrdReader

    files = save_recordings(tmp_path, evidence(), SIMULATOR, SIMULATOR.parameters.middle)
    assert [file.name for file in files] == ["held-out-0.rrd", "held-out-1.rrd"]
    for file, rows in zip(files, (3, 2), strict=True):
        moving = [chunk for chunk in RrdReader(str(file)).stream().to_chunks() if not chunk.is_static]
        found = {chunk.entity_path: chunk.to_record_batch() for chunk in moving if "time" in chunk.timeline_names}
        titles = "measured", "model\\ as\\ given", "calibrated"
        assert {f"/signals/{name}/{title}" for name in ("place\\ \\[m\\]", "speed") for title in titles} <= found.keys()
        assert len([place for place in found if place.startswith("/robot/")]) == 3  # the spring's one geom
        assert {batch.num_rows for batch in found.values()} == {rows}
    values = [column for column in found["/signals/place\\ \\[m\\]/calibrated"].to_pydict().values() if [5.0] in column]
    assert values == [[[5.0], [6.0]]]  # the second run begins at 3, and what is calibrated is 2 above it


def test_a_browser_is_given_the_viewer_and_where_the_runs_are(rerun):
    with socket.socket() as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    address, kept = serve_recordings(evidence(), SIMULATOR, SIMULATOR.parameters.middle, port=port)
    assert address == f"http://localhost:{port}/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{port + 1}%2Fproxy"
    assert len(kept) == 2
    with urllib.request.urlopen(f"http://localhost:{port}/", timeout=20) as page:
        assert b"rerun" in page.read().lower()


def test_what_is_missing_is_said_in_a_sentence(tmp_path, monkeypatch):
    without = {name: part for name, part in evidence().items() if not name.startswith("posture")}
    with pytest.raises(MadocError, match="no held-out run has positions to show"):
        save_recordings(tmp_path, without, SIMULATOR, SIMULATOR.parameters.middle)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MadocError, match=r"needs the package rerun-sdk; pip install .madoc-calibration.view"):
        save_recordings(tmp_path, evidence(), SIMULATOR, SIMULATOR.parameters.middle)
