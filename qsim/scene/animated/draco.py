"""Unpacks the meshes of a glTF file that Draco compressed, so that they are read like any other.

    Document with KHR_draco_mesh_compression -> Document whose accessors lie in buffers of its own

The library DracoPy decodes. What its accessors state is compared with what came out of the file. A file that has its
meshes uncompressed, too (the extension is not required), is read without the extension.
Source: Khronos, glTF 2.0, KHR_draco_mesh_compression.
"""

from __future__ import annotations

import copy
import importlib
from collections.abc import Iterable
from dataclasses import replace
from typing import Annotated, Any, TypedDict

import numpy as np
from msgspec import Meta

from qsim import limits
from qsim.kinds import Count
from qsim.records import convert
from qsim.scene.animated.gltf_buffers import DRACO, TYPES, Document

SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}  # by numbers of an element
TRIANGLES = 4  # mode of a primitive, after strips are unpacked, too
INDICES = 5125  # componentType of faces
HEADER = b"DRACO"


class Compressed(TypedDict):
    bufferView: Count
    attributes: Annotated[dict[str, Count], Meta(min_length=1)]


def unpacked(document: Document) -> Document:
    """Return a document without compressed meshes; the same if it needs no unpacking.

    `ValueError` without DracoPy, and for data that cannot be decoded or differ from what their accessors state.
    """
    if DRACO not in document.content.get("extensionsRequired", []):
        return document
    content = copy.deepcopy(document.content)
    unpacking = _Unpacking(replace(document, content=content))
    for m, mesh in enumerate(content.get("meshes", [])):
        primitives = mesh.get("primitives") if isinstance(mesh, dict) else None
        for p, primitive in enumerate(primitives if isinstance(primitives, list) else []):
            unpacking.unpack(primitive, f"meshes[{m}].primitives[{p}]")
    return unpacking.done()


class _Unpacking:
    """Puts decoded arrays behind the accessors of one document."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._content = document.content
        self._data = bytearray()
        self._decoded: dict[int, Any] = {}
        self._views: list[Any] = self._content.setdefault("bufferViews", [])

    def done(self) -> Document:
        """Return the document with one more buffer."""
        buffers = (*self._document.buffers, bytes(self._data))
        return replace(self._document, buffers=buffers)

    def unpack(self, primitive: Any, where: str) -> None:
        """Give a primitive accessors of its own; nothing for one that is not compressed."""
        extensions = primitive.get("extensions") if isinstance(primitive, dict) else None
        if not isinstance(extensions, dict) or DRACO not in extensions:
            return
        path = f"{self._document.path}: {where}"
        about = convert(extensions.pop(DRACO), Compressed, f"{path}: {DRACO}")
        attributes = primitive.get("attributes")
        if not isinstance(attributes, dict):
            raise ValueError(f"{path}: expected attributes; the file is damaged")
        self._check_counts(attributes.values(), path)
        mesh = self._mesh(about["bufferView"], where)
        for name, number in about["attributes"].items():
            found = None if mesh is None else mesh.get_attribute_by_unique_id(number)
            if found is None or name not in attributes:
                raise ValueError(f"{path}: {DRACO}: has no {name:.60}, which it names; the file is damaged")
            attributes[name] = self._accessor(attributes[name], np.asarray(found["data"]), f"{where}.{name:.60}")
        faces = np.asarray(mesh.faces).reshape(-1)
        primitive["indices"] = self._add(faces.astype("<u4"), INDICES, "SCALAR")
        primitive["mode"] = TRIANGLES

    def _check_counts(self, stated: Iterable[Any], path: str) -> None:
        """Raise `ValueError`, before anything is decoded, for accessors that state more vertices than are read."""
        entries = self._content.get("accessors")
        for number in stated:
            known = isinstance(entries, list) and isinstance(number, int) and 0 <= number < len(entries)
            about = entries[number] if known and isinstance(entries, list) else None
            count = about.get("count") if isinstance(about, dict) else None
            if not isinstance(count, int) or not 0 < count <= limits.VERTICES:
                raise ValueError(
                    f"{path}: an accessor states {count!r:.30} vertices; at most {limits.VERTICES} are read"
                )

    def _mesh(self, view: int, where: str) -> Any:
        """Return the decoded mesh of a bufferView."""
        if view not in self._decoded:
            raw = self._document.view(view, where)
            self._decoded[view] = _decoded(raw, f"{self._document.path}: {where}")
        return self._decoded[view]

    def _accessor(self, stated: Any, values: np.ndarray, where: str) -> int:
        """Return the number of a new accessor of decoded values, of the kind and the count that another one states."""
        path = self._document.path
        entries = self._content.get("accessors")
        known = isinstance(entries, list) and isinstance(stated, int) and 0 <= stated < len(entries)
        about = entries[stated] if known and isinstance(entries, list) else None
        if not isinstance(about, dict) or about.get("componentType") not in TYPES:
            raise ValueError(f"{path}: {where} names no accessor of a known type; the file is damaged")
        values = values.reshape(len(values), -1)
        shape = SHAPES.get(values.shape[1])
        if (about.get("count"), about.get("type")) != (len(values), shape):
            raise ValueError(
                f"{path}: {where}: {DRACO} holds {len(values)} of {shape}, and accessors[{stated}] states "
                f"{about.get('count')!r:.20} of {about.get('type')!r:.20}; the file is damaged"
            )
        kind = about["componentType"]
        return self._add(values.astype(TYPES[kind]), kind, shape, normalized=about.get("normalized") is True)

    def _add(self, values: np.ndarray, kind: int, shape: str | None, *, normalized: bool = False) -> int:
        """Return the number of a new accessor with these values."""
        self._data.extend(bytes(-len(self._data) % 4))
        if len(self._data) + values.nbytes > limits.ASSET:
            raise ValueError(f"{self._document.path}: its meshes have over {limits.ASSET} bytes, unpacked")
        view = {"buffer": len(self._document.buffers), "byteOffset": len(self._data), "byteLength": values.nbytes}
        self._data.extend(values.tobytes())
        self._views.append(view)
        accessor = {"bufferView": len(self._views) - 1, "componentType": kind, "count": len(values), "type": shape}
        accessors = self._content.setdefault("accessors", [])
        accessors.append(accessor | ({"normalized": True} if normalized else {}))
        return len(accessors) - 1


def _decoded(raw: bytes, where: str) -> Any:
    """Return a mesh of DracoPy; `ValueError` with one line for data that are no mesh."""
    try:
        library = importlib.import_module("DracoPy")
    except ImportError:
        raise ValueError(
            f"{where}: is compressed by {DRACO}, and DracoPy is missing: pip install DracoPy, or export without "
            "compression"
        ) from None
    damaged = f"{where}: its data are no mesh of Draco; the file is damaged"
    if not raw.startswith(HEADER):
        raise ValueError(damaged)
    try:
        mesh = library.decode(raw)
    except Exception as error:  # its errors have no common class
        raise ValueError(damaged) from error
    if getattr(mesh, "faces", None) is None or not len(mesh.faces):
        raise ValueError(f"{where}: {DRACO} holds no triangles; the file is damaged")
    return mesh
