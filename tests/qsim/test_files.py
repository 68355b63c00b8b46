"""Tests leftovers of interrupted writes, links, and the wording of the system's errors."""

import errno
import gzip
import os
from pathlib import Path

import numpy as np
import pytest
from fakes import (
    RECIPE,
    make,
)

from qsim import files
from qsim.clip.writer import ClipWriter
from qsim.dataset import recipe


def test_force_writes_through_a_link(tmp_path: Path):
    """`qsim render -o LINK --force`: the clip at the other place is replaced, the link stays."""
    job = recipe.parse(RECIPE).jobs[0]
    make(job, tmp_path / "disk2" / "far")
    (tmp_path / "near").symlink_to(tmp_path / "disk2" / "far")
    meta = {"shape": [1, 2, 3], "frame_rate": 1000.0, "exposure": 1e-3, "radiance_unit": "relative", "camera": None}
    with ClipWriter(tmp_path / "near", meta, force=True) as writer:
        writer.add(0, np.ones((2, 3)))
    assert (tmp_path / "near").is_symlink()
    assert files.read_json(tmp_path / "disk2" / "far" / "clip.json")["name"] == "near"
    assert sorted(os.listdir(tmp_path)) == ["disk2", "near"]
    assert os.listdir(tmp_path / "disk2") == ["far"]


def test_wordings():
    two = OSError(errno.EXDEV, "Invalid cross-device link", "a", None, "b")
    assert files.wording(two) == "a: Invalid cross-device link"
    assert files.wording(OSError(errno.EIO, "Input/output error")) == "Input/output error"
    assert files.wording(OSError("two\nlines")) == "two lines"
    assert files.wording(ValueError()) == "ValueError"
    with pytest.raises(OSError) as caught, files.replacing(Path("/nowhere/x")):
        pass
    assert "None" not in str(caught.value)


def test_an_array_in_any_order_is_read_from_a_file_and_from_a_stream(tmp_path: Path):
    for array in (np.arange(30, dtype=">i2").reshape(2, 3, 5), np.asfortranarray(np.eye(3, 4))):
        np.save(tmp_path / "a.npy", array)
        (tmp_path / "a.npy.gz").write_bytes(gzip.compress((tmp_path / "a.npy").read_bytes()))
        for path in (tmp_path / "a.npy", tmp_path / "a.npy.gz"):
            np.testing.assert_array_equal(files.load_array(path), array)
