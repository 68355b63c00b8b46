"""Provides what all families share: camera, walls, floors, textures and lights, chosen by a random generator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from qsim.optics.camera import Camera
from qsim.scene import (
    AreaLamp,
    Body,
    Diffuse,
    EnvironmentImage,
    Material,
    Motion,
    Patches,
    RoughPlastic,
    SunSky,
    Texture,
    textures,
)
from qsim.scene.rotation import UP, exponential, pose_matrix, unit, vector
from qsim.scene.shapes import moved, sheet

# pixels; other sizes by Scene.resized, which keeps the height of the view
HEIGHT = 512
WIDTH = 1024
FRAME_RATE = 2000.0  # Hz, the rate at which speed = 1 is defined
PITCH = 1.1e-6  # m
PHOTOGRAPHS = ("cat", "coffee", "astronaut", "rocket", "coins", "moon", "camera")
CLIP = 0.016  # s, 33 frames; thrown bodies pass their middle at half of it

T = TypeVar("T")


def camera(origin: ArrayLike, target: ArrayLike, view: float = 0.5, motion: Motion | None = None) -> Camera:
    """Return a small f/2.8 camera with a vertical field of `view` [rad]."""
    focal_length = HEIGHT * PITCH / 2 / np.tan(view / 2)
    return Camera(
        focal_length=float(focal_length),
        f_number=2.8,
        pixel_pitch=PITCH,
        height=HEIGHT,
        width=WIDTH,
        origin=vector(origin),
        target=vector(target),
        motion=motion,
    )


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a uniform random number from `low` to `high`."""
    return float(rng.uniform(low, high))


def any_angle(rng: np.random.Generator) -> float:
    """Return a uniform random angle from 0 to 2 pi [rad]."""
    return between(rng, 0.0, 2 * np.pi)


def sign(rng: np.random.Generator) -> float:
    """Return -1 or 1, equally likely."""
    return float(rng.choice((-1.0, 1.0)))


def pick(rng: np.random.Generator, options: Sequence[T]) -> T:
    """Return one of the options, all equally likely."""
    return options[int(rng.integers(len(options)))]


def direction(rng: np.random.Generator) -> tuple[float, float, float]:
    """Return a random unit vector, all directions equally likely."""
    return vector(unit(rng.standard_normal(3)))


def surface(rng: np.random.Generator, low: float = 0.05, high: float = 0.85) -> Texture:
    """Return a random texture for a body, its range stretched to `low` .. `high`."""
    kind = int(rng.integers(8))
    if kind == 0:
        return Texture(textures.checker(2 * int(rng.integers(2, 6)), 2 * int(rng.integers(2, 6)), low, high))
    if kind == 1:
        return Texture(textures.stripes(int(rng.integers(6, 20)), low, high))
    if kind == 2:
        return Texture(textures.dots(int(rng.integers(5, 14)), low, high))
    if kind == 3:
        return Texture(textures.levels(textures.speckles(rng, 900), low, high))
    if kind == 4:
        return Texture(textures.levels(textures.rings(rng), low, high))
    if kind == 5:
        return Texture(textures.levels(textures.cells(rng, 60), low, high))
    if kind == 6:
        return Texture(textures.levels(textures.noise(rng, slope=rng.uniform(0.7, 1.3)), low, high, contrast=2.0))
    return textures.photograph(
        pick(rng, ("cat", "coffee", "astronaut", "rocket", "coins", "moon", "camera")), low, high
    )


def backdrop(rng: np.random.Generator, low: float = 0.08, high: float = 0.75) -> Texture:
    """Return a random texture for a wall about one view high; it repeats if it tiles."""
    kind = int(rng.integers(7))
    if kind == 0:
        return Texture(textures.levels(textures.bricks(rng), low, high), repeat=(2.0, 1.0))
    if kind == 1:
        return Texture(textures.levels(textures.cells(rng, 150, 768), low, high), repeat=(2.0, 1.0))
    if kind == 2:
        return Texture(textures.levels(textures.speckles(rng, 2500, 768), low, high), repeat=(2.0, 1.0))
    if kind == 3:
        return Texture(textures.levels(textures.noise(rng, (1024, 1024), 1.1), low, high, 1.5), repeat=(2.0, 1.0))
    return textures.photograph(("brick", "gravel", "grass")[kind - 4], low, high, repeat=(2.0, 1.0))


