"""How results may differ between machines: one rule for each kind of result, and the comparison that follows it.

Machines differ in the order of sums (vector width, kernels of BLAS, threads), in fused products, and in the last bits
of exp, log and roots. So a stored result is compared by its kind:

| kind | may differ by |
|---|---|
| codes, packed bytes, digests, counts, texts | nothing |
| `Sums`: sums of n terms, and functions of them | n eps of their type, times the size of what is summed |
| `walk`: networks, where n eps would hide faults | the random walk of n roundings |
| `Fits`: fitted values and the ends of their intervals | 1e-3 of their own standard error |
| `Rendered`: light of n samples, stored in halves | nothing, but in few pixels a step of a half, or one sample |
| `ErrorsOfLight`: estimated from such pixels | what these few pixels change |

Each of two machines may round n terms by n u, u = eps / 2 (Higham, Accuracy and Stability of Numerical Algorithms,
2002, section 3.1), which makes n eps of the two. Where roundings are independent, the sum errs like a random walk,
z sqrt(n) u (Higham and Mary, SIAM J. Sci. Comput. 41, A2815, 2019), and sqrt(2) of that between two. A fit stops
anywhere within the flat bottom of its sum of squares, whose width is set by its data: a thousandth of the standard
error is seen by nobody who reads the interval. No figure here comes from what a machine gave.

`python tests/processors.py` runs the tests that compare floats on emulated processors.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np
from scipy import stats as _scipy_stats
from stats import FALSE_ALARM, critical_z

Array = np.ndarray
FIT = 1e-3  # of the standard error
INTERVAL = 2 * 1.959963984540054  # width of an interval of 95 %, in standard errors
P_VALUE_ERROR = 1 / sqrt(12)  # standard deviation of a p-value where the model is right: it is uniform
LEAST = 1e-6  # smaller numbers are what is left where terms of this size, at least, cancel
LARGEST_EXPONENT = 745  # exp(-745) is the least double: the logarithm of a probability is off by this many eps
DENOISER_TERMS = 16 * 9 * 64  # layers of Open Image Denoise, each a sum over 3 x 3 pixels of about 64 channels
EDGE_RAYS = 4e-6  # share of rays that take another way: 32 px are known to 32 eps of single precision, one edge a pixel


def eps(dtype: Any) -> float:
    """Relative spacing of a float type."""
    return float(np.finfo(np.dtype(dtype)).eps)


def rounding(terms: int, dtype: Any) -> float:
    """Relative difference of two sums of `terms` terms of one sign, at most."""
    return terms * eps(dtype)


def walk(terms: int, dtype: Any) -> float:
    """Relative difference of two sums whose roundings are independent, with one false alarm in a million."""
    return critical_z() * sqrt(terms / 2) * eps(dtype)


def standard_errors(values: Any, low: Any, high: Any) -> Array:
    """Standard errors of values that have intervals of 95 %; of an interval without an end, twice the other side."""
    values, low, high = (np.asarray(v, float) for v in (values, low, high))
    below = values - low
    above = high - values
    lower = np.where(np.isfinite(below), below, above)
    upper = np.where(np.isfinite(above), above, below)
    return np.where(np.isfinite(lower), lower + upper, 0.0) / INTERVAL


@dataclass(frozen=True)
class Sums:
    """Sums of `terms` terms, computed in `dtype`, of the size `of`.

    `of` is "mean" (the mean size of all numbers), "each" (that of each number, at least 1e-6) or a size in their unit.
    """

    values: Array
    terms: int | Array
    dtype: Any = np.float64
    of: str | float = "mean"

    def allowed(self, wanted: Array) -> Array:
        """The largest difference of each number."""
        size: Any = self.of
        if self.of == "each":
            size = np.maximum(np.abs(wanted), LEAST)
        elif self.of == "mean":
            size = np.mean(np.abs(wanted[np.isfinite(wanted)]))
        return np.broadcast_to(np.asarray(self.terms) * eps(self.dtype) * size, wanted.shape)


@dataclass(frozen=True)
class Fits:
    """Fitted values with their standard errors, of one shape; a value without one (0) is a sum of `terms` terms."""

    values: Array
    errors: Array
    terms: int = 1

    def allowed(self, wanted: Array) -> Array:
        """The largest difference of each number."""
        return FIT * np.broadcast_to(self.errors, wanted.shape) + rounding(self.terms, float) * np.abs(wanted)


@dataclass(frozen=True)
class Rendered:
    """Light of `samples` samples a pixel, each of up to `bounces` bounces in single precision, stored in halves."""

    values: Array
    samples: int
    bounces: int
    denoise: bool = False

    def allowed(self, wanted: Array) -> Array:
        """The largest difference of each of the few pixels that may differ: a step of a half, or one sample."""
        return np.maximum(eps(np.float16) * np.abs(wanted), np.abs(wanted).max() / self.samples)

    def few(self, pixels: int) -> int:
        """How many pixels may differ.

        The mean of n roundings of single precision has the spread sqrt(n / 6) u; it crosses the edge between two
        halves in as large a share of pixels as it has of their spacing. A ray near an edge may pass on its other side.
        A denoiser is a network on top.
        """
        rounded = sqrt(self.samples * self.bounces / 6) * eps(np.float32) / eps(np.float16)
        if self.denoise:
            rounded += walk(DENOISER_TERMS, np.float32) / eps(np.float16)
        expected = pixels * (rounded + self.samples * EDGE_RAYS)
        return int(_scipy_stats.poisson.isf(FALSE_ALARM, expected))


@dataclass(frozen=True)
class ErrorsOfLight:
    """Estimates, from its own pixels, of the error of light that is `Rendered`: its rms, or decibels of it."""

    values: Array
    light: Rendered

    def allowed(self, wanted: Array) -> Array:
        """The largest difference of each number.

        Where one of n samples changes, the error of its pixel changes by 1 / sqrt(n) of itself, the square by twice it.
        """
        share = self.light.few(self.light.values.size) / self.light.values.size
        return share * 2 / sqrt(self.light.samples) * np.abs(wanted)


Result = Sums | Fits | Rendered | ErrorsOfLight


def difference(result: Result, wanted: Array, errors: Array | None = None) -> str | None:
    """What is wrong with a result, as text, or None; `errors` are stored standard errors of fits."""
    found = np.asarray(result.values, float)
    wanted = np.asarray(wanted, float)
    if wanted.shape != found.shape:
        return f"shape {found.shape} instead of {wanted.shape}"
    finite = np.isfinite(wanted)
    if not np.array_equal(wanted[~finite], found[~finite], equal_nan=True):
        return "other numbers are infinite or not numbers"
    if isinstance(result, Fits) and errors is not None:
        result = Fits(result.values, errors, result.terms)
    apart = np.where(finite, np.abs(found - np.where(finite, wanted, 0)), 0.0)
    off = ~(apart <= np.where(finite, result.allowed(wanted), 0.0))
    if isinstance(result, Rendered) and not off.any():
        off = apart > 0
        if np.count_nonzero(off) <= result.few(off.size):
            return None
    if not off.any():
        return None
    mean = np.mean(wanted[finite])
    return f"{off.sum()} of {off.size} differ, by up to {np.nanmax(np.append(apart[off], 0.0)):.3g}, mean {mean:.6g}"
