"""Reads the materials of a glTF file as surfaces: metallic-roughness with its extensions.

    material + coordinates of its vertices -> MetallicRoughness

Read are base colour, metal, roughness, normals, emission and opacity, each a factor times a picture, and the extensions
in MATERIALS. All pictures of a material lie where that of its base colour lies, because a mesh has one set of
coordinates; one that lies elsewhere is left out and named. Occlusion is left out: light is traced.
Source: Khronos, glTF 2.0, sections 3.9 and appendix B, and the extensions KHR_materials_*.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal, NotRequired, TypedDict

import numpy as np
from msgspec import Meta

from qsim import limits
from qsim.colour import luminance
from qsim.kinds import Part
from qsim.records import convert
from qsim.scene.animated.gltf_buffers import Document
from qsim.scene.animated.gltf_materials import Factor, Paints, TextureInfo
from qsim.scene.bands import Colour
from qsim.scene.materials import MetallicRoughness, NormalMap, Picture, Texture, VertexColours
from qsim.scene.mesh_pieces import Paint, texture_of

MATERIALS = (  # extensions of materials that are read
    "KHR_materials_ior",
    "KHR_materials_transmission",
    "KHR_materials_specular",
    "KHR_materials_emissive_strength",
    "KHR_materials_unlit",
    "KHR_materials_clearcoat",
)
LEAST_IOR = 1.001  # of a surface without a coat; Mitsuba needs one above 1
PARTS = 5  # pictures of a material: colour, metal and roughness, normals, emission and opacity
WHITE: Colour = (1.0, 1.0, 1.0)


Amount = Annotated[float, Meta(ge=0.0, le=1e9)]  # far above what any file means, far below what overflows


class NormalInfo(TextureInfo):
    scale: NotRequired[Annotated[float, Meta(ge=-1e3, le=1e3)]]


class Roughness(TypedDict):
    baseColorFactor: NotRequired[Factor]
    baseColorTexture: NotRequired[TextureInfo]
    metallicFactor: NotRequired[Part]
    roughnessFactor: NotRequired[Part]
    metallicRoughnessTexture: NotRequired[TextureInfo]


class Surface(TypedDict):
    pbrMetallicRoughness: NotRequired[Roughness]
    normalTexture: NotRequired[NormalInfo]
    occlusionTexture: NotRequired[TextureInfo]
    emissiveTexture: NotRequired[TextureInfo]
    emissiveFactor: NotRequired[tuple[Part, Part, Part]]
    alphaMode: NotRequired[Literal["OPAQUE", "MASK", "BLEND"]]
    alphaCutoff: NotRequired[Amount]
    extensions: NotRequired[dict[str, Any]]


class Ior(TypedDict):
    ior: NotRequired[Amount]


class Transmission(TypedDict):
    transmissionFactor: NotRequired[Part]
    transmissionTexture: NotRequired[TextureInfo]


class Specular(TypedDict):
    specularFactor: NotRequired[Part]
    specularTexture: NotRequired[TextureInfo]
    specularColorFactor: NotRequired[tuple[Amount, Amount, Amount]]
    specularColorTexture: NotRequired[TextureInfo]


class Strength(TypedDict):
    emissiveStrength: NotRequired[Amount]


class Clearcoat(TypedDict):
    clearcoatFactor: NotRequired[Part]
    clearcoatTexture: NotRequired[TextureInfo]
    clearcoatRoughnessFactor: NotRequired[Part]
    clearcoatRoughnessTexture: NotRequired[TextureInfo]
    clearcoatNormalTexture: NotRequired[TextureInfo]


class Surfaces:
    """The materials of a document, in colour or as luminance."""

    def __init__(self, document: Document, paints: Paints, coloured: bool, tell: Callable[[str], None]) -> None:
        self._document = document
        self._paints = paints
        self._coloured = coloured
        self._tell = tell
        self._made: dict[tuple[int, bool], MetallicRoughness] = {}
        self._texels = 0

    def surface(
        self, number: int | None, by: str, uv: np.ndarray | None, colours: np.ndarray | None
    ) -> MetallicRoughness:
        """Return material `number` on vertices with coordinates [V, 2], v up, and colours [V, 3], both may be missing.

        The default material of glTF, for None, is a white metal of roughness 1.
        """
        if number is None:
            return MetallicRoughness(tint(WHITE, self._coloured), metallic=1.0, roughness=1.0)
        about = self._document.entry("materials", number, Surface, by)
        key = (number, uv is None)
        if key in self._made and colours is None:
            return self._made[key]
        reading = _Reading(self._document, self._paints, self._coloured, self._tell, number, about, uv)
        found = reading.surface(colours)
        self._count(found)
        if colours is None and reading.fits_all:
            self._made[key] = found
        return found

    def _count(self, surface: MetallicRoughness) -> None:
        """Raise `ValueError` where the pictures of all surfaces have more pixels than a file may have."""
        for value in vars(surface).values():
            image = getattr(value, "image", None)
            pixels = image.colours if isinstance(image, Picture) else image
            self._texels += pixels.shape[0] * pixels.shape[1] if isinstance(pixels, np.ndarray) else 0
        if self._texels > PARTS * limits.TEXELS:
            raise ValueError(
                f"{self._document.path}: the pictures of its materials have over {PARTS} x {limits.TEXELS} pixels in "
                "all; export smaller ones"
            )


def tint(colour: Sequence[float], coloured: bool) -> float | Colour:
    """Return a linear colour, or its luminance."""
    if not coloured:
        return float(luminance(np.array(colour, np.float64)))
    red, green, blue = (float(each) for each in colour)
    return red, green, blue


class _Reading:
    """One material on one piece."""

    def __init__(
        self,
        document: Document,
        paints: Paints,
        coloured: bool,
        tell: Callable[[str], None],
        number: int,
        about: Surface,
        uv: np.ndarray | None,
    ) -> None:
        self._document = document
        self._paints = paints
        self._coloured = coloured
        self._number = number
        self._about = about
        self._uv = uv
        self._where = f"materials[{number}]"
        self._tell = lambda what: tell(f"{self._where}: {what}")
        self.fits_all = True  # whether the surface is the same on every mesh
        self._base = about.get("pbrMetallicRoughness", Roughness())

    def surface(self, colours: np.ndarray | None) -> MetallicRoughness:
        """Return the material on vertices of these colours [V, 3]."""
        extensions = self._about.get("extensions", {})
        if "occlusionTexture" in self._about:
            self._tell("its occlusion is left out, because light is traced")
        base = self._reflectance(colours)
        if "KHR_materials_unlit" in extensions:
            if isinstance(base, VertexColours):
                self._tell("unlit colours of vertices are left out")
                base = self._tint(self._factor)
            return MetallicRoughness(0.0, ior=LEAST_IOR, roughness=1.0, emission=base, opacity=self._opacity())
        glossy = self._data(self._base, "metallicRoughnessTexture")
        transmission = self._transmission()
        coat = self._extension("KHR_materials_clearcoat", Clearcoat)
        for name in ("clearcoatTexture", "clearcoatRoughnessTexture", "clearcoatNormalTexture"):
            if name in coat:
                self._tell(f"its {name} is left out")
        if transmission != 0 and coat.get("clearcoatFactor", 0.0) > 0:
            self._tell("the clearcoat of its glass is left out")
        return MetallicRoughness(
            base,
            _times(glossy, 2, self._base.get("metallicFactor", 1.0)),
            _times(glossy, 1, self._base.get("roughnessFactor", 1.0)),
            self._ior(),
            transmission,
            coat.get("clearcoatFactor", 0.0),
            coat.get("clearcoatRoughnessFactor", 0.0),
            self._emission(),
            self._opacity(),
            self._normals(),
        )

    @property
    def _factor(self) -> Sequence[float]:
        return self._base.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))[:3]

    def _reflectance(self, colours: np.ndarray | None) -> float | Colour | Texture | VertexColours:
        """Return the base colour: factor times picture, or times the colours of vertices."""
        texture = self._picture(self._base, "baseColorTexture", self._factor)
        if texture is not None:
            if colours is not None and not np.allclose(colours, 1):
                self._tell("colours of vertices beside a picture are left out")
            return texture
        if colours is not None:
            return VertexColours(colours * self._factor)
        return self._tint(self._factor)

    def _emission(self) -> float | Colour | Texture:
        strength = self._extension("KHR_materials_emissive_strength", Strength).get("emissiveStrength", 1.0)
        factor = np.array(self._about.get("emissiveFactor", (0.0, 0.0, 0.0))) * strength
        if not factor.any():
            return 0.0
        texture = self._picture(self._about, "emissiveTexture", tuple(factor.tolist()))
        return self._tint(factor.tolist()) if texture is None else texture

    def _opacity(self) -> float | Texture:
        """Return the opacity: a share, or of a mask 0 and 1."""
        mode = self._about.get("alphaMode", "OPAQUE")
        if mode == "OPAQUE":
            return 1.0
        factor = self._base.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))[3]
        picture = self._data(self._base, "baseColorTexture")
        cutoff = self._about.get("alphaCutoff", 0.5) if mode == "MASK" else None
        if picture is None:
            return factor if cutoff is None else float(factor >= cutoff)
        texture, pixels = picture
        shown = np.clip(pixels[..., 3] * np.float32(factor), 0, 1)
        shown = shown if cutoff is None else (shown >= cutoff).astype(np.float32)
        return Texture(shown, texture.repeat, texture.nearest or cutoff is not None, texture.source, wrap=texture.wrap)

    def _ior(self) -> float:
        """Return the index whose reflection at normal incidence is that of KHR_materials_ior times the specular."""
        about = self._extension("KHR_materials_specular", Specular)
        for name in ("specularTexture", "specularColorTexture"):
            if name in about:
                self._tell(f"its {name} is left out")
        tinted = about.get("specularColorFactor", WHITE)
        if min(tinted) != max(tinted):
            self._tell("its specular colour is taken as its luminance")
        share = about.get("specularFactor", 1.0) * float(luminance(np.array(tinted)))
        # Fresnel at normal incidence: ((n - 1) / (n + 1))^2. The specular share scales that, and the index
        # is what would reflect so. KHR_materials_ior means total reflection by an index of 0.
        given = self._extension("KHR_materials_ior", Ior).get("ior", 1.5)
        reflected = 1.0 if given == 0 else ((given - 1) / (given + 1)) ** 2
        root = math.sqrt(min(max(reflected * share, 0.0), 0.9))
        return max((1 + root) / (1 - root), LEAST_IOR)

    def _transmission(self) -> float | Texture:
        about = self._extension("KHR_materials_transmission", Transmission)
        factor = about.get("transmissionFactor", 0.0)
        if factor == 0:
            return 0.0
        return _times(self._data(about, "transmissionTexture"), 0, factor)

    def _normals(self) -> NormalMap | None:
        """Return the normals of the material's picture, tilted by its scale."""
        picture = self._data(self._about, "normalTexture")
        if picture is None:
            return None
        texture, pixels = picture
        scale = self._about["normalTexture"].get("scale", 1.0)
        tilted = pixels[..., :3].astype(np.float64) * 2 - 1
        tilted[..., :2] *= scale
        tilted /= np.maximum(np.linalg.norm(tilted, axis=-1, keepdims=True), 1e-9)
        return NormalMap(np.clip(tilted / 2 + 0.5, 0, 1).astype(np.float32), texture.repeat, texture.wrap)

    def _extension(self, name: str, table: type[Any]) -> Any:
        found = self._about.get("extensions", {}).get(name, {})
        return convert(found, table, f"{self._document.path}: {self._where}: {name}")

    def _picture(self, holder: Any, name: str, factor: Sequence[float]) -> Texture | None:
        """Return a picture of colours times a factor; None without one, or where it cannot be placed."""
        paint = self._paint(holder, name)
        if paint is None or self._uv is None:
            return None
        # Factors above 1, of emission, are no reflectance: they scale the texture instead.
        scale = max(*factor, 1.0)
        red, green, blue = (each / scale for each in factor)
        texture = texture_of(replace(paint, factor=(red, green, blue)), [self._uv])
        return Texture(texture.image, texture.repeat, texture.nearest, texture.source, scale, texture.wrap)

    def _data(self, holder: Any, name: str) -> tuple[Texture, np.ndarray] | None:
        """Return how a picture of numbers is placed, and its stored values in 0..1, float32 [H, W, 4]."""
        paint = self._paint(holder, name)
        if paint is None or self._uv is None:
            return None
        info: TextureInfo = holder[name]
        values = self._paints.stored(info["index"], self._where)
        # The colours are placed, so that wrapping by other axes changes both alike.
        halves = [Picture(np.ascontiguousarray(values[..., channels])) for channels in ([0, 1, 2], [3, 3, 3])]
        placed = [
            texture_of(
                Paint(paint.where, WHITE, functools.partial(_given, half), paint.wrap, paint.nearest), [self._uv]
            )
            for half in halves
        ]
        images = [texture.image for texture in placed]
        assert isinstance(images[0], Picture)
        assert isinstance(images[1], Picture)
        return placed[0], np.concatenate([images[0].colours, images[1].colours[..., :1]], axis=-1)

    def _paint(self, holder: Any, name: str) -> Paint | None:
        """Return the picture of a name; None without one, or if it lies elsewhere than that of the base colour."""
        info: TextureInfo | None = holder.get(name)
        if info is None:
            return None
        if self._uv is None:
            self._tell(f"its {name} is left out, its mesh has no coordinates")
            return None
        placed = self._paints.placing(info, self._where)
        if placed != self._paints.placing_of(self._number, self._where):
            self._tell(f"its {name} is left out, it lies elsewhere than the first picture of the material")
            return None
        found = self._paints.picture(info, self._where)
        # A picture that wraps differently along its axes is changed by how far the mesh's coordinates run.
        self.fits_all = self.fits_all and found.wrap[0] == found.wrap[1]
        return found

    def _tint(self, colour: Sequence[float]) -> float | Colour:
        return tint(colour, self._coloured)


def _pixels(texture: Texture) -> np.ndarray:
    assert isinstance(texture.image, Picture)
    return texture.image.colours


def _given(picture: Picture) -> tuple[Picture, str]:
    return picture, ""


def _times(picture: tuple[Texture, np.ndarray] | None, channel: int, factor: float) -> float | Texture:
    """Return a factor times a channel of a picture."""
    if picture is None or factor == 0:
        return factor
    texture, pixels = picture
    return Texture(pixels[..., channel] * np.float32(factor), texture.repeat, texture.nearest, wrap=texture.wrap)
