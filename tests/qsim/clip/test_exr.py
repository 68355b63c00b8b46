"""Tests OpenEXR files against the OpenEXR library, and the clipping to the largest half."""

from pathlib import Path

import numpy as np
import pytest
from clips import RGB, write_clip
from tiny_clip import meta

from qsim.clip import exr
from qsim.clip.writer import ClipWriter
from qsim.streams.clip import Clip


def test_the_largest_half_is_kept_and_counted(tmp_path: Path):
    with ClipWriter(tmp_path / "a", meta(shape=[1, 2, 3])) as writer:
        writer.add(0, np.array([[1e6, 65504, 1], [0, 1e-7, 70000]], np.float32))
    clip = Clip.open(tmp_path / "a")
    assert clip.info.clipped_pixels == 2
    assert clip.radiance(0).max() == 65504


def test_light_above_the_largest_half_is_a_lower_bound(tmp_path: Path):
    """A sun in the picture, or in the sharp picture alone: its light is not known, and scores leave it out."""
    low = np.ones((2, 3), np.float32)
    sun, glint = (low + 1e6 * (np.arange(6).reshape(2, 3) == n) for n in (0, 4))
    with ClipWriter(tmp_path / "a", meta(shape=[3, 2, 3])) as writer:
        writer.add(0, sun, sharp=glint)
        writer.add(1, low, sharp=glint)
        writer.add(2, low, sharp=low)
    clip = Clip.open(tmp_path / "a")
    found = np.stack([clip.saturated(t) for t in range(3)])
    np.testing.assert_array_equal(found[:2], np.stack([(sun > 1) | (glint > 1), glint > 1]))
    assert not found[2].any()
    assert clip.info.saturated_pixels == clip.info.clipped_pixels == 3
    assert not (clip.path / "saturated" / "000002.exr").exists()
    assert clip.verify() == []
    np.testing.assert_array_equal(clip.sense("quiver-physical", ppp=3.0).known(), ~found)


def test_colour_clips_count_such_pixels_only(tmp_path: Path):
    """Scores of colours know no marks of pixels, so none are stored."""
    clip = write_clip(tmp_path / "a", radiance=np.full((2, 3, 4, 5), 1e5), bands=list(RGB))
    assert clip.info.clipped_pixels == 40
    assert clip.info.saturated_pixels is None
    assert not clip.saturated(0).any()


@pytest.mark.parametrize(("height", "width"), [(1, 1), (8, 10), (17, 33), (16, 7), (33, 128)])
def test_exr_agrees_with_the_openexr_library(tmp_path: Path, height: int, width: int):
    """The reference library reads our files, zipped and not; odd sizes around the 16-row chunks."""
    rng = np.random.default_rng(height)
    smooth = np.cumsum(rng.normal(size=(height, width)), axis=0)
    channels = {
        "u": smooth.astype("<f4"),
        "Z": np.where(smooth > 1, np.inf, smooth).astype("<f4"),
        "id": rng.integers(0, 2**32, (height, width), dtype=np.uint32),
        "h": smooth.astype("<f2"),
    }
    for compress in (False, True):
        path = tmp_path / f"{compress}.exr"
        path.write_bytes(exr.encode(channels, compress=compress))
        found = exr.read(path)
        assert sorted(found) == sorted(channels)
        for name, expected in channels.items():
            np.testing.assert_array_equal(found[name], expected)
