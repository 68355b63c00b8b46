"""Holds the results of a calibration: values with 95 % intervals, warnings, residuals and maps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import exp, inf, isnan, nan, sqrt
from statistics import NormalDist

from numpy import ndarray as Array

from qsim.calibration.quantiles import chi2_quantile

Z95 = NormalDist().inv_cdf(0.975)  # two-sided 95 % of the normal distribution


@dataclass(frozen=True)
class Value:
    """An estimate and its 95 % interval, whose ends are NaN for what has none, and infinite on an open side."""

    value: float
    low: float
    high: float
    unit: str
    method: str

    @classmethod
    def exact(cls, value: float, unit: str, method: str) -> Value:
        """Return a number without an interval: a count of what was found, or a description of the recording."""
        return cls(value, nan, nan, unit, method)

    def __str__(self) -> str:
        if isnan(self.low):
            return f"{self.value:.5g} {self.unit}"
        return f"{self.value:.5g} [{self.low:.5g}, {self.high:.5g}] {self.unit}"


@dataclass(frozen=True, eq=False)
class Calibration:
    """Results of a calibration: `values` by name, the limits of the data in `warnings`, and the goodness of the fit."""

    model: str  # QIS, BinarySPAD or CountingSPAD
    bits: int
    values: Mapping[str, Value]
    p_value: float  # of the fitted histograms; if small, the model is wrong; NaN without degrees of freedom
    warnings: tuple[str, ...] = ()
    residuals: tuple[Array, ...] = field(default=(), repr=False)  # per stack, (observed - fitted) / sigma per level
    maps: Mapping[str, Array] = field(default_factory=dict, repr=False)  # [H, W]
    paralyzable: bool = False  # of a CountingSPAD


def normal_interval(value: float, variance: float, unit: str, method: str, *, floor: float = -inf) -> Value:
    """Return value +- 1.96 sigma, cut at `floor`."""
    reach = Z95 * sqrt(max(variance, 0.0))
    return Value(max(value, floor), max(value - reach, floor), max(value + reach, floor), unit, method)


def poisson_interval(value: float, count: float, unit: str, method: str) -> Value:
    """Return the exact interval of a value that is proportional to a Poisson count of at least 1."""
    low = chi2_quantile(0.025, 2 * count) / 2
    high = chi2_quantile(0.975, 2 * count + 2) / 2
    return Value(value, value * low / count, value * high / count, unit, method)


def log_interval(value: float, log_variance: float, unit: str, method: str) -> Value:
    """Return value times e^(+-1.96 sigma): the interval of a positive scale."""
    factor = exp(min(Z95 * sqrt(max(log_variance, 0.0)), 700.0))
    return Value(value, value / factor, value * factor, unit, method)


def root_interval(square: float, variance: float, unit: str, method: str) -> Value:
    """Return the interval of a standard deviation from that of its square, which noise may make negative."""
    reach = Z95 * sqrt(variance)
    low, middle, high = (sqrt(max(x, 0.0)) for x in (square - reach, square, square + reach))
    return Value(middle, low, high, unit, method)


def odd_efficiency(found: Value) -> list[str]:
    """Return a warning if an efficiency is significantly above 1, which no sensor file holds; `ValueError` if 0."""
    if found.value <= 0:
        raise ValueError(
            "calibrate: the flats of known light hold no more counts than the dark frames; are dark and flat frames "
            "swapped, or are the flats without light?"
        )
    if found.low <= 1:
        return []
    return [
        f"the efficiency is {found.value:.4g}, above 1, and the sensor file holds 1: are photons per pixel and the "
        "exposure right?"
    ]
