"""Sorts the good pixels of all stacks into cells of similar light, with histograms and the spread inside a cell.

    stacks --hot pixels left out--> good pixels --smooth light of the flats--> cells (stack, group of pixels)

Inside a cell the pixels still differ by PRNU and the rest of the shading, and the frames by drift of the light. The
variance by both, `excess`, is that of all codes less that of the residuals after the means of pixel and frame. The fit
takes it as known, so its variances are those in time; `influence` states the share of every pixel in its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil, sqrt
from statistics import NormalDist

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.frame_statistics import FrameStatistics
from qsim.calibration.prnu import OUTLIER, robust_sigma, surface

MOST_GROUPS = 10
LEAST_PIXELS = 24  # of a group
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
    return np.asarray(basis @ np.linalg.lstsq(basis[good.ravel()], level[good], rcond=None)[0]).reshape(good.shape)


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
    return np.array_split(np.argsort(light, kind="stable"), count)


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
            fitted = basis @ np.linalg.lstsq(basis[inside], level[inside], rcond=None)[0]
            residual = level - fitted
            spread = max(robust_sigma(residual[inside]), sqrt(np.median(flat.pixel_variance) / flat.frames), 1e-9)
            inside = good.ravel() & (np.abs(residual) <= OUTLIER * spread)
        good &= inside.reshape(good.shape)
    return good


def _hot(stack: FrameStatistics) -> Array:
    """Return the pixels whose dark mean exceeds that of the others by more than their noise explains.

    The limit is passed by a fifth of a good pixel, all together. It allows for the skewness of few electrons.
    """
    level = stack.total / stack.frames
    in_time = stack.pixel_variance
    z = NormalDist().inv_cdf(1 - 0.2 / max(level.size, 5))
    good = level <= np.quantile(level, 0.9)
    for _ in range(30):
        centre = float(level[good].mean())
        spread = sqrt(max(float(in_time[good].mean()) / stack.frames, float(level[good].var()), 1e-12))
        third = float(((level[good] - centre) ** 3).mean()) / spread**3
        limit = centre + spread * (z + min(max(third, 0.0), 1.5) * (z * z - 1) / 6)
        now = level <= limit
        if np.array_equal(now, good):
            break
        good = now
    return ~good
