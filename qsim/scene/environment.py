"""Computes equirectangular radiance maps of the surroundings: a clear sky, its sun, and environment images.

    SunSky, EnvironmentImage -> float32 [H, W] radiance [W m^-2 sr^-1], row 0 at the zenith

Column u (0..1 from left to right) has azimuth pi - 2 pi u: +z is in the middle and +x left of it, seen from inside.
Mitsuba's own sun and sky do not support monochrome. The CIE model needs no table and keeps both irradiances.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim.colour import luminance
from qsim.scene.bands import Colour, three
from qsim.scene.image_files import read_hdr
from qsim.scene.lights import EnvironmentImage, SunSky

RINGING = 0.05  # of an environment's mean; free maps of 1024 x 512 px hold -0.03
SKY_ROWS = 128  # of both halves; the sky is smooth, and the sun is a separate disk

# CIE S 011/E:2003, standard general sky, type 12 "CIE standard clear sky, low luminance turbidity".
_A = -1.0
_B = -0.32
_C = 10.0
_D = -3.0
_E = 0.45


def sun_direction(light: SunSky) -> Array:
    """Return the unit vector towards the sun in world axes, float64 [3]."""
    horizontal = math.cos(light.elevation)
    return np.array(
        [horizontal * math.sin(light.azimuth), math.sin(light.elevation), horizontal * math.cos(light.azimuth)]
    )


def sun_radiance(light: SunSky) -> float | Colour:
    """Return the disk's radiance [W m^-2 sr^-1], a colour if the sun has one: irradiance / (pi sin^2 radius)."""
    area = math.pi * math.sin(light.sun_radius) ** 2
    if isinstance(light.sun_irradiance, tuple):
        red, green, blue = light.sun_irradiance
        return red / area, green / area, blue / area
    return light.sun_irradiance / area


def sky_map(light: SunSky, rows: int = SKY_ROWS) -> Array:
    """Return radiance of sky (above) and ground (below) without the sun's disk: float32 [rows, 2 rows], rows even.

    It is [rows, 2 rows, 3] if sun or sky has a colour.

    Relative sky radiance = phi(Z) f(chi), phi(Z) = 1 + a exp(b / cos Z), f(chi) = 1 + c (exp(d chi) - exp(d pi/2))
    + e cos^2 chi, with zenith distance Z and angle chi from the sun, scaled to the requested irradiance.
    """
    zenith = (np.arange(rows) + 0.5)[:, None] / rows * np.pi
    azimuth = np.pi - 2 * np.pi * (np.arange(2 * rows) + 0.5)[None, :] / (2 * rows)
    up = np.cos(zenith) + 0 * azimuth
    direction = np.stack([np.sin(zenith) * np.sin(azimuth), up, np.sin(zenith) * np.cos(azimuth)], -1)
    chi = np.arccos(np.clip(direction @ sun_direction(light), -1, 1))
    # Towards the horizon 1 / cos Z diverges; b < 0 sends the
    # exponential to 0 there, and the bound avoids a division by 0.
    phi = 1 + _A * np.exp(_B / np.maximum(up, 1e-3))
    sky = phi * (1 + _C * (np.exp(_D * chi) - math.exp(_D * np.pi / 2)) + _E * np.cos(chi) ** 2)
    above = up > 0
    # Both angles have steps of pi / rows. The sum over the upper half is the irradiance of a level surface.
    solid_angle = np.sin(zenith) * (np.pi / rows) ** 2
    irradiance = float(np.sum((sky * up * solid_angle)[above]))

    def seen(sun: float, blue: float) -> Array:
        """Return the map of one band from the irradiance of sun and sky."""
        # Lambertian ground: radiance = reflectance x irradiance / pi.
        sunlit = sun * max(math.sin(light.elevation), 0.0)
        ground = light.ground_reflectance * (sunlit + blue) / np.pi
        return np.where(above, sky * blue / irradiance, ground).astype(np.float32)

    sun = light.sun_irradiance
    blue = light.sky_irradiance
    if isinstance(sun, tuple) or isinstance(blue, tuple):
        return np.stack([seen(*each) for each in zip(three(sun), three(blue), strict=True)], axis=-1)
    return seen(sun, blue)


def environment_map(light: EnvironmentImage, *, colours: bool = False) -> Array:
    """Return the picture in W m^-2 sr^-1, float32 [H, W]; `ValueError` or `FileNotFoundError` with the file's name.

    With `colours` a picture in colour stays one, [H, W, 3].

    Slightly negative radiance, down to -RINGING times the mean, is an artefact of compressed files and becomes 0.
    """
    picture = read_hdr(Path(light.image)) if isinstance(light.image, str) else np.asarray(light.image, np.float32)
    if picture.ndim == 3:
        picture = picture[..., :3] if colours and picture.shape[2] >= 3 else luminance(picture[..., :3])
    where = light.image if isinstance(light.image, str) else "EnvironmentImage.image"
    if picture.ndim in (2, 3) and not np.isfinite(picture).all():
        bad = np.argwhere(~np.isfinite(picture))
        y, x = (int(i) for i in bad[0][:2])
        raise ValueError(
            f"{where}: {len(np.unique(bad[:, :2], axis=0))} pixels are infinite or NaN, the first at (y, x) = "
            f"({y}, {x}); replace them by the largest true radiance"
        )
    if picture.ndim not in (2, 3) or picture.size == 0:
        raise ValueError(f"{where}: expected finite radiance [H, W] of at least 0, found shape {picture.shape}")
    if picture.min() < -RINGING * abs(picture.mean()):
        raise ValueError(f"{where}: expected finite radiance [H, W] of at least 0, found {picture.min():.3g}")
    return (np.maximum(picture, 0) * light.scale).astype(np.float32)
