"""Reads photon counts of a static object from a .npy or .npz, which may be damaged."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim.arrays import plain
from qsim.files import decoding_errors, load_array, read_npy

LARGEST = 1 << 32  # bytes of an array of counts in a .npz


@dataclass(frozen=True)
class Counts:
    """Photon counts of a static object."""

    frames: Array  # integers [N, H, W]
    shares: Array  # [N]; light of each frame relative to the mean frame
    name: str

    @property
    def light(self) -> float:
        """Return the mean photons per pixel and frame."""
        return float(self.frames.mean())


def read_counts(path: Path) -> Counts:
    """Return counts [N, H, W], or [T, K, H, W] with K time gates, from a .npy or a .npz with one array.

    The share of a frame is the mean of its gate, or of the frame itself without gates. `ValueError` for anything but
    integer counts and for a damaged file; `FileNotFoundError` if there is no file.
    """
    if path.suffix not in (".npy", ".npz"):
        raise ValueError(f"{path}: photon counts are a .npy, or a .npz with one array")
    with decoding_errors(path, "an array of numbers"):
        array = plain(_load(path))
    if array.ndim not in (3, 4) or array.size == 0 or not np.issubdtype(array.dtype, np.integer) or array.min() < 0:
        raise ValueError(
            f"{path}: expected whole counts [N, H, W] or [T, K, H, W], got {array.dtype} {list(array.shape)}"
        )
    frames = array.reshape(-1, *array.shape[-2:])
    light = array.mean(axis=(0, 2, 3)) if array.ndim == 4 else array.mean(axis=(1, 2))
    if not light.min() > 0:
        raise ValueError(f"{path}: frame or gate {int(np.argmin(light))} holds no photon")
    shares = np.tile(light, len(frames) // len(light)) / light.mean()
    return Counts(frames, shares, path.name)


def _load(path: Path) -> Array:
    """Return the one array of a .npy or .npz."""
    if path.suffix == ".npy":
        return load_array(path)
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if len(members) != 1:
            names = ", ".join(member.filename.removesuffix(".npy") for member in members[:3])
            raise ValueError(f"holds {len(members)} arrays ({names}); one is read")
        if members[0].file_size > LARGEST:
            raise ValueError(f"its array has {members[0].file_size:,} bytes, and {LARGEST:,} are read at most")
        with archive.open(members[0]) as member:
            return read_npy(path, member)
