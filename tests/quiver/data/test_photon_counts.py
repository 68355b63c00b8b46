"""Damaged or wrong files of photon counts give an error of one line."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from quiver.data.photon_counts import Counts, read_counts
from quiver.evaluation.static_object import evaluate_static
from quiver.restoration.restorers import restorer


def test_bad_counts_are_named(tmp_path):
    np.save(tmp_path / "float.npy", np.ones((3, 4, 5)))
    with pytest.raises(ValueError, match=r"expected whole counts \[N, H, W\] or \[T, K, H, W\], got float64"):
        read_counts(tmp_path / "float.npy")
    dark = np.ones((3, 4, 5), np.uint8)
    dark[1] = 0
    np.save(tmp_path / "dark.npy", dark)
    with pytest.raises(ValueError, match="frame or gate 1 holds no photon"):
        read_counts(tmp_path / "dark.npy")
    (tmp_path / "text.npy").write_text("hello")
    with pytest.raises(ValueError, match=r"not readable as \.npy"):
        read_counts(tmp_path / "text.npy")
    np.savez(tmp_path / "two.npz", a=dark, b=dark)
    with pytest.raises(ValueError, match=r"two.npz: not readable .*holds 2 arrays \(a, b\); one is read"):
        read_counts(tmp_path / "two.npz")
    with pytest.raises(ValueError, match="codes of 1 to 8 bits, got 9"):
        evaluate_static(Counts(dark, np.ones(3), "x"), [restorer("moment")], frames=1, bits=9)
    with pytest.raises(ValueError, match="leave none of 3 for the reference"):
        evaluate_static(Counts(dark, np.ones(3), "x"), [restorer("moment")], frames=3)


def test_counts_in_any_order_and_kind_of_file_are_the_same(tmp_path, monkeypatch):
    """Arrays in column order and of foreign byte order, alone and in an archive; a huge one is refused."""
    counts = np.random.default_rng(3).poisson(3.0, (2, 3, 5, 4)).astype(">u2")
    for order in "CF":
        array = np.asarray(counts, order=order)
        np.save(tmp_path / "a.npy", array)
        np.savez_compressed(tmp_path / "a.npz", array)
        for path in (tmp_path / "a.npy", tmp_path / "a.npz"):
            np.testing.assert_array_equal(read_counts(path).frames, counts.reshape(6, 5, 4))
    monkeypatch.setattr("qsim.limits.COUNT_BYTES", 200)
    with pytest.raises(ValueError, match=r"a.npz: .*its array has 368 bytes, and 200 are read at most"):
        read_counts(tmp_path / "a.npz")


@pytest.mark.parametrize("name", ["counts.npz", "counts.npy"])
def test_a_damaged_file_of_counts_is_one_line(tmp_path, name):
    """Cut anywhere, any byte changed, or foreign bytes: read as whole counts, or one `ValueError` with the name."""
    counts = np.random.default_rng(12).poisson(3.0, (6, 5, 4)).astype(np.uint16)
    path = tmp_path / name
    np.savez_compressed(path, counts) if name.endswith("npz") else np.save(path, counts)
    good = path.read_bytes()
    rng = np.random.default_rng(13)
    refused = 0
    cases = [b"", b"PK\3\4", b"PK\5\6" + bytes(18), b"\x93NUMPY", good[:1]]
    for _ in range(250):
        content = bytearray(good[: rng.integers(1, len(good) + 1)] if rng.random() < 0.4 else good)
        for _ in range(int(rng.integers(1, 4))):
            content[rng.integers(len(content))] = rng.integers(256)
        cases.append(bytes(content))
    for content in cases:
        path.write_bytes(content)
        with contextlib.suppress(ValueError):
            read_counts(path)
            continue
        with pytest.raises(ValueError, match=f"^{path}: [^\n]*$"):
            read_counts(path)
        refused += 1
    assert refused > 100
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_counts(tmp_path / f"none{name}")
    with pytest.raises(ValueError, match=r"photon counts are a .npy, or a .npz"):
        read_counts(tmp_path / "counts.txt")
