"""Reads the base colours of a glTF file: factor and picture of each material, and the coordinates that place it.

Read are baseColorFactor (linear), baseColorTexture (sRGB) with its set of coordinates, its sampler and
KHR_texture_transform, and the diffuse colours of the older KHR_materials_pbrSpecularGlossiness. All else is left out:
opacity, roughness, metal, normals, emission, and colours of vertices. Source: Khronos, glTF 2.0, sections 3.8 and 3.9.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any
from urllib.parse import unquote

import numpy as np

from qsim.scene.animated.gltf_buffers import Document, data_uri
from qsim.scene.files_beside import picture_in, picture_of
from qsim.scene.materials import Picture
from qsim.scene.mesh_pieces import Paint
from qsim.structure import COUNT, NUMBER, OBJECT, TEXT, Table, expected, is_number, list_of, structure

WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST = (9728, 9984, 9986)  # filters that take one texel: NEAREST, and with mipmaps
WEBP = "EXT_texture_webp"
BASIS = "KHR_texture_basisu"

PAIR = expected("two numbers", list_of(is_number, 2))
FACTOR = expected("four numbers from 0 to 1", lambda v: list_of(is_number, 4)(v) and all(0 <= n <= 1 for n in v))
WRAP = expected(f"one of {', '.join(map(str, WRAPS))}", lambda value: type(value) is int and value in WRAPS)
TEXTURE_INFO: Table = {"index": COUNT, "texCoord, if any": COUNT, "extensions, if any": OBJECT}
TRANSFORM: Table = {
    "offset, if any": PAIR,
    "rotation, if any": NUMBER,
    "scale, if any": PAIR,
    "texCoord, if any": COUNT,
}
ROUGHNESS: Table = {"baseColorFactor, if any": FACTOR, "baseColorTexture, if any": TEXTURE_INFO}
GLOSSINESS: Table = {"diffuseFactor, if any": FACTOR, "diffuseTexture, if any": TEXTURE_INFO}
MATERIAL: Table = {"name, if any": TEXT, "pbrMetallicRoughness, if any": ROUGHNESS, "extensions, if any": OBJECT}
TEXTURE: Table = {"source, if any": COUNT, "sampler, if any": COUNT, "extensions, if any": OBJECT}
SAMPLER: Table = {"wrapS, if any": WRAP, "wrapT, if any": WRAP, "magFilter, if any": COUNT}
IMAGE: Table = {"uri, if any": TEXT, "bufferView, if any": COUNT}


class Paints:
    """The materials of a document, each read once."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._found: dict[int, tuple[Paint, dict[str, Any] | None]] = {}
        self._pictures: dict[int, tuple[Picture, str]] = {}  # several textures may share one

    def paint(self, number: int | None, by: str) -> Paint | None:
        """Return the paint of material `number`; None for none."""
        return None if number is None else self._material(number, by)[0]

    def coordinates(self, number: int | None, attributes: Mapping[str, int], by: str, count: int) -> np.ndarray | None:
        """Return where the vertices lie in the picture of material `number`, float64 [count, 2] with v up.

        Without a picture they are those of set 0. None if the mesh has none; `ValueError` if the picture needs another
        set than the mesh has.
        """
        info = None if number is None else self._material(number, by)[1]
        transform = self._transform(info, by)
        chosen = transform.get("texCoord", info.get("texCoord", 0) if info else 0)
        name = f"TEXCOORD_{chosen}"
        if name not in attributes:
            if chosen:
                raise ValueError(f"{self._document.path}: {by} has no {name}, which the picture of its material needs")
            return None
        found = self._document.array(attributes[name], by, "VEC2", count).astype(np.float64)
        if transform:
            turn = transform.get("rotation", 0.0)
            cos = np.cos(turn)
            sin = np.sin(turn)
            scaled = found * transform.get("scale", (1.0, 1.0))
            # Counter-clockwise as coordinates are drawn, with v down (github.com/KhronosGroup/glTF/issues/1563)
            found = scaled @ np.array([[cos, -sin], [sin, cos]]) + transform.get("offset", (0.0, 0.0))
        return found * (1, -1) + (0, 1)

    def _transform(self, info: dict[str, Any] | None, by: str) -> dict[str, Any]:
        extensions = (info or {}).get("extensions") or {}
        if "KHR_texture_transform" not in extensions:
            return {}
        where = f"{self._document.path}: {by}: KHR_texture_transform"
        return structure(extensions["KHR_texture_transform"], TRANSFORM, where, closed=False)

    def _material(self, number: int, by: str) -> tuple[Paint, dict[str, Any] | None]:
        if number not in self._found:
            self._found[number] = self._read(number, by)
        return self._found[number]

    def _read(self, number: int, by: str) -> tuple[Paint, dict[str, Any] | None]:
        """Return the paint of a material, and where its picture is placed."""
        document = self._document
        about = document.entry("materials", number, MATERIAL, by)
        where = f"{document.path}: materials[{number}]"
        base = about.get("pbrMetallicRoughness") or {}
        factor = base.get("baseColorFactor")
        info = base.get("baseColorTexture")
        older = (about.get("extensions") or {}).get("KHR_materials_pbrSpecularGlossiness")
        if older is not None and "pbrMetallicRoughness" not in about:
            base = structure(older, GLOSSINESS, where, closed=False)
            factor = base.get("diffuseFactor")
            info = base.get("diffuseTexture")
        red, green, blue = (factor or (1.0, 1.0, 1.0))[:3]
        if info is None:
            return Paint(where, (red, green, blue)), None
        texture = document.entry("textures", info["index"], TEXTURE, f"materials[{number}]")
        sampler: dict[str, Any] = {}
        if texture.get("sampler") is not None:
            sampler = document.entry("samplers", texture["sampler"], SAMPLER, f"textures[{info['index']}]")
        wrap = (WRAPS[sampler.get("wrapS", 10497)], WRAPS[sampler.get("wrapT", 10497)])
        read = functools.partial(self._image, texture, f"textures[{info['index']}]")
        return Paint(where, (red, green, blue), read, wrap, sampler.get("magFilter") in NEAREST), info

    def _image(self, texture: Mapping[str, Any], by: str) -> tuple[Picture, str]:
        """Return the picture of a texture and its SHA-256, from the file or from an image beside it."""
        document = self._document
        others = texture.get("extensions") or {}
        source = texture.get("source")
        if source is None and WEBP in others:
            source = structure(others[WEBP], {"source": COUNT}, f"{document.path}: {by}", closed=False)["source"]
        if source is None:
            why = f"only one of {BASIS}, which is not read" if BASIS in others else "none"
            raise ValueError(f"{document.path}: {by} needs a picture and has {why}; export PNG or JPEG")
        if source not in self._pictures:
            self._pictures[source] = self._picture(source, by)
        return self._pictures[source]

    def _picture(self, source: int, by: str) -> tuple[Picture, str]:
        document = self._document
        about = document.entry("images", source, IMAGE, by)
        where = f"{document.path}: images[{source}]"
        if about.get("bufferView") is not None:
            return picture_in(document.view(about["bufferView"], f"images[{source}]"), where)
        if about.get("uri") is None:
            raise ValueError(f"{where}: has neither uri nor bufferView; the file is damaged")
        if about["uri"].startswith("data:"):
            return picture_in(data_uri(where, about["uri"]), where)
        return picture_of(document.path, where, unquote(about["uri"]))
