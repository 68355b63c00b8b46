"""Stabilises the variance of a mean code by the sensor's exact distribution, with the exact unbiased inverse.

    f(m) = integral from mu(0) to m of dmu / sqrt(V(mu)),    deviation of f(mean of n codes) close to 1/sqrt(n)
    D(photons) = E[f(mean of n codes)],    inverse: photons = D^-1(denoised)

A denoiser estimates the expectation of f, not f at the expectation. So the algebraic inverse f^-1 would be biased; D^-1
is not (Makitalo and Foi, IEEE TIP 2011, for Poisson; here for any sensor, by the exact distribution of a sum of n
codes). Where a frame counts several times, as near the ends of a clip, that sum has another distribution and a larger
deviation: both are taken into account. Saturation reduces V towards 0, so f grows steeply there and ends at the top.

Other stabilisers, for comparison: `binomial` (Chan, Elgendy, Wang, Sensors 16(11), 2016: Anscombe's arcsine for a sum
of binary samples; wrong for a counting pixel) and `poisson` (Anscombe's square root of the electron count; ignores
clipping).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce
from typing import Literal

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.estimation import pieces
from qsim.sensor.sensor import Sensor

Kind = Literal["table", "binomial", "poisson"]

FLOOR = 1e-3  # of the variance in the integral [codes^2]: keeps f finite where every code is the top one
NODES = 16  # of the normal law of a mean of many codes
POINTS = 1500  # of the table of D; each needs the distribution of a sum


@dataclass(frozen=True)
class Stabiliser:
    """Tables for the mean of `samples` codes; the unit of stabilised values is the deviation of one code."""

    samples: int
    mean_code: Array  # [M] grid of mean codes from 0 to the top code
    stabilised: Array  # [M], f on that grid
    photons: Array  # [G]
    expected: Array  # [G], D: the expectation of f at these photons, rising
    excess: float = 1.0  # deviation of the mean over that of `samples` independent codes

    @property
    def deviation(self) -> float:
        """Return the nominal deviation of the stabilised mean code."""
        return self.excess * self.samples**-0.5

    @property
    def peak(self) -> float:
        """Return the range of stabilised values from darkness to saturation."""
        return float(self.expected[-1] - self.expected[0])

    def forward(self, mean_code: Array) -> Array:
        """Return stabilised values, float32 [...], of mean codes [...]."""
        return np.interp(mean_code, self.mean_code, self.stabilised).astype(np.float32)

    def inverse(self, stabilised: Array) -> Array:
        """Return photons, float32 [...], of denoised stabilised values [...]; from 0 to the cap of `samples` codes."""
        return np.interp(stabilised, self.expected, self.photons).astype(np.float32)


def sum_pmf(pmf: Array, times: Sequence[int]) -> Array:
    """Return the distribution of a sum of independent codes, each taken `times` times: [G, levels] -> [G, values].

    Values are 0 ... sum(times) * (levels - 1).
    """
    size = sum(times) * (pmf.shape[1] - 1) + 1
    if size <= 512:  # direct: exact tails
        total = np.ones((len(pmf), 1))
        for count in times:
            grown = np.zeros((len(pmf), total.shape[1] + count * (pmf.shape[1] - 1)))
            for code in range(pmf.shape[1]):
                grown[:, count * code : count * code + total.shape[1]] += pmf[:, code : code + 1] * total
            total = grown
        return total
    points = 2 ** int(np.ceil(np.log2(size)))
    parts = [np.fft.rfft(_spread(pmf, count), points, axis=1) ** n for count, n in Counter(times).items()]
    return np.maximum(np.fft.irfft(reduce(np.multiply, parts), axis=1)[:, :size], 0)


def _spread(pmf: Array, count: int) -> Array:
    """Return the distribution of a code taken `count` times, [G, count * (levels - 1) + 1]."""
    spread = np.zeros((len(pmf), count * (pmf.shape[1] - 1) + 1))
    spread[:, ::count] = pmf
    return spread


@lru_cache(maxsize=8)
def stabiliser(sensor: Sensor, exposure: float, times: tuple[int, ...], kind: Kind = "table") -> Stabiliser:
    """Return the tables for the mean of codes of this sensor, each taken `times` times. `ValueError` for unknown kinds.

    Codes of different frames are taken once each; a frame that is reflected is taken several times.
    """
    table = sensor.response(exposure)
    top = sensor.levels - 1
    samples = sum(times)
    mean_code = np.linspace(0, top, max(4096, samples * top + 1))
    match kind:
        case "table":
            slope = 1 / np.sqrt(np.maximum(table.variance, FLOOR))
            # The integral of 1 / sqrt(V) over the mean code, by the trapezoidal rule.
            area = np.cumsum(np.diff(table.mean) * (slope[1:] + slope[:-1]) / 2)
            stabilised = np.interp(mean_code, table.mean, np.concatenate([[0.0], area]))
        case "binomial":  # deviation 1/2 for the sum of N bits; scaled to that of a mean of codes
            bits = samples * top
            # Anscombe (1948): arcsin sqrt((x + 3/8) / (n + 3/4)) has a variance of nearly 1 / (4 n + 2).
            share = (mean_code * samples + 0.375) / (bits + 0.75)
            stabilised = 2 * np.sqrt((bits + 0.5) / samples) * np.arcsin(np.sqrt(share))
        case "poisson":  # deviation 1 for the sum of electrons
            electrons = mean_code * sensor.white(exposure) * sensor.efficiency / top
            stabilised = 2 * np.sqrt(electrons + 0.375 / samples)
        case _:
            raise ValueError(f"stabiliser is table, binomial or poisson, got {kind!r}")
    photons = np.linspace(0, np.sqrt(table.cap(samples)), POINTS) ** 2
    excess = (sum(count * count for count in times) / samples) ** 0.5
    if sensor.many_codes:  # their mean is nearly normal
        # Gauss-Hermite quadrature of E f over the normal law of the mean.
        nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
        mean, variance = sensor.moments(photons, exposure)
        deviation = np.sqrt(variance / samples) * excess
        spread = np.interp(mean[:, None] + nodes * deviation[:, None], mean_code, stabilised)
        expected = spread @ (weights / weights.sum())
    else:
        lattice = np.interp(np.arange(samples * top + 1) / samples, mean_code, stabilised)
        expected = np.concatenate(
            [sum_pmf(np.exp(sensor.log_pmf(part, exposure)), times) @ lattice for part in pieces(photons, len(lattice))]
        )
    expected = np.maximum.accumulate(expected)
    rising = np.concatenate([[True], np.diff(expected) > 0])
    return Stabiliser(samples, mean_code, stabilised, photons[rising], expected[rising], excess)
