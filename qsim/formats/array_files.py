"""Recordings in files that say their shape: .npy, .mat, zarr, visionsim's folders; packed planes or one code a pixel.

Each reader takes a path and the user's hints and returns a `Footage` of codes; `ValueError` names the file, and the
pixel whose value is no code. Bare streams of bits: planes.py.
"""

from __future__ import annotations

import itertools
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.checks import check_shape
from qsim.files import decoding_errors, load_array
from qsim.formats.recording import Footage, Hints, numbered

_LARGEST_CHUNK = 1 << 29  # bytes of a zarr chunk in memory; one of quanta-spad-sim has up to 200 MB
_LARGEST_METADATA = 1 << 22  # bytes
_ZARR_METADATA = ("zarr.json", ".zarray", ".zattrs", ".zgroup", ".zmetadata")
# Of zarr; others execute what a file holds (pickle), or expand a few bytes without a limit (bz2, lzma).
_CODECS = {"blosc", "bytes", "crc32c", "delta", "gzip", "lz4", "packbits", "sharding_indexed", "shuffle", "transpose",
           "zlib", "zstd"}  # fmt: skip


def read_cube(path: Path, hints: Hints) -> Footage:
    """Photon cube: uint8 [T, H, ceil(W/8)], rows padded, most significant bit first; [.., C] of colour needs a channel.

    Without a given width every bit of the last byte is a pixel. `ValueError` for another array.
    """
    array = load_array(path)
    if array.ndim == 4:
        if hints.channel is None or not 0 <= hints.channel < array.shape[3]:
            raise ValueError(f"{path}: a colour cube of {array.shape[3]} channels; choose one with --channel 0")
        array = array[..., hints.channel]
    if array.dtype != np.uint8 or array.ndim != 3:
        raise ValueError(f"{path}: a photon cube is uint8 [T, H, bytes], found {array.dtype} {list(array.shape)}")
    frames, height, columns = check_shape(path, array.shape)
    width = hints.width if hints.width is not None else 8 * columns
    if not 8 * (columns - 1) < width <= 8 * columns:
        raise ValueError(f"{path}: {columns} bytes per row hold {8 * columns - 7} to {8 * columns} pixels, not {width}")

    def read(start: int, stop: int) -> Array:
        return np.unpackbits(np.asarray(array[start:stop]), axis=-1, count=width)

    return Footage((frames, height, width), read, "photon cube", 1, meta={"bit_order": "msb"})


def read_codes_npy(path: Path, hints: Hints) -> Footage:
    """Unpacked codes: bool or unsigned [T, H, W] with one code per pixel; the bits are those given, else 1 for bool."""
    array = load_array(path)
    frames, height, width = check_shape(path, array.shape)
    bits = 1 if array.dtype == bool else hints.bits
    if bits is None or array.dtype.kind not in "bu":
        raise ValueError(f"{path}: {array.dtype} codes need their number of bits, as in --bits 3")

    def read(start: int, stop: int) -> Array:
        return checked_codes(path, np.asarray(array[start:stop]), bits, start)

    return Footage((frames, height, width), read, "codes", bits)


def read_mat(path: Path, hints: Hints) -> Footage:
    """SwissSPAD .mat: OUTPUT [H, W, T] of one file, or of part_1.mat ... part_n.mat in a folder with info.json.

    Another name is taken from `hints.variable`, or if it is the only array of frames.
    """
    files = [path]
    if path.is_dir():
        files = numbered(list(path.glob("part_*.mat")))
        info = path / "info.json"
        if info.is_file():
            with decoding_errors(info, "JSON"):
                wanted = int(json.loads(info.read_text("utf-8"))["no_parts"])
            files = [path / f"part_{k}.mat" for k in range(1, min(wanted, 100_000) + 1)]
        for file in files:
            if not file.is_file():
                raise FileNotFoundError(f"{file}: missing, though info.json speaks of {len(files)} parts")
        if not files:
            raise FileNotFoundError(f"{path}: holds no part_1.mat")
    parts = [mat_array(file, hints.variable) for file in files]
    if len({part.shape[1:] for part in parts}) > 1:
        raise ValueError(f"{path}: the parts differ in size: {sorted({part.shape[1:] for part in parts})}")
    planes = np.concatenate(parts)
    bits = hints.bits or 1
    codes = checked_codes(path, planes, bits, 0)
    return Footage(check_shape(path, codes.shape), lambda a, b: codes[a:b], "SwissSPAD .mat", bits)


