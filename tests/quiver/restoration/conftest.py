"""Every kind of input of `quiver restore`, in the folder of a test."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from clips import ClipMaker, packed

from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense


@pytest.fixture
def inputs(make_clip: ClipMaker, tmp_path: Path) -> dict[str, Path]:
    """A clip with one stream, its stream's file, a clip without, an array of codes, packed planes, and counts."""
    clip = make_clip(frames=4)
    sense(clip, Sensing("quiver-physical", bits=3, ppp=3.25, name="mine"))
    rng = np.random.default_rng(0)
    np.save(tmp_path / "codes.npy", rng.integers(0, 8, (4, 6, 7), dtype=np.uint8))
    np.save(tmp_path / "counts.npy", rng.poisson(3.0, (30, 8, 8)).astype(np.uint8))
    packed(rng.integers(0, 2, (14, 6, 7), dtype=np.uint8), tmp_path / "planes.npy")
    return {
        "clip": clip.path,
        "stream": clip.path / "streams/mine.npy",
        "array": tmp_path / "codes.npy",
        "planes": tmp_path / "planes.npy",
        "counts": tmp_path / "counts.npy",
    }
