"""Sorts the good pixels of all stacks into cells of similar light, with histograms and the spread inside a cell.

    stacks --hot pixels left out--> good pixels --smooth light of the flats--> cells (stack, group of pixels)

Inside a cell the pixels still differ by PRNU and the rest of the shading, and the frames by drift of the light. The
variance by both, `excess`, is that of all codes less that of the residuals after the means of pixel and frame. The fit
takes it as known, so its variances are those in time; `influence` states the share of every pixel in its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil, inf, sqrt
from statistics import NormalDist

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.frame_statistics import FrameStatistics
from qsim.calibration.prnu import OUTLIER, robust_sigma, smooth_part, surface

MOST_GROUPS = 10
LEAST_PIXELS = 24  # of a group
MOST_SUMS = 1 << 20  # values of a sum of codes, whose law is computed exactly
WIDTH = 1.2  # most difference of light within a group, in standard deviations of one code


@dataclass(frozen=True, eq=False)
class Cell:
    """Codes of one stack in one group of pixels."""

    stack: int  # number in darks followed by flats
    pixels: Array  # [n] numbers of the good pixels
    codes: Array  # [t, n]
    mean: float  # codes
    variance: float  # codes^2, in time
    excess: float  # codes^2, between pixels and by drift; 0 of a dark stack
    influence: Array  # [n] codes^2; its mean over pixels is the error of `excess`
    level: Array  # [n] mean code of a pixel
    in_time: Array  # [n] variance of a pixel in time, without drift


def cells_of(darks: Sequence[FrameStatistics], flats: Sequence[FrameStatistics], good: Array) -> list[Cell]:
    """Return the cells of all stacks. `good` [H, W] are the pixels that are used."""
    stride = darks[0].stride
    kept = good[::stride, ::stride].ravel()
    pixels = [_codes(stack)[:, kept] for stack in (*darks, *flats)]
    light = _smooth_light(flats, good)[::stride, ::stride].ravel()[kept]
    groups = _groups(pixels[: len(darks)], pixels[len(darks) :], light)
    everything = np.arange(int(kept.sum()))
    found = [replace(_cell(i, everything, codes), excess=0.0) for i, codes in enumerate(pixels[: len(darks)])]
    for i, codes in enumerate(pixels[len(darks) :], len(darks)):
        found += [_cell(i, group, codes[:, group]) for group in groups]
    return found


def _codes(stack: FrameStatistics) -> Array:
    """Return the sampled codes [t, pixels]."""
    if stack.sample is None:
        raise ValueError("calibrate: the statistics hold no codes; make them with qsim.calibration.measure")
    return stack.sample.reshape(len(stack.sample), -1)


def _cell(stack: int, pixels: Array, codes: Array) -> Cell:
    values = codes.astype(float)
    t, n = values.shape
    mean = float(values.mean())
    residual = values - values.mean(axis=0) - values.mean(axis=1, keepdims=True) + mean
    in_time = np.einsum("tn,tn->n", residual, residual) / (t - 1) * (n / (n - 1))
    variance = float(in_time.mean())
    excess = float(values.var(ddof=1)) - variance
    influence = ((values - mean) ** 2).mean(axis=0) - in_time - excess
    return Cell(stack, pixels, codes, mean, variance, excess, influence, values.mean(axis=0), in_time)


def _smooth_light(flats: Sequence[FrameStatistics], good: Array) -> Array:
    """Return a smooth surface [H, W] that rises with the light of the flats."""
    level = np.sum([flat.total / flat.frames for flat in flats], axis=0)
    height, width = good.shape
    basis = surface((height, width), int(good.sum()))
    return smooth_part(basis, level.ravel(), good.ravel()).reshape(good.shape)


def _groups(darks: Sequence[Array], flats: Sequence[Array], light: Array) -> list[Array]:
    """Return the groups of pixels: so many that the light within one differs by less than the noise of a code."""
    base = min(float(codes.mean()) for codes in darks)
    low, high = np.quantile(light, (0.02, 0.98))
    total = sum(float(codes.mean()) for codes in flats) - base * len(flats)
    contrast = float(high - low) / max(total, 1e-9)
    wanted = 1.0
    for codes in flats:
        noise = sqrt(float(codes.astype(float).var(axis=0, ddof=1).mean()))
        wanted = max(wanted, contrast * (float(codes.mean()) - base) / (WIDTH * max(noise, 1e-9)))
    count = max(1, min(ceil(wanted), MOST_GROUPS, light.size // LEAST_PIXELS))
    return _of_equal_width(light, count)


def _of_equal_width(light: Array, count: int) -> list[Array]:
    """Return groups of pixels that span equal ranges of light; one of few pixels joins the next brighter one."""
    order = np.argsort(light, kind="stable")
    ends = np.searchsorted(light[order], np.linspace(light.min(), light.max(), count + 1)[1:-1])
    kept: list[int] = []
    for end in ends:
        if end - (kept[-1] if kept else 0) >= LEAST_PIXELS and light.size - end >= LEAST_PIXELS:
            kept.append(int(end))
    return np.split(order, kept)


def good_pixels(darks: Sequence[FrameStatistics], flats: Sequence[FrameStatistics]) -> Array:
    """Return the pixels [H, W] that are used: no hot pixel by any dark stack, no outlier of any flat."""
    good = np.ones_like(darks[0].total, dtype=bool)
    for stack in darks:
        good &= ~_hot(stack)
    for flat in flats:
        level = (flat.total / flat.frames).ravel()
        basis = surface((good.shape[0], good.shape[1]), int(good.sum()))
        inside = good.ravel().copy()
        for _ in range(3):
            residual = level - smooth_part(basis, level, inside)
            spread = max(robust_sigma(residual[inside]), sqrt(np.median(flat.pixel_variance) / flat.frames), 1e-9)
            near = good.ravel() & (np.abs(residual) <= OUTLIER * spread)
            if 2 * near.sum() < good.sum():  # most codes are alike, and the others are no outliers of them
                break
            inside = near
        good &= inside.reshape(good.shape)
    return good


def _hot(stack: FrameStatistics) -> Array:
    """Return the pixels [H, W] whose sum of dark codes exceeds what frames of the other pixels give.

    The limit is passed by a fifth of a good pixel, all together. The law of the sum is that of independent codes from
    the histogram of the pixels that stay, so it is right for rare electrons too.
    """
    codes = _codes(stack)
    total = stack.total
    sampled = total[:: stack.stride, :: stack.stride].ravel()
    chance = 0.2 / max(total.size, 5)
    good = np.ones_like(total, dtype=bool)
    limit = inf
    for _ in range(30):
        kept = codes[:, sampled <= limit]
        limit = sum_limit(np.bincount(kept.ravel()), stack.frames, chance)
        now = total <= limit
        if np.array_equal(now, good):
            break
        good = now
    return ~good


def sum_limit(histogram: Array, terms: int, chance: float) -> float:
    """Return the sum of so many independent codes of a histogram that is exceeded with a probability `chance`."""
    low, high = np.flatnonzero(histogram)[[0, -1]]
    share = histogram[low : high + 1] / histogram.sum()
    length = (len(share) - 1) * terms + 1
    codes = np.arange(len(share))
    centre = float(share @ codes)
    variance = float(share @ (codes - centre) ** 2)
    if length <= MOST_SUMS:
        size = 1 << (length - 1).bit_length()
        law = np.fft.irfft(np.fft.rfft(share, size) ** terms, size)[:length]
        above = np.cumsum(law[::-1])[::-1] - law
        return float(low * terms + np.argmax(above < chance))
    # so many terms are normal but for their skewness (Cornish and Fisher, 1938)
    z = NormalDist().inv_cdf(1 - chance)
    skew = float(share @ (codes - centre) ** 3) / max(variance, 1e-12) ** 1.5 / sqrt(terms)
    return terms * (low + centre) + sqrt(terms * variance) * (z + skew * (z * z - 1) / 6)
