"""Reads photon counts of a static object from a .npy or .npz, which may be damaged, or sums binary planes of it."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim import limits, opening
from qsim.arrays import plain
from qsim.checks import ArgumentError
from qsim.files import decoding_errors, load_array, read_npy
from qsim.plane_sums import PlaneSums, Sums
from qsim.streams.sensing import Sensing
from qsim.streams.stream import is_stream
from quiver.data.codes import codes_of, open_stream, summed
from quiver.data.illumination import Illumination, ideal_clocked
from quiver.data.photon_cubes import cube_codes


@dataclass(frozen=True)
class Counts:
    """Photon counts of a static object."""

    frames: Array  # integers [N, H, W]
    shares: Array  # [N]; light of each frame relative to the mean frame
    name: str
    sums: Sums | None = None  # of binary planes, which saturate: a frame counts the planes that fired
    plane_rate: float | None = None  # 1/s

    @property
    def light(self) -> float:
        """Return the mean photons per pixel and frame."""
        if self.sums is None:
            return float(self.frames.mean())
        return float(arrivals(self.frames.mean(axis=0), self.sums.planes, len(self.frames)).mean())


def arrivals(mean: Array, planes: int, frames: int) -> Array:
    """Return the photons of each pixel [H, W] whose sums of so many planes have this mean over `frames` of them.

    A pixel that fired in every plane has those of half a plane less: its light has no upper bound.
    """
    fired = np.minimum(mean / planes, 1 - 0.5 / (planes * frames))
    return np.asarray(-planes * np.log1p(-fired))


def is_stored(path: Path) -> bool:
    """Return whether a file is a stored stream, whose description states what its codes are."""
    side = path.with_suffix(".json")
    return path.suffix in (".npy", ".json") and side.is_file() and is_stream(side)


def read_planes(path: Path, sums: PlaneSums, width: int | None) -> Counts:
    """Return sums of the binary planes of a static object, of an ideal clocked SPAD: of a stream, or of a .npy.

    A .npy holds planes of 0 and 1, [T, H, W], sums of planes as `sums` states, or with `width` packed planes,
    [T, H, ceil(W/8)]. The share of a frame is
    its light over that of the mean frame, to first order. `ValueError` for values of several bits.
    """
    if is_stored(path):
        if width is not None:
            raise ArgumentError("width", f"{path} is a stored stream, which has its own (see its .json); leave it out")
        codes = summed(codes_of(open_stream(path)), sums)
        rate = codes.frame_rate * (1 if codes.sums is None else codes.sums.step)
    else:
        sensor = ideal_clocked(sums.summed or 1)
        codes = cube_codes(path, Illumination(Sensing(sensor)), 1.0, sums=sums, width=width)
        rate = None
    if not codes.sensor.sums_planes:
        raise ValueError(f"{path}: holds codes of a {type(codes.sensor).__name__}, and planes are those of a SPAD")
    frames = codes.read(0, codes.shape[0])
    planes = codes.sensor.levels - 1
    light = arrivals(frames.mean(axis=0), planes, len(frames))
    slope = float((light * np.exp(-light / planes)).mean())
    if not slope > 0:
        raise ValueError(f"{path}: no plane holds a photon")
    shares = 1 + (frames.mean(axis=(1, 2)) - frames.mean()) / slope
    if not shares.min() > 0:
        raise ValueError(f"{path}: code {int(np.argmin(shares))} holds no photon")
    return Counts(frames, shares, path.name, codes.sums or Sums(1, 0, 1, len(frames)), rate)


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
        return np.asarray(load_array(path))
    with opening.opened(path) as opened, zipfile.ZipFile(opened) as archive:
        members = archive.infolist()
        if len(members) != 1:
            names = ", ".join(member.filename.removesuffix(".npy") for member in members[:3])
            raise ValueError(f"holds {len(members)} arrays ({names}); one is read")
        if members[0].file_size > limits.COUNT_BYTES:
            raise ValueError(
                f"its array has {members[0].file_size:,} bytes, and {limits.COUNT_BYTES:,} are read at most"
            )
        with archive.open(members[0]) as member:
            return read_npy(path, member)
