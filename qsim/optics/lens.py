"""Describes how a lens departs from the ideal one: distortion, fall-off of light, an axis off the middle, wide pixels.

    slopes (x, y) of a ray, r^2 = x^2 + y^2 -> slopes seen:
    x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + 2 p1 x y + p2 (r^2 + 2 x^2), times the aspect
    y (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 y^2) + 2 p2 x y

The model of Brown and Conrady: radial and tangential terms in the convention of OpenCV, COLMAP and nerfstudio. Slopes
are x / z and y / z in the camera's axes, x right and y down. An ideal lens shows a slope as it is.

With q = (p2, p1) the tangential part is r^2 q + 2 (q . x) x. Where the slope seen rises with the slope of the ray by at
least SLOWEST in every direction, the lens is one to one; `fold` is the radius of the largest such disk. The derivative
is a symmetric matrix and smallest along -q, so that both follow from polynomials in r.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.kinds import Number

KNOWN = 4097  # radii whose images are computed; the inverse starts between two of them
STEPS = 3  # of Newton's method from there; tests/qsim/optics/test_lens.py measures what they leave
TANGENTIAL_STEPS = 40  # at most, of the damped method for lenses with tangential terms; a usual one needs four
HALVINGS = 20  # of one of these steps
ROUNDING = 4e-16  # relative error of a slope from which no step makes it better
STRONGEST = 100.0  # of k1 r^2, k2 r^4, ... and 6 |p| r at the corner
SLOWEST = 0.02  # change of the slope seen over that of the slope, 1 on the axis: below it a picture counts as folded
ASPECTS = (0.1, 10.0)  # least and largest aspect
SMALLEST = 1e-100  # of a coefficient; one below changes no slope in any picture
IF_SET: dict[str, Any] = {"described": "if any"}


@dataclass(frozen=True)
class Lens:
    """Distortion, fall-off and principal point of a lens, and the pixels' shape; the defaults are an ideal lens."""

    k1: Number = 0.0  # of the slope squared; below 0 barrel, above 0 pincushion
    k2: Number = 0.0  # of its fourth power
    falloff: tuple[Number, ...] = ()  # a of the share of light 1 + a[0] r^2 + a[1] r^4 + ..., r the slope of the ray
    shift: tuple[Number, Number] = (0.0, 0.0)  # of the axis from the middle, right and down, in heights of the picture
    k3: Number = field(default=0.0, metadata=IF_SET)  # of its sixth power
    k4: Number = field(default=0.0, metadata=IF_SET)  # of its eighth power
    p1: Number = field(default=0.0, metadata=IF_SET)  # tangential, downwards
    p2: Number = field(default=0.0, metadata=IF_SET)  # tangential, to the right
    aspect: Number = field(default=1.0, metadata=IF_SET)  # fl_x / fl_y: a pixel's height over its width

    def __post_init__(self) -> None:
        numbers = (*self.terms.values(), self.aspect, *self.falloff, *self.shift)
        if len(self.shift) != 2 or not all(isinstance(n, int | float) and math.isfinite(n) for n in numbers):
            raise ValueError(f"Lens: finite numbers are expected, and two of them as shift, got {self!r}")
        least, most = ASPECTS
        if not least <= self.aspect <= most:
            raise ValueError(f"Lens.aspect, fl_x over fl_y, must be in [{least:g}, {most:g}], got {self.aspect!r}")

    @property
    def terms(self) -> dict[str, float]:
        """The coefficients of the distortion by name."""
        return {name: getattr(self, name) for name in ("k1", "k2", "k3", "k4", "p1", "p2")}

    @property
    def bends(self) -> bool:
        """Whether the lens distorts in the narrow sense: whether straight lines are seen as curves."""
        return any(term != 0 for term in self.terms.values())

    @property
    def distorts(self) -> bool:
        """Whether slopes are seen elsewhere than they are."""
        return self.bends or self.aspect != 1

    @property
    def tangential(self) -> float:
        """The length of (p1, p2)."""
        return math.hypot(self.p1, self.p2)

    @functools.cached_property
    def fold(self) -> float:
        """The slope r up to which the slope seen rises with r (by SLOWEST); far beyond, it would fall again."""
        radial = [1.0 - SLOWEST, 3 * self.k1, 5 * self.k2, 7 * self.k3, 9 * self.k4]  # d seen / d r, in powers of r^2
        if not self.tangential:
            return math.sqrt(_first_root(radial))
        # In powers of r, on the ray along -q: the derivative along it, and across it 1 + k1 r^2 + ... - 2 |q| r less
        # 4/3 |q| r, with which both eigenvalues reach SLOWEST on every other ray, too.
        along = np.zeros(9)
        across = np.zeros(9)
        along[::2] = radial
        across[::2] = 1.0 - SLOWEST, self.k1, self.k2, self.k3, self.k4
        along[1] = -6 * self.tangential
        across[1] = -10 / 3 * self.tangential
        return min(_first_root(along), _first_root(across))

    def seen(self, slopes: Array) -> Array:
        """Return slopes [..., 2] as the lens shows them; those beyond `fold` stay on its circle, outside pictures."""
        if not self.bends:
            return self._widened(slopes)
        radius = np.hypot(slopes[..., 0], slopes[..., 1])
        inside = np.minimum(radius, self.fold)
        share = np.where(radius > 0, inside / np.where(radius > 0, radius, 1.0), 1.0)
        if self.tangential:
            return self._widened(self._bent(slopes * share[..., None]))
        return self._widened(slopes * (share * self._stretch(inside))[..., None])

    def traced(self, slopes: Array) -> Array:
        """Return the slopes [..., 2] of the rays that are seen at `slopes`, the inverse of `seen`.

        The slopes lie inside a picture that `check` allows.
        """
        if self.aspect != 1:
            slopes = slopes / (self.aspect, 1.0)
        if not self.bends:
            return slopes
        radial = replace(self, p1=0.0, p2=0.0) if self.tangential else self
        radius = np.hypot(slopes[..., 0], slopes[..., 1])
        found = radial.traced_radius(radius)
        start: Array = slopes * np.where(radius > 0, found / np.where(radius > 0, radius, 1.0), 1.0)[..., None]
        return self._refined(start, slopes) if self.tangential else start

    def traced_radius(self, seen: Array) -> Array:
        """Return the lengths [...] of the longest slopes seen with the lengths `seen` [...], by Newton's method.

        Without tangential terms, all that are seen with this length are as long.
        """
        far = float(seen.max(initial=0.0))
        fold = self.fold
        reach = min(far, fold)
        while reach < fold and reach * float(self._least_stretch(np.array(reach))) < far:
            reach = min(1.5 * reach, fold)
        known = np.linspace(0.0, reach, KNOWN)
        # A table gives the start, near enough for Newton's method to double its digits in every step.
        radius = np.interp(seen, known * self._least_stretch(known), known)
        for _ in range(STEPS):
            off = radius * self._least_stretch(radius) - seen
            radius = np.clip(radius - off / self._least_rise(radius), 0.0, reach)
        return radius

    def illumination(self, slopes: Array, *, natural: bool) -> Array:
        """Return the share of the axis' light that pixels at the slopes seen [..., 2] collect, [...].

        `natural` is the light of a distant even scene through a fixed pupil: the cosine of the ray's angle times the
        solid angle of the pixel, hence cos^4 and the area that the distortion gives it. Else only `falloff` counts.
        """
        rays = self.traced(slopes)
        square = np.sum(rays**2, axis=-1)
        share: Array = np.polynomial.Polynomial([1.0, *self.falloff])(square)
        if not natural:
            return share
        if self.tangential:
            across, mixed, down = self._derivative(rays)
            area = across * down - mixed**2
        else:
            # The area of a pixel's slopes over that which is seen: stretch
            # along the circle times stretch along the radius.
            area = 1 + self.k1 * square + self.k2 * square**2 + self.k3 * square**3 + self.k4 * square**4
            rise = 1 + 3 * self.k1 * square + 5 * self.k2 * square**2 + 7 * self.k3 * square**3
            area = area * (rise + 9 * self.k4 * square**4)
        return share / ((1 + square) ** 2 * area)

    def check(self, corner: float) -> None:
        """Raise `ValueError` if a picture whose corner is seen at a slope of this length folds, or loses its light.

        The length is that before the aspect widens it.
        """
        stated = " and ".join(f"{name} = {term:g}" for name, term in self.terms.items() if term != 0)
        radial = enumerate((self.k1, self.k2, self.k3, self.k4), 1)
        with np.errstate(over="ignore"):
            strengths = [abs(k) * float(np.float64(corner) ** (2 * i)) for i, k in radial if k != 0]
        if max(*strengths, 6 * self.tangential * corner, 0.0) > STRONGEST:
            raise ValueError(
                f"Camera.lens: {stated} are beyond any lens at the corner of the picture, which is at {corner:.4g} "
                "focal lengths"
            )
        fold = self.fold
        if self.bends and math.isfinite(fold):
            limit = fold * float(self._least_stretch(np.array(fold)))
            if not corner < limit:
                raise ValueError(
                    f"Camera.lens: with {stated} the picture folds at {limit:.4g} focal lengths from the axis, and its "
                    f"corner is at {corner:.4g}; use weaker distortion or a longer lens"
                )
        # The falloff is least at the axis, at the corner, or where its polynomial turns between them.
        far = float(self.traced_radius(np.array([corner]))[0]) ** 2
        shares = np.polynomial.Polynomial([1.0, *self.falloff])
        turns = [float(root.real) for root in shares.deriv().roots() if 0 < float(root.real) < far]
        if not min(float(shares(square)) for square in (0.0, far, *turns)) > 0:
            raise ValueError(
                f"Camera.lens: falloff {self.falloff} leaves no light inside the picture, whose corner sees a slope of "
                f"{math.sqrt(far):.4g}; its polynomial 1 + a r^2 + ... must stay above 0"
            )

    def _widened(self, slopes: Array) -> Array:
        return slopes if self.aspect == 1 else slopes * (self.aspect, 1.0)

    def _stretch(self, radius: Array) -> Array:
        square = radius * radius
        stretch: Array = 1 + square * (self.k1 + square * (self.k2 + square * (self.k3 + square * self.k4)))
        return stretch

    def _least_stretch(self, radius: Array) -> Array:
        """Return the length of the slope seen over that of the slope, where the tangential part shortens it most."""
        stretch = self._stretch(radius)
        return stretch - 3 * self.tangential * radius if self.tangential else stretch

    def _least_rise(self, radius: Array) -> Array:
        """Return the derivative of `radius * _least_stretch(radius)`."""
        square = radius * radius
        more = 5 * self.k2 + square * (7 * self.k3 + 9 * self.k4 * square)
        rise: Array = 1 + square * (3 * self.k1 + more * square)
        return rise - 6 * self.tangential * radius if self.tangential else rise

    def _bent(self, slopes: Array) -> Array:
        """Return slopes [..., 2] within `fold` as radial and tangential terms show them."""
        square = np.sum(slopes**2, axis=-1)[..., None]
        pull = np.array([self.p2, self.p1])
        along = np.sum(slopes * pull, axis=-1)[..., None]
        # Brown (1966), as OpenCV has it: x (1 + k1 r^2 + ...) + 2 p1 x y +
        # p2 (r^2 + 2 x^2), and y with p1 and p2 exchanged.
        bent: Array = slopes * (self._stretch(np.sqrt(square)) + 2 * along) + square * pull
        return bent

    def _derivative(self, slopes: Array) -> tuple[Array, Array, Array]:
        """Return d x seen / d x, d x seen / d y (which is d y seen / d x) and d y seen / d y, [...] each."""
        x = slopes[..., 0]
        y = slopes[..., 1]
        square = x * x + y * y
        stretch = self._stretch(np.sqrt(square))
        slope = self.k1 + square * (2 * self.k2 + square * (3 * self.k3 + square * 4 * self.k4))  # d stretch / d r^2
        across = stretch + 2 * x * x * slope + 6 * self.p2 * x + 2 * self.p1 * y
        down = stretch + 2 * y * y * slope + 6 * self.p1 * y + 2 * self.p2 * x
        return across, 2 * x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y, down

    def _refined(self, start: Array, seen: Array) -> Array:
        """Return the slopes [..., 2] that are seen at `seen`, near `start`, by a damped Newton's method.

        `_bent` is the gradient of a convex function within `fold`, so that a step always leads nearer if it is halved
        often enough.
        """
        found = self._within(start)
        off = self._bent(found) - seen
        error = np.hypot(off[..., 0], off[..., 1])
        enough = ROUNDING * np.hypot(seen[..., 0], seen[..., 1])
        for _ in range(TANGENTIAL_STEPS):
            across, mixed, down = self._derivative(found)
            area = across * down - mixed**2
            # Newton's step: the inverse of a symmetric 2 x 2 matrix times what is off.
            step = np.stack([down * off[..., 0] - mixed * off[..., 1], across * off[..., 1] - mixed * off[..., 0]], -1)
            step = step / area[..., None]
            better = np.zeros(error.shape, bool)
            for _ in range(HALVINGS):
                trial = self._within(found - step)
                trial_off = self._bent(trial) - seen
                trial_error = np.hypot(trial_off[..., 0], trial_off[..., 1])
                better = trial_error < error
                if (better | (error <= 1e-13)).all():
                    break
                step = np.where(better[..., None], step, step / 2)
            found = np.where(better[..., None], trial, found)
            off = np.where(better[..., None], trial_off, off)
            error = np.where(better, trial_error, error)
            if not (better & (error > enough)).any():
                break
        return found

    def _within(self, slopes: Array) -> Array:
        """Return slopes [..., 2], those beyond `fold` on its circle."""
        radius = np.hypot(slopes[..., 0], slopes[..., 1])
        share: Array = np.minimum(1.0, self.fold / np.maximum(radius, 1e-300))
        return slopes * share[..., None]


def _first_root(coefficients: Any) -> float:
    """Return the least root above 0 of a polynomial, by its coefficients from the constant up; inf without one."""
    kept = [c if abs(c) >= SMALLEST else 0.0 for c in coefficients]
    roots = np.asarray(np.polynomial.Polynomial(kept).roots(), np.complex128)
    ends = roots.real[(np.abs(roots.imag) <= 1e-12 * np.abs(roots)) & (roots.real > 0)]
    return float(ends.min(initial=math.inf))
