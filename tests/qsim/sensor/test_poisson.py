"""Poisson probabilities and quantiles, and the functions that the process inverts, against 40 digits."""

from __future__ import annotations

from math import inf

import mpmath as mp
import numpy as np
import pytest
from scipy.special import ndtri, pdtr, pdtrc

from qsim.sensor.poisson import poisson_log_pmf, poisson_quantile


@pytest.mark.parametrize("mean", [0.0, 1e-300, 0.01, 3.0, 100.0, 2500.0, 65_000.0])
def test_poisson_probabilities_keep_their_digits(mean):
    """log Pois(n) to 1e-12 over 9 sigmas: the textbook form loses 5e-11 at 65 000, a wide sensor's mean."""
    n = np.unique(np.maximum(np.floor(mean + np.sqrt(mean) * np.arange(-9, 12)), 0))
    found = poisson_log_pmf(np.array(mean), n)
    with mp.workdps(40):
        for i, k in enumerate(n):
            exact = mp.mpf(mean) ** int(k) * mp.e ** -mp.mpf(mean) / mp.factorial(int(k))
            assert found[i] == -inf if exact == 0 else abs(found[i] - float(mp.log(exact))) < 1e-12


@pytest.mark.parametrize("mean", [0.01, 3.0, 100.0, 2500.0, 65_000.0])
def test_the_error_of_the_process_is_below_1e_13(mean):
    """Drawing by inversion is as exact as the functions it inverts: P(N <= n) and P(N > n) against 40 digits."""
    n = np.unique(np.maximum(np.floor(mean + np.sqrt(mean) * np.arange(-9, 12)), 0)).astype(int)
    below = pdtr(n, mean)
    above = pdtrc(n, mean)
    with mp.workdps(40):
        exact = [poisson_cdf(int(i), mean) for i in n]
        assert max(abs(below[i] - float(p)) for i, p in enumerate(exact)) < 1e-13
        assert max(abs(above[i] - float(1 - p)) for i, p in enumerate(exact)) < 1e-13


def test_the_error_of_the_read_noise_is_below_1e_13():
    """Phi(z(u)) = u relative to u, down to u = 2^-65: the other half of the process."""
    u = np.concatenate([2.0 ** -np.arange(1.0, 66), np.linspace(0.001, 0.499, 50)])
    with mp.workdps(40):
        back = [mp.ncdf(mp.mpf(z)) for z in ndtri(u)]
        assert max(abs(float(b / mp.mpf(x) - 1)) for b, x in zip(back, u, strict=True)) < 1e-13


def test_poisson_quantiles_invert_the_distribution_in_both_tails():
    """n is the smallest with P(N <= n) > u: checked with 40 digits from u = 2^-64 to 1 - 2^-64, means 1e-9 to 1e6.

    A cdf with a relative error of 1e-13 may choose a neighbour where u is that near to a step; none is here.
    """
    rng = np.random.default_rng(3)
    means = np.array([0.0, 1e-9, 0.01, 0.7, 3.0, 25.0, 300.0, 1e4, 1e6])
    small = np.array([2.0**-65, 1e-15, 1e-6, 0.02, *rng.uniform(0, 0.5, 4)])
    below = np.concatenate([small, 1 - small])
    above = np.concatenate([1 - small, small])
    n = poisson_quantile(np.repeat(means, below.size), np.tile(below, means.size), np.tile(above, means.size))
    with mp.workdps(40):
        for found, mean, u, v in zip(
            n, np.repeat(means, below.size), np.tile(below, means.size), np.tile(above, means.size), strict=True
        ):
            exact = 1 - mp.mpf(v) if v < 0.5 else mp.mpf(u)
            upper = poisson_cdf(int(found), mean)
            lower = poisson_cdf(int(found) - 1, mean)
            assert lower <= exact < upper, (found, mean, u, v)


def poisson_cdf(n: int, mean: float):
    if n < 0 or mean == 0:
        return mp.mpf(n >= 0)
    return mp.gammainc(n + 1, mp.mpf(mean), mp.inf, regularized=True)
