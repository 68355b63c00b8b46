"""Reads time-correlated photon counting (TCSPC): counts per pixel and frame of PicoQuant PTU and Becker & Hickl SDT.

The arrival times within the laser period are summed; the libraries ptufile and sdtfile decode the files.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import limits, opening
from qsim.checks import check_shape
from qsim.files import decoding_errors
from qsim.formats.array_files import Values, codes_of
from qsim.formats.recording import Hints, Recording


def read_ptu(path: Path, hints: Hints) -> Recording:
    """Read the image of a PTU file in T3 mode: counts [T, Y, X] of one channel; its frame time gives the rate."""
    import ptufile

    with decoding_errors(path, "PTU"), opening.opened(path) as opened, ptufile.PtuFile(opened) as file:
        if not (file.is_t3 and file.is_image):
            kind = getattr(file.measurement_submode, "name", file.measurement_submode)
            raise ValueError(f"{path}: holds a {kind} measurement; images in T3 mode are read")
        sizes = dict(zip(file.dims, file.shape, strict=True))
        size = [sizes.get(letter, 1) for letter in "TYXC"]
        _check_size(path, size)
        counts = np.asarray(file.decode_image(dtime=-1, dtype=np.uint32, keepdims=True))
        counts = counts.sum(axis=file.dims.index("H")) if "H" in file.dims else counts
        axes = "".join(letter for letter in file.dims if letter != "H")
        frame_time = float(file.frame_time)
        pixel_time = float(file.pixel_time)
    found = _counts(path, counts, axes, "PTU", hints)
    if not (0 < pixel_time <= frame_time < math.inf):
        return found
    said = f"{found.reading}; {1 / frame_time:.6g} frames per second, {pixel_time:.4g} s per pixel of the scan"
    return replace(found, reading=said, frame_rate=1 / frame_time, exposure=pixel_time)


def read_sdt(path: Path, hints: Hints) -> Recording:
    """Read the images of an SDT file: counts [Y, X] of each data block, which are channels or (`axes` TYX) frames."""
    import sdtfile

    with decoding_errors(path, "SDT"), opening.opened(path) as opened, sdtfile.SdtFile(opened) as file:
        blocks = [np.asarray(block) for block in file.data]
    images = [block.sum(axis=-1, dtype=np.uint32) for block in blocks if block.ndim in (3, 4)]
    if not images:
        raise ValueError(f"{path}: holds decays {[list(b.shape) for b in blocks[:4]]} and no image [Y, X, times]")
    if len(images) != len(blocks) or len({image.shape for image in images}) > 1:
        raise ValueError(
            f"{path}: its data blocks are {[list(b.shape) for b in blocks[:4]]}; images of one size are read"
        )
    stack = np.concatenate([image[None] if image.ndim == 2 else image for image in images])
    return _counts(path, stack, "CYX", "SDT", hints)


def _counts(path: Path, counts: Array, axes: str, source: str, hints: Hints) -> Recording:
    """Return counts as codes of `bits`, or of as many bits as the largest count needs."""
    largest = int(counts.max(initial=0))
    if largest > 65535:
        raise ValueError(f"{path}: {largest} counts in a pixel; codes have up to 16 bits, so read shorter frames")
    bits = hints.bits or max(largest.bit_length(), 1)
    values = Values(counts.shape, np.dtype(counts.dtype), lambda index: counts[index])
    found = codes_of(path, values, source, hints, stated=axes, bits=bits)
    said = f"{found.reading}; photons summed over the laser period, at most {largest} in a pixel: {bits} bits"
    return replace(found, code_model="counting", reading=said)


def _check_size(path: Path, size: list[Any]) -> None:
    """Raise `ValueError` for an image that is empty, or too large to hold."""
    frames, height, width, channels = (int(n) for n in size)
    check_shape(path, (frames, height, width))
    if frames * height * width * channels > limits.COUNTS:
        raise ValueError(f"{path}: states {frames} frames of {height} x {width} pixels, too many to read at once")
