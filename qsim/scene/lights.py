"""Lights and environments, as frozen records. A radiance, an intensity or an irradiance is a number or a colour."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from qsim.optics.camera import Pose, Vector
from qsim.scene.bands import Colour, largest, numbers
from qsim.scene.flicker import Flicker, check_flicker
from qsim.scene.motion import check_numbers

WIDEST = 1.5  # rad, the outer angle of a spot; its picture of the edge needs an end before pi / 2


@dataclass(frozen=True, eq=False)
class Constant:
    """Surroundings with the same radiance in every direction."""

    radiance: float | Colour  # W m^-2 sr^-1
    flicker: Flicker | None = None  # None: steady

    def __post_init__(self) -> None:
        check_light(self, "radiance")
        check_flicker(self)


@dataclass(frozen=True, eq=False)
class SunSky:
    """A clear sky (CIE standard general sky, type 12), a sun disk, and a ground of constant radiance below the horizon.

    Both irradiances are those in the rendered band. Azimuth 0 is +z, pi/2 is +x.
    """

    elevation: float = 0.8  # rad above the horizon; below it, only without sun_irradiance
    azimuth: float = 0.6  # rad
    sun_irradiance: float | Colour = 1.0  # W m^-2 on a plane facing the sun
    sky_irradiance: float | Colour = 0.25  # W m^-2 on the ground, sky alone
    ground_reflectance: float = 0.2  # 0..1
    sun_radius: float = 4.65e-3  # rad; the real sun's mean angular radius

    def __post_init__(self) -> None:
        check_light(self, "sun_irradiance", "sky_irradiance")
        for name, expected, right in (
            ("ground_reflectance", "a share from 0 to 1", 0 <= self.ground_reflectance <= 1),
            ("sun_radius", "an angle [rad] between 0 and pi/2", 0 < self.sun_radius < math.pi / 2),
            ("elevation", "an angle [rad] from -pi/2 to pi/2", abs(self.elevation) <= math.pi / 2),
        ):
            if not right:
                raise ValueError(f"SunSky.{name}: {expected} is needed, got {getattr(self, name)!r}")
        if self.elevation < 0 < largest(self.sun_irradiance):
            raise ValueError("SunSky.elevation: the sun is below the horizon; give sun_irradiance=0")


@dataclass(frozen=True, eq=False)
class AreaLamp:
    """A rectangle at `origin` that emits towards `target`, on that side only."""

    origin: Vector  # m
    target: Vector  # m
    width: float  # m
    height: float  # m
    radiance: float | Colour  # W m^-2 sr^-1
    motion: Pose | None = None  # in world axes: pose(t) is applied after the placement
    flicker: Flicker | None = None  # None: steady

    def __post_init__(self) -> None:
        check_light(self, "radiance")
        check_flicker(self)


@dataclass(frozen=True, eq=False)
class PointLight:
    """An isotropic point light: irradiance at distance r is intensity / r^2."""

    position: Vector  # m
    intensity: float | Colour  # W sr^-1
    motion: Pose | None = None
    flicker: Flicker | None = None  # None: steady

    def __post_init__(self) -> None:
        check_light(self, "intensity")
        check_flicker(self)


@dataclass(frozen=True, eq=False)
class SpotLight:
    """A point light in a cone: inside the inner angle irradiance is intensity / r^2, outside the outer one nothing.

    Between them it falls with the cosine's share s as s^2, which glTF's KHR_lights_punctual proposes, or where `smooth`
    as s^2 (3 - 2 s), which Blender computes.
    """

    position: Vector  # m
    direction: Vector
    intensity: float | Colour  # W sr^-1
    outer: float = math.pi / 4  # rad, from the axis to the edge; at most 1.5
    inner: float = 0.0  # rad, below the outer angle
    smooth: bool = False
    motion: Pose | None = None  # in world axes
    flicker: Flicker | None = None  # None: steady

    def __post_init__(self) -> None:
        check_light(self, "intensity")
        check_flicker(self)
        _check_direction(self)
        if not 0 <= self.inner < self.outer <= WIDEST:
            raise ValueError(
                f"SpotLight: angles [rad] 0 <= inner < outer <= {WIDEST:g} are needed, got {self.inner!r} and "
                f"{self.outer!r}"
            )


@dataclass(frozen=True, eq=False)
class DirectionalLight:
    """Parallel light from infinitely far away."""

    direction: Vector  # in which it travels
    irradiance: float | Colour  # W m^-2 on a plane across it
    motion: Pose | None = None  # in world axes; its rotation turns the direction
    flicker: Flicker | None = None  # None: steady

    def __post_init__(self) -> None:
        check_light(self, "irradiance")
        check_flicker(self)
        _check_direction(self)


@dataclass(frozen=True, eq=False)
class EnvironmentImage:
    """An equirectangular picture of radiance around the scene, zenith on top: array [H, W] or [H, W, 3], or .hdr, .exr.

    A scene of one band takes the luminance of colours.

    The first and last column meet at azimuth `rotation` + pi; the middle column is azimuth `rotation` (0 is +z).
    """

    image: np.ndarray | str
    scale: float = 1.0  # radiance per unit of the picture, W m^-2 sr^-1
    rotation: float = 0.0  # rad about +y
    flicker: Flicker | None = None  # None: steady

    def __post_init__(self) -> None:
        check_light(self, "scale")
        check_flicker(self)


Light = Constant | SunSky | AreaLamp | PointLight | SpotLight | DirectionalLight | EnvironmentImage
ENVIRONMENTS = (Constant, SunSky, EnvironmentImage)


def strength(light: Light) -> float:
    """Return a measure of a light's power that is 0 only if it emits nothing."""
    match light:
        case Constant(radiance) | AreaLamp(radiance=radiance):
            return largest(radiance)
        case SunSky(sun_irradiance=sun, sky_irradiance=sky):
            return largest(sun) + largest(sky)
        case PointLight(intensity=intensity) | SpotLight(intensity=intensity):
            return largest(intensity)
        case DirectionalLight(irradiance=irradiance):
            return largest(irradiance)
        case EnvironmentImage(image, scale):
            return scale * (1.0 if isinstance(image, str) else float(np.max(image)))
    raise ValueError(f"{light!r} is not one of the lights of qsim.scene")


def check_light(light: Any, *names: str) -> None:
    """Raise `ValueError` for places and numbers that are not finite, and for strengths below 0 under these names."""
    check_numbers(light)
    for name in names:
        found = getattr(light, name)
        if min(numbers(found), default=-1) < 0:
            raise ValueError(f"{type(light).__name__}.{name}: a finite number from 0 up is expected, got {found!r}")


def _check_direction(light: Any) -> None:
    """Raise `ValueError` for a direction of no length."""
    if not np.linalg.norm(light.direction) > 0:
        raise ValueError(f"{type(light).__name__}.direction: a vector other than zero is needed")
