"""Encodes OpenEXR images in memory, and reads crops of them by rows.

Files are single-part scan-line OpenEXR 2.0, which any program opens. The OpenEXR library is not used to write or crop
them, for two reasons. Bytes made in memory go through one atomic, checksummed writer (files.py) and do not depend on
the version of a library. A crop of an uncompressed image reads only its rows.

Layout (openexr.com, "OpenEXR File Layout"): magic, version, attributes, offset table, then per chunk
(int32 y, int32 size, data); inside a chunk every row holds its channels one after the other, in alphabetical order.
"""

from __future__ import annotations

import functools
import os
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim import limits, opening
from qsim.arrays import plain
from qsim.files import decoding_errors, native
from qsim.lazy_array import Crop

MAGIC = bytes((0x76, 0x2F, 0x31, 0x01)) + struct.pack("<i", 2)
_PIXEL_TYPES = {np.dtype("<u4"): 0, np.dtype("<f2"): 1, np.dtype("<f4"): 2}
_ZIP_ROWS = 16  # rows per chunk of the ZIP method
HALF_MAX = 65504.0
SMALLEST = 2.0**-16  # halves are 2^-24 apart here: light up to it has 256 steps


def encode(channels: dict[str, Array], *, compress: bool = False) -> bytes:
    """Return an EXR file of channels [H, W] of float16, float32 or uint32, uncompressed or losslessly zipped."""
    names = sorted(channels)
    height, width = channels[names[0]].shape
    arrays = [plain(channels[name]) for name in names]
    header = _header({name: array.dtype for name, array in zip(names, arrays, strict=True)}, height, width, compress)
    rows = np.concatenate([array.view(np.uint8).reshape(height, -1) for array in arrays], axis=1)
    step = _ZIP_ROWS if compress else 1
    chunks = []
    for y in range(0, height, step):
        raw = rows[y : y + step].tobytes()
        packed = _zip(raw) if compress else raw
        body = packed if len(packed) < len(raw) else raw
        chunks.append(struct.pack("<ii", y, len(body)) + body)
    first = len(header) + 8 * len(chunks)
    offsets = first + np.concatenate([[0], np.cumsum([len(chunk) for chunk in chunks])[:-1]])
    return b"".join([header, offsets.astype("<u8").tobytes(), *chunks])


def to_half(image: Array) -> Array:
    """Return a half-precision copy of an image [..., H, W]; values above the largest half, 65504, become that."""
    return np.minimum(image, HALF_MAX).astype("<f2")


def above_half(image: Array) -> Array:
    """Return bool [H, W]: True where an image [H, W], or a band of one [3, H, W], is above the largest half."""
    found: Array = image > HALF_MAX
    return found if found.ndim == 2 else np.asarray(found.any(axis=0))


def read_half(
    path: Path, height: int, width: int, crop: Crop | None = None, *, colour: bool = False, beside: Path | None = None
) -> Array:
    """Return float32 [h, w] of an uncompressed half image of channel Y; only rows of the crop (y, x, h, w) are read.

    With `colour` the channels are R, G, B and the result is [3, h, w].

    `ValueError` if the file has another size or layout: it is truncated, or was written by another program.
    """
    y, x, rows, columns = crop if crop is not None else (0, 0, height, width)
    header = _half_header(height, width, colour)
    channels = 3 if colour else 1
    start = len(header) + 8 * height
    stride = 8 + 2 * width * channels
    with opening.opened(path, beside=beside) as file:
        descriptor = file.fileno()
        size = os.fstat(descriptor).st_size
        if size != start + stride * height or os.pread(descriptor, len(header), 0) != header:
            raise ValueError(
                f"{path}: {size} bytes are not an uncompressed half EXR of {height} x {width} pixels "
                f"({start + stride * height} bytes); the file is truncated or damaged, run `qsim check`"
            )
        raw = os.pread(descriptor, rows * stride, start + y * stride)
    table = np.frombuffer(raw, dtype=np.uint8).reshape(rows, stride)
    if int.from_bytes(raw[:4], "little") != y:
        raise ValueError(f"{path}: row {y} is not at its place; the file is damaged, run `qsim check`")
    places = [8 + 2 * (width * channel + x) for channel in reversed(range(channels))]  # B, G, R follow each other
    planes = [np.ascontiguousarray(table[:, at : at + 2 * columns]).view("<f2").astype(np.float32) for at in places]
    return np.stack(planes) if colour else planes[0]


