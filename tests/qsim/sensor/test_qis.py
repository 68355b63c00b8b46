"""The Poisson-Gaussian-ADC pixel against an arbitrary-precision oracle, and its hard cases."""

from __future__ import annotations

from itertools import product
from math import inf

import mpmath as mp
import numpy as np
import pytest
from scipy.special import ndtr
from stats import assert_histogram, assert_mean

from qsim.keys import Key
from qsim.sensor.poisson import poisson_log_pmf
from qsim.sensor.qis import QIS

EXPOSURE = 5e-4
LIGHT = np.array([0.0, *10.0 ** np.arange(-12, 13, 3), 0.03, 0.5, 3.25, 9.75, 26.0, 75.0, 200.0, 450.0, 1500.0])


def oracle(sensor: QIS, photons: np.ndarray, levels: list[int]) -> tuple[list, list, list]:
    """P(code <= k), P(code = k), dP(code <= k)/dphotons for some k, by the definition, with 60 digits: [photons][k]."""
    with mp.workdps(60):
        top = sensor.levels - 1
        sigma = mp.mpf(sensor.read_noise)
        well = mp.mpf(sensor.full_well) if sensor.full_well is not None else mp.inf
        highest = (mp.mpf(max(k for k in levels if k < top)) + 0.5 - mp.mpf(sensor.offset)) / mp.mpf(sensor.gain)
        last = max(int(mp.ceil(min(well, highest + 45 * sigma))) + 2, 1)

        def at_most(k: int, n: int) -> tuple:  # (P(code <= k | n), P(code > k | n)), both with full relative precision
            if k in (-1, top):
                return (mp.mpf(k == top), mp.mpf(k != top))
            electrons = min(mp.mpf(n), well)
            if sigma == 0:  # the ADC rounds the float64 value of gain n + offset; Python rounds half to even
                code = round(sensor.gain * float(electrons) + sensor.offset)
                return (mp.mpf(code <= k), mp.mpf(code > k))
            z = ((k + mp.mpf(0.5) - mp.mpf(sensor.offset)) / mp.mpf(sensor.gain) - electrons) / sigma / mp.sqrt(2)
            return (mp.erfc(-z) / 2, mp.erfc(z) / 2)

        def minus(a: tuple, b: tuple):  # of two such pairs, on the side where both are small
            return a[0] - b[0] if a[0] < 0.5 else b[1] - a[1]

        table = {k: [at_most(k, n) for n in range(last + 2)] for k in {j for k in levels for j in (k - 1, k)}}
        cdf = []
        pmf = []
        slope = []
        for light in photons:
            mean = mp.mpf(sensor.quantum_efficiency) * mp.mpf(light) + mp.mpf(sensor.dark_current) * mp.mpf(EXPOSURE)
            weights = [mp.e**-mean]
            for n in range(1, last + 1):
                weights.append(weights[-1] * mean / n)
            rest = mp.mpf(1) if mean > 1e5 else mp.gammainc(last + 1, 0, mean, regularized=True)  # P(N > last)
            cdf.append([mp.fdot(weights, [c[0] for c in table[k]]) + rest * table[k][-1][0] for k in levels])
            mass = {k: [minus(a, b) for a, b in zip(table[k], table[k - 1], strict=True)] for k in levels}
            pmf.append([mp.fdot(weights, mass[k]) + rest * mass[k][-1] for k in levels])
            change = {k: [minus(table[k][n + 1], table[k][n]) for n in range(last + 1)] for k in levels}
            slope.append([mp.mpf(sensor.quantum_efficiency) * mp.fdot(weights, change[k]) for k in levels])
        return cdf, pmf, slope


def largest_errors(sensor: QIS, photons: np.ndarray, levels: list[int]) -> tuple[float, float, float]:
    """Absolute error of the cdf, of the logarithm where P > 1e-280, relative error of the slope above 1e-280."""
    cdf, pmf, slope = oracle(sensor, photons, levels)
    found = [f(photons, EXPOSURE)[:, levels] for f in (sensor.cdf, sensor.log_pmf, sensor.dcdf)]
    worst = [0.0, 0.0, 0.0]
    for i, j in np.ndindex(len(photons), len(levels)):
        worst[0] = max(worst[0], abs(float(found[0][i, j] - cdf[i][j])))
        if pmf[i][j] > 1e-280:
            worst[1] = max(worst[1], abs(float(found[1][i, j] - mp.log(pmf[i][j]))))
        if abs(slope[i][j]) > 1e-280:
            worst[2] = max(worst[2], abs(float(found[2][i, j] / slope[i][j] - 1)))
    return tuple(worst)


@pytest.mark.parametrize(
    ("bits", "read_noise", "gain"), [(1, 0.2, 1.0), (3, 0.0, 0.5), (3, 0.2, 1.0769), (3, 5.1, 0.5)]
)
def test_probabilities_agree_with_the_oracle(bits, read_noise, gain):
    sensor = QIS(0.8, 1.6, read_noise, bits, gain)
    errors = largest_errors(sensor, LIGHT, list(range(sensor.levels)))
    assert np.all(np.array(errors) < (1e-10, 1e-8, 1e-8)), errors


