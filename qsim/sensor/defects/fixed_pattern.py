"""Draws fixed-pattern noise: maps of gain, dark rate, dead pixels, offset and read noise. Off by default.

    FixedPattern (a few numbers)  --draw_maps-->  Maps (one value per pixel)

Maps of gain and dark change the coefficients of a pixel's light only: arrivals = efficiency gain photons + dark
dark_rate exposure. So the cdf of the sensor draws the codes. These maps have the mean 1: they spread the signal and do
not shift it. A map is a function of (device seed, row, column) of the full frame, so all frames and crops have the same
one. Maps of read noise and offset change the ADC; their codes are drawn step by step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key, hash_name, uniform, words
from qsim.sensor.distribution import require_number
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.settings import setting

_DEVICE = hash_name("qsim fixed pattern")  # the "clip" of all device maps


@dataclass(frozen=True)
class DarkSpread:
    """Dark rates relative to the median: a log-normal body and a share of hot pixels with a heavy (Pareto) tail.

    The defaults describe the 50 x 50 pixels of a SPAD512 camera in the project's reference data: 18 % spread beyond
    Poisson in the body, 2.2 % of pixels above 3 medians, 1.0 % above 10, the hottest at 370.
    """

    spread: Annotated[float, setting("of the dark rate: standard deviation of the logarithm, without hot pixels")] = (
        0.18
    )
    hot_share: Annotated[float, setting("share of hot pixels")] = 0.022
    hot_from: Annotated[float, setting("lowest rate of a hot pixel, in medians of the dark rate")] = 3.0
    hot_to: Annotated[float, setting("highest rate of a hot pixel, in medians of the dark rate")] = 400.0
    tail: Annotated[
        float, setting("the share of pixels above a rate falls as rate^-tail between hot_from and hot_to")
    ] = 0.67

    def __post_init__(self) -> None:
        require_number(self, "spread", 0)
        require_number(self, "hot_share", 0, 1)
        require_number(self, "hot_from", 0, open_low=True)
        require_number(self, "hot_to", self.hot_from, open_low=True)
        require_number(self, "tail", 0, open_low=True)

    @property
    def mean(self) -> float:
        """Mean rate over median rate: the factor from a data sheet's median to the sensor's rate."""
        low = self.hot_from
        high = self.hot_to
        a = self.tail
        # Of a power law with the exponent -(a + 1) between both ends; the
        # rest is log-normal, with the mean exp(spread^2 / 2).
        norm = low**-a - high**-a
        hot = np.log(high / low) / norm if a == 1 else a / (1 - a) * (high ** (1 - a) - low ** (1 - a)) / norm
        return (1 - self.hot_share) * float(np.exp(self.spread**2 / 2)) + self.hot_share * float(hot)

    def draw(self, u: Array, v: Array) -> Array:
        """Return rates over the mean rate [...] from two uniform numbers [...] per pixel: kind and size."""
        from scipy.special import ndtri

        low = self.hot_from
        high = self.hot_to
        a = self.tail
        hot = (low**-a - v * (low**-a - high**-a)) ** (-1 / a)
        return np.where(u < self.hot_share, hot, np.exp(self.spread * ndtri(v))) / self.mean


@dataclass(frozen=True)
class FixedPattern:
    """The strengths of the fixed-pattern noise of a device; `draw_maps` draws its maps."""

    device_seed: Annotated[
        int, setting("which device of its kind: the fixed pattern is a function of it", example=7)
    ] = 0
    prnu: Annotated[float, setting("relative standard deviation of the efficiency", example=0.01)] = 0.0
    dark: DarkSpread | None = None  # of the dark rate
    dead: Annotated[float, setting("share of pixels that never fire, placed independently", example=0.001)] = 0.0
    offset: Annotated[float, setting("QIS: codes rms (with `dark`: the dark signal non-uniformity)", example=0.2)] = 0.0
    read_noise: Annotated[float, setting("QIS: relative standard deviation of the read noise", example=0.1)] = 0.0

    def __post_init__(self) -> None:
        require_number(self, "prnu", 0, 1)
        require_number(self, "dead", 0, 1)
        require_number(self, "offset", 0)
        require_number(self, "read_noise", 0, 1)


@dataclass(frozen=True, eq=False)
class Maps:
    """Per-pixel maps [H, W], drawn or measured; None without a map."""

    gain: Array | None = None  # efficiency over the sensor's, mean 1
    dark: Array | None = None  # dark rate over the sensor's, mean 1
    dead: Array | None = None  # bool
    offset: Array | None = None  # codes on top of the sensor's
    read_noise: Array | None = None  # over the sensor's, mean 1

    def crop(self, y: int, x: int, height: int, width: int) -> Maps:
        """Return the maps of a crop [px] of the frame."""
        parts = {name: None if m is None else m[y : y + height, x : x + width] for name, m in vars(self).items()}
        return Maps(**parts)


PERFECT = Maps()


def draw_maps(pattern: FixedPattern, shape: tuple[int, int], origin: tuple[int, int] = (0, 0)) -> Maps:
    """Return the maps of a device for the crop of `shape` (H, W) at `origin` (y, x); a strength of 0 makes no map."""

    def numbers(name: str, redraw: int = 0) -> Array:
        key = Key(pattern.device_seed, _DEVICE, stage=hash_name(name))
        return uniform(words(key, shape, origin, redraw))

    def around_one(name: str, spread: float) -> Array | None:
        """Return log-normal factors [H, W] with the mean 1 and the standard deviation `spread`."""
        from scipy.special import ndtri

        sigma = np.sqrt(np.log1p(spread**2))
        return np.exp(sigma * ndtri(numbers(name)) - sigma**2 / 2) if spread else None

    from scipy.special import ndtri

    return Maps(
        gain=around_one("gain", pattern.prnu),
        dark=None if pattern.dark is None else pattern.dark.draw(numbers("dark"), numbers("dark", 1)),
        dead=numbers("dead") < pattern.dead if pattern.dead else None,
        offset=pattern.offset * ndtri(numbers("offset")) if pattern.offset else None,
        read_noise=around_one("read noise", pattern.read_noise),
    )


def measured_dark_map(rates: Array) -> tuple[float, Array]:
    """Return the mean [1/s] and a map of mean 1 of measured dark rates [H, W] [1/s].

    `ValueError` if a rate is negative or not finite, or if all are 0.
    """
    values = np.asarray(rates, float)
    if not (np.isfinite(values).all() and (values >= 0).all() and values.any()):
        raise ValueError("measured dark rates: expected finite numbers, none negative and not all 0")
    return float(values.mean()), values / values.mean()


def lit(sensor: Sensor, photons: Array, exposure: float, maps: Maps) -> tuple[Sensor, Array]:
    """Return a sensor and photons [..., H, W] that have the efficiency and dark rate of each pixel of the maps.

    Dark events become the photons that would cause them, so that the cdf of the sensor holds for each pixel.
    """
    light = photons if maps.gain is None else photons * maps.gain
    if maps.dark is None:
        return sensor, light
    return sensor.with_dark_rate(0.0), light + maps.dark * (sensor.dark_rate * exposure / sensor.efficiency)


def pmf(sensor: Sensor, photons: Array, exposure: float, maps: Maps) -> Array:
    """Return P(code), [..., H, W, levels], of photons [..., H, W] with maps; exact, without correlated noise."""
    sensor, light = lit(sensor, photons, exposure, maps)
    if maps.offset is None and maps.read_noise is None:
        chances = sensor.pmf(light, exposure)
    elif isinstance(sensor, QIS):
        noise = 1.0 if maps.read_noise is None else maps.read_noise
        offset = 0.0 if maps.offset is None else maps.offset
        chances = sensor.read_out_pmf(light, exposure, noise, offset)
    else:
        raise ValueError(f"{type(sensor).__name__} has no read-out: maps of offset and read noise are for a QIS")
    if maps.dead is not None:
        chances = np.where(maps.dead[..., None], np.arange(sensor.levels) == 0, chances)
    return chances
