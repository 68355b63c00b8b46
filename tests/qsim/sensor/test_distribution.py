"""The laws that follow from a cdf: probabilities, moments, likelihood, information, codes of uniform numbers."""

from __future__ import annotations

import numpy as np
import pytest
from sensor_cases import EXPOSURE, SENSORS, each

from qsim.keys import Key
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD


@each
def test_the_three_descriptions_agree(sensor: Sensor):
    """cdf = sum of exp(log_pmf); dcdf = its derivative, by differences of 4th order with an error near 1e-10."""
    light = np.array([0.02, 0.7, 3.25, 9.75, 40.0])
    cdf = sensor.cdf(light, EXPOSURE)
    pmf = np.exp(sensor.log_pmf(light, EXPOSURE))
    np.testing.assert_allclose(np.cumsum(pmf, axis=-1), cdf, atol=1e-12)
    np.testing.assert_array_equal(cdf[:, -1], 1.0)
    h = 1e-3
    near, far = (sensor.cdf(light + d, EXPOSURE) - sensor.cdf(light - d, EXPOSURE) for d in (h, 2 * h))
    np.testing.assert_allclose(sensor.dcdf(light, EXPOSURE), (8 * near - far) / (12 * h), atol=1e-9)


@each
@pytest.mark.parametrize("light", [0.0, 1e-12, 1e4, 1e12])
def test_extreme_light_is_a_distribution(sensor: Sensor, light):
    """One pixel, and a frame that is drawn: no NaN, no code without probability, nothing above 1."""
    cdf, pmf, log_pmf = (f(light, EXPOSURE) for f in (sensor.cdf, sensor.pmf, sensor.log_pmf))
    assert np.all((cdf >= 0) & (cdf <= 1) & (np.diff(cdf, prepend=0.0) >= -1e-15))
    assert pmf.sum() == pytest.approx(1.0, abs=1e-12)
    assert not np.isnan(log_pmf).any()
    assert not np.isnan(sensor.fisher_information(light, EXPOSURE))
    codes = sensor.sample(np.full((5, 9), light), EXPOSURE, key=Key(0, 1), engine="reference")
    assert np.all(pmf[codes] > 0)


@each
def test_shapes_follow_the_light(sensor: Sensor):
    light = np.linspace(0, 9, 6).reshape(2, 3)
    for function in (sensor.cdf, sensor.log_pmf, sensor.dcdf, sensor.pmf):
        assert function(light, EXPOSURE).shape == (2, 3, sensor.levels)
        np.testing.assert_allclose(function(light[1, 2], EXPOSURE), function(light, EXPOSURE)[1, 2], rtol=1e-13)
    for function in (sensor.mean, sensor.variance, sensor.fisher_information):
        assert function(light, EXPOSURE).shape == (2, 3)
    assert sensor.cdf(np.zeros((0, 4)), EXPOSURE).shape == (0, 4, sensor.levels)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, -1e-9])
@pytest.mark.parametrize("sensor", [SENSORS[0], SENSORS[3], SENSORS[7]])
def test_impossible_light_is_named(sensor: Sensor, wrong):
    light = np.full((2, 3, 4), 1.5)
    light[1, 2, 0] = light[1, 2, 1] = wrong
    message = rf"^photons\[1, 2, 0\] is {wrong!r}; expected photons are finite and not negative$"
    for function in (sensor.cdf, sensor.log_pmf, sensor.dcdf, sensor.mean, sensor.fisher_information):
        with pytest.raises(ValueError, match=message):
            function(light, EXPOSURE)


@pytest.mark.parametrize("exposure", [0.0, -1.0, np.nan, np.inf])
def test_impossible_exposure_is_named(exposure):
    with pytest.raises(ValueError, match="exposure is in seconds, finite and above 0, got"):
        SENSORS[0].cdf(1.0, exposure)


