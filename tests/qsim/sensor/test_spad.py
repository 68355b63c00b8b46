"""Clocked pixels against an arbitrary-precision oracle, and the laws of planes."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from law_errors import LIMITS, errors
from stats import assert_histogram

from qsim.keys import Key
from qsim.sensor.spad import BinarySPAD


def binomial_oracle(planes: int, photons: float, pde: float, dark: float) -> tuple[list, list]:
    """Binomial(M, p) and dF_k/dphotons = dp/dphotons dF_k/dp, the latter summed from the pmf's own derivatives."""
    rate = (mp.mpf(pde) * mp.mpf(photons) + mp.mpf(dark)) / planes
    q = mp.e**-rate
    p = -mp.expm1(-rate)
    pmf = [mp.binomial(planes, k) * p**k * q ** (planes - k) for k in range(planes + 1)]
    slope = []
    total = mp.mpf(0)
    for k in range(planes):  # d pmf / dp = C(M, k) [k p^(k-1) q^(M-k) - (M-k) p^k q^(M-k-1)], dp/dphotons = pde q / M
        rises = k * p ** (k - 1) * q ** (planes - k) if k else 0
        total += mp.binomial(planes, k) * (rises - (planes - k) * p**k * q ** (planes - k - 1))
        slope.append(total * mp.mpf(pde) / planes * q)
    return pmf, slope


def binary_errors(bits: int) -> np.ndarray:
    sensor = BinarySPAD(0.4, 0.01, bits)
    worst = np.zeros(3)
    with mp.workdps(400):  # the oracle's slope is a sum that cancels
        for photons in (0.0, *10.0 ** np.arange(-12, 13, 3), 0.3, 3.25, 26.0, 200.0, 1500.0, 2e4):
            worst = np.maximum(worst, errors(sensor, photons, *binomial_oracle(sensor.planes, photons, 0.4, 0.01)))
    return worst


@pytest.mark.parametrize("bits", [1, 3, 5])
def test_sums_of_planes_agree_with_the_oracle(bits):
    worst = binary_errors(bits)
    assert np.all(worst < LIMITS), worst


@pytest.mark.slow
def test_sums_of_127_planes_agree_with_the_oracle():
    worst = binary_errors(7)
    assert np.all(worst < LIMITS), worst


def test_two_bit_depths_of_one_plane_rate_use_the_same_photons():
    """Frame f of 3 bits is the sum of the 1-bit frames 7 f ... 7 f + 6 of the same key."""
    light = np.random.default_rng(0).uniform(0, 20, (9, 13))
    key = Key(1, 2, frame=5)
    deep = BinarySPAD(0.4, 100.0, 3).sample(light, 7e-4, key=key, engine="reference")
    planes = np.broadcast_to(light / 7, (7, 9, 13))
    flat = BinarySPAD(0.4, 100.0).sample(planes, 1e-4, key=key.at(35), engine="reference")
    np.testing.assert_array_equal(deep, flat.sum(axis=0))
    assert 0 < deep.mean() < 7


@pytest.mark.parametrize("planes", [2, 10, 100])
def test_a_sum_of_any_number_of_planes_has_the_law_and_the_photons_of_its_planes(planes):
    """M need not be 2^bits - 1: the same planes of the same key, in the reference and in the compiled engine."""
    sensor = BinarySPAD(0.4, 100.0).of_planes(planes)
    assert (sensor.levels, sensor.white(1.0)) == (planes + 1, planes / 0.4)
    assert sensor.to_dict()["summed"] == planes
    light = np.random.default_rng(0).uniform(0, 2 * planes, (128, 129))
    key = Key(1, 2, frame=5)
    flat = BinarySPAD(0.4, 100.0).sample(
        np.broadcast_to(light / planes, (planes, *light.shape)), 1e-4, key=key.at(5 * planes), engine="reference"
    )
    for engine in ("reference", "fast"):
        codes = sensor.sample(light, planes * 1e-4, key=key, engine=engine)
        assert np.count_nonzero(codes != flat.sum(axis=0)) < 3  # the compiled engine rounds
    expected, _ = binomial_oracle(planes, 3.0, 0.4, 100.0 * planes * 1e-4)
    np.testing.assert_allclose(sensor.pmf(3.0, planes * 1e-4), [float(p) for p in expected], rtol=1e-9)


