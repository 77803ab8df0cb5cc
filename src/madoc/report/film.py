"""The film of a run's policies, read from its folder and drawn as strips of frames."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from madoc.report.reading import read_arrays
from madoc.report.rendering import chart

FRAME = 88.0
"""Width of a frame in the units of a chart."""


@dataclass(frozen=True)
class Film:
    """An episode of each policy from the same start, as the outlines of the robot at a few moments.

    Attributes:
        names: Names of the policies.
        time: Time of each frame since the start, s.
        ends: The two ends of each geom, m; NaN after an episode has ended.
        radius: Radius of each geom, m.
    """

    names: tuple[str, ...]
    time: Float[np.ndarray, " frames"]
    ends: Float[np.ndarray, "policies frames geoms ends xyz"]
    radius: Float[np.ndarray, " geoms"]


def read_film(folder: Path) -> Film | None:
    """The film that an evaluation left in a folder; None where it left none."""
    arrays = read_arrays(folder / "film.npz", "names", "time", "ends", "radius")
    if arrays is None:
        return None
    return Film(
        tuple(map(str, arrays["names"])), *(np.asarray(arrays[name], float) for name in ("time", "ends", "radius"))
    )


def strip(film: Film, policy: int, *, beside: int | None = None) -> Markup:
    """The frames of one policy from the side, and in grey those of another `beside` it.

    Seen from the side in which the robot moves most. A robot that travels farther than its own size stays in the middle
    of each frame; the vertical scale is the same in all.
    """
    flat = _side_view(film)
    low, high = _view(flat, film.radius)
    size = float(max(high - low)) or 1.0
    scale, height = FRAME / size, FRAME * float(high[1] - low[1]) / size
    shown = [(beside, "ghost")] if beside is not None and beside != policy else []
    frames = []
    for index, time in enumerate(film.time.tolist()):
        lines = []
        for one, colour in [*shown, (policy, "body")]:
            for ends, radius in zip(flat[one, index], film.radius.tolist(), strict=True):
                if np.isfinite(ends).all():
                    across = (ends[:, 0] - (low[0] + high[0]) / 2) * scale + FRAME / 2
                    down = (high[1] - ends[:, 1]) * scale
                    lines.append((colour, across.tolist(), down.tolist(), 2.0 * radius * scale))
        frames.append((FRAME * index, f"{time:.1f} s", lines))
    label = f"frames of the policy {film.names[policy]}"
    return chart("film", label=label, width=FRAME * len(frames), height=height + 18, frames=frames, wide=FRAME)


def _side_view(film: Film) -> Float[np.ndarray, "policies frames geoms ends 2"]:
    """Horizontal and vertical coordinates, m; the horizontal is x or y, in which more moves."""
    spread = np.nanmax(film.ends, axis=(0, 1, 2, 3)) - np.nanmin(film.ends, axis=(0, 1, 2, 3))
    flat = film.ends[..., [int(spread[1] > spread[0]), 2]].copy()
    middle = (np.nanmin(flat[0, 0], axis=(0, 1)) + np.nanmax(flat[0, 0], axis=(0, 1)))[0] / 2
    own = float(np.ptp(flat[0, 0, ..., 0])) + float(np.ptp(flat[0, 0, ..., 1]))
    travel = flat[..., 0].mean((2, 3), keepdims=True) - middle
    if np.nanmax(np.abs(travel)) > own:
        flat[..., 0] -= travel
    return flat


def _view(
    flat: Float[np.ndarray, "policies frames geoms ends 2"], radius: Float[np.ndarray, " geoms"]
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """The lower left and the upper right corner of all that is drawn, m."""
    thick = radius[:, None, None]
    return np.nanmin(flat - thick, axis=(0, 1, 2, 3)), np.nanmax(flat + thick, axis=(0, 1, 2, 3))
