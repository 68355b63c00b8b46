"""Stabilises the variance of a mean code by the sensor's exact distribution, with the exact unbiased inverse.

    f(m) = integral from mu(0) to m of dmu / sqrt(V(mu)),    deviation of f(mean of n codes) close to 1/sqrt(n)
    D(photons) = E[f(mean of n codes)],    inverse: photons = D^-1(denoised)

A denoiser estimates the expectation of f, not f at the expectation. So the algebraic inverse f^-1 would be biased; D^-1
is not (Makitalo and Foi, IEEE TIP 2011, for Poisson; here for any sensor, by the exact distribution of a sum of n
codes). Saturation reduces V towards 0, so f grows steeply there and ends at the top.

Other stabilisers, for comparison: `binomial` (Chan, Elgendy, Wang, Sensors 16(11), 2016: Anscombe's arcsine for a sum
of binary samples; wrong for a counting pixel) and `poisson` (Anscombe's square root of the electron count; ignores
clipping).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.estimation import pieces
from qsim.sensor.sensor import Sensor

Kind = Literal["table", "binomial", "poisson"]

FLOOR = 1e-3  # of the variance in the integral [codes^2]: keeps f finite where every code is the top one
POINTS = 1500  # of the table of D; each needs the distribution of a sum


@dataclass(frozen=True)
class Stabiliser:
    """Tables for the mean of `samples` codes; the unit of stabilised values is the deviation of one code."""

    samples: int
    mean_code: Array  # [M] grid of mean codes from 0 to the top code
    stabilised: Array  # [M], f on that grid
    photons: Array  # [G]
    expected: Array  # [G], D: the expectation of f at these photons, rising

    @property
    def deviation(self) -> float:
        """Return the nominal deviation of the stabilised mean code."""
        return self.samples**-0.5

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


def sum_pmf(pmf: Array, samples: int) -> Array:
    """Return the distribution of a sum of independent codes: [G, levels] -> [G, samples * (levels - 1) + 1]."""
    size = samples * (pmf.shape[1] - 1) + 1
    if size <= 512:  # direct: exact tails
        total = np.ones((len(pmf), 1))
        for _ in range(samples):
            grown = np.zeros((len(pmf), total.shape[1] + pmf.shape[1] - 1))
            for code in range(pmf.shape[1]):
                grown[:, code : code + total.shape[1]] += pmf[:, code : code + 1] * total
            total = grown
        return total
    spectrum = np.fft.rfft(pmf, 2 ** int(np.ceil(np.log2(size))), axis=1) ** samples
    return np.maximum(np.fft.irfft(spectrum, axis=1)[:, :size], 0)


def stabiliser(sensor: Sensor, exposure: float, samples: int, kind: Kind = "table") -> Stabiliser:
    """Return the tables for the mean of `samples` codes of this sensor. `ValueError` for an unknown kind."""
    table = sensor.response(exposure)
    top = sensor.levels - 1
    mean_code = np.linspace(0, top, max(4096, samples * top + 1))
    match kind:
        case "table":
            slope = 1 / np.sqrt(np.maximum(table.variance, FLOOR))
            area = np.cumsum(np.diff(table.mean) * (slope[1:] + slope[:-1]) / 2)
            stabilised = np.interp(mean_code, table.mean, np.concatenate([[0.0], area]))
        case "binomial":  # deviation 1/2 for the sum of N bits; scaled to that of a mean of codes
            bits = samples * top
            share = (mean_code * samples + 0.375) / (bits + 0.75)
            stabilised = 2 * np.sqrt((bits + 0.5) / samples) * np.arcsin(np.sqrt(share))
        case "poisson":  # deviation 1 for the sum of electrons
            electrons = mean_code * sensor.white(exposure) * sensor.efficiency / top
            stabilised = 2 * np.sqrt(electrons + 0.375 / samples)
        case _:
            raise ValueError(f"stabiliser is table, binomial or poisson, got {kind!r}")
    photons = np.linspace(0, np.sqrt(table.cap(samples)), POINTS) ** 2
    lattice = np.interp(np.arange(samples * top + 1) / samples, mean_code, stabilised)
    expected = np.concatenate(
        [sum_pmf(np.exp(sensor.log_pmf(part, exposure)), samples) @ lattice for part in pieces(photons, len(lattice))]
    )
    expected = np.maximum.accumulate(expected)
    rising = np.concatenate([[True], np.diff(expected) > 0])
    return Stabiliser(samples, mean_code, stabilised, photons[rising], expected[rising])
