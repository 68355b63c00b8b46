"""Writes and reads the layout of the Single Photon Challenge: cubes of colour planes, with the truth of the last plane.

    SCENE/000000.npy  uint8 [T, H, ceil(W/8), 3]: T binary planes in red, green and blue, packed along the width, first
                      pixel highest; the benchmark has T, H, W = 1024, 800, 800
    SCENE/000000.png  8-bit sRGB [H, W, 3]: the sharp light x of the last plane; that of test scenes is not published
    SCENE/meta.json   width before packing, planes, seeds and sensors; the benchmark has no such file

A plane of light x, 1 at white, fires with the probability 1 - exp(-DETECTIONS x). The three colours are the streams
red, green and blue of one clip, each with its own noise: in a colour clip each behind its filter, in a clip of one band
three draws of the same light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim import files, opening
from qsim.checks import check_shape
from qsim.colour import from_linear
from qsim.files import decoding_errors, load_array
from qsim.formats.export_info import CubesInfo
from qsim.lazy_array import LazyArray
from qsim.sensor import packing
from qsim.sensor.colour_filter import MASKS
from qsim.streams.clip import Clip
from qsim.streams.stream import Stream

# of a cube of the benchmark
PLANES = 1024
SIDE = 800
COLOURS = ("red", "green", "blue")
DETECTIONS = 0.5  # expected per plane at white
_TOGETHER = 64  # planes written at a time


def write(clip: Clip, folder: Path, planes: int) -> CubesInfo:
    """Write the cubes of a clip and their truth to a folder; return what meta.json states of them.

    Cubes do not overlap, and planes that fill no cube are left out. `ValueError` without three streams of one bit.
    """
    bands = bands_of(clip, planes)
    frames, height, width = bands[0].shape
    clipped = 0.0
    for n, first in enumerate(range(0, frames - planes + 1, planes)):
        _write_cube(folder / f"{n:06d}.npy", bands, first, planes)
        light = np.stack([_light(band, first + planes - 1) for band in bands], axis=-1)
        clipped += float((light > 1).mean())
        _write_picture(folder / f"{n:06d}.png", light)
    cubes = frames // planes
    return CubesInfo(
        cubes=cubes,
        planes=planes,
        width=width,
        left_out=frames - cubes * planes,
        detections_at_white=DETECTIONS,
        clipped=clipped / cubes,
        seeds=tuple(band.info.seed for band in bands),
        sensors=tuple(band.info.sensor for band in bands),
        benchmark=(planes, height, width) == (PLANES, SIDE, SIDE),
    )


def bands_of(clip: Clip, planes: int) -> list[Stream]:
    """Return the streams red, green and blue; `ValueError` unless they hold a cube of binary planes in three bands."""
    absent = [name for name in COLOURS if name not in clip.streams]
    if absent:
        raise ValueError(
            f"{clip.path}: has no stream called {absent[0]}; the challenge has the streams red, green and blue of one "
            f"bit: make it with `qsim sense` with bits=1, name={absent[0]} and seed={COLOURS.index(absent[0]) + 1}"
        )
    bands = [clip.stream(name) for name in COLOURS]
    for band in bands:
        band.require_even("a cube of the challenge")
        single = band.bits == 1 and band.info.planes_per_code == 1
        if not (single and band.sensor.sums_planes) or band.shape != bands[0].shape:
            kind = type(band.sensor).__name__
            raise ValueError(
                f"{band.path}: {band.bits}-bit codes {list(band.shape)} of a {kind}; the challenge has planes of one "
                "bit of a clocked SPAD, as in sensor=spad512s bits=1"
            )
    for band, name in zip(bands, COLOURS, strict=True):
        filters = band.colour_filter
        if filters is not None and filters.mask != MASKS[name]:
            found = ", ".join(filters.mask)
            raise ValueError(f"{band.path}: its filters are {found}, not {name}; sense it with colour={name}")
    seeds = [band.info.seed for band in bands]
    for n, seed in enumerate(seeds):
        if seed is not None and seed in seeds[:n]:
            raise ValueError(
                f"{bands[n].path}: has the same seed {seed}, and so the same noise, as "
                f"{COLOURS[seeds.index(seed)]}; sense it with another seed="
            )
    if len(bands[0]) < planes:
        raise ValueError(f"{clip.path}: {len(bands[0])} planes are fewer than the {planes} of a cube; give a window=")
    return bands


def line(made: CubesInfo, shape: tuple[int, int, int]) -> str:
    """Return one line on the cubes of a clip of this shape."""
    _, height, width = shape
    size = "as the benchmark's" if made.benchmark else f"the benchmark's are {PLANES} of {SIDE} x {SIDE}"
    number = "1 cube" if made.cubes == 1 else f"{made.cubes} cubes"
    return (
        f"{number} of {made.planes} planes of {height} x {width} pixels in three colours ({size}) "
        f"with the truth of their last planes, white = {DETECTIONS:g} detections, "
        f"{100 * made.clipped:.3g} % of it above white; not written: flow, depth, planes that fill no "
        f"cube ({made.left_out})"
    )


@dataclass(frozen=True, eq=False)
class Cube:
    """A cube of colour planes on disk, read on demand."""

    scene: str
    path: Path  # SCENE/000000.npy
    packed: LazyArray  # uint8 [T, H, ceil(W/8), 3]
    width: int  # pixels, before packing

    @property
    def name(self) -> str:
        """The place of its picture in a submission: SCENE/000000."""
        return f"{self.scene}/{self.path.stem}"

    @property
    def shape(self) -> tuple[int, int, int]:
        """(T, H, W)."""
        return self.packed.shape[0], self.packed.shape[1], self.width

    def planes(self, start: int, stop: int) -> Array:
        """Return planes start ... stop - 1 as uint8 0 and 1, [t, H, W, 3]."""
        return np.unpackbits(np.asarray(self.packed[start:stop]), axis=2, count=self.width)

    def truth(self) -> Array | None:
        """Return the truth of the last plane, sRGB uint8 [H, W, 3]; None without one, `ValueError` for another size."""
        path = self.path.with_suffix(".png")
        return read_picture(path, self.shape[1:]) if path.is_file() else None


def cubes(folder: Path) -> list[Cube]:
    """Return the cubes of a scene, or of all scenes in a folder, in the order of their names.

    `ValueError` if there is none, or for a file that is not a cube. Without meta.json a row has 8 pixels per byte.
    """
    found = sorted(folder.glob("[0-9]*.npy")) or sorted(folder.glob("*/[0-9]*.npy"))
    if not found:
        raise ValueError(f"{folder}: holds no cubes of the challenge; they are called SCENE/000000.npy")
    return [read_cube(path) for path in found]


def read_cube(path: Path) -> Cube:
    """Return a cube; `ValueError` unless it is uint8 [T, H, bytes, 3] and as wide as meta.json beside it states."""
    packed = load_array(path)
    if packed.dtype != np.uint8 or packed.ndim != 4 or packed.shape[3] != 3:
        raise ValueError(
            f"{path}: a cube of the challenge is uint8 [T, H, bytes, 3], found {packed.dtype} {list(packed.shape)}"
        )
    check_shape(path, packed.shape[:3])
    row = packed.shape[2]
    side = path.with_name("meta.json")
    width = files.read_json(side).get("width") if side.is_file() else 8 * row
    if type(width) is not int or packing.packed_width(width, 1) != row or width < 1:
        raise ValueError(
            f"{side}: width {width!r:.40}, but {path.name} has {row} bytes per row; remove {side.name}, "
            f"or take it from a copy"
        )
    return Cube(path.absolute().parent.name, path, packed, width)


def picture(light: Array) -> Array:
    """Return linear light [H, W, 3], 1 at white, as the pictures of the challenge: sRGB uint8 [H, W, 3], clipped."""
    return from_linear(light, "srgb", 255)


def read_picture(path: Path, size: tuple[int, int]) -> Array:
    """Return a colour picture of 8 bits, uint8 [H, W, 3]; `ValueError` if it is damaged or of another size."""
    from PIL import Image

    with decoding_errors(path, "PNG"), opening.opened(path) as file, Image.open(file, formats=["PNG"]) as opened:
        if (opened.height, opened.width) != size or opened.mode != "RGB":
            raise ValueError(
                f"{path}: {opened.mode} of {opened.height} x {opened.width} pixels; its cube needs RGB of "
                f"{size[0]} x {size[1]}"
            )
        return np.asarray(opened)


def _light(band: Stream, t: int) -> Array:
    """Return the sharp light of plane t in units of white, float64 [H, W]; dark counts do not enter."""
    light = band.truth(t, t + 1)[0]
    if band.colour_filter is not None:
        light = band.colour_filter.mosaic(light, band.sensor.efficiency)
    return light * (band.sensor.efficiency / DETECTIONS)


def _write_cube(path: Path, bands: Sequence[Stream], first: int, planes: int) -> None:
    """Write planes first ... first + planes - 1: uint8 [planes, H, ceil(W/8), 3]."""
    row = bands[0].packed.shape[1:]
    with files.replacing(path) as file:
        header = {"descr": "|u1", "fortran_order": False, "shape": (planes, *row, len(bands))}
        np.lib.format.write_array_header_1_0(file, header)
        for start in range(first, first + planes, _TOGETHER):
            stop = min(start + _TOGETHER, first + planes)
            file.write(np.stack([band.packed[start:stop] for band in bands], axis=-1).tobytes())


def _write_picture(path: Path, light: Array) -> None:
    from PIL import Image

    with files.replacing(path) as file:
        Image.fromarray(picture(light)).save(file, format="png")
