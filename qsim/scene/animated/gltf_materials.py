"""Reads the pictures of a glTF file, where they lie on a mesh, and the base colour of each material.

Read are baseColorFactor (linear), baseColorTexture (sRGB) with its set of coordinates, its sampler and
KHR_texture_transform, and the diffuse colours of the older KHR_materials_pbrSpecularGlossiness. `gltf_surfaces.py`
reads the rest of a material. Source: Khronos, glTF 2.0, sections 3.8 and 3.9.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal, NamedTuple, NotRequired, TypedDict
from urllib.parse import unquote

import numpy as np

from qsim.kinds import Count, Number, Part
from qsim.records import convert
from qsim.scene.animated.gltf_buffers import Document, data_uri
from qsim.scene.files_beside import bytes_beside, picture_in
from qsim.scene.image_files import stored
from qsim.scene.materials import Picture
from qsim.scene.mesh_pieces import Paint

WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST = (9728, 9984, 9986)  # filters that take one texel: NEAREST, and with mipmaps
WEBP = "EXT_texture_webp"
BASIS = "KHR_texture_basisu"

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
    metallicRoughnessTexture: NotRequired[TextureInfo]


class Glossiness(TypedDict):
    diffuseFactor: NotRequired[Factor]
    diffuseTexture: NotRequired[TextureInfo]


class Material(TypedDict):
    name: NotRequired[str]
    normalTexture: NotRequired[TextureInfo]
    emissiveTexture: NotRequired[TextureInfo]
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


class Placing(NamedTuple):
    """Where a picture lies: the set of coordinates and how they are changed."""

    chosen: int = 0
    offset: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0  # rad
    scale: tuple[float, float] = (1.0, 1.0)


class Paints:
    """The materials of a document, each read once.

    With `complete` a material without a picture of its base colour places its other pictures.
    """

    def __init__(self, document: Document, complete: bool = False) -> None:
        self._document = document
        self._complete = complete
        self._found: dict[int, tuple[Paint, TextureInfo | None]] = {}
        self._pictures: dict[int, tuple[Picture, str]] = {}  # several textures may share one
        self._stored: dict[int, np.ndarray] = {}

    def paint(self, number: int | None, by: str) -> Paint | None:
        """Return the paint of material `number`; None for none."""
        return None if number is None else self._material(number, by)[0]

    def picture(self, info: TextureInfo, by: str) -> Paint:
        """Return a white paint with a picture."""
        document = self._document
        where = f"textures[{info['index']}]"
        texture = document.entry("textures", info["index"], Texture, by)
        sampler = Sampler()
        if "sampler" in texture:
            sampler = document.entry("samplers", texture["sampler"], Sampler, where)
        wrap = (WRAPS[sampler.get("wrapS", 10497)], WRAPS[sampler.get("wrapT", 10497)])
        read = functools.partial(self._image, texture, where)
        place = f"{document.path}: {by}"
        return Paint(place, image=read, wrap=wrap, nearest=sampler.get("magFilter") in NEAREST)

    def stored(self, texture: int, by: str) -> np.ndarray:
        """Return the stored numbers of a texture's picture in 0..1, float32 [H, W, 4]."""
        about = self._document.entry("textures", texture, Texture, by)
        source = self._source(about, f"textures[{texture}]")
        if source not in self._stored:
            raw, where = self._bytes(source, f"textures[{texture}]")
            self._stored[source] = stored(io.BytesIO(raw), where)
        return self._stored[source]

    def placing(self, info: TextureInfo | None, by: str) -> Placing:
        """Return the set of coordinates of a picture and its transform; without a picture those of set 0."""
        transform = self._transform(info, by)
        chosen = transform.get("texCoord", info.get("texCoord", 0) if info else 0)
        return Placing(
            chosen, transform.get("offset", (0.0, 0.0)), transform.get("rotation", 0.0), transform.get("scale", (1, 1))
        )

    def placing_of(self, number: int | None, by: str) -> Placing:
        """Return where the pictures of material `number` lie."""
        return self.placing(None if number is None else self._material(number, by)[1], by)

    def coordinates(self, number: int | None, attributes: Mapping[str, int], by: str, count: int) -> np.ndarray | None:
        """Return where the vertices lie in the picture of material `number`, float64 [count, 2] with v up.

        Without a picture they are those of set 0. None if the mesh has none; `ValueError` if the picture needs another
        set than the mesh has.
        """
        placed = self.placing_of(number, by)
        name = f"TEXCOORD_{placed.chosen}"
        if name not in attributes:
            if placed.chosen:
                raise ValueError(f"{self._document.path}: {by} has no {name}, which the picture of its material needs")
            return None
        found = self._document.array(attributes[name], by, "VEC2", count).astype(np.float64)
        if placed != Placing(placed.chosen):
            cos = np.cos(placed.rotation)
            sin = np.sin(placed.rotation)
            # Counter-clockwise as coordinates are drawn, with v down (github.com/KhronosGroup/glTF/issues/1563)
            found = found * placed.scale @ np.array([[cos, -sin], [sin, cos]]) + placed.offset
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
            others = (base.get("metallicRoughnessTexture"), about.get("normalTexture"), about.get("emissiveTexture"))
            placed = [other for other in others if other is not None and self._complete]
            return Paint(where, (red, green, blue)), placed[0] if placed else None
        return replace(self.picture(info, f"materials[{number}]"), factor=(red, green, blue)), info

    def _image(self, texture: Texture, by: str) -> tuple[Picture, str]:
        """Return the picture of a texture and its SHA-256, from the file or from an image beside it."""
        source = self._source(texture, by)
        if source not in self._pictures:
            self._pictures[source] = picture_in(*self._bytes(source, by))
        return self._pictures[source]

    def _source(self, texture: Texture, by: str) -> int:
        """Return the number of the image of a texture."""
        document = self._document
        others = texture.get("extensions") or {}
        source = texture.get("source")
        if source is None and WEBP in others:
            source = convert(others[WEBP], WebpTexture, f"{document.path}: {by}")["source"]
        if source is None:
            why = f"only one of {BASIS}, which is not read" if BASIS in others else "none"
            raise ValueError(f"{document.path}: {by} needs a picture and has {why}; export PNG or JPEG")
        return source

    def _bytes(self, source: int, by: str) -> tuple[bytes, str]:
        """Return the bytes of an image file, in the file or beside it, and the name for messages."""
        document = self._document
        about = document.entry("images", source, Image, by)
        where = f"{document.path}: images[{source}]"
        if about.get("bufferView") is not None:
            return document.view(about["bufferView"], f"images[{source}]"), where
        if about.get("uri") is None:
            raise ValueError(f"{where}: has neither uri nor bufferView; the file is damaged")
        if about["uri"].startswith("data:"):
            return data_uri(where, about["uri"]), where
        name = unquote(about["uri"])
        return bytes_beside(document.path, where, name), f"{where}: {name:.60}"
