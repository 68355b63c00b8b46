"""Writes glTF files for tests: arrays become accessors of one buffer, in the file, beside it, or as text."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class Gltf:
    """A document that grows; `content` is its JSON."""

    def __init__(self, **content: Any) -> None:
        self.data = bytearray()
        self.content: dict[str, Any] = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": []} | content

    def view(self, raw: bytes, **more: Any) -> int:
        """Add bytes as a bufferView."""
        self.data += bytes(-len(self.data) % 4)
        start = len(self.data)
        self.data += raw
        self.content["bufferViews"].append({"buffer": 0, "byteOffset": start, "byteLength": len(raw), **more})
        return len(self.content["bufferViews"]) - 1

    def add(self, values: Any, kind: str = "f4", **more: Any) -> int:
        """Add an array [count] or [count, numbers] as an accessor."""
        values = np.asarray(values)
        values = values.reshape(len(values), -1).astype("<" + kind)
        return self.accessor(self.view(values.tobytes()), values.shape, kind, **more)

    def accessor(self, view: int | None, shape: tuple[int, ...], kind: str = "f4", **more: Any) -> int:
        """Add an accessor of a view, or of none."""
        about = {"componentType": COMPONENTS[kind], "count": shape[0], "type": SHAPES[shape[1]], **more}
        self.content["accessors"].append(about | ({} if view is None else {"bufferView": view}))
        return len(self.content["accessors"]) - 1

    def write(self, path: Path, how: str = "chunk") -> Path:
        """Write a .glb (`how` = "chunk"), or a .gltf with its buffer as a file ("beside") or as text ("text")."""
        about: dict[str, Any] = {"byteLength": len(self.data)}
        if how == "beside":
            path.with_suffix(".bin").write_bytes(self.data)
            about["uri"] = path.with_suffix(".bin").name
        elif how == "text":
            about["uri"] = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        text = json.dumps(self.content | {"buffers": [about]}).encode()
        if how != "chunk":
            path.write_bytes(text)
            return path
        text += b" " * (-len(text) % 4)
        data = bytes(self.data) + bytes(-len(self.data) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


def arm() -> Gltf:
    """Return a strip of 14 vertices and 12 triangles along x that bends about z at x = 1 by a right angle in 1 s.

    Its second joint takes the vertices beyond x = 1 and half of those at x = 1.
    """
    x = np.repeat(np.arange(7) / 3, 2)
    vertices = np.column_stack([x, np.tile([0.0, 0.1], 7), np.zeros(14)])
    faces = np.concatenate([[(i, i + 2, i + 1), (i + 1, i + 2, i + 3)] for i in range(0, 12, 2)])
    second = np.where(np.isclose(x, 1), 0.5, x > 1)
    file = Gltf()
    binds = np.tile(np.eye(4), (2, 1, 1))
    binds[1, 0, 3] = -1.0
    attributes = {
        "POSITION": file.add(vertices),
        "NORMAL": file.add(np.tile([0.0, 0, 1], (14, 1))),
        "TEXCOORD_0": file.add(np.column_stack([x / 2, 1 - vertices[:, 1]])),
        "JOINTS_0": file.add(np.tile([0, 1, 0, 0], (14, 1)), "u1"),
        "WEIGHTS_0": file.add(np.column_stack([1 - second, second, 0 * second, 0 * second])),
    }
    half = np.sqrt(0.5)
    sampler = {"input": file.add([0.0, 1.0]), "output": file.add([[0, 0, 0, 1.0], [0, 0, half, half]])}
    file.content |= {
        "scene": 0,
        "scenes": [{"nodes": [0, 2]}],
        "nodes": [{"children": [1]}, {"translation": [1.0, 0, 0]}, {"mesh": 0, "skin": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": file.add(faces.ravel(), "u2")}]}],
        "skins": [{"joints": [0, 1], "inverseBindMatrices": file.add(binds.transpose(0, 2, 1).reshape(2, 16))}],
        "animations": [
            {
                "name": "bend",
                "channels": [{"sampler": 0, "target": {"node": 1, "path": "rotation"}}],
                "samplers": [sampler],
            }
        ],
    }
    return file