def wall(material: Material, width: float = 6.0, height: float = 3.0, z: float = 0.0, y: float = 0.0) -> Body:
    """Return an upright rectangle [m] facing +z."""
    return Body("wall", moved(sheet(width, height), pose_matrix(None, (0.0, y, z))), material)


def floor(material: Material, size: float = 6.0, y: float = 0.0, z: float = 0.0) -> Body:
    """Return a horizontal square [m] facing up."""
    return Body("floor", moved(sheet(size, size), pose_matrix(exponential((-np.pi / 2, 0, 0)), (0.0, y, z))), material)


def paint(rng: np.random.Generator, texture: Texture) -> Material:
    """Return a matt or slightly glossy material, by chance."""
    return Diffuse(texture) if rng.random() < 0.5 else RoughPlastic(texture, roughness=between(rng, 0.15, 0.4))


def finished(own: Material, drawn: Material) -> Material:
    """Return the colours of a mesh file as matt or glossy as a drawn material, with white at a reflectance of 0.9."""
    if isinstance(own, Patches):
        parts: Any = tuple(finished(part, drawn) for part in own.materials)
        return replace(own, materials=parts)
    assert isinstance(own, Diffuse)
    assert isinstance(own.reflectance, Texture)
    colours = replace(own.reflectance, scale=0.9)
    return replace(drawn, reflectance=colours) if isinstance(drawn, RoughPlastic) else Diffuse(colours)


def sun(rng: np.random.Generator, low: float = 0.5, high: float = 1.1, strength: float = 6.0) -> SunSky:
    """Return sun and sky in front, left or right of the camera (which faces -z)."""
    return SunSky(
        elevation=between(rng, low, high),
        azimuth=between(rng, -1.0, 1.0),
        sun_irradiance=strength * between(rng, 0.7, 1.3),
        sky_irradiance=strength * between(rng, 0.2, 0.5),
    )


def lamp(rng: np.random.Generator, target: ArrayLike, distance: float = 2.5, power: float = 12.0) -> AreaLamp:
    """Return a soft lamp above and beside the camera, directed at `target`."""
    side = pick(rng, (-1.0, 1.0)) * rng.uniform(0.4, 0.9)
    away = unit((side, rng.uniform(0.5, 0.9), rng.uniform(0.7, 1.0)))
    size = between(rng, 0.5, 1.0)
    return AreaLamp(
        origin=vector(np.asarray(target) + distance * away),
        target=vector(target),
        width=size,
        height=size,
        radiance=power / size**2,
    )


def studio(rng: np.random.Generator, strength: float = 0.6, boxes: int = 5) -> EnvironmentImage:
    """Return a studio: soft boxes, grey walls, a dark floor; mean radiance `strength` [W m^-2 sr^-1]."""
    height = 64
    width = 128
    up = (0.5 - (np.arange(height)[:, None] + 0.5) / height) * np.pi  # elevation [rad]
    azimuth = ((np.arange(width)[None, :] + 0.5) / width - 0.5) * 2 * np.pi
    room = 0.25 + 0.15 * np.sin(up) + 0.05 * np.cos(azimuth) + 0.1 * (up > 0.9)
    for i in range(boxes):
        at = (between(rng, 0.1, 1.0), between(rng, -1.6, 1.6) if i < 3 else any_angle(rng) - np.pi)
        size = (between(rng, 0.12, 0.35), between(rng, 0.12, 0.5))
        aside = np.abs(np.angle(np.exp(1j * (azimuth - at[1]))))
        cover = np.clip((size[0] - np.abs(up - at[0])) / 0.06, 0, 1) * np.clip((size[1] - aside) / 0.06, 0, 1)
        room = np.maximum(room, cover * between(rng, 2.0, 5.0))
    mean = float(np.average(room, weights=np.broadcast_to(np.cos(up), room.shape)))
    return EnvironmentImage(room / mean, scale=strength)


def upright(yaw: float) -> tuple[float, float, float]:
    """Return the rotation vector of a rotation by `yaw` [rad] about the vertical."""
    return vector(yaw * np.asarray(UP))
