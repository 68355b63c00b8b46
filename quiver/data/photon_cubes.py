"""Reads codes from a bare array on disk: codes, or packed binary planes that are summed when they are read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim.arrays import plain
from qsim.files import load_array
from quiver.data.codes import Codes, array_codes, array_digest
from quiver.data.illumination import Illumination

PLANE_PIXELS = 1 << 24  # unpacked at a time: 16 MB


def cube_codes(
    path: Path, light: Illumination, frame_rate: float, *, planes: int | None = None, width: int | None = None
) -> Codes:
    """Return the codes of a bare .npy: integers [T, H, W], or with `width` binary planes [T, H, ceil(W/8)].

    The first pixel of a packed byte is its highest bit. Every `planes` = 2^b - 1 planes (default 1) are summed to one
    b-bit code of a clocked SPAD; the remainder at the end is not used. `frame_rate` counts codes per second.
    `ValueError` where these do not fit together.
    """
    array = load_array(path)
    if width is None:
        if planes is not None:
            raise ValueError(f"{path}: planes = {planes} sums packed binary planes; give their width in pixels, too")
        codes = array_codes(array, light.device(1 / frame_rate), 1 / frame_rate, path.name, str(path))
    else:
        codes = _summed(path, array, light, frame_rate, planes or 1, width)
    return replace(codes, digest=lambda: array_digest(array), sensor_name=light.sensor)


def plane_bits(planes: int) -> int:
    """Return the bits of a code that sums this many binary planes. `ValueError` unless that is 2^b - 1 with b = 1 ...
    16.
    """
    bits = planes.bit_length()
    if 1 <= planes == 2**bits - 1 < 2**16:
        return bits
    lower = 2 ** ((planes + 1).bit_length() - 1) - 1
    higher = 2 ** (planes + 1).bit_length() - 1
    near = f"{lower} or {higher}"
    if planes < 1:
        near = "1"
    elif higher > 65535:
        near = "65535"
    raise ValueError(f"planes: a b-bit code sums 2^b - 1 binary planes, got {planes}; use {near}")


def _summed(path: Path, cube: Array, light: Illumination, frame_rate: float, planes: int, width: int) -> Codes:
    """Return packed planes as codes that are summed when they are read."""
    bits = plane_bits(planes)
    if light.bits not in (None, bits):
        raise ValueError(f"{path}: sums of {planes} planes are {bits}-bit codes, got bits = {light.bits}; leave it out")
    sensor = light.but(bits=bits).device(1 / frame_rate)
    if planes > 1 and not sensor.sums_planes:
        raise ValueError(
            f"{light.sensor}: only a clocked SPAD sums planes, this is a {type(sensor).__name__}; "
            "give another sensor, as in spad-320x240"
        )
    if cube.ndim != 3 or cube.dtype != np.uint8 or cube.shape[2] != (width + 7) // 8 or 0 in cube.shape:
        raise ValueError(
            f"{path}: {cube.dtype} {list(cube.shape)} is not a cube of packed planes {width} px wide; "
            f"expected uint8 [T, H, {(width + 7) // 8}]"
        )
    if len(cube) < planes:
        raise ValueError(f"{path}: {len(cube)} planes are fewer than the {planes} of one code")

    def code(t: int) -> Array:
        return sum_planes(cube, width, t * planes, (t + 1) * planes, bits)

    return Codes(
        name=path.name,
        shape=(len(cube) // planes, cube.shape[1], width),
        sensor=sensor,
        exposure=1 / frame_rate,
        frame_rate=frame_rate,
        read=lambda start, stop: np.stack([code(t) for t in range(start, stop)]),
        source=str(path),
    )


def sum_planes(cube: Array, width: int, start: int, stop: int, bits: int) -> Array:
    """Return the sum [H, W] of packed planes start ... stop - 1 of uint8 [T, H, ceil(W/8)], as codes of `bits` bits."""
    together = max(1, PLANE_PIXELS // (cube.shape[1] * width))  # planes unpacked at a time
    total = np.zeros((cube.shape[1], width), np.uint16)  # at most 65535
    for first in range(start, stop, together):
        part = plain(cube[first : min(first + together, stop)])
        total += np.unpackbits(part, axis=2, count=width).sum(axis=0, dtype=np.uint16)
    return total.astype(np.uint8 if bits <= 8 else np.uint16)
