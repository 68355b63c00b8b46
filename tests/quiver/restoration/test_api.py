"""`quiver.restore` in Python: the same default method as the command, and refusals of what it would ignore."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from clips import ClipMaker

import quiver
from qsim.clip.sensing import Sensing, sense
from quiver.cli.program import main


def packed(planes: np.ndarray, path: Path) -> Path:
    np.save(path, np.packbits(planes, axis=2))
    return path


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


@pytest.mark.filterwarnings("ignore:nano was")  # measured or not for such streams
def test_the_command_and_the_call_have_one_default_method(inputs, tmp_path):
    assert main(["restore", str(inputs["clip"]), "-o", str(tmp_path / "r.npy"), "-q"]) == 0
    np.testing.assert_allclose(quiver.restore(inputs["clip"]), np.load(tmp_path / "r.npy"), atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mode": "streaming"}, "--mode: acts on networks, and moment is classical"),
        ({"device": "cpu"}, "--device: acts on networks"),
    ],
)
def test_the_call_refuses_what_it_would_ignore(inputs, changes, message):
    with pytest.raises(ValueError, match=message):
        quiver.restore(inputs["clip"], "moment", **changes)
    with pytest.raises(ValueError, match="a stream has its own light"):
        quiver.restore(inputs["stream"], "moment", ppp=3.0)
