"""Recordings in files that say their shape: .npy, .mat, zarr, visionsim's folders; packed planes or one code a pixel.

Each reader takes a path and the user's hints and returns a `Footage` of codes; `ValueError` names the file, and the
pixel whose value is no code. Bare streams of bits: planes.py.
"""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy import ndarray as Array

from qsim.footage import Footage, Hints, check_shape, numbered, reading


def read_cube(path: Path, hints: Hints) -> Footage:
    """Photon cube: uint8 [T, H, ceil(W/8)], rows padded, most significant bit first; [.., C] of colour needs a channel.

    Without a given width every bit of the last byte is a pixel. `ValueError` for another array.
    """
    array = load_npy(path)
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
    array = load_npy(path)
    frames, height, width = check_shape(path, array.shape)
    bits = 1 if array.dtype == bool else hints.bits
    if bits is None or array.dtype.kind not in "bu":
        raise ValueError(f"{path}: {array.dtype} codes need their number of bits, as in --bits 3")

    def read(start: int, stop: int) -> Array:
        return checked_codes(path, np.asarray(array[start:stop]), bits, start)

    return Footage((frames, height, width), read, "codes", bits)


def read_mat(path: Path, hints: Hints) -> Footage:
    """SwissSPAD .mat: OUTPUT [H, W, T] of one file, or of part_1.mat ... part_n.mat in a folder with info.json."""
    files = [path]
    if path.is_dir():
        files = numbered(list(path.glob("part_*.mat")))
        info = path / "info.json"
        if info.is_file():
            with reading(info, "JSON"):
                wanted = int(json.loads(info.read_text("utf-8"))["no_parts"])
            files = [path / f"part_{k}.mat" for k in range(1, min(wanted, 100_000) + 1)]
        for file in files:
            if not file.is_file():
                raise FileNotFoundError(f"{file}: missing, though info.json speaks of {len(files)} parts")
        if not files:
            raise FileNotFoundError(f"{path}: holds no part_1.mat")
    parts = [_mat_output(file) for file in files]
    if len({part.shape[1:] for part in parts}) > 1:
        raise ValueError(f"{path}: the parts differ in size: {sorted({part.shape[1:] for part in parts})}")
    planes = np.concatenate(parts)
    bits = hints.bits or 1
    codes = checked_codes(path, planes, bits, 0)
    return Footage(check_shape(path, codes.shape), lambda a, b: codes[a:b], "SwissSPAD .mat", bits)


def read_zarr(path: Path, hints: Hints) -> Footage:
    """zarr v2 or v3: the array `frames` of a group, or an array at the root; [T, H, W], one code a pixel."""
    import zarr

    with reading(path, "zarr"):
        node = zarr.open(store=str(path), mode="r")
        array: Any = node
        if isinstance(node, zarr.Group):
            if "frames" not in node:
                raise ValueError(f"{path}: a zarr group without the array 'frames'; it holds {sorted(node.keys())}")
            array = node["frames"]
        attributes = {k: v for k, v in dict(node.attrs).items() if isinstance(v, str | int | float | list)}
        shape = check_shape(path, array.shape)
        if array.dtype.kind not in "bu":
            raise ValueError(f"{path}: expected unsigned codes, found {array.dtype}")
        if array.nchunks_initialized < array.nchunks:
            stored = f"{array.nchunks_initialized} of {array.nchunks} chunks are there"
            raise ValueError(
                f"{path}: {stored}; the recording is incomplete (or its dark chunks were left out: write them too)"
            )
        if np.prod(array.chunks, dtype=float) > 1 << 31:
            raise ValueError(f"{path}: chunks of {array.chunks} pixels are too large to read")
    bits = hints.bits or 1

    def read(start: int, stop: int) -> Array:
        with reading(path, "zarr"):
            return checked_codes(path, np.asarray(array[start:stop]), bits, start)

    return Footage(shape, read, "zarr", bits, meta={"attributes": attributes})


