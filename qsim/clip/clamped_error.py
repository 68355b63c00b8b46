"""White, and errors that count as in scores: picture and truth are clamped at white before they are compared.

    white = the lower of 2.5 x the mean radiance (optics.WHITE_PER_MEAN) and the 99.9th percentile
    PSNR  = 20 log10(white / rms error), clamped; beside it the same without the clamp

White belongs to a clip and is known when all of it is rendered. A frame therefore states its clamped error at several
whites around the one that its pilot foresaw, and the clip reads off its own. Clips of earlier versions state errors
below the 99.9th percentile, without a clamp; `stated` says which it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.colour import psnr
from qsim.optics.radiometry import WHITE_PER_MEAN

STEPS = tuple(2 ** (k / 2) for k in range(-3, 4))  # whites around the foreseen one at which a frame states its error


@dataclass(frozen=True)
class Errors:
    """The same error in two counts, rms in W m^-2 sr^-1."""

    at_white: float  # of picture and truth clamped at white
    plain: float  # without a clamp

    @classmethod
    def between(cls, picture: Array, truth: Array, white: float) -> Errors:
        """Of a picture against its truth, arrays of one shape."""
        return cls(rms(np.minimum(picture, white) - np.minimum(truth, white)), rms(picture - truth))

    @classmethod
    def of_halves(cls, halves: Array, white: float) -> Errors:
        """Of the mean of two independent halves [2, ...] with noise alone."""
        picture, squares = halves.mean(axis=0), (halves[0] - halves[1]) ** 2 / 4
        clamped = clamped_squares(squares, picture, halves.min(axis=0), white)
        return cls(math.sqrt(float(clamped.mean())), math.sqrt(float(squares.mean())))


def rms(difference: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(difference))))


def white_of(mean: float, high: float) -> float:
    """White of a mean radiance and a 99.9th percentile, in their unit; of the mean alone where nearly all is black."""
    return min(WHITE_PER_MEAN * mean, high) if high > 0 else WHITE_PER_MEAN * mean


def white_in(radiance: Array) -> float:
    """White of a picture or several, in the unit of the radiance."""
    return white_of(float(radiance.mean()), float(np.percentile(radiance, 99.9)))


def clamped_squares(squares: Array, picture: Array, lower: Array, white: float) -> Array:
    """Squared errors of a picture's pixels that count at white, from those that count without a clamp; all [...].

    `lower` is the darker of two independent estimates of each pixel. Below white all of an error counts. A pixel that
    is white may be so by a bright stray path alone: it errs by as much as its darker half lacks. What such pixels have
    above white the others lack: it is light that belongs to all, so that each of them errs by its share of it.
    """
    stray = float(np.mean(np.where(lower < white, np.maximum(picture - white, 0), 0)))
    return np.where(picture < white, squares, (white - np.minimum(lower, white)) ** 2) + stray**2


def whites_around(white: float) -> list[float]:
    """The whites at which a frame states its error, the foreseen one in the middle."""
    return [white * step for step in STEPS]


def error_at(white: float, errors_at: Sequence[Sequence[float]]) -> float:
    """The clamped error at a white, read off pairs (white, error) of rising white; beyond them that of the last."""
    whites, errors = np.transpose(errors_at)
    return float(np.interp(math.log(white), np.log(whites), errors))


def measured(
    mean: float, high: float, errors: Sequence[float], errors_at: Sequence[Sequence[Sequence[float]]]
) -> dict[str, Any]:
    """What clip.json says of the errors of a clip's frames.

    From its mean radiance, its 99.9th percentile, the plain errors [frames] and pairs (white, error) of each frame;
    where a frame has no pairs, its plain error takes their place, which is never less.
    """
    white = white_of(mean, high)
    found: dict[str, Any] = {"error_per_frame": list(errors), "white": white}
    if white > 0:
        found["error_at_white_per_frame"] = [
            error_at(white, pairs) if len(pairs) else plain for plain, pairs in zip(errors, errors_at, strict=True)
        ]
        found["psnr_of_truth"] = _stored(psnr(white, rms(np.array(found["error_at_white_per_frame"]))))
        found["psnr_unclamped"] = _stored(psnr(white, rms(np.array(errors))))
    return found


def _stored(decibels: float) -> float | None:
    """JSON has no infinity: no error is null."""
    return decibels if math.isfinite(decibels) else None


@dataclass(frozen=True)
class Stated:
    """The PSNR of a clip's radiance [dB] and what it is measured by."""

    psnr: float
    unclamped: float | None  # below the same white; None for clips of earlier versions, which know only one figure
    below: str

    @property
    def line(self) -> str:
        """`38.1 dB below white (2.5 x the mean), clamped there; 35.0 dB unclamped`."""
        unclamped = "" if self.unclamped is None else f", clamped there; {self.unclamped:.1f} dB unclamped"
        return f"{self.psnr:.1f} dB below {self.below}{unclamped}"


def stated(meta: dict[str, Any]) -> Stated | None:
    """What clip.json states of the error of its radiance; None where nothing was measured."""
    psnr, white = meta.get("psnr_of_truth"), meta.get("white")
    if psnr is None:
        return None
    if white is None:
        return Stated(psnr, None, "the 99.9th percentile (a clip of an earlier version)")
    by_mean = math.isclose(white, WHITE_PER_MEAN * meta["mean_radiance"], rel_tol=1e-6)
    rule = f"{WHITE_PER_MEAN:g} x the mean" if by_mean else "the 99.9th percentile"
    return Stated(psnr, meta.get("psnr_unclamped"), f"white ({rule})")


def frame_errors(errors: Callable[[float], float], white: float) -> tuple[tuple[float, float], ...]:
    """Pairs (white, error) around a foreseen white, from what gives the error at one; empty without light."""
    return tuple((each, errors(each)) for each in whites_around(white)) if white > 0 else ()
