"""Reads codes from a bare array on disk: codes, or packed binary planes that are unpacked and summed when read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim.arrays import plain
from qsim.checks import ArgumentError
from qsim.files import load_array
from qsim.lazy_array import LazyArray
from qsim.plane_sums import AS_STORED, PlaneSums
from qsim.sensor import devices
from qsim.sensor.sensor import Sensor
from quiver.data.codes import Codes, array_codes, array_digest, summed
from quiver.data.illumination import Illumination


def cube_codes(
    path: Path, light: Illumination, frame_rate: float, *, sums: PlaneSums = AS_STORED, width: int | None = None
) -> Codes:
    """Return the codes of a bare .npy: integers [T, H, W], or with `width` binary planes [T, H, ceil(W/8)].

    The first pixel of a packed byte is its highest bit. `frame_rate` counts the frames of the
    file per second: planes, if they are summed here, and codes, if the camera has summed them (`sums.summed`).
    `ValueError` where these do not fit together.
    """
    array = load_array(path)
    planes = sums.planes or 1
    if sums.summed is not None:
        codes = _of_sums(path, array, light, frame_rate, sums, width)
    elif width is None and planes == 1:
        codes = array_codes(array, light.device(1 / frame_rate), 1 / frame_rate, path.name, str(path))
    else:
        sensor = _plane_of(light, planes, 1 / frame_rate)
        if width is None:
            _check_planes(path, array)
            codes = array_codes(array, sensor, 1 / frame_rate, path.name, str(path))
        else:
            codes = _unpacked(path, array, sensor, frame_rate, width)
    codes = replace(codes, digest=lambda: array_digest(array), sensor_name=light.sensor, unmapped=True)
    return summed(codes, replace(sums, summed=None))


def _of_sums(
    path: Path, array: LazyArray, light: Illumination, frame_rate: float, sums: PlaneSums, width: int | None
) -> Codes:
    """Return the codes of a bare array that are sums of planes already; `ArgumentError` for packed planes."""
    if width is not None:
        raise ArgumentError("summed", f"{path}: packed planes (width=) are single ones; leave it out")
    planes = sums.summed or 1
    seconds = 1 / (frame_rate * planes)
    named = light.sensing.sensor
    sensor = devices.load_sum(named, planes, bits=light.bits, ppp=light.ppp, exposure=seconds, argument="summed")
    codes = array_codes(array, sensor, 1 / frame_rate, path.name, str(path))
    return replace(codes, sums=sums.stored(len(array)) if planes > 1 else None)


def _plane_of(light: Illumination, planes: int, exposure: float) -> Sensor:
    """Return the sensor of one plane of sums of so many; `ArgumentError` for bits of neither a plane nor a sum."""
    bits = devices.plane_bits(light.sensor, planes, light.bits)
    return light.but(bits=bits).device(exposure).plane


def _check_planes(path: Path, array: LazyArray) -> None:
    """Raise `ValueError` for an array of planes that may be packed."""
    if array.ndim == 3 and array.size and array.dtype == np.uint8 and array[0].max() > 1:
        raise ValueError(
            f"{path}: values up to {array[0].max()} are no planes of 0 and 1; if they are packed, give their width= in "
            "pixels"
        )


def _unpacked(path: Path, cube: LazyArray, sensor: Sensor, frame_rate: float, width: int) -> Codes:
    """Return packed planes, uint8 [T, H, ceil(W/8)], as codes of one bit that are unpacked when they are read."""
    if cube.ndim != 3 or cube.dtype != np.uint8 or cube.shape[2] != (width + 7) // 8 or 0 in cube.shape:
        raise ValueError(
            f"{path}: {cube.dtype} {list(cube.shape)} is not a cube of packed planes {width} px wide; "
            f"expected uint8 [T, H, {(width + 7) // 8}]"
        )

    def read(start: int, stop: int) -> Array:
        return np.unpackbits(plain(cube[start:stop]), axis=2, count=width)

    return Codes(
        name=path.name,
        shape=(len(cube), cube.shape[1], width),
        sensor=sensor,
        exposure=1 / frame_rate,
        frame_rate=frame_rate,
        read=read,
        source=str(path),
    )
