"""Held-out runs for the viewer Rerun: signals, and the robot measured, in the model as given, and calibrated."""

from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np
from jaxtyping import Float

from madoc.errors import MadocError, needing
from madoc.simulation import Simulator
from madoc.simulation.pictures import Solid, placed, solids

if TYPE_CHECKING:
    from rerun import AsComponents, RecordingStream, TimeColumn

MOTIONS: Mapping[str, tuple[str, tuple[int, int, int, int]]] = {
    "measured": ("measured", (13, 153, 102, 110)),
    "before": ("model as given", (201, 138, 27, 255)),
    "after": ("calibrated", (31, 111, 214, 255)),
}
"""What each motion of `evidence.npz` is called, the colour of its lines, and of its robot unless calibrated."""
TIMELINE = "time"
"""Name of the time since the start of a run, s."""
MEMORY = "2GB"
"""Largest memory of what is served."""


def save_recordings(
    folder: Path,
    evidence: Mapping[str, np.ndarray],
    simulator: Simulator,
    parameters: Float[np.ndarray, " parameters"],
) -> list[Path]:
    """Leave `held-out-0.rrd`, ..., one for each held-out run.

    Raises:
        MadocError: The package rerun-sdk is not installed, or no run has positions.
    """
    rerun, files = _rerun(evidence), []
    for run, name in enumerate(evidence["names"].tolist()):
        files.append(folder / f"held-out-{run}.rrd")
        with rerun.RecordingStream("madoc", recording_id=f"{run} {name}") as stream:
            stream.save(files[-1], default_blueprint=_views(rerun, evidence))
            _record(rerun, stream, evidence, run, simulator, parameters)
            stream.flush()
    return files


def serve_recordings(
    evidence: Mapping[str, np.ndarray],
    simulator: Simulator,
    parameters: Float[np.ndarray, " parameters"],
    *,
    port: int,
) -> tuple[str, list["RecordingStream"]]:
    """Serve all held-out runs and the viewer on two ports, the given one and the next, until the process ends.

    Returns:
        The address to open, and what has to be kept for as long as it is served.

    Raises:
        MadocError: As `save_recordings`, or a port is taken.
    """
    rerun = _rerun(evidence)
    names, views = evidence["names"].tolist(), _views(rerun, evidence)
    streams = [rerun.RecordingStream("madoc", recording_id=f"{run} {name}") for run, name in enumerate(names)]
    try:
        source = streams[0].serve_grpc(grpc_port=port + 1, default_blueprint=views, server_memory_limit=MEMORY)
        for stream in streams[1:]:
            stream.connect_grpc(source, default_blueprint=views)
        for run, stream in enumerate(streams):
            _record(rerun, stream, evidence, run, simulator, parameters)
        rerun.serve_web_viewer(web_port=port, open_browser=False)
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise MadocError(
            f"could not serve on ports {port} and {port + 1} ({reason}); name others with --port"
        ) from error
    return f"http://localhost:{port}/?url={quote(source, safe='')}", streams


def _rerun(evidence: Mapping[str, np.ndarray]) -> ModuleType:
    """The package, where there is something to show."""
    if "posture_measured" not in evidence:
        raise MadocError(
            "no held-out run has positions to show; calibrate with --holdout to logs that show the joints' positions"
        )
    with needing("a view of the robot needs the package rerun-sdk;", "madoc-calibration[view]"):
        import rerun
        import rerun.blueprint
    return rerun


def _views(rerun: ModuleType, evidence: Mapping[str, np.ndarray]) -> object:
    """The robot on the left, a chart for each signal on the right, all with one time."""
    make = rerun.blueprint
    charts = [
        make.TimeSeriesView(origin=rerun.new_entity_path(["signals", name]), name=name)
        for name in evidence["signals"].tolist()
    ]
    robot = make.Spatial3DView(origin="robot", name="robot")
    panel = make.TimePanel(timeline=TIMELINE, expanded=False)
    return make.Blueprint(make.Horizontal(robot, make.Grid(*charts)), panel, collapse_panels=True)


def _record(
    rerun: ModuleType,
    stream: "RecordingStream",
    evidence: Mapping[str, np.ndarray],
    run: int,
    simulator: Simulator,
    parameters: Float[np.ndarray, " parameters"],
) -> None:
    """Write one run into a recording."""
    stream.send_recording_name(str(evidence["names"][run]))
    model = simulator.model(parameters)
    bodies = solids(model)
    for motion, (title, colour) in MOTIONS.items():
        for index, signal in enumerate(evidence["signals"].tolist()):
            place = rerun.new_entity_path(["signals", signal, title])
            values = evidence[motion][run, :, index].astype(np.float64)
            known = np.isfinite(values)
            stream.log(place, rerun.SeriesLines(colors=[colour], names=[title]), static=True)
            columns = rerun.Scalars.columns(scalars=values[known])
            stream.send_columns(place, [_times(rerun, evidence["time"][known])], columns)
        positions = evidence[f"posture_{motion}"][run].astype(np.float64)
        known = np.isfinite(positions).all(1)
        places, turns = placed(model, bodies, positions[known])
        for index, solid in enumerate(bodies):
            place = rerun.new_entity_path(["robot", title, solid.name])
            stream.log(place, _shape(rerun, solid, None if motion == "after" else colour), static=True)
            moved = rerun.Transform3D.columns(translation=places[:, index], mat3x3=turns[:, index])
            stream.send_columns(place, [_times(rerun, evidence["time"][known])], moved)


def _times(rerun: ModuleType, seconds: Float[np.ndarray, " times"]) -> "TimeColumn":
    return rerun.TimeColumn(TIMELINE, duration=seconds)


def _shape(rerun: ModuleType, solid: Solid, colour: tuple[int, int, int, int] | None) -> "AsComponents":
    """A solid as Rerun draws it, in its own colour where none is given."""
    paint = [colour or tuple((255.0 * solid.colour).round().astype(int).tolist())]
    filled = {"colors": paint, "fill_mode": "solid"}
    radius, _, half = solid.size.tolist()
    match solid.kind:
        case "mesh":
            return rerun.Mesh3D(vertex_positions=solid.vertices, triangle_indices=solid.faces, albedo_factor=paint[0])
        case "box":
            return rerun.Boxes3D(half_sizes=[solid.size], **filled)
        case "ellipsoid":
            return rerun.Ellipsoids3D(half_sizes=[solid.size], **filled)
        case "capsule":  # from its lower end, where MuJoCo has its middle
            return rerun.Capsules3D(lengths=[2.0 * half], radii=[radius], translations=[[0.0, 0.0, -half]], **filled)
    return rerun.Cylinders3D(lengths=[2.0 * half], radii=[radius], **filled)
