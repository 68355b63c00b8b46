"""Reads the container of glTF 2.0: .glb or .gltf, its JSON, buffers in the file or beside it, and its arrays.

    file -> Document -> array [count, numbers] of an accessor

Every index, offset and size is checked before anything is read, and every message names the file and the entry.
Source: Khronos, glTF 2.0 specification, sections 3.6 and 4.
"""

from __future__ import annotations

import base64
import binascii
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NotRequired, TypedDict, TypeVar
from urllib.parse import unquote

import numpy as np

from qsim.checks import require_finite
from qsim.kinds import Count, Whole
from qsim.parsing import parse_json
from qsim.records import convert
from qsim.scene.files_beside import file_beside, regular_bytes

JSON_CHUNK = 0x4E4F534A
BINARY_CHUNK = 0x004E4942
TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
NUMBERS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
DRACO = "KHR_draco_mesh_compression"  # meshes that draco.py unpacks
# What a file may require: these change materials, how meshes are stored, or the type of numbers: any type is read.
KNOWN_EXTENSIONS = (
    *("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_punctual", "KHR_mesh_quantization"),
    DRACO,
)

Component = Literal[5120, 5121, 5122, 5123, 5125, 5126]  # the keys of TYPES
Shape = Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT4"]  # the keys of NUMBERS
Entry = TypeVar("Entry")


class SparseIndices(TypedDict):
    bufferView: Count
    componentType: Component
    byteOffset: NotRequired[Count]


class SparseValues(TypedDict):
    bufferView: Count
    byteOffset: NotRequired[Count]


class Sparse(TypedDict):
    count: Whole
    indices: SparseIndices
    values: SparseValues


class Accessor(TypedDict):
    componentType: Component
    count: Whole
    type: Shape
    bufferView: NotRequired[Count]
    byteOffset: NotRequired[Count]
    normalized: NotRequired[bool]
    sparse: NotRequired[Sparse]


class View(TypedDict):
    buffer: Count
    byteLength: Whole
    byteOffset: NotRequired[Count]
    byteStride: NotRequired[Whole]


class Buffer(TypedDict):
    byteLength: Whole
    uri: NotRequired[str]


class Asset(TypedDict):
    version: str


class Root(TypedDict):
    asset: Asset