@pytest.mark.parametrize("well", [3.0, 4.5, 200.0])
def test_full_well_agrees_with_the_oracle(well):
    """N above the well counts as the well, also if that is no integer; read noise comes after it."""
    sensor = QIS(0.8, 1.6, 0.6, 3, 0.9, offset=0.3, full_well=well)
    errors = largest_errors(sensor, LIGHT, list(range(8)))
    assert np.all(np.array(errors) < (1e-10, 1e-8, 1e-8)), errors


GRID = list(product((1, 3, 5, 7), (0.0, 0.05, 0.2, 1.0, 5.1), (0.135, 0.3590, 1.0, 1.0769, 1.08), (None, 40.0)))


@pytest.mark.slow
@pytest.mark.parametrize(("bits", "read_noise", "gain", "well"), GRID)
def test_probabilities_agree_with_the_oracle_everywhere(bits, read_noise, gain, well):
    """The grid of bits, read noise, gain and full well; of 7 bits every ninth code."""
    sensor = QIS(0.8, 1.6, read_noise, bits, gain, full_well=well)
    step = {5: 3, 7: 9}.get(bits, 1)
    levels = sorted({*range(0, sensor.levels, step), sensor.levels - 1})
    errors = largest_errors(sensor, LIGHT, levels)
    assert np.all(np.array(errors) < (1e-10, 1e-8, 1e-8)), errors


def test_ties_round_half_to_even():
    """Gain 0.5, no read noise: 1 electron is 0.5 -> 0, 3 are 1.5 -> 2, 5 are 2.5 -> 2, 7 are 3.5 -> 4."""
    sensor = QIS(1.0, 0.0, 0.0, 3, gain=0.5)
    poisson = np.exp(-2.0) * np.cumprod([1.0, *(2.0 / np.arange(1, 9))])
    expected = [poisson[0] + poisson[1], poisson[2], poisson[3] + poisson[4] + poisson[5], poisson[6]]
    np.testing.assert_allclose(sensor.pmf(2.0, EXPOSURE)[:4], expected, rtol=1e-13)


def test_impossible_codes_have_no_probability():
    """Gain 10 without read noise jumps from code 0 to code 10: 7 codes between never occur, at any light."""
    log_pmf = QIS(1.0, 0.0, 0.0, 4, gain=10.0).log_pmf(np.array([0.5, 1e6]), EXPOSURE)
    assert np.all(log_pmf[:, 1:10] == -inf)
    assert np.all(np.isfinite(log_pmf[:, [0, 10]]))


def test_tails_are_probabilities_not_differences():
    """At 0.01 photons a difference of F would call the top code impossible; it has a probability of 4.8e-18."""
    assert QIS(0.8, 1.6, 0.2, 3).pmf(0.01, EXPOSURE)[7] == pytest.approx(4.8e-18, rel=0.01)


@pytest.mark.parametrize("photons", [0.0, 1e-12, 1e3, 1e12])
@pytest.mark.parametrize(
    "sensor",
    [
        QIS(1.0, 0.0, 0.0, 1),
        QIS(0.8, 1.6, 0.05, 8, 0.1),
        QIS(0.8, 1.6, 5.1, 5, 10.0),
        QIS(0.8, 1e7, 1e-3, 3, full_well=0.4),
        QIS(0.8, 1.6, 0.2, 3, offset=50.0),
        QIS(0.8, 1.6, 0.2, 3, offset=-50.0),
    ],
)
def test_extreme_light_is_a_distribution(sensor, photons):
    cdf = sensor.cdf(photons, EXPOSURE)
    pmf = sensor.pmf(photons, EXPOSURE)
    assert np.all(np.diff(cdf) >= -1e-15)
    assert cdf[-1] == pytest.approx(1.0, abs=1e-13)
    assert pmf.sum() == pytest.approx(1.0, abs=1e-12)
    assert np.all(sensor.dcdf(photons, EXPOSURE) <= 0)
    assert not np.isnan(sensor.log_pmf(photons, EXPOSURE)).any()


def test_wide_codes_are_computed_in_blocks_that_fit():
    """12 bits are 16 tables; their seams carry the same distribution as one Gaussian-smoothed Poisson."""
    sensor = QIS(0.6, 0.0, 2.0, 12, gain=1.3, offset=64.0)
    photons = np.array([0.0, 300.0, 2000.0])
    pmf = sensor.pmf(photons, EXPOSURE)
    codes = np.arange(4096)
    np.testing.assert_allclose(np.cumsum(pmf, axis=1), sensor.cdf(photons, EXPOSURE), atol=1e-10)
    mean = 1.3 * 0.6 * photons + 64
    np.testing.assert_allclose(pmf @ codes, mean, rtol=1e-9)
    # Rounding to whole codes adds 1/12: at a sigma of 2.6 codes that law holds to exp(-2 pi^2 2.6^2) = 1e-58
    np.testing.assert_allclose(sensor.variance(photons, EXPOSURE), 1.69 * (0.6 * photons + 4) + 1 / 12, rtol=1e-7)


