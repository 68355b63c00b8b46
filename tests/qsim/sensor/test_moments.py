"""Mean and variance without tables, against the sums over all codes, for random sensors of every kind."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from qsim.sensor import paralyzable, qis_moments
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.poisson import poisson_log_pmf
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD

LEAST = 1e-6  # codes and codes^2: below it, errors count in units of 1e-9 of this
MOST_TERMS = 1e5  # numbers of a dense table


def random_qis(rng: np.random.Generator) -> QIS:
    """Any gain, offset, full well and read noise whose dense table stays small."""
    while True:
        bits = int(rng.integers(1, 13))
        top = 2**bits - 1
        gain = 10 ** rng.uniform(-3, 3)
        noise = float(rng.choice([0.0, 10 ** rng.uniform(-4, 0), 10 ** rng.uniform(-1, 3)]))
        offset = float(rng.choice([0.0, rng.uniform(-20, 40), rng.uniform(-0.2, 0.6) * top]))
        well = None if rng.random() < 0.5 else float(10 ** rng.uniform(-0.5, np.log10(top / gain + 2) + 0.3))
        if (top / gain + 80 * noise) * top < MOST_TERMS:
            return QIS(1.0, 0.0, noise, bits, gain=gain, offset=offset, full_well=well)


def light_of(rng: np.random.Generator, brightest: float) -> np.ndarray:
    """Dark, and from far below one event to far beyond saturation."""
    return np.append(0.0, 10 ** rng.uniform(-2, np.log10(brightest) + 0.7, 9))


def assert_equal_moments(sensor: Sensor, found: tuple, expected: tuple) -> None:
    for name, some, exact in zip(("mean", "variance"), found, expected, strict=True):
        np.testing.assert_allclose(some, exact, rtol=1e-9, atol=1e-9 * LEAST, err_msg=f"{name} of {sensor!r}")


@pytest.mark.parametrize("seed", [*range(3), *(pytest.param(s, marks=pytest.mark.slow) for s in range(3, 60))])
def test_random_converters_have_the_moments_of_their_tables(seed):
    rng = np.random.default_rng(seed)
    for _ in range(8):
        sensor = random_qis(rng)
        light = light_of(rng, (sensor.levels + abs(sensor.offset)) / sensor.gain + 9 * sensor.read_noise)
        dense = sensor.dense_moments_of(light, 1.0)
        assert_equal_moments(sensor, qis_moments.moments(sensor, light), dense)


@pytest.mark.parametrize(
    "sensor",
    [
        QIS(1.0, 0.0, 0.0, 12, gain=0.25),  # codes by thresholds, between 1e4 electrons and the clip
        QIS(1.0, 0.0, 0.002, 12, gain=0.2, offset=0.5),
        QIS(1.0, 0.0, 0.0, 12, gain=1 / 7, offset=-3.3),
    ],
)
def test_steps_of_many_electrons(sensor: QIS):
    """Against the sum over all electrons near the light, each of which gives one code or the next."""
    for light in np.array([1.05e4, 1.3e4, 0.93 * (sensor.levels - sensor.offset) / sensor.gain]):
        n = np.arange(np.floor(light - 12 * np.sqrt(light)), light + 12 * np.sqrt(light))
        chance = np.exp(poisson_log_pmf(np.array(light), n))
        x = sensor.gain * n + sensor.offset
        codes = np.rint(x)
        spread = np.zeros(len(n))
        if sensor.read_noise:
            up = ndtr((x - np.floor(x) - 0.5) / (sensor.gain * sensor.read_noise))
            codes = np.floor(x) + up
            spread = up * (1 - up)
        mean = chance @ codes
        expected = np.array([mean]), np.array([chance @ (spread + (codes - mean) ** 2)])
        assert_equal_moments(sensor, qis_moments.moments(sensor, np.array([light])), expected)


@pytest.mark.parametrize("seed", [*range(2), *(pytest.param(s, marks=pytest.mark.slow) for s in range(2, 40))])
def test_random_counters_have_the_moments_of_their_tables(seed):
    rng = np.random.default_rng(seed)
    for _ in range(3):
        bits = int(rng.integers(9, 12))
        dead = float(rng.choice([0.0, 10 ** rng.uniform(-6, 0)]))
        sensors: list[Sensor] = [BinarySPAD(0.5, 10.0, bits), CountingSPAD(0.5, 10.0, dead, bits)]
        for sensor in sensors:
            light = light_of(rng, sensor.levels)
            assert_equal_moments(sensor, sensor.moments_of(light, 1.0), sensor.dense_moments_of(light, 1.0))


@pytest.mark.parametrize("bits", [4, 8])
def test_paralyzable_counters_have_the_moments_of_their_tables(bits, monkeypatch):
    """In 60 dead times up to 22 counts are expected: 4 bits are clipped, 8 are not. More take long tables."""
    sensor = CountingSPAD(0.5, 10.0, 1 / 60, bits, paralyzable=True)
    light = np.array([0.0, 0.01, 3.0, 15.0, 25.0, 54.0])
    dense = sensor.dense_moments_of(light, 1.0)
    monkeypatch.setattr(paralyzable, "MANY", 2)
    assert_equal_moments(sensor, sensor.moments_of(light, 1.0), dense)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("gain", [1e-3, 0.3, 1.0, 1e3])
def test_no_response_takes_more_than_few_terms(bits, gain, monkeypatch):
    """The cost is that of its terms: at most 2.5e7 (a tenth of a second for 1e7), whatever the read noise."""
    counted = [0]
    tables = qis_moments.shared_tables

    def counting(chain, mean):
        for levels, n in tables(chain, mean):
            least, most = qis_moments.window(mean[levels])
            counted[0] += int(((most - least) / max(n[1] - n[0], 1)).sum())
            yield levels[:1], n

    monkeypatch.setattr(qis_moments, "shared_tables", counting)
    for noise in (0.0, 0.2, 3.0, 1e4):
        counted[0] = 0
        sensor = QIS(1.0, 0.0, noise, bits, gain=gain)
        end = sensor.levels / gain + 5 * noise
        qis_moments.moments(sensor, np.linspace(0, np.sqrt(end), 4096) ** 2)
        assert counted[0] < 2.5e7