def largest(height: int, width: int) -> int:
    """Return the most bytes that a frame's file has: 16 channels of 4 bytes, none of them shrunk, and headers."""
    return 65536 + height * (64 + 64 * width)


def read(path: Path, size: tuple[int, int] | None = None, beside: Path | None = None) -> dict[str, Array]:
    """Return the channels [H, W] of a scan-line EXR file by name; `size` = (height, width), if it is known.

    The OpenEXR library decodes. `ValueError` if the file is unreadable, has another size, or declares more pixels than
    its bytes can hold.
    """
    import OpenEXR

    opening.regular(path, "file; the clip is damaged, run `qsim check`", beside=beside)
    with decoding_errors(path, "OpenEXR; the file is damaged, run `qsim check`"):
        with OpenEXR.File(native(path), separate_channels=True, header_only=True) as file:
            header = dict(file.header())  # a copy: closing empties it
            names = [channel.name for channel in header["channels"]]
        first, last = (np.asarray(corner) for corner in header["dataWindow"])
        found = [int(n) for n in (last - first + 1)[::-1]]
        height, width = size or found
        if found != [height, width] or header["type"] != OpenEXR.scanlineimage:
            raise ValueError(f"{path}: holds {header['type']} {found}, expected scan lines {[height, width]}")
        if 2 * height * width * len(names) > limits.DEFLATED * path.stat().st_size:
            raise ValueError(f"{path}: {path.stat().st_size} bytes cannot hold {len(names)} channels of {found}")
        with OpenEXR.File(native(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        for name, array in channels.items():
            if array.shape != (height, width):
                raise ValueError(
                    f"{path}: channel {name!r} is {array.dtype} {list(array.shape)}, not {[height, width]}"
                )
    return channels


def _attribute(name: str, kind: str, value: bytes) -> bytes:
    return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value


def _header(types: dict[str, np.dtype], height: int, width: int, compress: bool) -> bytes:
    channels = b"".join(
        name.encode() + b"\0" + struct.pack("<iiii", _PIXEL_TYPES[kind.newbyteorder("<")], 0, 1, 1)
        for name, kind in types.items()
    )
    window = struct.pack("<iiii", 0, 0, width - 1, height - 1)
    return b"".join(
        [
            MAGIC,
            _attribute("channels", "chlist", channels + b"\0"),
            _attribute("compression", "compression", bytes([3 if compress else 0])),
            _attribute("dataWindow", "box2i", window),
            _attribute("displayWindow", "box2i", window),
            _attribute("lineOrder", "lineOrder", b"\0"),
            _attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
            _attribute("screenWindowCenter", "v2f", struct.pack("<ff", 0.0, 0.0)),
            _attribute("screenWindowWidth", "float", struct.pack("<f", 1.0)),
            b"\0",
        ]
    )


@functools.lru_cache(maxsize=16)
def _half_header(height: int, width: int, colour: bool) -> bytes:
    return _header(dict.fromkeys("BGR" if colour else "Y", np.dtype("<f2")), height, width, compress=False)


def _zip(raw: bytes) -> bytes:
    """Apply the ZIP method of EXR: even bytes before odd bytes, differences of bytes (offset 128), deflate."""
    data = np.frombuffer(raw, np.uint8)
    split = np.concatenate([data[0::2], data[1::2]])
    delta = split.copy()
    delta[1:] = split[1:] - split[:-1] + np.uint8(128)
    return zlib.compress(delta.tobytes(), 4)
