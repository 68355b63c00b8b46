"""Renders planes that a code sums: together they have the samples, and the noise, of one sharp frame.

    instants of a code -> halves of each -> their mean, denoised or not -> light of planes, errors of planes and mean

Each plane has a few samples of its own. That in the middle has more, of which its sharp frame is made, too. Where a
denoiser is chosen, it cleans their mean only. In each half, every plane is then multiplied by the cleaned mean over the
raw one, pixel by pixel:

    F_A = A D(A) / mean of A over the planes,    F = (F_A + F_B) / 2

The planes keep their motion, are not negative, and their mean is the cleaned one. The error of a plane against its
truth follows from its own halves, as in reuse/choice.py: (F - M)^2 + (F_A - F_B)(A - B) / 2 - (A - B)^2 / 4 on average.

What this does to the noise: a plane has sqrt(planes) times the error of a code, and more where the mean is cleaned.
What is left after the mean sums to zero over the planes. Codes that begin elsewhere average it less. A binary plane is
not linear: noise of s photons lowers its mean count as s^2 / 2 photons less light would.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clamped_error import Errors, StatedError, frame_errors, white_in
from qsim.rendering.budget import Budget
from qsim.rendering.denoiser import Mixture, denoised, keeping_mean, mixture

MOST_BYTES = 2**29  # that the halves of the planes of a code may take
BYTES = 8  # of the halves of a pixel and band


@dataclass(frozen=True, eq=False)
class Planes:
    """The planes of a code."""

    first: int  # frame of the first one
    light: Array  # float32 [n, (3,) H, W], W m^-2 sr^-1
    errors: tuple[StatedError, ...]  # of each plane
    fireflies: tuple[int, ...]  # pixels with implausible samples of each plane
    error: StatedError  # of their mean
    middles: dict[int, Array]  # means [3, 2, (3,) H, W] of those in the middle of a code, by frame


def most_planes(pixels: int, bands: int = 1) -> int:
    """Return the most planes of so many pixels whose halves take MOST_BYTES."""
    return max(1, MOST_BYTES // (BYTES * pixels * bands))


def together(halves: Array, surfaces: tuple[Array, Array] | None, budget: Budget) -> tuple[Array, list[StatedError]]:
    """Return the light [n, (3,) H, W] of the planes of a code, and the errors of each and, last, of their mean.

    `halves` [n, 2, (3,) H, W] are finite; `surfaces` are albedo and normals of their mean for the denoiser, or None.
    The errors include the bounces that the budget leaves out, which repeat in all planes.
    """
    mean = halves.mean(axis=0, dtype=np.float64)
    white = budget.white or white_in(mean.mean(axis=0))
    if surfaces is None:
        raw = (*halves.astype(np.float64), mean)
        return halves.mean(axis=1), [_stated(_of_halves(each), budget, white) for each in raw]
    cleaned = np.stack([denoised(half, *surfaces, budget.quality) for half in mean])
    rough = mixture(mean, cleaned)
    mixed = keeping_mean(rough, float(mean.mean()), white)
    factor = float(mixed.picture.mean() / rough.picture.mean()) if rough.picture.any() else 1.0
    wanted = factor * (rough.share * cleaned + (1 - rough.share) * mean)
    light = np.empty(halves.shape[:1] + halves.shape[2:], np.float32)
    errors = []
    for plane, own in enumerate(halves.astype(np.float64)):
        # Each plane is multiplied by what denoising made of the mean: what all
        # planes share becomes clean, what is a plane's own stays.
        carried = np.where(mean > 0, own * (wanted / np.where(mean > 0, mean, 1)), wanted)
        light[plane] = carried.mean(axis=0)
        errors.append(_stated(_against(own, carried), budget, white))
    return light, [*errors, _stated(_of_mixture(mixed), budget, white)]


_Measured = tuple[float, Callable[[float], float]]  # error, and error clamped at a white


def _stated(measured: _Measured, budget: Budget, white: float) -> StatedError:
    """Return a measured error with the bounces that are left out."""
    plain, clamped = measured
    at_whites = frame_errors(lambda white: math.hypot(clamped(white), budget.left_out_clamped), white)
    return StatedError(math.hypot(plain, budget.left_out), at_whites)


def _of_halves(halves: Array) -> _Measured:
    return Errors.of_halves(halves, math.inf).plain, lambda white: Errors.of_halves(halves, white).at_white


def _of_mixture(mixed: Mixture) -> _Measured:
    return mixed.error, mixed.error_at


def _against(own: Array, halves: Array) -> _Measured:
    """Return the error of the mean of two halves [2, ...] of which each has noise of the same one of `own` only."""
    z = own[0] - own[1]
    picture = halves.mean(axis=0)
    # The error without the truth, from two halves: their difference z is noise alone, and its product with
    # the picture's own difference is the part of the noise that the picture kept.
    squares = (picture - own.mean(axis=0)) ** 2 + (halves[0] - halves[1]) * z / 2 - z**2 / 4
    noise = (halves[0] - halves[1]) ** 2 / 4
    return _of_mixture(Mixture(np.ones_like(z), picture, halves.min(axis=0), squares, z**2 / 4, noise))
