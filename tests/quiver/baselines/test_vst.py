"""Variance stabilisation from the exact distribution, its unbiased inverse, and Transform Denoise on top."""

import numpy as np
import pytest
from stats import assert_mean

from qsim.keys import Key
from qsim.sensor.devices import quiver_physical
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from quiver.baselines import moment, transform_denoise
from quiver.baselines.vst import stabiliser, sum_pmf

EXPOSURE = 5e-4
SENSOR = QIS(0.8, 1.6, 0.2, 3, gain=3.5 / 3.25)
PHOTONS = np.array([0.3, 1, 2, 3.25, 5, 8])


def deviations(kind, samples):
    """Exact deviation of f(mean of `samples` codes) over its target 1/sqrt(samples), at PHOTONS."""
    transform = stabiliser(SENSOR, EXPOSURE, (1,) * samples, kind)
    pmf = sum_pmf(np.exp(SENSOR.log_pmf(PHOTONS, EXPOSURE)), (1,) * samples)
    f = transform.forward(np.arange(pmf.shape[1]) / samples).astype(float)
    return np.sqrt(pmf @ f**2 - (pmf @ f) ** 2) / transform.deviation


@pytest.mark.parametrize(
    ("kind", "samples", "expected"),
    [
        ("table", 11, [1.08, 1.02, 1.01, 1.01, 1.02, 1.05]),
        ("table", 3, [1.05, 1.14, 1.07, 1.05, 1.09, 1.24]),
        ("table", 1, [0.79, 1.13, 1.22, 1.27, 1.37, 1.23]),
        ("binomial", 11, [1.02, 1.09, 1.19, 1.32, 1.48, 1.61]),
        ("poisson", 11, [0.96, 0.99, 1.00, 1.00, 0.92, 0.63]),
    ],
)
def test_deviation_after_stabilising_worked_by_hand(kind, samples, expected):
    """Computed once from the sensor's definition, to two digits."""
    np.testing.assert_allclose(deviations(kind, samples), expected, atol=0.012)


def test_only_the_table_stabilises_within_three_percent():
    """Eleven frames, from 1 to 5 photons, where few codes are 0 or saturated: the other forms exceed 3 %."""
    inner = slice(1, 5)
    assert np.abs(deviations("table", 11)[inner] - 1).max() < 0.03
    assert np.abs(deviations("binomial", 11)[inner] - 1).max() > 0.3
    assert np.abs(deviations("poisson", 11)[inner] - 1).max() > 0.07


@pytest.mark.parametrize("times", [(1,), (1, 1, 1), (1,) * 11, (2, 2, 2, 2, 2, 1), (11,)], ids=str)
@pytest.mark.parametrize("sensor", [SENSOR, BinarySPAD(0.4, 25.0, 3), quiver_physical(3.25, bits=1)], ids=str)
def test_the_inverse_is_unbiased(sensor, times):
    """E[f], the result of a perfect denoiser, gives the light; the inverse of f would not."""
    transform = stabiliser(sensor, EXPOSURE, times)
    photons = np.linspace(0.02, 0.9, 7) * transform.photons[-1]
    pmf = sum_pmf(np.exp(sensor.log_pmf(photons, EXPOSURE)), times)
    expected = pmf @ transform.forward(np.arange(pmf.shape[1]) / sum(times))
    np.testing.assert_allclose(transform.inverse(expected), photons, rtol=2e-4)
    algebraic = np.interp(expected, transform.stabilised, transform.mean_code)
    assert np.abs(algebraic - sensor.mean(photons, EXPOSURE)).max() > 1e-3


def test_sums_of_codes_by_both_ways_agree():
    """Direct convolution below 512 values, Fourier above; 8 bits and 3 frames take the second."""
    pmf = np.random.default_rng(0).dirichlet(np.ones(256), 2)
    direct = [np.convolve(np.convolve(p, p), p) for p in pmf]
    np.testing.assert_allclose(sum_pmf(pmf, (1, 1, 1)), direct, atol=1e-15)
    few = pmf[:, :8] / pmf[:, :8].sum(axis=1, keepdims=True)
    np.testing.assert_allclose(sum_pmf(few, (1, 1)), [np.convolve(p, p) for p in few], atol=1e-15)


@pytest.mark.parametrize("levels", [8, 256])
def test_a_code_that_counts_twice_is_no_sum_of_two(levels):
    """2 a + b: the distribution of 2 a has gaps. Eight levels go the direct way, 256 that of Fourier."""
    pmf = np.random.default_rng(1).dirichlet(np.ones(levels), 2)
    twice = np.zeros((2, 2 * levels - 1))
    twice[:, ::2] = pmf
    expected = [np.convolve(a, b) for a, b in zip(twice, pmf, strict=True)]
    np.testing.assert_allclose(sum_pmf(pmf, (2, 1)), expected, atol=1e-15)


@pytest.mark.parametrize("photons", [1.0, 3.25, 5.0])
def test_a_flat_field_denoises_to_its_light(photons):
    """The residual noise of a denoised flat field is low-pass: errors of the mean are those of the undenoised mean.

    Two more sources: shrinkage of f towards block means costs nothing on average, and D is exact. 1 % covers them.
    """
    codes = SENSOR.sample(np.full((3, 48, 56), photons), EXPOSURE, key=Key(2, 2), engine="reference")
    restored = transform_denoise.restore(codes, SENSOR, EXPOSURE)
    raw = moment.restore(codes, SENSOR, EXPOSURE, window=3)
    assert restored.std() < 0.4 * raw.std()
    information = float(SENSOR.fisher_information(np.array([photons]), EXPOSURE)[0])
    assert_mean(restored[1], photons, 1.3 / (3 * information) + restored[1].size * (0.01 * photons / 4.9) ** 2)


def test_stabilisers_have_names():
    with pytest.raises(ValueError, match="table, binomial or poisson, got 'anscombe'"):
        stabiliser(SENSOR, EXPOSURE, (1, 1, 1), "anscombe")


def test_stabilised_counts_are_those_of_anscombe():
    """For a Poisson counter f(code) = 2 sqrt(code) but for a constant: exact in the limit of a fine table."""
    transform = stabiliser(QIS(1.0, 0.0, 0.0, 8), EXPOSURE, (1,))
    codes = np.array([1.0, 4.0, 25.0, 100.0])
    np.testing.assert_allclose(np.diff(transform.forward(codes)), np.diff(2 * np.sqrt(codes)), rtol=2e-3)


def test_stabilised_means_have_variance_one():
    """Sums of 31 planes: the delta method leaves 3 / (8 mean) of the variance, 4 % at mean codes of 10 to 22."""
    sensor = BinarySPAD(0.4, 0.0, 5)
    transform = stabiliser(sensor, EXPOSURE, (1,))
    for light in (30.0, 60.0, 100.0):
        pmf = sensor.pmf(light, EXPOSURE)
        stabilised = transform.forward(np.arange(32))
        mean = pmf @ stabilised
        assert pmf @ (stabilised - mean) ** 2 == pytest.approx(1.0, abs=0.08)
        assert transform.inverse(mean) == pytest.approx(light, rel=1e-3)
