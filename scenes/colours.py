"""Gives scenes of one band colours: paints, textures of two colours, warm and cool lamps, yellow sun and blue sky.

Shapes, motions and cameras stay as they are, and the mean light over the bands nearly does.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from qsim.colour import hue_from_turns
from qsim.keys import hash_name
from qsim.scene import (
    AreaLamp,
    Body,
    Constant,
    EnvironmentImage,
    Light,
    Material,
    Patches,
    PointLight,
    Scene,
    SunSky,
    Texture,
)
from qsim.scene.bands import RGB, Colour, has_colour, three

SUN = (1.12, 1.04, 0.84)  # of its mean over the bands, as all tints: a sun some way above the horizon
SKY = (0.72, 0.96, 1.32)
# lamps between incandescent and daylight
WARM = (1.38, 1.02, 0.60)
COOL = (0.88, 1.0, 1.12)
BRIGHTEST = 0.95  # of any reflectance


def coloured(scene: Scene) -> Scene:
    """Return a scene in colours that follow from its name and seed, for the bands `qsim.optics.RGB`.

    Bodies that share a material share its colours. Metals, glass and the shapes of a Mitsuba file keep their own.
    `ValueError` for a scene that states its bands already.
    """
    if scene.bands is not None:
        raise ValueError(f"scene {scene.name}: states its bands already; leave bands out")
    rng = np.random.default_rng([scene.seed, hash_name(f"colours of {scene.name}")])
    painted: dict[int, Material] = {}
    for body in scene.bodies:
        if id(body.material) not in painted:
            painted[id(body.material)] = _painted(body.material, rng)
    bodies = tuple(replace(body, material=painted[id(body.material)]) for body in scene.bodies)
    return replace(scene, bands=RGB, bodies=bodies, lights=tuple(_lit(light, rng) for light in scene.lights))


def with_parts(scene: Scene, parts: Sequence[Body], bands: Literal["rgb"] | None) -> Scene:
    """Return a scene with more bodies, which have the colours of their files; with `bands` the others are coloured."""
    if not parts:
        return scene
    base = scene if bands is None else coloured(scene)
    return replace(base, bodies=(*base.bodies, *parts))


def _painted(material: Material, rng: np.random.Generator) -> Material:
    """Return a material with its reflectance or radiance in colour."""
    if isinstance(material, Patches):
        parts: Any = tuple(_painted(part, rng) for part in material.materials)
        return replace(material, materials=parts)
    found: Any = material
    dark = _tint(rng)
    bright = _tint(rng)
    names = {field.name for field in dataclasses.fields(found)}
    if has_colour(found) or not names & {"reflectance", "radiance"}:
        return material
    if "radiance" in names:
        return replace(found, radiance=_times(found.radiance, _between(WARM, COOL, rng)))
    if not isinstance(found.reflectance, Texture):
        return replace(found, reflectance=_times(found.reflectance, bright, BRIGHTEST))
    texture: Texture = found.reflectance
    if not isinstance(texture.image, np.ndarray):
        return material  # a picture has its colours
    grey = texture.pixels()[..., None].astype(np.float64)
    share = grey / max(float(grey.max()), 1e-12)
    image = np.minimum(grey * ((1 - share) * np.array(dark) + share * np.array(bright)), BRIGHTEST)
    return replace(found, reflectance=replace(texture, image=image.astype(np.float32), scale=1.0))


def _lit(light: Light, rng: np.random.Generator) -> Light:
    """Return a light in colour; a picture of the surroundings keeps its own, or is tinted like a lamp."""
    tint = _between(WARM, COOL, rng)
    match light:
        case SunSky(sun_irradiance=sun, sky_irradiance=sky):
            return replace(light, sun_irradiance=_times(sun, SUN), sky_irradiance=_times(sky, SKY))
        case Constant(radiance) | AreaLamp(radiance=radiance):
            return replace(light, radiance=_times(radiance, tint))
        case PointLight(intensity=intensity):
            return replace(light, intensity=_times(intensity, tint))
        case EnvironmentImage(image=np.ndarray() as image) if image.ndim == 2:
            return replace(light, image=image[..., None] * np.array(tint))
    return light


def _tint(rng: np.random.Generator) -> Colour:
    """Return a random tint: any hue, saturated between 20 and 90 %."""
    saturation = rng.uniform(0.2, 0.9)
    return _of_mean_one(1 - saturation * (1 - hue_from_turns(np.array(rng.random()))))


def _between(one: Colour, other: Colour, rng: np.random.Generator) -> Colour:
    share = rng.random()
    return _of_mean_one((1 - share) * np.array(one) + share * np.array(other))


def _of_mean_one(values: np.ndarray) -> Colour:
    red, green, blue = (float(value) for value in values / values.mean())
    return red, green, blue


def _times(value: float | Colour, tint: Colour, most: float = np.inf) -> Colour:
    red, green, blue = (float(min(one * each, most)) for one, each in zip(three(value), tint, strict=True))
    return red, green, blue