def read_zarr(path: Path, hints: Hints) -> Footage:
    """zarr v2 or v3 in a folder: array `frames` of a group, or an array at the root; [T, H, W], one code a pixel."""
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
        if float(np.prod(stored, dtype=float)) * array.dtype.itemsize > _LARGEST_CHUNK:
            raise ValueError(
                f"{path}: chunks of {list(stored)} pixels; up to {_LARGEST_CHUNK} bytes are read at a time"
            )
        wanted = math.prod(-(-n // chunk) for n, chunk in zip(shape, stored, strict=True))
        found = _count_files(folder, wanted)  # before the library lists all the chunks that there should be
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

    return Footage(shape, read, "zarr", bits, meta={"attributes": attributes})


def _zarr_codecs(path: Path, folder: Path) -> set[str]:
    """The codecs named by an array's own metadata; `ValueError` if `folder` holds no array, or too much metadata."""
    if not path.is_dir():
        raise ValueError(f"{path}: is a single file; a zarr is read from its folder, so unpack it first")
    described = [folder / name for name in ("zarr.json", ".zarray") if (folder / name).is_file()]
    for file in [*described, *(path / name for name in ("zarr.json", ".zattrs", ".zgroup")), folder / ".zattrs"]:
        if file.is_file() and file.stat().st_size > _LARGEST_METADATA:
            raise ValueError(f"{file}: {file.stat().st_size} bytes of metadata; up to {_LARGEST_METADATA} are read")
    found: set[str] = set()
    for file in described:
        with decoding_errors(file, "JSON"):
            content = json.loads(file.read_text("utf-8"))
            waiting = [content[key] for key in ("codecs", "filters", "compressor") if key in content]
            while waiting:
                item = waiting.pop()
                if isinstance(item, dict):
                    found |= {str(item[key]) for key in ("id", "name") if key in item}
                    waiting += item.values()
                elif isinstance(item, list):
                    waiting += item
    if not any((folder / ".zarray" == file) or b'"array"' in file.read_bytes() for file in described):
        inside = sorted(item.name for item in itertools.islice(path.iterdir(), 100) if item.is_dir())
        raise ValueError(f"{path}: a zarr group without the array 'frames'; it holds {inside}")
    return {name.removeprefix("numcodecs.") for name in found}


def _count_files(folder: Path, enough: int) -> int:
    """Files below a folder other than zarr's metadata, counted no further than `enough`."""
    count = 0
    for _, _, names in os.walk(folder):
        count += sum(name not in _ZARR_METADATA for name in names)
        if count >= enough:
            break
    return count


def read_visionsim(path: Path, hints: Hints) -> Footage:
    """visionsim: transforms.json with frames.npy [T, H, bytes, C] (0.1), or with shards 0000.npy, ... (later)."""
    description = path / "transforms.json"
    with decoding_errors(description, "JSON"):
        info = json.loads(description.read_text("utf-8"))
        width, channels = int(info["w"]), int(info.get("c", 1))
        packed = bool(info.get("bitpack", "bitpack_dim" in info or info.get("bitplanes", 1) == 1))
        if packed and int(info.get("bitpack_dim", 2)) != 2:
            raise ValueError(f"{description}: planes packed along axis {info['bitpack_dim']}; only axis 2 (W) is known")
    shards = [path / "frames.npy"] if (path / "frames.npy").is_file() else numbered(list(path.glob("[0-9]*.npy")))
    if not shards:
        raise FileNotFoundError(f"{path}: holds neither frames.npy nor 0000.npy")
    channel = hints.channel or 0
    if channels > 1 and hints.channel is None:
        raise ValueError(f"{path}: {channels} colour planes; choose one with --channel 0")
    parts = []
    for shard in shards:
        array = load_array(shard)
        if array.dtype.kind != "u" or array.ndim != 4 or channel >= array.shape[3]:
            raise ValueError(
                f"{shard}: expected unsigned [T, H, W, {channels}], found {array.dtype} {list(array.shape)}"
            )
        if array.shape[2] != (-(-width // 8) if packed else width):
            raise ValueError(f"{shard}: {array.shape[2]} columns do not hold the width {width} of transforms.json")
        parts.append(array[..., channel])
    bits = 1 if packed else hints.bits or int(info.get("bitplanes", 1)).bit_length()
    if not 1 <= bits <= 16:
        raise ValueError(f"{description}: sums of {info['bitplanes']!r:.40} bitplanes; 1 to 65535 are read")
    ends = np.cumsum([len(part) for part in parts])
    shape = check_shape(path, (int(ends[-1]), parts[0].shape[1], width))

    def read(start: int, stop: int) -> Array:
        rows = [part[max(0, start - e + len(part)) : max(0, stop - e + len(part))]
                for part, e in zip(parts, ends, strict=True)]  # fmt: skip
        joined = np.concatenate(rows)
        if packed:
            return np.unpackbits(joined, axis=2, count=width)
        return checked_codes(path, joined, bits, start)

    model = "binary_sum" if packed else "binary_sum_static"
    return Footage(shape, read, "visionsim", bits, model, {"bit_order": "msb"})


def checked_codes(path: Path, values: Array, bits: int, first: int) -> Array:
    """Codes as uint8 (uint16 above 8 bits); `ValueError` with frame and pixel if one is above 2^bits - 1."""
    top = 2**bits - 1
    if values.dtype != bool and values.size and int(values.max()) > top:
        t, y, x = (int(i) for i in np.argwhere(values > top)[0])
        raise ValueError(
            f"{path}: value {int(values[t, y, x])} at (t, y, x) = ({first + t}, {y}, {x}) is no {bits}-bit code "
            f"(0..{top}); say the right --bits, or --stretched"
        )
    return values.astype(np.uint8 if bits <= 8 else np.uint16)


def mat_array(path: Path, variable: str | None = None) -> Array:
    """An array of a .mat file as [T, H, W]: level 5 by scipy, 7.3 (HDF5, axes reversed) by h5py; [H, W] is one frame.

    The one called `variable`; without a name OUTPUT, or the only array of numbers in two or three dimensions.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    with open(path, "rb") as file:
        head = file.read(1024)
    if b"\x89HDF\r\n\x1a\n" in head:
        return _hdf_array(path, variable)
    import scipy.io

    with decoding_errors(path, "MATLAB 5 .mat"):
        numbers = ("int", "uint", "single", "double", "logical")
        shapes = {name: shape for name, shape, kind in scipy.io.whosmat(path) if kind.startswith(numbers)}
        name = _chosen(path, variable, shapes)
        _plausible(path, shapes[name])
        return _frames_first(path, name, scipy.io.loadmat(path, variable_names=[name])[name])


def _hdf_array(path: Path, variable: str | None) -> Array:
    import h5py

    with decoding_errors(path, "MATLAB 7.3 .mat"), h5py.File(path, "r") as file:
        own = [name for name in file if isinstance(file.get(name, getlink=True), h5py.HardLink)]
        wanted = variable or "OUTPUT"
        if wanted in file.keys() - set(own):
            raise ValueError(
                f"{path}: {wanted} is a link, which may lead into another file; store the planes themselves"
            )
        shapes = {name: file[name].shape for name in own if isinstance(file[name], h5py.Dataset)}
        name = _chosen(path, variable, shapes)
        stored = file[name]
        if stored.external or stored.is_virtual:
            raise ValueError(f"{path}: {name} lies in other files, which are not read; store the planes themselves")
        _plausible(path, stored.shape)
        if stored.dtype.kind not in "buif":
            raise ValueError(f"{path}: {name} is {stored.dtype} {list(stored.shape)}, expected numbers [T, W, H]")
        return _frames_first(path, name, stored[...].T)


def _chosen(path: Path, variable: str | None, shapes: dict[str, tuple[int, ...]]) -> str:
    """The array to read; `ValueError` with the names found where the choice is open."""
    if variable is not None:
        if variable not in shapes:
            raise ValueError(f"{path}: has no array {variable}; it holds {sorted(shapes)}")
        return variable
    if "OUTPUT" in shapes:
        return "OUTPUT"
    images = sorted(
        name for name, shape in shapes.items() if len(shape) in (2, 3) and min(shape) > 0 and max(shape) > 1
    )
    if len(images) == 1:
        return images[0]
    if not images:
        raise ValueError(f"{path}: has no array of frames; it holds {sorted(shapes)}")
    raise ValueError(f"{path}: holds the arrays {images}; choose one with --variable {images[0]}")


def _frames_first(path: Path, name: str, planes: Array) -> Array:
    """MATLAB's [H, W, T] or [H, W] as [T, H, W]; whole numbers stored as floats become integers."""
    if planes.dtype.kind not in "buif" or planes.ndim not in (2, 3):
        raise ValueError(f"{path}: {name} is {planes.dtype} {list(planes.shape)}, expected unsigned [H, W, T]")
    planes = planes if planes.ndim == 3 else planes[..., None]
    if planes.dtype.kind in "if":
        whole = np.rint(planes)
        if planes.size and not (np.isfinite(planes).all() and (whole == planes).all() and whole.min() >= 0):
            raise ValueError(f"{path}: {name} holds values that are no counts: expected whole numbers from 0 up")
        planes = whole.astype(np.uint32) if not planes.size or whole.max() < 2**32 else planes
    return np.ascontiguousarray(planes.transpose(2, 0, 1))


def _plausible(path: Path, shape: tuple[int, ...]) -> None:
    """Deflate shrinks at most 1032-fold: a header that promises more than that is lying."""
    promised, size = float(np.prod(shape, dtype=float)), path.stat().st_size
    if promised > 1032.0 * size:
        raise ValueError(f"{path}: the header promises {promised:.3g} values, which {size} bytes cannot hold")
