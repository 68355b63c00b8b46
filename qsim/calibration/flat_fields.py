"""Subtracts each pixel's dark level from flat fields of a SPAD array or a QIS; prnu.py measures PRNU in them.

SPAD: arrivals = inverse of the exact mean code; dark rate of every pixel from all dark frames
QIS:  mean codes; dark level of every pixel from the dark frames of the flat's exposure, or a line through them
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.frame_statistics import FrameStatistics
from qsim.calibration.prnu import WIDEST, Flat, hot_by_level, hot_by_rate, surface
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS


@dataclass(frozen=True, eq=False)
class Response:
    """Exact curve of mean code against arrivals of one pixel, with the measured dead time, and its inverse."""

    bits: int
    ratio: float  # dead time in exposures of `exposure`; 0 for 1-bit planes
    paralyzable: bool
    exposure: float  # s

    def at(self, exposure: float) -> Response:
        """Return the curve of the same pixel at another exposure [s]."""
        return replace(self, ratio=self.ratio * (self.exposure / exposure), exposure=exposure)

    def table(self, largest: float) -> tuple[Array, Array]:
        """Return (arrivals, mean code) [G], rising, up to a mean of `largest` or to the maximum of the mean."""
        top = 2 * largest + 10
        for _ in range(12):
            arrivals = np.linspace(0, np.sqrt(top), 1500) ** 2
            codes = self.mean(arrivals)
            end = int(np.argmax(codes))
            if codes[end] >= largest or end < len(codes) - 1:
                break
            top *= 2
        return arrivals[: end + 1], codes[: end + 1]

    def mean(self, arrivals: Array) -> Array:
        """Return the exact expected code at arrivals per exposure, any shape."""
        if self.bits == 1:
            return -np.expm1(-arrivals)
        return CountingSPAD(1.0, 0.0, self.ratio, self.bits, self.paralyzable).mean(arrivals, 1.0)

    def of_stack(self, stack: FrameStatistics) -> tuple[Array, Array, float]:
        """Return arrivals per exposure of every pixel and their variance, both [H, W], and d code / d arrivals.

        The bias of a curved inverse, f''/2 times the variance of the pixel's mean, is subtracted.
        """
        t = stack.frames
        mean = stack.total / t
        if self.bits == 1:
            mean = np.minimum(mean, 1 - 0.5 / t)
        arrivals, codes = self.at(stack.exposure).table(float(mean.max()))
        found = np.interp(mean, codes, arrivals)
        at = np.interp(stack.mean, codes, arrivals)
        slope_table = np.gradient(codes, arrivals)
        slope = float(np.interp(at, arrivals, slope_table))
        variance = np.where(stack.pixel_variance > 0, stack.pixel_variance, 0.0) if t > 1 else mean
        slopes = np.interp(found, arrivals, slope_table)
        curvature = np.interp(found, arrivals, np.gradient(slope_table, arrivals))
        found = found + 0.5 * curvature / slopes**3 * variance / t
        return np.maximum(found, 0.0), variance / (t * slopes**2), slope


def dark_rates(darks: Sequence[FrameStatistics], response: Response) -> tuple[Array, Array]:
    """Return the DCR of every pixel [1/s] from all exposures, and its variance, both [H, W]."""
    weight = np.array([stack.frames * stack.exposure for stack in darks])
    weight = weight / weight.sum()
    rate, variance = np.zeros(darks[0].total.shape), np.zeros(darks[0].total.shape)
    for stack, share in zip(darks, weight, strict=True):
        arrivals, of_arrivals, _ = response.of_stack(stack)
        rate += share * arrivals / stack.exposure
        variance += of_arrivals * (share / stack.exposure) ** 2
    return rate, variance


def spad_flats(
    flats: Sequence[FrameStatistics], darks: Sequence[FrameStatistics], response: Response
) -> tuple[list[Flat], Array | None]:
    """Return the flats of a SPAD array, and the hot pixels [H, W] by the dark frames; None without dark frames."""
    shape = flats[0].total.shape
    rate, of_rate = dark_rates(darks, response) if darks else (np.zeros(shape), np.zeros(shape))
    hot = hot_by_rate(rate * sum(s.frames * s.exposure for s in darks)) if darks else None
    good = np.ones(shape, bool) if hot is None or hot.all() else ~hot
    found = []
    for flat in flats:
        if flat.frames < 2:
            continue
        mean = flat.total / flat.frames
        dark = rate * flat.exposure
        average = float(dark[good].mean())
        arrivals, _, _ = response.of_stack(flat)
        light, codes = _table(mean, good, partial(_above, response.mean, average), float(arrivals[good].max()))
        if response.bits == 1:  # exact: 1 - code is a product of light and dark
            slope = 1 - mean
            level = 1 - slope * np.exp(np.minimum(dark - average, 30.0))
        else:
            slope = np.interp(arrivals - average, light, np.gradient(codes, light))
            level = mean - slope * (dark - average)
        noise = flat.pixel_variance / flat.frames + (slope * flat.exposure) ** 2 * of_rate
        found.append(Flat(level, noise, light, codes, mean))
    return found, hot


def qis_flats(
    flats: Sequence[FrameStatistics], darks: Sequence[FrameStatistics], sensor: QIS
) -> tuple[list[Flat], Array]:
    """Return the flats of a QIS, and the hot pixels [H, W] by the dark frames of longest exposure.

    `sensor` gives the curve of mean code against electrons (fitted gain and read noise), without dark current.
    """
    longest = max(darks, key=lambda stack: stack.exposure)
    hot = hot_by_level(
        longest.total / longest.frames, float(np.sqrt(np.median(longest.pixel_variance) / longest.frames))
    )
    good = ~hot if not hot.all() else np.ones_like(hot)
    found = []
    for flat in flats:
        dark, of_dark = _dark_level(darks, flat.exposure)
        mean, average = flat.total / flat.frames, float(dark[good].mean())
        if float(mean[good].mean()) <= average:
            continue
        zero = float(sensor.mean(np.array(0.0), 1.0))
        curve = partial(_electrons, sensor, average - zero)
        largest = 2 * float(mean[good].max() - average) / sensor.gain + 1
        light, codes = _table(mean, good, curve, largest)
        level = mean - (dark - average)
        found.append(Flat(level, flat.pixel_variance / flat.frames + of_dark, light, codes, mean))
    return found, hot


def _above(mean: Callable[[Array], Array], dark: float, light: Array) -> Array:
    """Return the mean code of light above a dark level in arrivals."""
    return mean(dark + light)


def _electrons(sensor: QIS, shift: float, light: Array) -> Array:
    """Return the mean code at a number of electrons, shifted to the measured dark level at 0."""
    return sensor.mean(light, 1.0) + shift


def _table(mean: Array, good: Array, curve: Callable[[Array], Array], largest: float) -> tuple[Array, Array]:
    """Return (light, mean code) [G] up to `WIDEST` times the brightest light of the flat's smooth surface."""
    basis = surface(mean.shape, int(good.sum()))
    fitted = basis @ np.linalg.lstsq(basis[good.ravel()], mean[good], rcond=None)[0]
    light = np.linspace(0, np.sqrt(max(largest, 1e-9)), 600) ** 2
    codes = curve(light)
    rising = int(np.argmax(codes)) + 1
    top = 1.2 * float(np.interp(fitted.max(), codes[:rising], light[:rising]))
    light = np.linspace(0, np.sqrt(WIDEST * max(top, 1e-9)), 600) ** 2
    return light, curve(light)


def _dark_level(darks: Sequence[FrameStatistics], exposure: float) -> tuple[Array, Array]:
    """Return the dark code of every pixel at this exposure and its variance, both [H, W].

    It comes from the darks of this exposure, else from a straight line through all, else from the only exposure.
    """
    same = [s for s in darks if abs(s.exposure / exposure - 1) < 1e-6]
    used = same or list(darks)
    means = np.stack([s.total / s.frames for s in used])
    variances = np.stack([s.pixel_variance / s.frames for s in used])
    weight = np.array([s.frames for s in used], float)
    weight /= weight.sum()
    time = np.array([s.exposure for s in used])
    centre = float(weight @ time)
    spread = float(weight @ (time - centre) ** 2)
    if not same and spread > 0:
        weight = weight * (1 + (exposure - centre) * (time - centre) / spread)
    return np.tensordot(weight, means, 1), np.tensordot(weight**2, variances, 1)
