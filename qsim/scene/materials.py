"""Surfaces: materials with textures and relief, as frozen records. A reflectance is a number, a colour or a texture."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from qsim.checks import require_finite
from qsim.colour import luminance
from qsim.scene.bands import Colour, numbers
from qsim.scene.flicker import Flicker, check_flicker
from qsim.scene.image_files import read_colour, read_grey
from qsim.scene.lights import check_light

AIR = 1.000277  # Mitsuba's index around bodies; it raises RuntimeError for a rough surface of the same index


WRAPS = ("repeat", "mirror", "clamp")


@dataclass(frozen=True, eq=False)
class Picture:
    """The colours of an image that has been read already: as those of a file, they become luminance in one band."""

    colours: np.ndarray  # float32 [H, W, 3], linear

    def __post_init__(self) -> None:
        if self.colours.ndim != 3 or self.colours.shape[2] != 3 or not self.colours.size:
            raise ValueError(f"Picture.colours: expected a picture [H, W, 3], got shape {self.colours.shape}")


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture on a surface: an array of linear values, or an image file (sRGB, grey or colour).

    In a scene of one band, the colours of a file become linear luminance (Rec. 709), and arrays are [H, W].
    """

    image: np.ndarray | str | Picture  # float [H, W] linear, in scenes of three bands also [H, W, 3]; or a path
    repeat: tuple[float, float] = (1.0, 1.0)  # repetitions of the picture in u, v = 0..1
    nearest: bool = False  # nearest texel instead of bilinear
    source: str | None = None  # name of the photograph that the picture shows; data sets record it
    scale: float = 1.0  # factor on all values
    wrap: str = field(default="repeat", metadata={"described": "if any"})  # beyond 0..1: one of WRAPS

    def __post_init__(self) -> None:
        if self.wrap not in WRAPS:
            raise ValueError(f"Texture.wrap: one of {', '.join(WRAPS)} is expected, got {self.wrap!r}")

    def at(self, uv: np.ndarray) -> np.ndarray:
        """Return the linear values of the texels at coordinates [N, 2], float32 [N]; errors as of `pixels`."""
        pixels = self.pixels()
        places = uv * self.repeat
        if self.wrap == "repeat":
            places = places % 1.0
        elif self.wrap == "mirror":
            places = 1 - np.abs(places % 2.0 - 1)
        height, width = pixels.shape
        column = np.clip((places[:, 0] * width).astype(np.int64), 0, width - 1)
        row = np.clip(((1 - places[:, 1]) * height).astype(np.int64), 0, height - 1)
        return np.asarray(pixels[row, column])

    def pixels(self) -> np.ndarray:
        """Return linear values, float32 [H, W]; `FileNotFoundError` or `ValueError` with the file's name."""
        if isinstance(self.image, Picture):
            return self._scaled("Texture.image", luminance(self.image.colours.astype(np.float64)).astype(np.float32))
        if not isinstance(self.image, str | Path):
            pixels = np.asarray(self.image, np.float32)
            where = "Texture.image"
        else:
            where = str(self.image)
            pixels = read_grey(Path(self.image))
        if pixels.ndim != 2 or pixels.size == 0:
            raise ValueError(f"{where}: expected a picture [H, W], got shape {pixels.shape}")
        return self._scaled(where, pixels)

    def colours(self) -> np.ndarray:
        """Return linear values of the bands, float32 [H, W, 3], equal in a grey picture; errors as of `pixels`."""
        if isinstance(self.image, str | Path):
            return self._scaled(str(self.image), read_colour(Path(self.image)))
        if isinstance(self.image, Picture):
            return self._scaled("Texture.image", self.image.colours)
        pixels = np.asarray(self.image, np.float32)
        if pixels.ndim != 3:
            return np.repeat(self.pixels()[..., None], 3, axis=2)
        if pixels.shape[2] != 3 or pixels.size == 0:
            raise ValueError(f"Texture.image: expected a picture [H, W] or [H, W, 3], got shape {pixels.shape}")
        return self._scaled("Texture.image", pixels)

    def _scaled(self, where: str, pixels: np.ndarray) -> np.ndarray:
        scaled = np.float32(self.scale) * pixels
        require_finite(where, scaled)
        return scaled


@dataclass(frozen=True, eq=False)
class Bump:
    """Relief that only tilts normals: a height map, with values in units of `height`."""

    texture: Texture
    height: float = 1.0  # m


