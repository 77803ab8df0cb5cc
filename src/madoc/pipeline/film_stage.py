"""Films for the report: of a held-out run, measured over simulated, and of policies from the same start."""

import warnings
from collections.abc import Mapping
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray, UInt8
from PIL import Image

from madoc import simulation
from madoc.pipeline.calibrated import read_calibration
from madoc.pipeline.orders import NO_PERMISSION, Permission
from madoc.report.reading import read_arrays
from madoc.runs.files import replacing
from madoc.simulation import Simulator
from madoc.simulation.pictures import outlines, pictures, side_camera
from madoc.simulation.rollout import act, reset_states
from madoc.types import Policy

FILM, MOTION = "film", "motion"
"""Names of the files of policies and of a held-out run, without their endings."""
FRAMES = 60
"""Largest number of frames of a film, evenly spread."""
SECONDS = 12.0
"""Largest length of the film of a held-out run, s."""
WIDTH = 320
"""Width of a picture in pixels."""
MOST = 1.6
"""Largest ratio of a picture's width to its height; the smallest is 1 / MOST."""
COLUMNS = 10
"""Pictures beside each other in a sheet of them, whose sides may have 16,383 pixels as WebP."""
_WEBP: Mapping[str, int] = {"quality": 70, "method": 2}
"""A tenth of the size of PNG, in a third of a second a sheet."""


def leave_motion(run: Path, *, permission: Permission = NO_PERMISSION) -> Path | None:
    """Leave `motion.npz` and `motion.webp` of the longest held-out run beside a calibration's `evidence.npz`.

    The measured motion shines through the simulated one: in the model as given, and calibrated. A failure is a warning
    only, as the result is written already.

    Returns:
        The animated picture; None where there is nothing to draw, or the robot's own Python file may not be run.
    """
    folder = run / "calibration" if (run / "calibration" / "spec.json").exists() else run
    evidence, stem = folder / "evidence.npz", folder / MOTION
    picture = stem.with_suffix(".webp")
    if not evidence.exists() or (picture.exists() and picture.stat().st_mtime >= evidence.stat().st_mtime):
        return picture if picture.exists() else None
    try:
        arrays = read_arrays(evidence, "measured", "time")
        if arrays is None or "posture_measured" not in arrays:
            return None
        calibrated = read_calibration(folder, permission=permission)
        panels, ghost, time = _longest_run(arrays)
        return _leave(stem, simulation.make(calibrated.task), calibrated.result.mean, panels, time, ghost=ghost)
    except Exception as error:
        warnings.warn(f"no film was made of {folder}: {error}", stacklevel=2)
        return None


def _longest_run(
    arrays: Mapping[str, np.ndarray],
) -> tuple[dict[str, np.ndarray], Float[np.ndarray, "frames qpos"], Float[np.ndarray, " frames"]]:
    """The positions of the longest held-out run in both simulations, the measured ones, and the times of the frames."""
    whole = np.isfinite(arrays["measured"]).all(-1)
    longest = int(whole.sum(1).argmax())
    rows = np.flatnonzero(whole[longest] & (arrays["time"] <= SECONDS))
    rows = rows[np.linspace(0, len(rows) - 1, min(FRAMES, len(rows))).round().astype(int)]
    before, after, measured = (
        arrays[f"posture_{name}"][longest, rows].astype(np.float64) for name in ("before", "after", "measured")
    )
    return {"your model as given": before, "calibrated": after}, measured, arrays["time"][rows]


def leave_film(
    folder: Path,
    policies: Mapping[str, Policy],
    simulator: Simulator,
    parameters: Float[np.ndarray, " parameters"],
    key: PRNGKeyArray,
) -> None:
    """Let each policy act one episode in a system, and leave `film.npz` and `film.webp`."""
    steps = np.unique(np.linspace(0, simulator.task.max_episode_steps, FRAMES).round().astype(int))
    of_start, _ = jax.random.split(key)
    start = reset_states(simulator)(of_start, 1)[None]
    episodes = {name: _states(policy, simulator, parameters, start) for name, policy in policies.items()}
    panels = {name: np.full((len(steps), states.shape[1]), np.nan) for name, states in episodes.items()}
    for name, states in episodes.items():
        seen = steps[steps < len(states)]
        panels[name][: len(seen)] = states[seen]
    _leave(folder / FILM, simulator, parameters, panels, simulator.control_step * steps)