def read_visionsim(path: Path, hints: Hints) -> Footage:
    """visionsim: transforms.json with frames.npy [T, H, bytes, C] (0.1), or with shards 0000.npy, ... (later)."""
    description = path / "transforms.json"
    with reading(description, "JSON"):
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
        array = load_npy(shard)
        if array.dtype.kind != "u" or array.ndim != 4 or channel >= array.shape[3]:
            raise ValueError(
                f"{shard}: expected unsigned [T, H, W, {channels}], found {array.dtype} {list(array.shape)}"
            )
        if array.shape[2] != (-(-width // 8) if packed else width):
            raise ValueError(f"{shard}: {array.shape[2]} columns do not hold the width {width} of transforms.json")
        parts.append(array[..., channel])
    bits = 1 if packed else hints.bits or int(info.get("bitplanes", 1)).bit_length()
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


def load_npy(path: Path) -> Array:
    """A .npy array as a memory map, or a .npy.gz in memory; `ValueError` for objects and lying headers."""
    if path.suffix == ".gz":
        with reading(path, "gzipped .npy"), gzip.open(path, "rb") as packed:
            return _read_npy(path, packed)
    with reading(path, ".npy"):
        array = np.lib.format.open_memmap(path, mode="r")
        if array.dtype.hasobject or array.dtype.kind not in "buif":
            raise ValueError(f"{path}: an array of {array.dtype}; numbers are expected")
        if array.ndim and array.nbytes + 64 > path.stat().st_size:
            raise ValueError(f"{path}: the header promises {array.nbytes} bytes, the file has {path.stat().st_size}")
        return array


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


def _mat_output(path: Path) -> Array:
    """OUTPUT of a .mat file as [T, H, W]: level 5 by scipy, 7.3 (HDF5, axes reversed) by h5py."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    with open(path, "rb") as file:
        head = file.read(1024)
    if b"\x89HDF\r\n\x1a\n" in head:
        return _hdf_output(path)
    import scipy.io

    with reading(path, "MATLAB 5 .mat"):
        shapes = {name: shape for name, shape, _ in scipy.io.whosmat(path)}
        if "OUTPUT" not in shapes:
            raise ValueError(f"{path}: has no variable OUTPUT; it holds {sorted(shapes)}")
        _plausible(path, shapes["OUTPUT"])
        planes = scipy.io.loadmat(path, variable_names=["OUTPUT"])["OUTPUT"]
        if planes.dtype.kind not in "bu" or planes.ndim not in (2, 3):
            raise ValueError(f"{path}: OUTPUT is {planes.dtype} {list(planes.shape)}, expected unsigned [H, W, T]")
        planes = planes if planes.ndim == 3 else planes[..., None]
        return np.ascontiguousarray(planes.transpose(2, 0, 1))


def _hdf_output(path: Path) -> Array:
    import h5py

    with reading(path, "MATLAB 7.3 .mat"), h5py.File(path, "r") as file:
        if "OUTPUT" not in file or not isinstance(file["OUTPUT"], h5py.Dataset):
            raise ValueError(f"{path}: has no variable OUTPUT; it holds {sorted(file)}")
        stored = file["OUTPUT"]
        _plausible(path, stored.shape)
        if stored.dtype.kind not in "bu" or stored.ndim != 3:
            raise ValueError(f"{path}: OUTPUT is {stored.dtype} {list(stored.shape)}, expected unsigned [T, W, H]")
        return np.ascontiguousarray(stored[...].transpose(0, 2, 1))


def _plausible(path: Path, shape: tuple[int, ...]) -> None:
    """Deflate shrinks at most 1032-fold: a header that promises more than that is lying."""
    promised, size = float(np.prod(shape, dtype=float)), path.stat().st_size
    if promised > 1032.0 * size:
        raise ValueError(f"{path}: the header promises {promised:.3g} values, which {size} bytes cannot hold")


def _read_npy(path: Path, file: gzip.GzipFile | BinaryIO) -> Array:
    """An array from a stream; memory grows with what is really there, not with what the header says."""
    version = np.lib.format.read_magic(file)
    reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = reader(file)
    if fortran or dtype.hasobject or dtype.kind not in "buif":
        raise ValueError(
            f"{path}: {dtype} in column order; only numbers in row order are read" if fortran else f"{path}: {dtype}"
        )
    wanted = int(np.prod(shape, dtype=object)) * dtype.itemsize
    content = bytearray()
    while len(content) < wanted:
        block = file.read(min(1 << 24, wanted - len(content)))
        if not block:
            raise ValueError(f"{path}: the header promises {wanted} bytes, the file has {len(content)}")
        content += block
    return np.frombuffer(content, dtype).reshape(shape)