@dataclass(frozen=True, eq=False)
class NormalMap:
    """Tangent-space normals as a picture, float [H, W, 3] in 0..1; (0.5, 0.5, 1) is flat."""

    image: np.ndarray
    repeat: tuple[float, float] = (1.0, 1.0)
    wrap: str = field(default="repeat", metadata={"described": "if any"})  # beyond 0..1: one of WRAPS

    def __post_init__(self) -> None:
        if self.wrap not in WRAPS:
            raise ValueError(f"NormalMap.wrap: one of {', '.join(WRAPS)} is expected, got {self.wrap!r}")
        image = np.asarray(self.image)
        if image.ndim != 3 or image.shape[2] != 3 or not image.size:
            raise ValueError(f"NormalMap.image: a picture [H, W, 3] is expected, got shape {image.shape}")
        if not (image.min() >= 0 and image.max() <= 1):
            raise ValueError(
                f"NormalMap.image: values from 0 to 1 are expected, found {image.min()} to {image.max()}; divide 8-bit "
                "values by 255"
            )


Relief = Bump | NormalMap | None


@dataclass(frozen=True, eq=False)
class Diffuse:
    """A two-sided Lambertian surface."""

    reflectance: float | Colour | Texture = 0.5  # 0..1
    relief: Relief = None

    def __post_init__(self) -> None:
        _check_reflectance(self)


@dataclass(frozen=True, eq=False)
class RoughPlastic:
    """A diffuse base under a rough dielectric coat (GGX)."""

    reflectance: float | Colour | Texture = 0.5  # of the base, 0..1
    roughness: float = 0.1  # GGX alpha
    ior: float = 1.49
    relief: Relief = None

    def __post_init__(self) -> None:
        _check_reflectance(self)
        _check_surface(self)
        if self.roughness == 0:
            raise ValueError("RoughPlastic.roughness: a number above 0 is expected, got 0; its coat cannot be a mirror")


@dataclass(frozen=True, eq=False)
class Conductor:
    """A metal given by its complex index at the camera's wavelength (aluminium at 550 nm); roughness 0 is a mirror.

    Aluminium 0.96 + 6.70i, silver 0.055 + 3.32i, gold 0.42 + 2.35i, copper 1.04 + 2.59i, chromium 3.12 + 3.31i
    (rounded handbook values at 550 nm).
    """

    eta: float | Colour = 0.96
    k: float | Colour = 6.70
    roughness: float = 0.1  # GGX alpha
    relief: Relief = None

    def __post_init__(self) -> None:
        for name in ("eta", "k"):
            found = getattr(self, name)
            if min(numbers(found), default=-1) < 0:
                raise ValueError(f"Conductor.{name}: a finite number from 0 up is expected, got {found!r}")
        _check_surface(self)


@dataclass(frozen=True, eq=False)
class Dielectric:
    """Glass or water; roughness 0 is clear. `thin` is a pane without thickness."""

    ior: float = 1.5
    roughness: float = 0.0
    thin: bool = False

    def __post_init__(self) -> None:
        _check_surface(self)


@dataclass(frozen=True, eq=False)
class VertexColours:
    """Linear colours of the vertices of a mesh, interpolated between them; their luminance in scenes of one band."""

    colours: np.ndarray  # float [V, 3], 0..1

    def __post_init__(self) -> None:
        if self.colours.ndim != 2 or self.colours.shape[1] != 3 or not len(self.colours):
            raise ValueError(f"VertexColours.colours: [V, 3] is expected, got shape {self.colours.shape}")
        if not (self.colours.min() >= 0 and self.colours.max() <= 1):
            raise ValueError("VertexColours.colours: values from 0 to 1 are expected")