@dataclass(frozen=True, eq=False)
class Document:
    """The JSON of a file and its buffers."""

    path: Path
    content: dict[str, Any]
    buffers: tuple[bytes, ...]

    def entry(self, kind: str, index: int, table: type[Entry], by: str) -> Entry:
        """Return entry `index` of a list, checked; `by` names who asks for it."""
        entries = entries_of(self.path, self.content, kind)
        if index >= len(entries):
            raise ValueError(f"{self.path}: {by} names {kind}[{index}]; there are {len(entries)}")
        return convert(entries[index], table, f"{self.path}: {kind}[{index}]")

    def array(self, index: int, by: str, shape: str, count: int | None = None) -> np.ndarray:
        """Return an accessor of this shape, float64 or int64 [count, numbers]; normalized numbers become -1 .. 1.

        `count` is the expected number of elements; an accessor without data is zero and needs it.
        """
        where = f"accessors[{index}]"
        about = self.entry("accessors", index, Accessor, by)
        if about["type"] != shape or count not in (None, about["count"]):
            raise ValueError(
                f"{self.path}: {by} needs {'' if count is None else f'{count} of '}{shape}, "
                f"but {where} has {about['count']} of {about['type']}"
            )
        kind = np.dtype(TYPES[about["componentType"]])
        numbers = NUMBERS[shape]
        if "bufferView" in about:
            start = about.get("byteOffset", 0)
            values = self._elements(about["bufferView"], start, about["count"], numbers, kind, where)
        elif count is None:
            raise ValueError(f"{self.path}: {where} has no bufferView, so {by} has no numbers")
        else:
            values = np.zeros((count, numbers), kind)
        if "sparse" in about:
            values = self._patched(values, about["sparse"], where)
        if kind.kind == "f":
            require_finite(f"{self.path}: {where}", values)
        if not about.get("normalized", False):
            return values.astype(np.float64 if kind.kind == "f" else np.int64)
        if kind.kind == "f":
            raise ValueError(f"{self.path}: {where} is of float numbers, which cannot be normalized")
        return np.maximum(values / float(np.iinfo(kind).max), -1.0)

    def view(self, number: int, by: str) -> bytes:
        """Return the bytes of a bufferView."""
        about = self.entry("bufferViews", number, View, by)
        if about["buffer"] >= len(self.buffers):
            raise ValueError(f"{self.path}: bufferViews[{number}] names buffers[{about['buffer']}], which is missing")
        data = self.buffers[about["buffer"]]
        start = about.get("byteOffset", 0)
        if start + about["byteLength"] > len(data):
            raise ValueError(f"{self.path}: bufferViews[{number}] reaches beyond the {len(data)} bytes of its buffer")
        return data[start : start + about["byteLength"]]

    def _patched(self, values: np.ndarray, sparse: Sparse, where: str) -> np.ndarray:
        """Return the values with some replaced, of a sparse accessor."""
        count = sparse["count"]
        indices = sparse["indices"]
        if count > len(values) or TYPES[indices["componentType"]][1] != "u":
            raise ValueError(f"{self.path}: {where}: sparse needs unsigned indices, at most as many as values")
        places = self._elements(
            indices["bufferView"],
            indices.get("byteOffset", 0),
            count,
            1,
            np.dtype(TYPES[indices["componentType"]]),
            where,
        )[:, 0]
        start = sparse["values"].get("byteOffset", 0)
        changed = self._elements(sparse["values"]["bufferView"], start, count, values.shape[1], values.dtype, where)
        if places.max() >= len(values):
            raise ValueError(f"{self.path}: {where}: sparse index {places.max()}; there are {len(values)} values")
        values = values.copy()
        values[places] = changed
        return values

    def _elements(self, view: int, offset: int, count: int, numbers: int, kind: np.dtype, where: str) -> np.ndarray:
        about = self.entry("bufferViews", view, View, where)
        if about["buffer"] >= len(self.buffers):
            raise ValueError(f"{self.path}: bufferViews[{view}] names buffers[{about['buffer']}], which does not exist")
        data = self.buffers[about["buffer"]]
        start = about.get("byteOffset", 0)
        size = numbers * kind.itemsize
        stride = about.get("byteStride", size)
        end = offset + stride * (count - 1) + size
        if stride < size or end > about["byteLength"] or start + about["byteLength"] > len(data):
            raise ValueError(
                f"{self.path}: {where} reaches byte {start + end} of buffers[{about['buffer']}]; "
                f"bufferViews[{view}] holds {about['byteLength']} bytes from {start}, the buffer {len(data)}"
            )
        return np.ndarray((count, numbers), kind, data, start + offset, (stride, kind.itemsize))


def open_document(path: Path, known: tuple[str, ...] = KNOWN_EXTENSIONS) -> Document:
    """Return a .glb or .gltf file of version 2; `FileNotFoundError`, or `ValueError` with the name of the file.

    `known` are the beginnings of the names of extensions that it may require.
    """
    content, chunk = _read(path)
    version = convert(content, Root, str(path))["asset"]["version"]
    if not version.startswith("2."):
        raise ValueError(f"{path}: glTF of version {version[:20]}; version 2.0 is read")
    refuse_required(path, content, known)
    buffers = entries_of(path, content, "buffers")
    return Document(path, content, tuple(_buffer(path, i, each, chunk) for i, each in enumerate(buffers)))


def files_of(path: Path) -> set[Path]:
    """Return the files beside a .glb or .gltf file that its buffers and pictures are in."""
    content, _ = _read(path)
    found = set()
    for kind in ("buffers", "images"):
        for i, entry in enumerate(entries_of(path, content, kind)):
            uri = entry.get("uri") if isinstance(entry, dict) else None
            if isinstance(uri, str) and not uri.startswith("data:"):
                found.add(file_beside(path, f"{path}: {kind}[{i}]", unquote(uri)).resolve())
    return found