def test_many_electrons_per_code_are_computed_in_blocks_that_fit():
    """A hundredth of a code per electron: tables of 40 codes and 4000 electrons each, against one sum over all."""
    sensor = QIS(0.8, 0.0, 7.0, 8, gain=0.01)
    light = np.array([0.0, 900.0, 12_000.0])
    pmf = sensor.pmf(light, EXPOSURE)
    codes = np.arange(256)
    np.testing.assert_allclose(np.cumsum(pmf, axis=1), sensor.cdf(light, EXPOSURE), atol=1e-11)
    electrons = np.arange(12_000)
    weights = np.exp(poisson_log_pmf(0.8 * light[2], electrons))
    below = ndtr(((codes[:-1] + 0.5) / 0.01 - electrons[:, None]) / 7.0)
    np.testing.assert_allclose(sensor.cdf(light[2], EXPOSURE)[:-1], weights @ below, atol=1e-11)


def test_sixteen_bits_draw_the_process():
    """Mean and variance of 16-bit codes are those of gain (N + 3.3 z) + 500 plus 1/12 of rounding."""
    sensor = QIS(0.7, 20.0, 3.3, 16, gain=1.7, offset=500.0)
    codes = sensor.sample(np.full((3, 120, 101), 12_000.0), EXPOSURE, key=Key(5, 6), engine="reference")
    electrons = 0.7 * 12_000 + 20 * EXPOSURE
    assert codes.dtype == np.uint16
    assert_mean(codes, 1.7 * electrons + 500, 1.7**2 * (electrons + 3.3**2) + 1 / 12)


@pytest.mark.parametrize(("bits", "read_noise", "photons"), [(3, 0.2, 3.25), (5, 0.0, 11.0), (7, 5.1, 60.0)])
def test_the_process_has_the_distribution_of_the_cdf(bits, read_noise, photons):
    """Two engines, one function: the step-by-step draw, used above 8 bits, against the pmf of few bits."""
    sensor = QIS(0.8, 1.6, read_noise, bits, gain=1.0769, full_well=photons)  # passed by 4 to 26 % of the pixels
    light = np.full((300, 401), photons)
    codes = sensor.read_out(light, EXPOSURE, Key(7, bits))
    assert_histogram(codes, sensor.pmf(photons, EXPOSURE), checks=3)


def test_fewer_bits_of_the_same_pixel_are_the_clipped_code():
    """The same key, gain and offset: a 1-bit, a 3-bit and a 5-bit read-out have the same electrons."""
    light = np.random.default_rng(0).uniform(0, 30, (40, 37))
    wide = QIS(0.8, 1.6, 0.2, 5).sample(light, EXPOSURE, key=Key(1, 2), engine="reference")
    for bits in (1, 3):
        narrow = QIS(0.8, 1.6, 0.2, bits).sample(light, EXPOSURE, key=Key(1, 2), engine="reference")
        np.testing.assert_array_equal(narrow, np.minimum(wide, 2**bits - 1))


def test_white_follows_from_the_settings_alone():
    """8.125 photons at the gain of 3.25 PPP: 7 / (0.5 * 7 / 3.25 * 0.8)."""
    assert QIS(0.8, 1.6, 0.2, 3, gain=0.5 * 7 / 3.25).white(EXPOSURE) == pytest.approx(8.125)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("quantum_efficiency", 80.0, "QIS.quantum_efficiency is a number, above 0 and at most 1; got 80.0"),
        ("read_noise", -0.1, "QIS.read_noise is a number, at least 0; got -0.1"),
        ("bits", 17, "QIS.bits is an integer 1 ... 16, got 17"),
        ("bits", 3.0, "QIS.bits is an integer 1 ... 16, got 3.0"),
        ("gain", "1", "QIS.gain is a number, above 0; got '1'"),
        ("full_well", float("nan"), "QIS.full_well is a number, above 0; got nan"),
    ],
)
def test_settings_that_make_no_sense_are_named(field, value, message):
    settings = {"quantum_efficiency": 0.8, "dark_current": 1.6, "read_noise": 0.2, "bits": 3, field: value}
    with pytest.raises(ValueError, match="^" + message.replace(".", r"\.") + "$"):
        QIS(**settings)


def test_a_wrong_gain_does_not_pass():
    """The power of the 16-bit check: of 1 % more gain it makes 27 sigmas of 36 360 pixels."""
    codes = QIS(0.7, 20.0, 3.3, 16, gain=1.717, offset=500.0).sample(
        np.full((3, 120, 101), 12_000.0), EXPOSURE, key=Key(5, 6), engine="reference"
    )
    with pytest.raises(AssertionError, match="z = "):
        assert_mean(codes, 1.7 * 8400.01 + 500, 1.7**2 * (8400.01 + 3.3**2) + 1 / 12)
