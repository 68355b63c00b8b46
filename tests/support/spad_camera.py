"""A small SPAD camera of its own: binary planes of moving pictures, with dark counts and hot pixels.

    picture, motion -> light of every plane -> fired or not (NumPy's own random numbers)

It shares no code with qsim: tests and benchmarks compare the program with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array
from scipy.ndimage import gaussian_filter, map_coordinates

Scene = Callable[[float], Array]  # light [H, W] at a time in codes, 1 on average or below


def texture(size: int, seed: int, blur: float = 1.0) -> Array:
    """A periodic picture of fine and coarse structure and of sharp edges, about 0.1 to 2.5, of mean 1."""
    rng = np.random.default_rng(seed)
    found = sum(
        gaussian_filter(rng.standard_normal((size, size)), sigma, mode="wrap") * sigma for sigma in (1.0, 3.0, 9.0)
    )
    patches = gaussian_filter(rng.standard_normal((size, size)), 6, mode="wrap") > 0.02
    picture = gaussian_filter(np.exp(0.6 * found) * (0.4 + 1.2 * patches), blur, mode="wrap")
    return picture / picture.mean()


def panned(picture: Array, shape: tuple[int, int], speed: float, angle: float = 0.4) -> Scene:
    """A picture that passes by at a speed [px per code]."""

    def light(time: float) -> Array:
        y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
        move = speed * time
        return map_coordinates(picture, [y + move * np.sin(angle), x + move * np.cos(angle)], order=1, mode="grid-wrap")

    return light


def turned(picture: Array, shape: tuple[int, int], rate: float) -> Scene:
    """A picture that turns about the middle [radians per code]."""

    def light(time: float) -> Array:
        y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
        y -= shape[0] / 2
        x -= shape[1] / 2
        c = np.cos(rate * time)
        s = np.sin(rate * time)
        return map_coordinates(picture, [c * y - s * x, s * y + c * x], order=1, mode="grid-wrap")

    return light


def passing(picture: Array, shape: tuple[int, int], speed: float) -> Scene:
    """A still picture that a disc of another one crosses, a third of the frame's height wide [px per code]."""
    other = np.roll(picture, (17, 29), axis=(0, 1))
    moving = panned(other, shape, -speed, 0.0)

    def light(time: float) -> Array:
        y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
        inside = (y - shape[0] / 2) ** 2 + ((x - speed * time) % shape[1] - shape[1] / 2) ** 2 < (shape[0] / 3) ** 2
        return np.where(inside, moving(time), picture[: shape[0], : shape[1]])

    return light


def still(picture: Array, shape: tuple[int, int]) -> Scene:
    """A picture at rest."""
    return lambda time: picture[: shape[0], : shape[1]]


def stars(shape: tuple[int, int], share: float, seed: int, sky: float = 0.1) -> tuple[Scene, Array]:
    """A still sky with stars of one pixel each, and where they are [H, W]."""
    rng = np.random.default_rng(seed)
    where = rng.random(shape) < share
    light = np.where(where, np.exp(rng.uniform(np.log(0.5), np.log(8.0), shape)), sky)
    return (lambda time: light), where


@dataclass(frozen=True)
class Camera:
    """What the pixels of an array do in one plane."""

    dark: Array  # detections per plane in the dark [H, W]
    efficiency: float = 1.0

    def planes(self, scene: Scene, light: float, codes: int, planes: int, seed: int) -> Array:
        """Return bool [codes planes, H, W] of a scene with `light` photons per pixel and code of `planes` planes."""
        rng = np.random.default_rng(seed)
        found = np.empty((codes * planes, *self.dark.shape), bool)
        for n in range(len(found)):
            rate = self.efficiency * light / planes * scene(n / planes) + self.dark
            found[n] = rng.random(self.dark.shape) < -np.expm1(-rate)
        return found

    def codes(self, scene: Scene, light: float, codes: int, planes: int, seed: int) -> Array:
        """Return sums of planes, uint8 [codes, H, W], of a scene that rests during each code."""
        rng = np.random.default_rng(seed)
        found = np.empty((codes, *self.dark.shape), np.uint8)
        for n in range(codes):
            rate = self.efficiency * light / planes * scene(n + 0.5) + self.dark
            found[n] = rng.binomial(planes, -np.expm1(-rate))
        return found


def hot_map(shape: tuple[int, int], share: float, seed: int) -> tuple[Array, Array]:
    """Where hot pixels are [H, W], and their detections per plane: from a tenth to three, evenly in the logarithm."""
    rng = np.random.default_rng(seed)
    hot = rng.random(shape) < share
    return hot, np.where(hot, np.exp(rng.uniform(np.log(0.1), np.log(3.0), shape)), 0.0)
