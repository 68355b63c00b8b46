"""Tests OpenEXR files against the OpenEXR library, and the clipping to the largest half."""

from pathlib import Path

import numpy as np
import pytest
from tiny_clip import meta

from qsim.clip import exr
from qsim.clip.clip import Clip
from qsim.clip.writer import ClipWriter


def test_the_largest_half_is_kept_and_counted(tmp_path: Path):
    with ClipWriter(tmp_path / "a", meta(shape=[1, 2, 3])) as writer:
        writer.add(0, np.array([[1e6, 65504, 1], [0, 1e-7, 70000]], np.float32))
    clip = Clip.open(tmp_path / "a")
    assert clip.meta["clipped_pixels"] == 2
    assert clip.radiance(0).max() == 65504


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
