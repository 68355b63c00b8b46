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

    def __post_init__(self) -> None:
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


Material = Diffuse | RoughPlastic | Conductor | Dielectric | Glow | Patches


def _check_reflectance(material: Diffuse | RoughPlastic) -> None:
    found = material.reflectance
    kind = type(material).__name__
    values = list(numbers(found))
    if not isinstance(found, Texture) and not (values and min(values) >= 0 and max(values) <= 1):
        raise ValueError(f"{kind}.reflectance: a number from 0 to 1 or a Texture is expected, got {found!r}")


def shows_picture(material: Material) -> bool:
    """Return whether a material places a picture on its surface: a texture or a relief."""
    if isinstance(material, Patches):
        return any(shows_picture(part) for part in material.materials)
    return isinstance(getattr(material, "reflectance", None), Texture) or getattr(material, "relief", None) is not None


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
