"""Reads and writes recordings in files that state their shape: .npy, zarr and the folders of visionsim.

Each reader takes a path and the user's hints and returns a `Recording`; `ValueError` names the file, and the pixel
whose value is not a code. Streams of bits without a shape: raw_cameras.py.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import files, limits, opening
from qsim.checks import check_shape
from qsim.clip.source import Source
from qsim.colour import luminance, to_linear
from qsim.file_order import numbered
from qsim.files import decoding_errors, load_array
from qsim.formats import axes
from qsim.formats.export_info import Stated, beside, is_ours
from qsim.formats.recording import (
    Hints,
    Recording,
    checked_codes,
    light_recording,
    need_transfer,
    reached,
    white_of,
)
from qsim.lazy_array import LazyArray
from qsim.parsing import parse_json
from qsim.sensor import packing

_ZARR_METADATA = ("zarr.json", ".zarray", ".zattrs", ".zgroup", ".zmetadata")
# Of zarr; others execute what a file holds (pickle), or expand a few bytes without a limit (bz2, lzma).
_CODECS = {
    "blosc",
    "bytes",
    "crc32c",
    "delta",
    "gzip",
    "lz4",
    "packbits",
    "sharding_indexed",
    "shuffle",
    "transpose",
    "zlib",
    "zstd",
}


def read_cube(path: Path, hints: Hints) -> Recording:
    """Read a photon cube: uint8 [T, H, ceil(W/8)], rows padded, most significant bit first; [.., C] needs a channel.

    Without a given width, that of our description beside it counts (in colour the meta.json of a challenge);
    else every bit of the last byte is a pixel. `ValueError` for another array.
    """
    array = load_array(path)
    description = "meta.json" if array.ndim == 4 else f"{path.name}.json"
    if array.ndim == 4:
        if hints.channel is None or not 0 <= hints.channel < array.shape[3]:
            raise ValueError(f"{path}: a colour cube of {array.shape[3]} channels; choose one with channel=0")
        array = array.channel(hints.channel)
    else:
        hints.refuse(path, "photon cube", "channel")
    if array.dtype != np.uint8 or array.ndim != 3:
        raise ValueError(f"{path}: a photon cube is uint8 [T, H, bytes], found {array.dtype} {list(array.shape)}")
    frames, height, columns = check_shape(path, array.shape)
    known = written_with(path, description)
    width = hints.width
    if width is None:
        width = 8 * columns if known is None else known["shape"][2]
    if not 8 * (columns - 1) < width <= 8 * columns:
        raise ValueError(
            f"{path}: {columns} bytes per row hold {8 * columns - 7} to {8 * columns} pixels, not width={width}"
        )

    def read(start: int, stop: int) -> Array:
        return np.unpackbits(np.asarray(array[start:stop]), axis=-1, count=width)

    orientation = "" if known is None else known.get("orientation", "")
    source = Source(format="photon cube", bit_order="msb", orientation=orientation)
    return Recording((frames, height, width), read, source, 1)


def written_with(path: Path, description: str) -> Stated | None:
    """Return a description, NAME.npy.json, if `qsim convert` wrote it beside a photon cube; else None."""
    stated = beside(path.with_name(description))
    return stated if is_ours(stated) and "shape" in stated else None


@dataclass(frozen=True)
class Values:
    """An array of a file, read by parts: its shape, its type, and blocks of it by an index."""

    shape: tuple[int, ...]
    dtype: np.dtype
    read: Callable[[tuple[Any, ...]], Array]


def read_codes_npy(path: Path, hints: Hints) -> Recording:
    """Read unpacked codes: bool or whole numbers [T, H, W], one code per pixel; bits as given, 1 for bool."""
    array = load_array(path)
    return codes_of(path, Values(array.shape, array.dtype, lambda index: array[index]), "codes", hints)


def read_light_npy(path: Path, hints: Hints) -> Recording:
    """Read numbers [T, H, W] as light: integers by `transfer` (full scale of their type), floats are linear."""
    array = load_array(path)
    return light_of(path, Values(array.shape, array.dtype, lambda index: array[index]), ".npy", hints)


def codes_of(
    path: Path, values: Values, form: str, hints: Hints, *, stated: str | None = None, bits: int | None = None
) -> Recording:
    """Return an array as codes of one bit (bool) or of the stated bits; its axes by `axes`, else as `stated`."""
    reading = axes.named(path, values.shape, hints, stated)
    if reading.colour:
        raise ValueError(f"{path}: colours hold no codes; name the axis of channels C, and choose one with channel=")
    shape = check_shape(path, reading.shape(values.shape))
    if values.dtype == bool:
        hints.refuse(path, f"{form} of bool", "bits")
        bits = 1
    bits = bits or hints.bits
    if bits is None or values.dtype.kind not in "bui":
        raise ValueError(f"{path}: {values.dtype} codes need a number of bits, as in bits=3")

    def read(start: int, stop: int) -> Array:
        return checked_codes(path, reading.turned(np.asarray(values.read(reading.block(start, stop)))), bits, start)

    return Recording(shape, read, Source(format=form), bits, reading=reading.said)


def light_of(path: Path, values: Values, form: str, hints: Hints) -> Recording:
    """Return an array as light, in colour as luminance; its axes by `axes`."""
    reading = axes.named(path, values.shape, hints)
    full_shape = reading.shape(values.shape)
    if reading.colour and full_shape[3] != 3:
        raise ValueError(f"{path}: axis S has {full_shape[3]} colours; red, green and blue are read")
    shape = check_shape(path, full_shape[:3])
    if values.dtype == bool:
        raise ValueError(f"{path}: bool values are codes of one bit, not light; leave layout= out")
    floats = values.dtype.kind == "f"
    transfer = "linear" if floats and hints.transfer is None else need_transfer(path, hints)
    top = 1.0 if floats else float(np.iinfo(values.dtype).max)
    full = float("inf") if floats else top
    white, _ = white_of(path, hints, full)

    def marked(start: int, stop: int) -> tuple[Array, Array]:
        block = reading.turned(np.asarray(values.read(reading.block(start, stop))))
        found = _checked_light(path, block, start)
        light = found.astype(np.float32) if floats and transfer == "linear" else to_linear(found, transfer, top)
        return luminance(light) if reading.colour else light, reached(found, white, reading.colour)

    found = light_recording(path, shape, marked, Source(format=form, transfer=transfer), hints, full)
    return replace(found, reading=reading.said)


def read_zarr(path: Path, hints: Hints) -> Recording:
    """Read zarr v2 or v3: the array `frames` of a group, or an array at the root, [T, H, W], one code a pixel."""
    import zarr

    folder = path / "frames" if (path / "frames").is_dir() else path
    codecs = _zarr_codecs(path, folder)
    if unknown := sorted(codecs - _CODECS):
        raise ValueError(f"{path}: stored by the codec {unknown[0]!r}; read are {', '.join(sorted(_CODECS))}")
    with decoding_errors(path, "zarr"):
        array: Any = zarr.open_array(store=str(folder), mode="r")
        node: Any = array if folder == path else zarr.open_group(store=str(path), mode="r", use_consolidated=False)
        attributes = {k: v for k, v in dict(node.attrs).items() if isinstance(v, str | int | float | list)}
        shape = check_shape(path, array.shape)
        if array.dtype.kind not in "bu":
            raise ValueError(f"{path}: expected unsigned codes, found {array.dtype}")
        stored = getattr(array, "shards", None) or array.chunks
        if float(np.prod(stored, dtype=float)) * array.dtype.itemsize > limits.CHUNK:
            raise ValueError(f"{path}: chunks of {list(stored)} pixels; up to {limits.CHUNK} bytes are read at a time")
        wanted = math.prod(-(-n // chunk) for n, chunk in zip(shape, stored, strict=True))
        found = _count_files(folder, wanted, path)  # before the library lists all the chunks that there should be
        if found >= wanted:
            found = min(found, array.nchunks_initialized) if stored == array.chunks else found
        if found < wanted:
            raise ValueError(
                f"{path}: {found} of {wanted} chunks are there; the recording is incomplete (or its dark chunks were "
                "left out: write them too)"
            )
    bits = hints.bits or 1

    def read(start: int, stop: int) -> Array:
        with decoding_errors(path, "zarr"), zarr.config.set({"async.concurrency": 1}):  # one chunk in memory at a time
            return checked_codes(path, np.asarray(array[start:stop]), bits, start)

    return Recording(shape, read, Source(format="zarr", attributes=attributes), bits)


def _zarr_codecs(path: Path, folder: Path) -> set[str]:
    """Return the codecs in an array's metadata; `ValueError` if `folder` holds no array, or too much metadata."""
    if not path.is_dir():
        raise ValueError(f"{path}: is a single file; a zarr is read from its folder, so unpack it first")
    described = [folder / name for name in ("zarr.json", ".zarray") if (folder / name).is_file()]
    for file in [*described, *(path / name for name in ("zarr.json", ".zattrs", ".zgroup")), folder / ".zattrs"]:
        if file.is_file():
            parse_json(file, opening.text(file, "description", most=limits.METADATA, beside=path))
    found: set[str] = set()
    for file in described:
        with decoding_errors(file, "JSON"):
            content = parse_json(file, opening.text(file))
            waiting = [content[key] for key in ("codecs", "filters", "compressor") if key in content]
            while waiting:
                item = waiting.pop()
                if isinstance(item, dict):
                    found |= {str(item[key]) for key in ("id", "name") if key in item}
                    waiting += item.values()
                elif isinstance(item, list):
                    waiting += item
    if not any((folder / ".zarray" == file) or b'"array"' in opening.content(file) for file in described):
        inside = sorted(item.name for item in itertools.islice(path.iterdir(), 100) if item.is_dir())
        raise ValueError(f"{path}: a zarr group without the array 'frames'; it holds {inside}")
    return {name.removeprefix("numcodecs.") for name in found}


