"""Computes white, and errors as in scores: image and truth are clamped at white before they are compared.

    white = the lower of 2.5 x the mean radiance (optics.WHITE_PER_MEAN) and the 99.9th percentile
    PSNR  = 20 log10(white / rms error), clamped; beside it the same without the clamp

The white of a clip is known when all frames are rendered. A frame therefore stores its clamped error at several whites
around the one that the pilot predicted, and the clip interpolates at its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clip_info import ClipInfo, ErrorInfo
from qsim.colour import bright_end, psnr
from qsim.optics.radiometry import WHITE_PER_MEAN

NEAR = 0.05  # largest relative difference of light between frames whose errors count as equal: 0.4 dB
STEPS = tuple(2 ** (k / 2) for k in range(-3, 4))  # whites of a frame's errors, over the predicted white


@dataclass(frozen=True)
class Errors:
    """An error with and without the clamp, rms in W m^-2 sr^-1."""

    at_white: float  # of image and truth clamped at white
    plain: float  # without a clamp

    @classmethod
    def between(cls, picture: Array, truth: Array, white: float) -> Errors:
        """Return the errors of a picture against its truth, arrays [...] of one shape."""
        return cls(rms(np.minimum(picture, white) - np.minimum(truth, white)), rms(picture - truth))

    @classmethod
    def of_halves(cls, halves: Array, white: float) -> Errors:
        """Return the errors of the mean of two independent halves [2, ...] that have noise only."""
        noise = HalvesNoise.of(halves)
        return cls(noise.error_at(white), math.sqrt(float(noise.squares.mean())))


@dataclass(frozen=True, eq=False)
class HalvesNoise:
    """What the errors of the mean of two independent halves need at any white; they have noise only."""

    picture: Array  # [...], the mean
    squares: Array  # [...], squared errors
    lower: Array  # [...], the darker half

    @classmethod
    def of(cls, halves: Array) -> HalvesNoise:
        """Return the noise of halves [2, ...]."""
        return cls(halves.mean(axis=0), (halves[0] - halves[1]) ** 2 / 4, halves.min(axis=0))

    def error_at(self, white: float) -> float:
        """Return the rms error of picture and truth clamped at white."""
        return math.sqrt(float(clamped_squares(self.squares, self.picture, self.lower, white).mean()))


@dataclass(frozen=True)
class StatedError:
    """The error of a picture, rms in W m^-2 sr^-1: without a clamp, and clamped at some whites."""

    plain: float
    at_whites: tuple[tuple[float, float], ...] = ()  # (white, error clamped there) of rising white; none without light

    @classmethod
    def of(cls, plain: float, at_whites: Sequence[Sequence[float]]) -> StatedError:
        """Return the error of any sequences."""
        return cls(plain, tuple((float(white), float(error)) for white, error in at_whites))

    def at(self, white: float) -> float:
        """Return the error clamped at a white; beyond the largest white the plain one, which is never smaller."""
        known = len(self.at_whites) and white <= self.at_whites[-1][0]
        return error_at(white, self.at_whites) if known else self.plain

    def and_more(self, more: float) -> StatedError:
        """Return the error with an independent one in addition."""
        at_whites = tuple((white, math.hypot(at_white, more)) for white, at_white in self.at_whites)
        return StatedError(math.hypot(self.plain, more), at_whites)

    def or_larger(self, other: StatedError) -> StatedError:
        """Return the larger of two errors, at each white of the first."""
        at_whites = tuple((white, max(found, other.at(white))) for white, found in self.at_whites)
        return StatedError(max(self.plain, other.plain), at_whites)


def rms(difference: Array) -> float:
    """Return the root of the mean square of an array [...]."""
    return float(np.sqrt(np.mean(np.square(difference))))


def white_of(mean: float, high: float) -> float:
    """Return white from a mean and a 99.9th percentile, in their unit; from the mean alone if the percentile is 0."""
    return min(WHITE_PER_MEAN * mean, high) if high > 0 else WHITE_PER_MEAN * mean


def white_in(radiance: Array) -> float:
    """Return the white of images [...], in the unit of the radiance."""
    return white_of(float(radiance.mean()), bright_end(radiance))


@dataclass(frozen=True, eq=False)
class Clamp:
    """What errors of a picture clamped at one white need, whatever they are without a clamp."""

    below: Array  # bool [...], the picture is below white
    distance: Array  # [...], squared distance of the darker half to white
    stray: float  # mean light above white of pixels whose darker half is below

    @classmethod
    def at(cls, white: float, picture: Array, lower: Array) -> Clamp:
        """Return the clamp of a picture [...] at white; `lower` [...] is the darker of two estimates of each pixel."""
        # Large arrays cost what their memory does: each is made once, and changed in place.
        over = picture - white
        np.maximum(over, 0, out=over)
        over *= lower < white
        distance = np.minimum(lower, white)
        np.subtract(white, distance, out=distance)
        distance *= distance
        return cls(picture < white, distance, float(np.mean(over)))

    def squares(self, squares: Array | float) -> Array:
        """Return squared errors [...] of clamped pixels from those without a clamp, as `clamped_squares`."""
        clamped = np.where(self.below, squares, self.distance)
        clamped += self.stray**2
        return clamped


def clamped_squares(squares: Array, picture: Array, lower: Array, white: float) -> Array:
    """Return squared errors [...] of pixels clamped at white, from squared errors [...] without a clamp.

    `lower` [...] is the darker of two independent estimates of each pixel. Below white the complete error counts. A
    pixel may be white because of a single bright path: its error is then the distance of its darker half to white. The
    light of such pixels above white is missing in all others, and each of them errs by its share of it.
    """
    # Light that a few bright paths bring to some pixels is missing in all others, on average: a bias of all.
    return Clamp.at(white, picture, lower).squares(squares)


def whites_around(white: float) -> list[float]:
    """Return the whites at which a frame stores its error, the predicted one in the middle."""
    return [white * step for step in STEPS]


def error_at(white: float, errors_at: Sequence[Sequence[float]]) -> float:
    """Return the clamped error at a white, interpolated in pairs (white, error) of rising white; constant beyond."""
    whites, errors = np.transpose(errors_at)
    return float(np.interp(math.log(white), np.log(whites), errors))


def over_neighbours(errors: Sequence[float], means: Sequence[float], shares: bool = False) -> list[float]:
    """Return the rms error of each frame from the estimates of the frame, of the one before and of the one after it.

    Estimates from few samples err by chance, and errors hardly change from frame to frame. A neighbour whose mean
    radiance (`means`) differs by more than NEAR, as under light that flickers, does not count. Where frames share
    samples (`shares`), the first and the last have those of one side only, and err more: they count for themselves.
    """
    squares = np.square(errors)
    lights = np.asarray(means)
    count = np.ones_like(squares)
    sums = squares.copy()
    for here, there in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
        # A relative difference: frames of other light have other errors.
        near = np.abs(lights[here] - lights[there]) <= NEAR * lights[here]
        if shares:
            near[:1] = near[-1:] = False
        sums[here] += np.where(near, squares[there], 0)
        count[here] += near
    return np.sqrt(sums / count).tolist()


def measured(
    means: Sequence[float],
    high: float,
    errors: Sequence[float],
    errors_at: Sequence[Sequence[Sequence[float]]],
    shares: bool = False,
    codes: Mapping[int, StatedError] | None = None,
) -> ErrorInfo:
    """Return what clip.json states of the errors of a clip's frames.

    `means` are the mean radiances of the frames, `high` is the 99.9th percentile of all. `errors` holds the plain error
    of each frame, `errors_at` its pairs (white, error). Where none reaches the white of the clip, the plain error
    is taken, which is never smaller. `shares` states whether the frames share samples. `codes` are the errors of codes
    by their middle frame, where frames share the noise of a code: the PSNR is that of the codes.
    """
    white = white_of(math.fsum(means) / len(means), high)
    whole = dict(sorted((codes or {}).items()))
    of_codes = [error.plain for error in whole.values()]
    if not white > 0:
        return ErrorInfo(error_per_frame=tuple(errors), error_per_code=tuple(of_codes), white=white)
    own = [StatedError.of(*both).at(white) for both in zip(errors, errors_at, strict=True)]
    own_codes = [error.at(white) for error in whole.values()]
    return ErrorInfo(
        error_per_frame=tuple(errors),
        white=white,
        error_at_white_per_frame=tuple(over_neighbours(own, means, shares)),
        error_per_code=tuple(of_codes),
        error_at_white_per_code=tuple(over_neighbours(own_codes, [means[t] for t in whole])),
        psnr_of_truth=_stored(psnr(white, rms(np.array(own_codes or own)))),
        psnr_unclamped=_stored(psnr(white, rms(np.array(of_codes or errors)))),
    )


def _stored(decibels: float) -> float | None:
    """Return a PSNR as JSON stores it: null instead of infinity, which no error gives."""
    return decibels if math.isfinite(decibels) else None


@dataclass(frozen=True)
class Stated:
    """The PSNR of a clip's radiance [dB] and its reference level."""

    psnr: float
    unclamped: float  # below the same white
    below: str  # the reference level
    frames: int = 1  # whose mean it is the PSNR of

    @property
    def line(self) -> str:
        """`38.1 dB below white (2.5 x the mean), clamped there; 35.0 dB unclamped`."""
        of = f", of the mean of {self.frames} frames and of its sharp middle" if self.frames > 1 else ""
        return f"{self.psnr:.1f} dB below {self.below}, clamped there; {self.unclamped:.1f} dB unclamped{of}"


def stated(info: ClipInfo) -> Stated | None:
    """Return the PSNR of the radiance that clip.json holds; None if none was measured."""
    if info.psnr_of_truth is None or info.psnr_unclamped is None or info.white is None:
        return None
    by_mean = math.isclose(info.white, WHITE_PER_MEAN * info.mean_radiance, rel_tol=1e-6)
    rule = f"{WHITE_PER_MEAN:g} x the mean" if by_mean else "the 99.9th percentile"
    planes = 1 if info.render is None or not info.error_per_code else info.render.planes
    return Stated(info.psnr_of_truth, info.psnr_unclamped, f"white ({rule})", planes)


def frame_errors(errors: Callable[[float], float], white: float) -> tuple[tuple[float, float], ...]:
    """Return pairs (white, error) around a predicted white, from a function of white; empty without light."""
    return tuple((each, errors(each)) for each in whites_around(white)) if white > 0 else ()
