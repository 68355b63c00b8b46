"""HDF5 on a full disk: an `OSError` at once or at the end, and no crash of the library when it closes its file."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from qsim.formats.hdf5_output import writable

TAKEN = (9, 30)  # KiB, less and more than the file takes


def write(path: Path) -> None:
    rng = np.random.default_rng(0)
    with open(path, "x+b") as part, writable(part) as (file, check):
        file.attrs["format"] = "f"
        stored = file.create_dataset("a", (5, 40, 50), np.uint8, chunks=(1, 40, 50), compression="gzip")
        for n in range(len(stored)):
            stored[n] = rng.integers(0, 99, (40, 50))
            check()
        file.create_dataset("names", data=["a", "b"], dtype=h5py.string_dtype())


def test_what_is_written_is_read(tmp_path):
    write(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert file.attrs["format"] == "f"
        np.testing.assert_array_equal(file["a"][0], np.random.default_rng(0).integers(0, 99, (40, 50)))


@pytest.mark.parametrize("room", [*range(TAKEN[0]), 40])
def test_a_full_disk_at_any_byte_is_an_error(room, tmp_path, monkeypatch):
    """The disk takes so many KiB, also of a single write."""
    pwrite = os.pwrite
    left = room << 10

    def full(descriptor: int, content: memoryview, place: int) -> int:
        nonlocal left
        if not left:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        done = pwrite(descriptor, content[:left], place)
        left -= done
        return done

    monkeypatch.setattr(os, "pwrite", full)
    path = Path(tempfile.mkdtemp(dir=tmp_path)) / "a.h5"
    if room < TAKEN[0]:
        with pytest.raises(OSError, match="No space left"):
            write(path)
    elif room > TAKEN[1]:
        write(path)
        assert h5py.is_hdf5(path)


@pytest.mark.parametrize("at", range(4))
def test_a_signal_while_hdf5_writes_ends_the_block(at, tmp_path, monkeypatch):
    """Raised inside of the library, it would be lost in one that says nothing."""
    pwrite = os.pwrite
    calls = 0

    def interrupted(descriptor: int, content: memoryview, place: int) -> int:
        nonlocal calls
        calls += 1
        if calls == at + 1:
            raise KeyboardInterrupt
        return pwrite(descriptor, content, place)

    monkeypatch.setattr(os, "pwrite", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "a.h5")
