"""Describes how a lens departs from the ideal one: radial distortion, fall-off of light, and an axis off the middle.

    slope r = tangent of the angle off axis -> slope seen = r (1 + k1 r^2 + k2 r^4)

The radial terms of the model of Brown and Conrady, in the convention of OpenCV, COLMAP and nerfstudio; tangential terms
are left out. Slopes are x / z and y / z in the camera's axes. An ideal lens shows a slope as it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

KNOWN = 4097  # radii whose images are computed; the inverse starts between two of them
STEPS = 3  # of Newton's method from there; tests/qsim/optics/test_lens.py measures what they leave
STRONGEST = 100.0  # of k1 r^2 and k2 r^4 at the corner
SLOWEST = 0.02  # change of the slope seen over that of the slope, 1 on the axis: below it a picture counts as folded


@dataclass(frozen=True)
class Lens:
    """Radial distortion, fall-off and principal point of a lens; the defaults are those of an ideal lens."""

    k1: float = 0.0  # of the slope squared; below 0 barrel, above 0 pincushion
    k2: float = 0.0  # of its fourth power
    falloff: tuple[float, ...] = ()  # a of the share of light 1 + a[0] r^2 + a[1] r^4 + ..., r the slope of the ray
    shift: tuple[float, float] = (0.0, 0.0)  # of the axis from the middle, right and down, in heights of the picture

    def __post_init__(self) -> None:
        numbers = (self.k1, self.k2, *self.falloff, *self.shift)
        if len(self.shift) != 2 or not all(isinstance(n, int | float) and math.isfinite(n) for n in numbers):
            raise ValueError(f"Lens: finite numbers are expected, and two of them as shift, got {self!r}")

    @property
    def distorts(self) -> bool:
        """Whether slopes are seen elsewhere than they are."""
        return self.k1 != 0 or self.k2 != 0

    @property
    def fold(self) -> float:
        """The slope r up to which the slope seen rises with r (by SLOWEST); far beyond, it would fall again."""
        rises = np.polynomial.Polynomial([1.0 - SLOWEST, 3 * self.k1, 5 * self.k2])  # d seen / d r, in powers of r^2
        with np.errstate(over="ignore"):
            roots = np.asarray(rises.roots(), np.complex128)
        ends = roots.real[(np.abs(roots.imag) <= 1e-12 * np.abs(roots)) & (roots.real > 0)]
        return math.sqrt(float(ends.min(initial=math.inf)))

    def seen(self, slopes: Array) -> Array:
        """Return slopes [..., 2] as the lens shows them; those beyond `fold` stay on its circle, outside pictures."""
        if not self.distorts:
            return slopes
        radius = np.hypot(slopes[..., 0], slopes[..., 1])
        inside = np.minimum(radius, self.fold)
        share = inside / np.where(radius > 0, radius, 1.0)
        return slopes * (np.where(radius > 0, share, 1.0) * self._stretch(inside))[..., None]

    def traced(self, slopes: Array) -> Array:
        """Return the slopes [..., 2] of the rays that are seen at `slopes`, the inverse of `seen`.

        The slopes lie inside a picture that `check` allows.
        """
        if not self.distorts:
            return slopes
        radius = np.hypot(slopes[..., 0], slopes[..., 1])
        found = self.traced_radius(radius)
        return slopes * np.where(radius > 0, found / np.where(radius > 0, radius, 1.0), 1.0)[..., None]

    def traced_radius(self, seen: Array) -> Array:
        """Return the lengths [...] of slopes that are seen with the lengths `seen` [...], by Newton's method."""
        far, fold = float(seen.max(initial=0.0)), self.fold
        reach = min(far, fold)
        while reach < fold and reach * float(self._stretch(np.array(reach))) < far:
            reach = min(1.5 * reach, fold)
        known = np.linspace(0.0, reach, KNOWN)
        radius = np.interp(seen, known * self._stretch(known), known)
        for _ in range(STEPS):
            square = radius * radius
            off = radius * self._stretch(radius) - seen
            radius = np.clip(radius - off / (1 + square * (3 * self.k1 + 5 * self.k2 * square)), 0.0, reach)
        return radius

    def illumination(self, slopes: Array, *, natural: bool) -> Array:
        """Return the share of the axis' light that pixels at the slopes seen [..., 2] collect, [...].

        `natural` is the light of a distant even scene through a fixed pupil: the cosine of the ray's angle times the
        solid angle of the pixel, hence cos^4 and the area that the distortion gives it. Else only `falloff` counts.
        """
        square = np.sum(self.traced(slopes) ** 2, axis=-1)
        share: Array = np.polynomial.Polynomial([1.0, *self.falloff])(square)
        if not natural:
            return share
        area = (1 + self.k1 * square + self.k2 * square**2) * (1 + 3 * self.k1 * square + 5 * self.k2 * square**2)
        return share / ((1 + square) ** 2 * area)

    def check(self, corner: float) -> None:
        """Raise `ValueError` if a picture whose corner is seen at a slope of this length folds, or loses its light."""
        if abs(self.k1) * corner**2 > STRONGEST or abs(self.k2) * corner**4 > STRONGEST:
            raise ValueError(
                f"Camera.lens: k1 = {self.k1:g} and k2 = {self.k2:g} are beyond any lens; they multiply the square and "
                f"the fourth power of {corner:.4g} focal lengths, at which the corner of the picture is"
            )
        fold = self.fold
        if self.distorts and math.isfinite(fold):
            limit = fold * float(self._stretch(np.array(fold)))
            if not corner < limit:
                raise ValueError(
                    f"Camera.lens: with k1 = {self.k1:g} and k2 = {self.k2:g} the picture folds at {limit:.4g} focal "
                    f"lengths from the axis, and its corner is at {corner:.4g}; use weaker distortion or a longer lens"
                )
        far = float(self.traced_radius(np.array([corner]))[0]) ** 2
        shares = np.polynomial.Polynomial([1.0, *self.falloff])
        turns = [float(root.real) for root in shares.deriv().roots() if 0 < float(root.real) < far]
        if not min(float(shares(square)) for square in (0.0, far, *turns)) > 0:
            raise ValueError(
                f"Camera.lens: falloff {self.falloff} leaves no light inside the picture, whose corner sees a slope of "
                f"{math.sqrt(far):.4g}; its polynomial 1 + a r^2 + ... must stay above 0"
            )

    def _stretch(self, radius: Array) -> Array:
        square = radius * radius
        stretch: Array = 1 + square * (self.k1 + square * self.k2)
        return stretch