@dataclass(frozen=True, eq=False)
class MetallicRoughness:
    """The surface of glTF 2.0: a diffuse base under a rough dielectric coat, mixed with a metal.

    Where `transmission` is above 0 it is Disney's surface as Mitsuba computes it (Burley, 2015), whose base is brighter
    than a diffuse one. Both sides look alike, but glass has an inside. A surface may also emit, on its
    outer side, and let a share of the light pass straight on.
    """

    reflectance: float | Colour | Texture | VertexColours = 0.5  # base colour, 0..1
    metallic: float | Texture = 0.0  # 0..1
    roughness: float | Texture = 0.5  # 0..1; the GGX alpha is its square
    ior: float = 1.5  # above 1
    transmission: float | Texture = 0.0  # share of glass, 0..1
    clearcoat: float = 0.0  # strength of a second coat of index 1.5, 0..1; glass has none
    clearcoat_roughness: float = 0.0  # 0..1
    emission: float | Colour | Texture = 0.0  # W m^-2 sr^-1
    opacity: float | Texture = 1.0  # 0..1
    relief: Relief = None

    def __post_init__(self) -> None:
        if not isinstance(self.reflectance, VertexColours):
            _check_reflectance(self)
        for name in ("metallic", "roughness", "transmission", "clearcoat", "clearcoat_roughness", "opacity"):
            found = getattr(self, name)
            if not isinstance(found, Texture) and not (_is_number(found) and 0 <= found <= 1):
                raise ValueError(f"MetallicRoughness.{name}: a number from 0 to 1 is expected, got {found!r}")
        if not (_is_number(self.ior) and self.ior > 1):
            raise ValueError(f"MetallicRoughness.ior: a finite number above 1 is expected, got {self.ior!r}")
        if not isinstance(self.emission, Texture):
            check_light(self, "emission")

    @property
    def glows(self) -> bool:
        """Whether the surface emits."""
        return isinstance(self.emission, Texture) or max(numbers(self.emission)) > 0


@dataclass(frozen=True, eq=False)
class Glow:
    """A surface whose outer side emits the same radiance in all directions; it reflects nothing."""

    radiance: float | Colour  # W m^-2 sr^-1
    flicker: Flicker | None = None  # None: steady

    def __post_init__(self) -> None:
        check_light(self, "radiance")
        check_flicker(self)


@dataclass(frozen=True, eq=False)
class Patches:
    """Materials of the parts of one mesh: of its first `counts[0]` faces, of the next `counts[1]`, and so on."""

    materials: tuple[Diffuse | RoughPlastic | Conductor | Dielectric, ...]
    counts: tuple[int, ...]

    def __post_init__(self) -> None:
        if not self.materials or len(self.materials) != len(self.counts) or min(self.counts) < 1:
            raise ValueError(
                f"Patches: as many materials as counts of faces from 1 are expected, got {len(self.materials)} and "
                f"{self.counts}"
            )
        for material in self.materials:
            if not isinstance(material, Diffuse | RoughPlastic | Conductor | Dielectric):
                raise ValueError(f"Patches: a {type(material).__name__} has no parts; give such a body its own mesh")


Material = Diffuse | RoughPlastic | Conductor | Dielectric | MetallicRoughness | Glow | Patches


def see_through(material: Material) -> bool:
    """Return whether a surface lets light pass straight on, as one with holes."""
    if not isinstance(material, MetallicRoughness):
        return False
    return isinstance(material.opacity, Texture) or material.opacity < 1


def emits(material: Material) -> bool:
    """Return whether a surface glows."""
    if isinstance(material, Glow):
        return max(numbers(material.radiance)) > 0
    return isinstance(material, MetallicRoughness) and material.glows


def _check_reflectance(material: Diffuse | RoughPlastic | MetallicRoughness) -> None:
    found = material.reflectance
    kind = type(material).__name__
    values = list(numbers(found))
    if not isinstance(found, Texture) and not (values and min(values) >= 0 and max(values) <= 1):
        raise ValueError(f"{kind}.reflectance: a number from 0 to 1 or a Texture is expected, got {found!r}")


def shows_picture(material: Material) -> bool:
    """Return whether a material places a picture on its surface: a texture or a relief."""
    if isinstance(material, Patches):
        return any(shows_picture(part) for part in material.materials)
    if getattr(material, "relief", None) is not None:
        return True
    return any(isinstance(value, Texture) for value in vars(material).values())


def _check_surface(material: Any) -> None:
    """Raise `ValueError` for a roughness outside 0 to 1, and for an index of refraction that Mitsuba does not take."""
    kind = type(material).__name__
    roughness = material.roughness
    ior = getattr(material, "ior", 1.5)
    if not (_is_number(roughness) and 0 <= roughness <= 1):
        raise ValueError(f"{kind}.roughness: a number from 0 to 1 is expected, got {roughness!r}")
    if not (_is_number(ior) and ior > 0):
        raise ValueError(f"{kind}.ior: a finite number above 0 is expected, got {ior!r}")
    if roughness > 0 and abs(ior - AIR) < 1e-6:
        raise ValueError(f"{kind}.ior: a rough surface needs an index other than that of air, got {ior!r}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))