def _read(path: Path) -> tuple[dict[str, Any], bytes | None]:
    """Return the JSON of a .glb or .gltf file, and the binary chunk of a .glb file that has one."""
    if not path.is_file():
        raise FileNotFoundError(f"mesh {path}: no such file")
    raw = regular_bytes(path, f"mesh {path}")
    text, chunk = _chunks(path, raw) if raw[:4] == b"glTF" else (raw, None)
    try:
        return _without_nulls(parse_json(path, text.decode("utf-8-sig"))), chunk
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: neither a .glb nor a .gltf file: {error.reason} at byte {error.start}") from None


def _without_nulls(content: Any) -> Any:
    """Return JSON without keys of the value null, which count as missing."""
    if isinstance(content, dict):
        return {key: _without_nulls(value) for key, value in content.items() if value is not None}
    return [_without_nulls(each) for each in content] if isinstance(content, list) else content


def refuse_required(path: Path, content: Mapping[str, Any], known: tuple[str, ...] = KNOWN_EXTENSIONS) -> None:
    """Raise `ValueError` for a file that cannot be understood without an extension that is not read."""
    needed = content.get("extensionsRequired", [])
    if not isinstance(needed, list) or not all(isinstance(name, str) for name in needed):
        raise ValueError(f"{path}: extensionsRequired: expected a list of names")
    unknown = [name for name in needed if not name.startswith(known)]
    if unknown:
        raise ValueError(
            f"{path}: needs the extension {', '.join(f'{name:.60}' for name in unknown)}, which is not read; export "
            "without it (without compression)"
        )


def data_uri(where: str, uri: str) -> bytes:
    """Return the bytes of a data: uri in base64."""
    try:
        return base64.b64decode(uri.partition(";base64,")[2], validate=True)
    except (binascii.Error, ValueError):
        raise ValueError(f"{where}: its data: uri is not base64; the file is damaged") from None


def entries_of(path: Path, content: Mapping[str, Any], kind: str) -> list[Any]:
    """Return a list of the document, empty if it is missing."""
    found = content.get(kind, [])
    if not isinstance(found, list):
        raise ValueError(f"{path}: {kind}: expected a list, got a {type(found).__name__}")
    return found


def _chunks(path: Path, raw: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON of a .glb file, and its binary chunk if it has one."""
    if len(raw) < 20:
        raise ValueError(f"{path}: {len(raw)} bytes are no .glb file; it is truncated")
    _, version, length = struct.unpack_from("<4sII", raw)
    if version != 2:
        raise ValueError(f"{path}: glTF container of version {version}; version 2 is read")
    if length > len(raw):
        raise ValueError(f"{path}: truncated: {len(raw)} bytes of {length}")
    # A header of 12 bytes, then chunks: length, kind, content (glTF 2.0, 4.4).
    chunks = []
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", raw, at)
        if at + 8 + size > length:
            raise ValueError(f"{path}: the chunk at byte {at} reaches beyond the end of the file; it is damaged")
        chunks.append((kind, raw[at + 8 : at + 8 + size]))
        at += 8 + size
    if not chunks or chunks[0][0] != JSON_CHUNK:
        raise ValueError(f"{path}: the first chunk of a .glb file is JSON; this one is not, it is damaged")
    binary = [data for kind, data in chunks[1:2] if kind == BINARY_CHUNK]
    return chunks[0][1], binary[0] if binary else None


def _buffer(path: Path, index: int, entry: Any, chunk: bytes | None) -> bytes:
    where = f"{path}: buffers[{index}]"
    about = convert(entry, Buffer, where)
    uri = about.get("uri")
    if uri is None:
        if index or chunk is None:
            raise ValueError(f"{where}: the buffer is missing: no uri, and no binary chunk in the file")
        data = chunk
    elif uri.startswith("data:"):
        data = data_uri(where, uri)
    else:
        data = regular_bytes(file_beside(path, where, unquote(uri)), where)
    if len(data) < about["byteLength"]:
        raise ValueError(f"{where}: {len(data)} bytes, but {about['byteLength']} are stated; the file is truncated")
    return data