def test_sums_of_all_planes_of_a_depth_are_one_sensor():
    assert BinarySPAD(0.4, 1.0).of_planes(7) == BinarySPAD(0.4, 1.0, 3)
    assert "summed" not in BinarySPAD(0.4, 1.0).of_planes(7).to_dict()
    with pytest.raises(ValueError, match="a code of 3 bits sums 4 to 7 planes, got 9"):
        BinarySPAD(0.4, 1.0, 3, 9)


def test_planes_that_see_their_own_instant_are_summed_in_groups():
    """A light that is on in the first group only: the second code holds dark counts, of which there are none."""
    sensor = BinarySPAD(0.5, 0.0, 2)
    light = np.zeros((6, 5, 7))
    light[:3] = 4.0
    codes = sensor.sample_planes(light, 1e-4, key=Key(3, 4), engine="reference")
    assert codes.shape == (2, 5, 7)
    assert codes[1].max() == 0
    assert codes[0].mean() > 1.5
    steady = sensor.sample(np.full((5, 7), 12.0), 3e-4, key=Key(3, 4), engine="reference")
    np.testing.assert_array_equal(codes[0], steady)


def test_planes_at_constant_light_are_the_codes_of_a_stack():
    """A clip at the plane rate whose light holds still for each code: the same codes as at the code rate."""
    sensor = BinarySPAD(0.4, 50.0, 2)
    light = np.random.default_rng(1).uniform(0, 9, (3, 6, 9))
    key = Key(2, 3, frame=4)
    planes = sensor.sample_planes(np.repeat(light / 3, 3, axis=0), 1e-4, key=key, engine="reference")
    np.testing.assert_array_equal(planes, sensor.sample(light, 3e-4, key=key, engine="reference"))


def test_planes_in_the_wrong_number_are_refused():
    with pytest.raises(ValueError, match=r"planes of a 3-bit code come in groups of 7: \[T 7, H, W\], got \[8, 2, 2\]"):
        BinarySPAD(0.5, 0.0, 3).sample_planes(np.ones((8, 2, 2)), 1e-4, key=Key(0, 0))


@pytest.mark.parametrize(("bits", "photons"), [(1, 0.7), (3, 4.9), (5, 60.0)])
def test_codes_of_planes_are_binomial(bits, photons):
    sensor = BinarySPAD(0.4, 300.0, bits)
    codes = sensor.sample(np.full((200, 203), photons), 1e-3, key=Key(8, bits), engine="reference")
    assert_histogram(codes, sensor.pmf(photons, 1e-3), checks=3)


@pytest.mark.parametrize("bits", [9, 12, 16])
@pytest.mark.parametrize("light", [0.0005, 0.4, 5.0])
def test_sums_of_many_planes_are_binomial_drawn_at_once(bits, light):
    """By one number per pixel: the law of a sum of planes."""
    sensor = BinarySPAD(0.4, 300.0, bits)
    photons = light * sensor.planes
    codes = sensor.sample(np.full((200, 203), photons), 1e-3, key=Key(8, bits), engine="reference")
    assert_histogram(codes, sensor.pmf(photons, 1e-3), checks=9)


def test_sixteen_bits_are_65535_planes():
    """Mean M p within 6 sigma of 12 pixels, each Binomial(65535, p)."""
    sensor = BinarySPAD(0.5, 0.0, 16)
    codes = sensor.sample(np.full((3, 4), 65535.0), 1.0, key=Key(1, 1), engine="reference")
    p = -np.expm1(-0.5)
    assert codes.dtype == np.uint16
    assert abs(codes.mean() - 65535 * p) < 6 * np.sqrt(65535 * p * (1 - p) / 12)


def test_settings_of_a_clocked_pixel_that_make_no_sense_are_named():
    with pytest.raises(ValueError, match=r"^BinarySPAD.pde is a number, above 0 and at most 1; got 45$"):
        BinarySPAD(45, 0.0)
