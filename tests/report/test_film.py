"""Outlines of geoms worked by hand, and strips of frames."""

import base64
import re
import struct
import zlib
from dataclasses import replace

import mujoco
import numpy as np

from madoc.report.film import read_film, rendered, strip
from madoc.simulation.outlines import outlines
from robots import ARM

MODEL = """
<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
  <body pos="0 0 1"><joint type="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.1" mass="1"/>
    <geom type="box" pos="0 0 -1" size="0.1 0.2 0.5" mass="1"/>
  </body></worldbody></mujoco>
"""


def test_geoms_become_segments_where_they_are():
    model = mujoco.MjModel.from_xml_string(MODEL)
    ends, radius = outlines(model, np.array([[0.0, 0.0], [np.pi / 2, 0.0]]))
    np.testing.assert_allclose(radius, [0.1, 0.15])
    hanging, level = ends[:, 0]
    np.testing.assert_allclose(sorted(hanging[:, 2]), [0.5, 1.0], atol=1e-12)
    np.testing.assert_allclose(level[:, 2], [1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(sorted(level[:, 0]), [-0.5, 0.0], atol=1e-12)
    # Half the longest side, less the rounding at its ends.
    np.testing.assert_allclose(sorted(ends[0, 1, :, 2]), [-0.35, 0.35], atol=1e-12)


def test_a_strip_has_a_frame_for_each_moment_until_the_episode_ends(tmp_path):
    ends, radius = outlines(mujoco.MjModel.from_xml_string(ARM), np.zeros((3, 4)))
    films = np.stack([ends, np.where(np.arange(3)[:, None, None, None] < 2, ends, np.nan)])
    names, time = np.array(["calibrated", "truth"]), np.array([0.0, 0.5, 1.0])
    np.savez(tmp_path / "film.npz", names=names, time=time, ends=films, radius=radius)
    film = read_film(tmp_path)
    geoms = len(radius)
    drawn = strip(film, 0, beside=1)
    assert (drawn.count('class="body"'), drawn.count('class="ghost"')) == (3 * geoms, 2 * geoms)
    assert strip(film, 1).count('class="body"') == 2 * geoms
    assert "0.5 s" in drawn
    assert read_film(tmp_path / "elsewhere") is None


def test_pictures_are_shown_where_they_are(tmp_path):
    random = np.random.default_rng(0)
    pictures = random.integers(0, 255, (2, 3, 4, 5, 4), dtype=np.uint8)
    pictures[..., 3] = 255 * (pictures[..., 3] > 100)
    arrays = {"names": np.array(["calibrated", "truth"]), "time": np.array([0.0, 0.5, 1.0]), "pictures": pictures}
    np.savez(tmp_path / "film.npz", **arrays, ends=np.zeros((2, 3, 1, 2, 3)), radius=np.ones(1))
    film = read_film(tmp_path)
    for strip_of, drawn in zip(pictures, rendered(film), strict=True):
        assert drawn.count("<image ") == 1
        assert "0.5 s" in drawn
        file = base64.b64decode(re.search(r'base64,([^"]*)"', drawn)[1])
        pixels = np.concatenate(list(strip_of), axis=1)
        shown = pixels[..., 3] > 0
        np.testing.assert_array_equal(read_png(file)[shown], pixels[shown] & [248, 248, 248, 255])
        assert not read_png(file)[~shown].any()
    noise = replace(film, pictures=random.integers(0, 255, (2, 3, 300, 200, 4), dtype=np.uint8))
    assert rendered(noise) is None
    assert rendered(replace(film, pictures=None)) is None


def read_png(file):
    """The pixels of a PNG whose rows are differences from the row above."""
    assert file[:8] == b"\x89PNG\r\n\x1a\n"
    parts, place = {}, 8
    while place < len(file):
        (size,) = struct.unpack(">I", file[place : place + 4])
        name, content = file[place + 4 : place + 8], file[place + 8 : place + 8 + size]
        assert struct.unpack(">I", file[place + 8 + size : place + 12 + size]) == (zlib.crc32(name + content),)
        parts[name], place = content, place + 12 + size
    assert list(parts) == [b"IHDR", b"IDAT", b"IEND"]
    width, height, *kind = struct.unpack(">IIBBBBB", parts[b"IHDR"])
    assert kind == [8, 6, 0, 0, 0]
    rows = np.frombuffer(zlib.decompress(parts[b"IDAT"]), np.uint8).reshape(height, 1 + 4 * width)
    assert (rows[:, 0] == 2).all()
    return np.cumsum(rows[:, 1:], axis=0, dtype=np.uint8).reshape(height, width, 4)
