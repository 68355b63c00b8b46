"""The fit of a camera's histograms: bins, probabilities and their derivatives."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.stats import binom

from qsim.calibration.cells import sum_limit
from qsim.calibration.code_law import code_law
from qsim.calibration.goodness import chi_square, pooled
from qsim.calibration.moment_law import ADC, MomentLaw
from qsim.sensor.qis import QIS


def test_rounding_joins_no_bins():
    """Counts that are a multiple of 5: shares that sum to a little less or more than 1 give one p-value."""
    rng = np.random.default_rng(3)
    for _ in range(200):
        shares = rng.dirichlet(np.ones(int(rng.integers(4, 12))))
        histogram = rng.multinomial(5 * int(rng.integers(20, 2000)), shares)
        scaled = [shares * factor * histogram.sum() for factor in (1 - 1e-14, 1.0, 1 + 1e-14)]
        found = [chi_square([(histogram, expected)], 1) for expected in scaled]
        np.testing.assert_allclose(found, found[0], rtol=1e-9)


def test_no_bin_expects_less_than_five():
    """A bin of 0.007 before one of thousands stayed alone: one count in it called a right model wrong."""
    observed, expected = pooled(np.array([1.0, 3000.0, 4.0, 2.0]), np.array([0.007, 3000.0, 4.5, 2.5]))
    np.testing.assert_allclose(observed, [3001.0, 6.0])
    np.testing.assert_allclose(expected, [3000.007, 7.0])


def test_the_limit_of_a_sum_of_rare_codes_is_that_of_a_binomial():
    """One electron in 250 codes: normal limits took every pixel with an electron for a hot one."""
    for terms, chance in ((19, 1e-4), (400, 1e-6)):
        assert sum_limit(np.array([0, 249, 1]), terms, chance) == terms + binom.isf(chance, terms, 1 / 250)


def test_moments_of_a_bright_cell_have_the_slopes_of_their_differences():
    cell = SimpleNamespace(codes=np.zeros((5, 9)), mean=130.0, variance=420.0, in_time=np.linspace(300, 500, 9))
    law = MomentLaw([cell])
    at = np.array([np.log(2.0), 10.0, np.log(3.0), 61.0])

    def moments(p):
        return law.laws(np.exp(p[0]), p[1], np.exp(p[2]), p[3:])

    assert moments(at)[1] == 4 * (61 + 9) + ADC
    slopes = law.slopes(2.0, 3.0, at[3:])
    score = law.score(*moments(at), *slopes)
    for k, step in enumerate(1e-5 * np.eye(4)):
        above = moments(at + step)
        below = moments(at - step)
        for slope, high, low in zip(slopes, above, below, strict=True):
            np.testing.assert_allclose(slope[k], (high - low) / 2e-5, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(score[k].sum(), (law.value(*above) - law.value(*below)) / 2e-5, rtol=1e-4)


def test_law_is_that_of_the_sensor():
    """The banded sum and the full one equal the sensor's own table; the share of outliers is the only difference."""
    rng = np.random.default_rng(4)
    for _ in range(40):
        bits = int(rng.integers(2, 9))
        gain = float(np.exp(rng.uniform(np.log(0.05), np.log(20))))
        noise = float(np.exp(rng.uniform(np.log(0.1), np.log(3))))
        offset = float(rng.uniform(-2, 0.3 * 2**bits))
        mean = rng.uniform(0, 1.2, 3) * 2**bits / gain
        law = code_law(np.arange(2**bits - 1.0), gain, offset, noise, mean, np.zeros(3), smooth=False)
        exact = np.exp(QIS(1.0, 0.0, noise, bits, gain=gain, offset=offset).log_pmf(mean, 1.0))
        np.testing.assert_allclose(law.shares, exact, atol=2e-6)


def test_slopes_of_the_law_are_its_differences():
    """Derivatives of narrow, wide and negative spreads: by all five arguments of the series, by four of the exact sum.

    Those of the exact sum leave out how its points follow the mean, and only guide the fit; intervals do not use them.
    """
    rng = np.random.default_rng(5)
    for smooth in (False, True):
        for _ in range(30):
            gain = float(rng.uniform(0.3, 8))
            noise = float(rng.uniform(0.3, 2))
            mean = rng.uniform(200, 600, 3) if smooth else rng.uniform(2, 40, 3)
            spread = np.minimum(np.array([-0.05, 0.1, 0.8]) * (mean + noise**2), mean**2 / 15)  # no negative light
            edges = np.unique(np.rint(gain * rng.uniform(0, 1.3 * mean.max(), 30)))
            start = np.concatenate([[np.log(gain), 1.7, np.log(noise)], mean, spread])

            def shares(p, edges=edges, smooth=smooth):
                return code_law(edges, np.exp(p[0]), p[1], np.exp(p[2]), p[3:6], p[6:], smooth=smooth).shares

            law = code_law(edges, gain, 1.7, noise, mean, spread, smooth=smooth)
            moves = np.eye(9)
            directions = [moves[0], moves[1], moves[2], moves[3:6].sum(axis=0), moves[6:].sum(axis=0)]
            slopes = (law.by_gain, law.by_offset, law.by_noise, law.by_mean, law.by_spread)[: 5 if smooth else 4]
            for direction, slope in zip(directions, slopes, strict=False):
                step = 1e-4
                difference = (shares(start + step * direction) - shares(start - step * direction)) / (2 * step)
                # nodes follow mean and noise in the difference, not in the derivative: of second order in the spread
                near = 2e-3 if smooth else 0.1
                np.testing.assert_allclose(slope, difference, atol=near * np.abs(difference).max() + 1e-7)


def test_series_for_bright_light_is_near_the_sum():
    """Above 150 e- the Edgeworth series differs from the exact sum by less than 1e-4 in any cumulated share."""
    rng = np.random.default_rng(6)
    for _ in range(20):
        gain = float(rng.uniform(0.2, 2))
        noise = float(rng.uniform(1.0, 5.0))
        mean = rng.uniform(150, 1500, 1)
        edges = np.arange(0.0, 2.0 * gain * mean[0], max(1.0, gain * 3))
        both = [code_law(edges, gain, 5.0, noise, mean, np.zeros(1), smooth=smooth) for smooth in (False, True)]
        np.testing.assert_allclose(*(np.cumsum(law.shares, axis=1) for law in both), atol=1e-4)