def _leave(
    stem: Path,
    simulator: Simulator,
    parameters: Float[np.ndarray, " parameters"],
    panels: Mapping[str, Float[np.ndarray, "frames state"]],
    time: Float[np.ndarray, " frames"],
    *,
    ghost: Float[np.ndarray, "frames state"] | None = None,
) -> Path | None:
    """Leave a film as an animated picture and as sheets of pictures; None of a robot without a shape.

    `STEM.npz` has `names` of the panels, `time` of the frames (s), `size` of a picture (width and height) and the
    number of `columns` of a sheet, and for each panel its sheet as WebP, `sheet_0`, ... All panels are seen alike; the
    camera keeps the ghost in its picture where there is one.
    """
    model, states = simulator.model(parameters), np.stack(list(panels.values()))
    kept = states if ghost is None else np.stack([ghost] * len(panels))
    (ends, radius), (others, _) = (outlines(model, part.reshape(-1, part.shape[-1])) for part in (kept, states))
    shown, known = (np.isfinite(part).all((1, 2, 3)) for part in (ends, others))
    if not len(radius) or not shown.any():
        return None
    low, high = ends[shown].min((0, 1, 2)), ends[shown].max((0, 1, 2))
    air = (high - low).max() / 2.0  # a simulation that goes farther astray leaves the picture
    fitted = np.concatenate([ends[shown], np.clip(others[known], low - air, high + air)])
    camera, ratio = side_camera(fitted, radius, float(model.vis.global_.fovy), MOST)
    centre = np.zeros((len(shown), 3))
    centre[shown] = camera.centre[: shown.sum()]
    camera = replace(camera, centre=centre.reshape(*kept.shape[:2], 3))
    drawn = pictures(model, states, camera, ghost=ghost, width=WIDTH, height=round(WIDTH / ratio))
    sheets = {f"sheet_{index}": np.frombuffer(_sheet(panel), dtype=np.uint8) for index, panel in enumerate(drawn)}
    about = {"names": np.array(list(panels)), "time": time, "size": np.array([WIDTH, drawn.shape[2]])}
    with replacing(stem.with_suffix(".npz")) as stream:
        np.savez(stream, allow_pickle=False, columns=np.array(COLUMNS), **about, **sheets)
    with replacing(stem.with_suffix(".webp")) as stream:
        stream.write(_animation(drawn, float(np.diff(time).mean()) if len(time) > 1 else 1.0))
    return stem.with_suffix(".webp")


def _sheet(frames: UInt8[np.ndarray, "frames height width 3"]) -> bytes:
    """Pictures as one, a row of `COLUMNS` after the other, as WebP."""
    count, height, width, _ = frames.shape
    rows = -(-count // COLUMNS)
    sheet = np.full((rows * COLUMNS, height, width, 3), 255, dtype=np.uint8)
    sheet[:count] = frames
    sheet = sheet.reshape(rows, COLUMNS, height, width, 3).swapaxes(1, 2).reshape(rows * height, COLUMNS * width, 3)
    stream = BytesIO()
    Image.fromarray(sheet).save(stream, "WEBP", **_WEBP)
    return stream.getvalue()


def _animation(drawn: UInt8[np.ndarray, "panels frames height width 3"], seconds: float) -> bytes:
    """The panels beside each other as an animated WebP, each frame shown so long."""
    first, *others = (Image.fromarray(np.concatenate(list(frames), axis=1)) for frames in drawn.swapaxes(0, 1))
    stream = BytesIO()
    options = {"save_all": True, "append_images": others, "duration": max(1, round(1000.0 * seconds)), "loop": 0}
    first.save(stream, "WEBP", **options, **_WEBP)
    return stream.getvalue()


def _states(
    policy: Policy,
    simulator: Simulator,
    parameters: Float[np.ndarray, " parameters"],
    start: Float[np.ndarray, "1 1 state"],
) -> Float[np.ndarray, "steps state"]:
    """The states of one episode of a deterministic policy, the first included, up to its end."""
    system, state, states = simulator.bind(parameters), start, [start[0, 0]]
    for step in range(simulator.task.max_episode_steps):
        action = np.asarray(act(policy, system.observe(state), None, np.int32(step)), dtype=np.float64)
        state = system.step(state, action)
        if not np.isfinite(state).all():
            break
        states.append(state[0, 0])
        if simulator.task.terminated(state).all():
            break
    return np.stack(states)
