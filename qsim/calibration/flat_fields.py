"""Subtracts each pixel's dark level from flat fields of a SPAD array or a QIS; prnu.py measures PRNU in them.

SPAD: arrivals = inverse of the exact mean code; dark rate of every pixel from all dark frames
QIS:  mean codes; dark level of every pixel from the dark frames of the flat's exposure, or a line through them
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.frame_statistics import FrameStatistics
from qsim.calibration.prnu import WIDEST, Flat, hot_by_level, smooth_part, surface
from qsim.calibration.spad_response import Response
from qsim.sensor.qis import QIS

LINEAR = 10.0  # counts missing to saturation in a stack, from which on it tells a pixel's dark rate
_CORRECTABLE = 0.2  # of the standard error: bias of the mean of nearly saturated planes, up to which a flat is used


@dataclass(frozen=True, eq=False)
class DarkRates:
    """Dark rate of every pixel and its variance, both [H, W], and what finds the hot pixels."""

    rate: Array  # [H, W] 1/s; noise may make it negative
    variance: Array  # [H, W]
    counts: Array  # [H, W] detections in `time`, less afterpulses and crosstalk
    time: float  # s of all stacks
    saturated: Array  # bool [H, W]: no stack has a frame below the top code, so the rate is a lower limit
    missing: Array  # [H, W] counts below saturation, in the stack that tells the pixel's rate best
    frames: Array  # [H, W] frames of that stack, and its exposure
    exposure: Array


def dark_rates(darks: Sequence[FrameStatistics], response: Response) -> DarkRates:
    """Return the dark rate of every pixel [1/s] from all exposures in which it is not nearly saturated."""
    shape = darks[0].total.shape
    weight = np.zeros(shape)
    rate = np.zeros(shape)
    variance = np.zeros(shape)
    missing = np.full(shape, -np.inf)  # below 0 where a fitted dead time allows fewer counts than there were
    frames = np.zeros(shape)
    exposure = np.zeros(shape)
    for stack in sorted(darks, key=lambda one: one.exposure):
        here = response.at(stack.exposure)
        arrivals = response.of_stack(stack)
        room = most_counts(here) * stack.frames - stack.total
        used = (room >= LINEAR) | (weight == 0)
        time = stack.frames * stack.exposure
        # Mean of the rates of all stacks, each weighted with the time that it looked.
        rate += np.where(used, time * arrivals.value / stack.exposure, 0)
        variance += np.where(used, arrivals.variance * (time / stack.exposure) ** 2, 0)
        weight += np.where(used, time, 0)
        better = room > missing
        missing = np.where(better, room, missing)
        frames = np.where(better, stack.frames, frames)
        exposure = np.where(better, stack.exposure, exposure)
    rate = rate / weight
    variance = variance / weight**2
    total = sum(stack.frames * stack.exposure for stack in darks)
    return DarkRates(rate, variance, rate * total, total, missing <= 0, missing, frames, exposure)


def most_counts(response: Response) -> float:
    """Return the top code, or the most counts that a dead time allows."""
    top = float(response.levels - 1)
    return top if response.ratio == 0 else min(top, 1 / response.ratio + 1)


def light_of(flat: FrameStatistics, darks: DarkRates | None, response: Response) -> tuple[Array, Array]:
    """Return the light [H, W] in avalanches per exposure, and its variance without that of the dark level."""
    arrivals = response.of_stack(flat)
    if darks is None:
        return arrivals.value, arrivals.variance
    return arrivals.value - darks.rate * flat.exposure, arrivals.variance


def too_bright(flat: FrameStatistics, good: Array, response: Response) -> bool:
    """Return whether so many good pixels are saturated in all frames that the mean of the light is biased."""
    t = flat.frames
    if response.bits > 1:
        full = flat.total[good] >= t * (flat.histogram.size - 1)
        return float(full.mean()) > 1e-3
    # -log(1 - q) = sum of q^n / n, of which T planes estimate the first T terms without bias: the rest
    # of the series is the bias, its variance that of the delta method, q / ((1 - q) T).
    q = (flat.total[good] + 0.0) / (t + 0.5)
    bias = float(np.mean(q ** (t + 1) / ((t + 1) * (1 - q))))
    error = np.sqrt(float(np.mean(q / (1 - q))) / (t * q.size))
    return bool(bias > _CORRECTABLE * error)


def spad_flats(flats: Sequence[FrameStatistics], darks: DarkRates | None, hot: Array, response: Response) -> list[Flat]:
    """Return the flats of a SPAD array without dark levels; `hot` [H, W] are the pixels that are left out."""
    good = np.ones_like(hot) if hot.all() else ~hot
    found = []
    for flat in flats:
        if flat.frames < 2:
            continue
        here = response.at(flat.exposure)
        mean = flat.total / flat.frames
        dark = np.zeros(mean.shape) if darks is None else darks.rate * flat.exposure
        of_rate = 0.0 if darks is None else darks.variance
        average = float(dark[good].mean())
        arrivals = response.of_stack(flat).value
        largest = max(float(arrivals[good].max()), 1e-9)
        light, codes = _table(mean, good, partial(_above, here.mean, average), largest)
        if response.bits == 1:  # exact: 1 - code is a product of light and dark
            slope = 1 - mean
            level = 1 - slope * np.exp(np.clip(dark - average, -30.0, 30.0))
        else:
            # Moves each pixel along the curve of codes to the mean dark rate, so that only its efficiency is left.
            slope = np.interp(arrivals - average, light, np.gradient(codes, light))
            level = mean - slope * (dark - average)
        in_time = flat.pixel_variance / flat.frames * _excess(here, mean, flat.frames)
        found.append(Flat(level, in_time + (slope * flat.exposure) ** 2 * of_rate, light, codes, mean))
    return found


def _excess(response: Response, mean: Array, frames: int) -> Array:
    """Return the variance of a mean over frames, over that which the variance in time of independent frames gives."""
    excess = response.excess(mean)
    return np.asarray(excess / np.maximum(1 - (excess - 1) / max(frames - 1, 1), 0.1))


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
        mean = flat.total / flat.frames
        average = float(dark[good].mean())
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
    fitted = smooth_part(basis, mean.ravel(), good.ravel())
    # Squares are dense near 0, where the code of a pixel bends most in relative terms.
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
        # A straight line by weighted least squares is a weighted mean, too; at
        # the centre of the exposures its weights are unchanged.
        weight = weight * (1 + (exposure - centre) * (time - centre) / spread)
    return np.tensordot(weight, means, 1), np.tensordot(weight**2, variances, 1)
