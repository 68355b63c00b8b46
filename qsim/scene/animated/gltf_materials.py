"""Reads the base colours of a glTF file: factor and picture of each material, and the coordinates that place it.

Read are baseColorFactor (linear), baseColorTexture (sRGB) with its set of coordinates, its sampler and
KHR_texture_transform, and the diffuse colours of the older KHR_materials_pbrSpecularGlossiness. All else is left out:
opacity, roughness, metal, normals, emission, and colours of vertices. Source: Khronos, glTF 2.0, sections 3.8 and 3.9.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Annotated, Any, Literal, NotRequired, TypedDict
from urllib.parse import unquote

import numpy as np
from msgspec import Meta

from qsim.kinds import Count, Number
from qsim.records import convert
from qsim.scene.animated.gltf_buffers import Document, data_uri
from qsim.scene.files_beside import picture_in, picture_of
from qsim.scene.materials import Picture
from qsim.scene.mesh_pieces import Paint

WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST = (9728, 9984, 9986)  # filters that take one texel: NEAREST, and with mipmaps
WEBP = "EXT_texture_webp"
BASIS = "KHR_texture_basisu"

Part = Annotated[float, Meta(ge=0.0, le=1.0)]
Factor = tuple[Part, Part, Part, Part]
Wrap = Literal[10497, 33071, 33648]  # the keys of WRAPS


class TextureInfo(TypedDict):
    index: Count
    texCoord: NotRequired[Count]
    extensions: NotRequired[dict[str, Any]]


class Transform(TypedDict):
    offset: NotRequired[tuple[Number, Number]]
    rotation: NotRequired[Number]
    scale: NotRequired[tuple[Number, Number]]
    texCoord: NotRequired[Count]


class Roughness(TypedDict):
    baseColorFactor: NotRequired[Factor]
    baseColorTexture: NotRequired[TextureInfo]


class Glossiness(TypedDict):
    diffuseFactor: NotRequired[Factor]
    diffuseTexture: NotRequired[TextureInfo]


class Material(TypedDict):
    name: NotRequired[str]
    pbrMetallicRoughness: NotRequired[Roughness]
    extensions: NotRequired[dict[str, Any]]


class Texture(TypedDict):
    source: NotRequired[Count]
    sampler: NotRequired[Count]
    extensions: NotRequired[dict[str, Any]]


class Sampler(TypedDict):
    wrapS: NotRequired[Wrap]
    wrapT: NotRequired[Wrap]
    magFilter: NotRequired[Count]


class Image(TypedDict):
    uri: NotRequired[str]
    bufferView: NotRequired[Count]


class WebpTexture(TypedDict):
    source: Count


class Paints:
    """The materials of a document, each read once."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._found: dict[int, tuple[Paint, TextureInfo | None]] = {}
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

    def _transform(self, info: TextureInfo | None, by: str) -> Transform:
        extensions = {} if info is None else info.get("extensions", {})
        if "KHR_texture_transform" not in extensions:
            return {}
        where = f"{self._document.path}: {by}: KHR_texture_transform"
        return convert(extensions["KHR_texture_transform"], Transform, where)

    def _material(self, number: int, by: str) -> tuple[Paint, TextureInfo | None]:
        if number not in self._found:
            self._found[number] = self._read(number, by)
        return self._found[number]

    def _read(self, number: int, by: str) -> tuple[Paint, TextureInfo | None]:
        """Return the paint of a material, and where its picture is placed."""
        document = self._document
        about = document.entry("materials", number, Material, by)
        where = f"{document.path}: materials[{number}]"
        base = about.get("pbrMetallicRoughness", Roughness())
        factor = base.get("baseColorFactor")
        info = base.get("baseColorTexture")
        older = (about.get("extensions") or {}).get("KHR_materials_pbrSpecularGlossiness")
        if older is not None and "pbrMetallicRoughness" not in about:
            glossy = convert(older, Glossiness, where)
            factor = glossy.get("diffuseFactor")
            info = glossy.get("diffuseTexture")
        red, green, blue = (factor or (1.0, 1.0, 1.0))[:3]
        if info is None:
            return Paint(where, (red, green, blue)), None
        texture = document.entry("textures", info["index"], Texture, f"materials[{number}]")
        sampler = Sampler()
        if "sampler" in texture:
            sampler = document.entry("samplers", texture["sampler"], Sampler, f"textures[{info['index']}]")
        wrap = (WRAPS[sampler.get("wrapS", 10497)], WRAPS[sampler.get("wrapT", 10497)])
        read = functools.partial(self._image, texture, f"textures[{info['index']}]")
        return Paint(where, (red, green, blue), read, wrap, sampler.get("magFilter") in NEAREST), info

    def _image(self, texture: Texture, by: str) -> tuple[Picture, str]:
        """Return the picture of a texture and its SHA-256, from the file or from an image beside it."""
        document = self._document
        others = texture.get("extensions") or {}
        source = texture.get("source")
        if source is None and WEBP in others:
            source = convert(others[WEBP], WebpTexture, f"{document.path}: {by}")["source"]
        if source is None:
            why = f"only one of {BASIS}, which is not read" if BASIS in others else "none"
            raise ValueError(f"{document.path}: {by} needs a picture and has {why}; export PNG or JPEG")
        if source not in self._pictures:
            self._pictures[source] = self._picture(source, by)
        return self._pictures[source]

    def _picture(self, source: int, by: str) -> tuple[Picture, str]:
        document = self._document
        about = document.entry("images", source, Image, by)
        where = f"{document.path}: images[{source}]"
        if about.get("bufferView") is not None:
            return picture_in(document.view(about["bufferView"], f"images[{source}]"), where)
        if about.get("uri") is None:
            raise ValueError(f"{where}: has neither uri nor bufferView; the file is damaged")
        if about["uri"].startswith("data:"):
            return picture_in(data_uri(where, about["uri"]), where)
        return picture_of(document.path, where, unquote(about["uri"]))
