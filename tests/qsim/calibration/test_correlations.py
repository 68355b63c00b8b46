"""Afterpulses and crosstalk of counts that their top code clips."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

from qsim.calibration import correlations
from qsim.calibration.frame_statistics import measure


def _exactly_hidden(arrivals: float, top: int) -> tuple[float, float]:
    """Return the mean code of Poisson counts, and the mean of the counts that a full code hides, in 60 digits."""
    with mpmath.workdps(60):
        x = mpmath.mpf(arrivals)
        above = [mpmath.gammainc(k + 1, 0, x, regularized=True) for k in range(top + 1)]  # P(N > k)
        return float(sum(above[:top])), float(x - top * above[top] / above[top - 1])


@pytest.mark.parametrize("top", [3, 7, 31, 255])
@pytest.mark.parametrize("share", [1e-4, 0.01, 0.2, 0.7, 1.0, 1.5])
def test_hidden_counts_are_those_of_a_poisson_law(top, share):
    mean, hidden = _exactly_hidden(share * top, top)
    assert correlations._hidden(mean, top) == pytest.approx(hidden, rel=0.05, abs=0.01)  # of a table of 399 steps


@pytest.mark.parametrize("bits", [2, 3, 5, 8])
def test_a_few_saturated_pixels_of_a_dark_array_change_no_correlation(bits):
    top = (1 << bits) - 1
    rng = np.random.default_rng(bits)
    counts = np.minimum(rng.poisson(0.02, (400, 24, 24)), top)
    counts[:, 3, 4] = top
    counts[:, 20, 9] = np.minimum(rng.poisson(1.2 * top, 400), top)
    stack = measure([counts], bits=bits, exposure=1.0, photons=None)
    found = correlations.measure_correlations([stack], bits)
    assert correlations._shown(stack) == pytest.approx(1.0, abs=0.2)  # the second hot pixel is clipped, too
    for chance in (found.afterpulsing, found.crosstalk):
        assert abs(chance.value) < 5 * np.sqrt(chance.variance)
        assert 0 < chance.variance < 1e-3
