"""Computes probabilities of single QIS codes, in logarithms, from the electrons that make them likely.

    P(code = k) = sum over n of Pois(n; mean) P(k | n),    dlog P / dmean = E[n | k] / mean - 1

Given the code, n lies between its light and its place on the scale of electrons, within a few deviations. Where read
noise blurs many electrons, every second, fourth ... term suffices (qis_moments.py). Beyond the full well, and beyond
the blurred end of an outer code, P(k | n) is constant, and the sum is a tail of the Poisson law.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, floor, inf, log

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.poisson import poisson_log_pmf
from qsim.sensor.qis_moments import LONGER, Chain

SIGMAS = 9.0  # beyond them, 1e-19 of a normal law is left out
FARTHEST = 39.0  # read noises: Phi(-39) is 0 in float64
MOST = 1e15  # electrons


@dataclass(frozen=True)
class _Part:
    """Electrons with their logarithmic share of P(code)."""

    logs: Array
    electrons: Array


def code_law(chain: Chain, code: int, mean: float, chance: Callable[[Array], Array]) -> tuple[float, float]:
    """Return log P(code) and its derivative by the expected electrons `mean`, above 0.

    `chance` returns log P(code | n) of electrons [n].
    """
    low, high = _interval(chain, code)
    # Light and noise as two normal laws: given the code, n lies between the light and the place of the code
    root = np.sqrt(mean)
    variance = mean + chain.noise**2
    nearest = min(max(mean, low), high)
    likeliest = mean + (nearest - mean) * mean / variance
    reach = SIGMAS * (root * chain.noise + mean) / np.sqrt(variance) + LONGER
    first = floor(max(likeliest - reach, low - FARTHEST * chain.noise - 1, 0.0))
    last = ceil(max(min(likeliest + reach, high + FARTHEST * chain.noise + 1), first))
    # Terms that differ little are one: steps are half of what light and noise together let n vary
    step = max(1, floor(0.5 * chain.noise * root / (chain.noise + root))) if chain.noise else 1
    parts = []
    blurred = SIGMAS * chain.noise + 1
    cut = last - first > step * 2 * blurred
    # Where P(code | n) no longer changes, the rest of the sum is a tail of the Poisson law
    if last >= chain.well:
        edge = ceil(chain.well)
        parts.append(_above(edge, mean, float(chance(np.array([chain.well]))[0])))
        last = edge - 1
        step = 1
    elif cut and high == MOST and last > low + blurred:
        edge = max(ceil(low + blurred), first)
        parts.append(_above(edge, mean, 0.0))
        last = edge - 1
        step = 1
    if cut and low == -MOST and first < high - blurred:
        edge = min(floor(high - blurred), last)
        parts.append(_below(edge, mean))
        first = edge + 1
        step = 1
    n = np.arange(first, last + 1, step, dtype=float)
    if len(n):
        parts.append(_Part(poisson_log_pmf(np.array(mean), n) + chance(n) + log(step), n))
    logs = np.concatenate([part.logs for part in parts])
    most = logs.max()
    if most == -inf:
        return -inf, 0.0
    weights = np.exp(logs - most)
    total = weights.sum()
    electrons = np.concatenate([part.electrons for part in parts])
    return float(most + np.log(total)), float(weights @ (electrons - mean) / total / mean)


def _interval(chain: Chain, code: int) -> tuple[float, float]:
    """Return the electrons between which the code lies without read noise; the outer codes end at +-MOST."""
    low = (code - 0.5 - chain.offset) / chain.gain if code else -MOST
    high = (code + 0.5 - chain.offset) / chain.gain if code < chain.top else MOST
    return min(max(low, -MOST), MOST), min(max(high, -MOST), MOST)


def _above(edge: int, mean: float, log_chance: float) -> _Part:
    """Return the electrons n >= edge together: their share, and their mean."""
    from scipy.special import gammainc, gammaincc

    if edge <= 0:
        return _Part(np.array([log_chance]), np.array([mean]))
    share = gammainc(edge, mean)
    one_more = gammainc(edge - 1, mean) if edge > 1 else 1.0
    with np.errstate(divide="ignore"):
        logs = np.log1p(-gammaincc(edge, mean)) if share > 0.5 else np.log(share)
    return _Part(np.array([logs + log_chance]), np.array([mean * one_more / share if share else edge]))


def _below(edge: int, mean: float) -> _Part:
    """Return the electrons n <= edge together: their share, and their mean."""
    from scipy.special import gammainc, gammaincc

    if edge < 0:
        return _Part(np.array([-inf]), np.array([0.0]))
    share = gammaincc(edge + 1, mean)
    one_less = gammaincc(edge, mean) if edge else 0.0
    with np.errstate(divide="ignore"):
        logs = np.log1p(-gammainc(edge + 1, mean)) if share > 0.5 else np.log(share)
    return _Part(np.array([logs]), np.array([mean * one_less / share if share else edge]))
