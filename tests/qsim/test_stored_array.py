"""Arrays of a .npy that are read by parts: as those in memory, and an error where their file changes meanwhile."""

from __future__ import annotations

import copy
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from qsim import stored_array
from qsim.files import load_array

SHAPE = (5, 6, 7)
INDICES = (
    3,
    -1,
    slice(1, 4),
    slice(None, None, 2),
    slice(4, 1, -1),
    slice(2, 2),
    (slice(1, 4), slice(2, 5), slice(3, 6)),
    (slice(1, 4), slice(2, 5)),
    (slice(0, 5, 2), slice(2, 5), 1),
    (slice(1, 4), 2),
    (2, slice(2, 5)),
    (slice(1, 4), slice(5, 2, -1)),
    (slice(1, 4), slice(3, 3)),
    (Ellipsis, 2),
    [0, 3],
    None,
)


@pytest.fixture(params=["C", "F"])
def order(request) -> str:
    return str(request.param)


def saved(path: Path, order: str, kind: str = "<f4") -> np.ndarray:
    array = np.arange(np.prod(SHAPE)).astype(kind).reshape(SHAPE)
    np.save(path, np.asarray(array, order=order))  # type: ignore[call-overload]
    return array


@pytest.mark.parametrize("kind", ["<f4", ">u2", "?"])
def test_every_part_is_that_of_the_array_in_memory(kind, order, tmp_path, monkeypatch):
    monkeypatch.setattr(stored_array, "PIECE", 100)  # bytes: several pieces of an array in Fortran order
    expected = saved(tmp_path / "a.npy", order, kind)
    found = load_array(tmp_path / "a.npy")
    assert (found.shape, found.dtype, found.size) == (expected.shape, expected.dtype, expected.size)
    assert found.nbytes == expected.nbytes
    np.testing.assert_array_equal(found, expected, strict=True)
    np.testing.assert_array_equal(found.channel(2)[1:3], expected[1:3, :, 2], strict=True)
    for index in INDICES:
        np.testing.assert_array_equal(found[index], expected[index], strict=True)


@pytest.mark.parametrize("shape", [(4,), (4, 0), (0, 4), (3, 0, 2)])
def test_flat_and_empty_arrays(shape, order, tmp_path):
    expected = np.asarray(np.ones(shape), order=order)
    np.save(tmp_path / "a.npy", expected)
    np.testing.assert_array_equal(load_array(tmp_path / "a.npy"), expected, strict=True)


@pytest.mark.parametrize("part", [slice(None), slice(3, 5), (slice(3, 5), slice(1, 3))])
def test_a_file_that_is_cut_or_overwritten_is_an_error(part, order, tmp_path):
    """A memory map would end the process by SIGBUS, or mix two recordings."""
    path = tmp_path / "a.npy"
    saved(path, order)
    cut = load_array(path)
    whole = path.stat().st_size
    os.truncate(path, whole // 2)
    with pytest.raises(ValueError, match=r"a\.npy: became shorter"):
        cut[part]
    os.truncate(path, whole)
    with pytest.raises(ValueError, match=r"a\.npy: was changed"):
        cut[part]


def test_a_file_that_was_replaced_stays_readable(order, tmp_path):
    path = tmp_path / "a.npy"
    expected = saved(path, order)
    found = load_array(path)
    np.save(tmp_path / "b.npy", expected + 1)
    os.replace(tmp_path / "b.npy", path)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("way", [copy.deepcopy, lambda array: pickle.loads(pickle.dumps(array))])
def test_a_copy_is_in_memory(way, order, tmp_path):
    path = tmp_path / "a.npy"
    expected = saved(path, order)
    made = way(load_array(path))
    path.unlink()
    np.testing.assert_array_equal(made, expected, strict=True)


def test_no_descriptor_is_left(tmp_path):
    saved(tmp_path / "a.npy", "C")
    before = os.listdir("/proc/self/fd") if os.path.isdir("/proc/self/fd") else []
    for _ in range(5):
        load_array(tmp_path / "a.npy")[0]
    assert len(os.listdir("/proc/self/fd") if before else []) == len(before)
