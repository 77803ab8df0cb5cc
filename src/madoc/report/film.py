"""The film of a run's policies, read from its folder and shown as strips of frames."""

import base64
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from markupsafe import Markup

from madoc.report.reading import read_arrays
from madoc.report.rendering import chart

FRAME = 88.0
"""Width of a frame in the units of a chart."""
LARGEST = 300_000
"""Largest size of all pictures of a page in bytes."""


@dataclass(frozen=True)
class Film:
    """An episode of each policy from the same start, as the outlines of the robot at a few moments.

    Attributes:
        names: Names of the policies.
        time: Time of each frame since the start, s.
        ends: The two ends of each geom, m; NaN after an episode has ended.
        radius: Radius of each geom, m.
        pictures: The frames by MuJoCo's renderer, transparent where nothing is; None where OpenGL was not to be had.
    """

    names: tuple[str, ...]
    time: Float[np.ndarray, " frames"]
    ends: Float[np.ndarray, "policies frames geoms ends xyz"]
    radius: Float[np.ndarray, " geoms"]
    pictures: UInt8[np.ndarray, "policies frames height width 4"] | None = None


def read_film(folder: Path) -> Film | None:
    """The film that an evaluation left in a folder; None where it left none."""
    arrays = read_arrays(folder / "film.npz", "names", "time", "ends", "radius")
    if arrays is None:
        return None
    time, ends, radius = (np.asarray(arrays[name], float) for name in ("time", "ends", "radius"))
    pictures = arrays.get("pictures")
    return Film(
        tuple(map(str, arrays["names"])), time, ends, radius, None if pictures is None else np.asarray(pictures, "u1")
    )


def rendered(film: Film) -> list[Markup] | None:
    """The pictures of each policy as a strip; None where there are none, or they are too large for a page."""
    if film.pictures is None:
        return None
    images = [png(np.concatenate(list(frames), axis=1)) for frames in film.pictures]
    if sum(map(len, images)) > LARGEST:
        return None
    _, frames, height, width, _ = film.pictures.shape
    times = [(FRAME * (index + 0.5), f"{time:.1f} s") for index, time in enumerate(film.time.tolist())]
    tall = FRAME * height / width
    return [
        chart(
            "pictures",
            label=f"frames of the policy {name}",
            width=FRAME * frames,
            height=tall + 18,
            tall=tall,
            data=base64.b64encode(image).decode(),
            times=times,
        )
        for name, image in zip(film.names, images, strict=True)
    ]


def png(pixels: UInt8[np.ndarray, "height width 4"]) -> bytes:
    """An image as a PNG file (ISO/IEC 15948), each row as its difference from the row above.

    Colours are kept to 5 of their 8 bits, which halves the file and hardly shows; what is transparent has none.
    """
    height, width, _ = pixels.shape
    kept = np.where(pixels[..., 3:] > 0, pixels & np.array([0xF8, 0xF8, 0xF8, 0xFF], dtype=np.uint8), np.uint8(0))
    rows = kept.reshape(height, -1)
    above = np.concatenate([np.zeros_like(rows[:1]), rows[:-1]])
    filtered = np.concatenate([np.full((height, 1), 2, dtype=np.uint8), rows - above], axis=1)
    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(filtered.tobytes(), 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
        for name, content in parts
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