def _count_files(folder: Path, enough: int, beside: Path) -> int:
    """Count the files below a folder without zarr's metadata, up to `enough`.

    `ValueError` for a link out of the folder `beside`.
    """
    count = 0
    for place, _, names in os.walk(folder):
        chunks = [name for name in names if name not in _ZARR_METADATA]
        for name in chunks:
            file = Path(place) / name
            if file.is_symlink():
                opening.regular(file, "chunk", beside=beside)
        count += len(chunks)
        if count >= enough:
            break
    return count


def read_visionsim(path: Path, hints: Hints) -> Recording:
    """Read visionsim: transforms.json with frames.npy [T, H, bytes, C] (0.1) or shards 0000.npy, ... (later)."""
    description = path / "transforms.json"
    if not description.is_file():
        raise FileNotFoundError(f"{path}: has no transforms.json; a recording of visionsim is a folder with one")
    with decoding_errors(description, "JSON"):
        info = parse_json(description, opening.text(description))
        width = int(info["w"])
        packed = bool(info.get("bitpack", "bitpack_dim" in info or info.get("bitplanes", 1) == 1))
        planes = None if info.get("bitplanes") is None else int(info["bitplanes"])
        if packed and int(info.get("bitpack_dim", 2)) != 2:
            raise ValueError(f"{description}: planes packed along axis {info['bitpack_dim']}; only axis 2 (W) is known")
    shards = [path / "frames.npy"] if (path / "frames.npy").is_file() else numbered(list(path.glob("[0-9]*.npy")))
    if not shards:
        raise FileNotFoundError(f"{path}: holds neither frames.npy nor 0000.npy")
    channel = hints.channel or 0
    first = load_array(shards[0], path)
    channels = first.shape[3] if first.ndim == 4 else 1
    if channels > 1 and hints.channel is None:
        raise ValueError(f"{path}: {channels} colour planes; choose one with channel=0")
    columns = -(-width // 8) if packed else width
    parts = [_shard(shard, channel, channels, columns, width) for shard in shards]
    if packed:
        hints.refuse(path, "visionsim", "bits")
        bits = 1
    else:
        bits = hints.bits or 1 if planes is None else _bits_of_sums(description, planes, hints.bits)
    ends = np.cumsum([len(part) for part in parts])
    stated = info.get("frames")
    if isinstance(stated, list) and stated and len(stated) != int(ends[-1]):
        raise ValueError(
            f"{path}: {int(ends[-1])} frames, and transforms.json states {len(stated)}; add the shards that are missing"
        )
    shape = check_shape(path, (int(ends[-1]), parts[0].shape[1], width))

    def read(start: int, stop: int) -> Array:
        rows = [
            part[max(0, start - e + len(part)) : max(0, stop - e + len(part))]
            for part, e in zip(parts, ends, strict=True)
        ]
        joined = np.concatenate(rows)
        if packed:
            return np.unpackbits(joined, axis=2, count=width)
        return checked_codes(path, joined, bits, start)

    model = "binary_sum" if packed else "binary_sum_static"
    odd = None if planes == 2**bits - 1 else planes
    return Recording(shape, read, Source(format="visionsim", bit_order="msb", bitplanes=odd), bits, model)


def _shard(path: Path, channel: int, channels: int, columns: int, width: int) -> LazyArray:
    """Return one colour plane [T, H, columns] of a shard; `ValueError` for another type or shape."""
    array = load_array(path, path.parent)
    if array.dtype.kind != "u" or array.ndim != 4 or channel >= array.shape[3]:
        raise ValueError(f"{path}: expected unsigned [T, H, W, {channels}], found {array.dtype} {list(array.shape)}")
    if array.shape[2] != columns:
        raise ValueError(f"{path}: {array.shape[2]} columns do not hold the width {width} of transforms.json")
    return array.channel(channel)


def _bits_of_sums(path: Path, planes: int, bits: int | None) -> int:
    """Return the bits of sums of bitplanes; `ValueError` for more than 16, and for other `bits`."""
    found = planes.bit_length()
    if not 1 <= found <= 16:
        raise ValueError(f"{path}: sums of {planes!r:.40} bitplanes; read are 1 to 65535")
    if bits is not None and bits != found:
        raise ValueError(f"{path}: sums of {planes} bitplanes have {found} bits, not {bits}; leave bits= out")
    return found


def _checked_light(path: Path, values: Array, first: int) -> Array:
    """Return the values if they are finite, not negative and within float32; else `ValueError` with the pixel."""
    wide = values.astype(np.float32) if values.dtype == np.float16 else values  # the limit is no half float
    good = (wide >= 0) & (wide < 3e38)
    if not good.all():
        t, y, x = (int(i) for i in np.argwhere(~good)[0][:3])
        place = f"(t, y, x) = ({first + t}, {y}, {x})"
        raise ValueError(f"{path}: value {values[t, y, x]} at {place} is not a light level: expected finite and >= 0")
    return np.asarray(wide)


def write_cube(path: Path, blocks: Iterator[Array], shape: tuple[int, int, int]) -> None:
    """Write binary planes as a photon cube: uint8 [T, H, ceil(W/8)], rows padded, most significant bit first."""
    frames, height, width = shape
    with files.replacing(path) as file:
        header = {"descr": "|u1", "fortran_order": False, "shape": (frames, height, packing.packed_width(width, 1))}
        np.lib.format.write_array_header_1_0(file, header)
        for block in blocks:
            file.write(packing.pack(block, 1).tobytes())


def write_zarr(
    folder: Path, blocks: Iterator[Array], shape: tuple[int, int, int], attributes: Mapping[str, object]
) -> None:
    """Write a zarr v3 group with `frames` [T, H, W] in chunks of full frames, as quanta-spad-sim stores them."""
    import zarr

    group = zarr.open_group(str(folder), mode="w", zarr_format=3)
    group.attrs.update(attributes)
    per_chunk = max(1, min(max(shape[0], 1), (8 << 20) // (shape[1] * shape[2])))
    array = None
    start = 0
    for block in blocks:
        if array is None:
            chunks = (per_chunk, *shape[1:])
            array = group.create_array(
                "frames", shape=shape, chunks=chunks, dtype=block.dtype, config={"write_empty_chunks": True}
            )  # dark chunks too: a reader cannot distinguish an omitted chunk from a lost one
        array[start : start + len(block)] = block
        start += len(block)
