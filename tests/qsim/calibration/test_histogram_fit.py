"""Bins of a histogram fit are pooled alike, whatever the rounding of the expected counts."""

from __future__ import annotations

import numpy as np

from qsim.calibration.histogram_fit import goodness


def test_rounding_joins_no_bins():
    """Counts that are a multiple of 5: shares that sum to a little less or more than 1 give one p-value."""
    rng = np.random.default_rng(3)
    for _ in range(200):
        shares = rng.dirichlet(np.ones(int(rng.integers(4, 12))))
        histogram = rng.multinomial(5 * int(rng.integers(20, 2000)), shares)
        stack = type("Stack", (), {"histogram": histogram})()
        found = [goodness([stack], [shares * factor], 1)[0] for factor in (1 - 1e-14, 1.0, 1 + 1e-14)]
        np.testing.assert_allclose(found, found[0], rtol=1e-9)
