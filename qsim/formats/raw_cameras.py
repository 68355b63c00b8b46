"""Reads raw files of photon counting and spike cameras, binary planes as streams of bits, and writes those of spikes.

Each reader takes a path and the user's hints and returns a `Recording` of codes. The order of bits, rows and halves is
not in these files; it is stated in the reader's docstring and in `source`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import files, opening
from qsim.checks import check_shape
from qsim.clip.source import Source
from qsim.formats.export_info import beside
from qsim.formats.raw_layout import raw_files
from qsim.formats.recording import Hints, Recording, check_size

# pixels of SwissSPAD2's half and full array
HALF = (256, 512)
FULL = (512, 512)
RAW_FRAME = 512 * 512 // 8  # bytes of one full-array plane


def read_swissspad2_half(path: Path, _hints: Hints) -> Recording:
    """SwissSPAD2 half array: raw planes of 256 x 512, one bit stream, least significant bit first; file or folder."""
    files = raw_files(path)
    counts = [check_size(file, file.stat().st_size, RAW_FRAME // 2, "SwissSPAD2 half-array") for file in files]

    def decode(raw: Array) -> Array:
        return np.unpackbits(raw, bitorder="little").reshape(-1, *HALF)

    # Two independent readers (python-spad, quanta_SL) agree on bits and rows; the orientation is not in a file.
    source = Source(format="SwissSPAD2 half array", bit_order="lsb", orientation="as stored")
    return _raw(files, counts, RAW_FRAME // 2, HALF, decode, source)


def read_swissspad2_full(path: Path, _hints: Hints) -> Recording:
    """SwissSPAD2 full array: 512 x 512 in eight zones of 128 columns, bottom half upside down, LSB first."""
    files = raw_files(path)
    counts = [check_size(file, file.stat().st_size, RAW_FRAME, "SwissSPAD2 full-array") for file in files]

    def decode(raw: Array) -> Array:
        # Rows of 1024 bits: top quarter 0, bottom quarter 0, top quarter 1, ...; the bottom's first row is row 511.
        zones = np.unpackbits(raw, bitorder="little").reshape(-1, 256, 4, 2, 128)
        top = zones[:, :, :, 0].reshape(-1, *HALF)
        bottom = zones[:, ::-1, :, 1].reshape(-1, *HALF)
        return np.concatenate([top, bottom], axis=1)

    # As photoncube: each half from its outer row inwards. The camera's orientation is not in a file.
    orientation = "as stored, the bottom half turned: it is stored upside down"
    source = Source(format="SwissSPAD2 full array", bit_order="lsb", orientation=orientation)
    return _raw(files, counts, RAW_FRAME, FULL, decode, source)


def read_spad512s(path: Path, _hints: Hints) -> Recording:
    """SPAD512S: raw planes of 512 x 512, row by row, most significant bit first; some files end with 4 more bytes.

    Public readers disagree about left and right: the file is read as stored, `orientation` states it, and `flip_lr` is
    unknown.
    """
    files = raw_files(path)
    counts = [check_size(file, file.stat().st_size, RAW_FRAME, "SPAD512S", footer=(0, 4)) for file in files]

    def decode(raw: Array) -> Array:
        return np.unpackbits(raw).reshape(-1, *FULL)

    # Both public readers agree on bits and rows, one of them mirrored; a file does not state which is right.
    source = Source(format="SPAD512S", bit_order="msb", orientation="as stored, left and right are disputed")
    return _raw(files, counts, RAW_FRAME, FULL, decode, source)


def read_spike(path: Path, hints: Hints) -> Recording:
    """Spike camera: one bit stream, least significant bit first, frames upside down; size by hints or config.yaml."""
    height = hints.height
    width = hints.width
    config = path.parent / "config.yaml"
    stated = beside(path.with_name(f"{path.name}.json")).get("shape")  # of an export
    if height is None and width is None and stated is not None:
        _, height, width = stated
    if height is None and width is None and config.is_file():
        settings = opening.content(config, "description").decode("utf-8", "replace")
        found = dict(re.findall(r"^\s*(spike_h|spike_w)\s*:\s*(\d{1,9})\b", settings, re.M))
        height = int(found.get("spike_h", 0)) or None
        width = int(found.get("spike_w", 0)) or None
    if height is None or width is None:
        raise ValueError(f"{path}: a spike file does not hold its size; add height= and width=, as in 250 and 400")
    check_shape(path, (1, height, width))
    if height * width % 8:
        raise ValueError(f"{path}: spike frames fill whole bytes, {height} x {width} pixels do not")
    frame = height * width // 8
    count = check_size(path, path.stat().st_size, frame, f"spike ({height} x {width})")

    def decode(raw: Array) -> Array:
        return np.unpackbits(raw, bitorder="little").reshape(-1, height, width)[:, ::-1]

    # On published streams this bit order gives the smoother frames; flipped, they agree with their ground truth.
    source = Source(format="spike camera", bit_order="lsb", orientation="stored upside down, turned upright")
    return _raw([path], [count], frame, (height, width), decode, source)


def write_spike(path: Path, blocks: Iterator[Array], shape: tuple[int, int, int]) -> None:
    """Write binary planes [t, H, W] as `read_spike` reads them; `ValueError` if a plane does not fill whole bytes."""
    _, height, width = shape
    if height * width % 8:
        raise ValueError(f"{path}: spike frames fill whole bytes, {height} x {width} pixels do not; export a cube")
    with files.replacing(path) as file:
        for block in blocks:
            file.write(np.packbits(block[:, ::-1].reshape(len(block), -1), axis=1, bitorder="little").tobytes())


def roughness(planes: Array) -> float:
    """Return the roughness of the mean plane over its shot noise, about 1 for smooth scenes in the right layout.

    Even and odd planes are averaged apart: a full plane that is read as two of half its size alternates.
    """
    values = [_roughness(planes[start::2]) for start in range(min(2, len(planes)))]
    return float(np.mean(values))


def _roughness(planes: Array) -> float:
    mean = planes.mean(axis=0, dtype=np.float64)
    steps = np.mean(np.diff(mean, axis=1) ** 2) + np.mean(np.diff(mean, axis=0) ** 2)
    floor = 4 * np.mean(mean * (1 - mean) / len(planes))
    return float(steps / floor) if floor > 0 else float("inf")


def _raw(
    files: list[Path], counts: list[int], frame_bytes: int, size: tuple[int, int], decode: Any, source: Source
) -> Recording:
    for file in files:
        opening.regular(file)
    ends = np.cumsum(counts)

    def read(start: int, stop: int) -> Array:
        parts = []
        for file, count, end in zip(files, counts, ends, strict=True):
            low = max(start - (end - count), 0)
            high = min(stop - (end - count), count)
            if low < high:
                raw = np.fromfile(file, np.uint8, (high - low) * frame_bytes, offset=low * frame_bytes)
                parts.append(decode(raw))
        return np.concatenate(parts)

    return Recording((int(ends[-1]), *size), read, source, 1)