def test_small_means_keep_their_digits():
    """1e-12 photons on a perfect 1-bit pixel: mean and variance are 1e-12, not a difference of ones."""
    sensor = QIS(1.0, 0.0, 0.0, 1)
    assert sensor.mean(1e-12, EXPOSURE) == pytest.approx(1e-12, rel=1e-12)
    assert sensor.variance(1e-12, EXPOSURE) == pytest.approx(1e-12, rel=1e-12)


def test_mean_code_of_the_published_profile():
    """4.20 e-, gain 1.0769: mean code / 7 is 0.607 and std 1.91; with the paper's text 0.371 and 1.59 (spec.md, 4)."""
    published = QIS(0.8, 1.6 / EXPOSURE, 0.2, 3, gain=0.5 * 7 / 3.25)
    paper = QIS(0.8, 1.6, 0.2, 3)
    for sensor, mean, deviation, dark, bright in (
        (published, 0.607, 1.91, 0.015, 0.182),
        (paper, 0.371, 1.59, 0.075, 0.017),
    ):
        pmf = sensor.pmf(3.25, EXPOSURE)
        assert sensor.mean(3.25, EXPOSURE) / 7 == pytest.approx(mean, abs=5e-4)
        assert np.sqrt(sensor.variance(3.25, EXPOSURE)) == pytest.approx(deviation, abs=5e-3)
        assert (pmf[0], pmf[7]) == (pytest.approx(dark, abs=5e-4), pytest.approx(bright, abs=5e-4))


def test_log_likelihood_picks_the_code_and_broadcasts():
    sensor = SENSORS[0]
    light = np.array([[1.0, 5.0, 9.0], [0.0, 2.0, 3.0]])
    codes = np.array([[[0, 7, 3], [1, 2, 6]], [[5, 0, 0], [7, 1, 4]]], np.uint8)
    found = sensor.log_likelihood(codes, light, EXPOSURE)
    assert found.shape == (2, 2, 3)
    for t, y, x in np.ndindex(codes.shape):
        expected = sensor.log_pmf(light[y, x], EXPOSURE)[codes[t, y, x]]
        assert found[t, y, x] == pytest.approx(expected, rel=1e-13)
    with pytest.raises(ValueError, match=r"codes are integers 0 ... 7 of this 3-bit sensor"):
        sensor.log_likelihood(np.array([8]), light[0, :1], EXPOSURE)


def test_fisher_information_of_simple_pixels():
    """One plane: pde^2 q / p; an ideal counter that never clips: pde / photons; nothing left at 1e9 photons."""
    q = np.exp(-0.4 * 3.0)
    assert BinarySPAD(0.4, 0.0).fisher_information(3.0, EXPOSURE) == pytest.approx(0.16 * q / (1 - q), rel=1e-12)
    assert QIS(0.8, 0.0, 0.0, 8).fisher_information(20.0, EXPOSURE) == pytest.approx(0.8 / 20.0, rel=1e-12)
    assert BinarySPAD(0.4, 0.0).fisher_information(0.0, EXPOSURE) == np.inf
    for sensor in SENSORS:
        assert np.isfinite(sensor.fisher_information(np.array([1e-3, 30.0, 1e9]), EXPOSURE)).all()


def test_tails_are_drawn_to_two_to_the_minus_64():
    """At 0.01 photons codes above 3 need u within 1e-9 of 1: words near 2^64 reach them, from the survival function."""
    sensor = QIS(0.8, 1.6, 0.2, 3)
    survival = np.cumsum(sensor.pmf(0.01, EXPOSURE)[::-1])[::-1]  # P(code >= k)
    for k in range(4, 8):
        v = round(survival[k] * 2.0**64)  # 1 - u in units of 2^-64
        for offset, code in ((-max(1, v // 100), k), (max(1, v // 100), k - 1)):
            place = 2**64 - 1 - max(v + offset, 0)
            first = np.array([place >> 32], np.uint32)
            second = np.array([place & 0xFFFFFFFF], np.uint32)
            assert sensor.codes_at(first, second, np.array([0.01]), EXPOSURE)[0] == code
    lowest = np.zeros(1, np.uint32)
    assert sensor.codes_at(lowest, lowest, np.array([30.0]), EXPOSURE)[0] == 0
