"""Estimates from few codes are unbiased: exact expectations under laws that are written here, and a simulator's light.

The bound is the documented one: 0.5 % of the light from 0.05 detections on, up to 1.5 of six and more binary planes.
"""

import numpy as np
import pytest
from scipy import stats
from stats import critical_z

from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from qsim.sensor.spike import SpikeCamera
from quiver.baselines import exposures, likelihood, moment

EXPOSURE = 1e-4
ALLOWED = 0.005
DETECTIONS = np.geomspace(0.05, 1.5, 12)


@pytest.mark.parametrize("method", [moment, likelihood])
@pytest.mark.parametrize(("window", "seen", "bits"), [(11, 11, 1), (11, 6, 1), (15, 8, 1), (3, 3, 3), (1, 1, 4)])
def test_few_binary_planes_are_unbiased_at_the_ends_of_a_clip_too(method, window, seen, bits):
    """Binomial expectations over every number of detections; the first frame in a window of 11 sees 6 frames."""
    rng = np.random.default_rng(3)
    top = 2**bits - 1
    totals = np.arange(seen * top + 1)
    codes = np.zeros((window, 1, len(totals)), np.uint8)
    codes[:seen, 0] = np.clip(totals - np.arange(seen)[:, None] * top, 0, top)  # any codes of this sum
    frame = 0 if seen < window else window // 2
    for dark in (0.0, 0.02, 0.05):  # detections of a plane
        efficiency = rng.uniform(0.1, 1)
        sensor = BinarySPAD(efficiency, dark * top / EXPOSURE, bits)
        found = method.restore(codes, sensor, EXPOSURE, window=window, frames=range(frame, frame + 1))[0, 0]
        light = DETECTIONS * top / efficiency
        chance = -np.expm1(-(DETECTIONS + dark))
        expected = stats.binom.pmf(totals, len(totals) - 1, chance[:, None]) @ found.astype(float)
        np.testing.assert_allclose(expected, light, rtol=ALLOWED)
        assert np.isfinite(found).all()
        assert found[0] == pytest.approx(-dark * top / efficiency, abs=0.01 * top / efficiency)  # no floor at 0
        assert found[-1] < 20 * top / efficiency


@pytest.mark.parametrize("method", ["moment", "likelihood"])
@pytest.mark.parametrize("bits", [1, 2])
def test_sums_of_planes_in_a_schedule_are_unbiased(method, bits):
    """Three exposures in turn, binomial draws of our own; the tolerance is the bound and that of 20 000 pixels."""
    rng = np.random.default_rng(4)
    shares = np.resize([1, 0.25, 0.0625], 11)
    top = 2**bits - 1
    sensor = BinarySPAD(0.4, 200.0, bits)
    for detections in DETECTIONS[::4]:
        light = detections * top / 0.4
        chance = -np.expm1(-shares * (0.4 * light + 200 * EXPOSURE) / top)
        codes = rng.binomial(top, chance[:, None], (11, 20_000)).astype(np.uint8)
        found = exposures.METHODS[method](codes, shares, sensor, EXPOSURE)
        error = critical_z(checks=12) * found.std() / np.sqrt(found.size)
        assert abs(found.mean() - light) < error + ALLOWED * light


def test_one_bit_and_several_of_a_noisy_sensor_are_unbiased():
    """Electrons, normal read noise and rounding drawn here; light of 0.1 to 1.5 electrons."""
    rng = np.random.default_rng(5)
    for bits, offset in ((1, 0.0), (3, 0.0), (3, 0.4)):
        sensor = QIS(0.8, 500.0, 0.25, bits, offset=offset)
        for electrons in (0.1, 0.5, 1.5):
            expected = electrons + 500 * EXPOSURE
            read = rng.poisson(expected, (11, 1, 20_000)) + 0.25 * rng.standard_normal((11, 1, 20_000))
            codes = np.clip(np.rint(read + offset), 0, 2**bits - 1).astype(np.uint8)
            for method in (moment, likelihood):
                found = method.restore(codes, sensor, EXPOSURE, frames=range(5, 6)).astype(float)
                error = critical_z(checks=18) * found.std() / np.sqrt(found.size)
                assert abs(found.mean() - electrons / 0.8) < error + 0.01 * electrons / 0.8


def test_sums_of_spikes_are_left_as_they_are():
    """Spikes of a pixel that subtracts its threshold count its charge: the light is linear in their number."""
    sensor = SpikeCamera(0.5, 0.0, 10)
    codes = np.zeros((11, 1, 2), np.uint8)
    codes[:4, 0, 1] = 1
    found = moment.restore(codes, sensor, EXPOSURE, frames=range(5, 6))
    np.testing.assert_allclose(found[0, 0], [0, 4 / 11 * 20], rtol=1e-3, atol=1e-3)
