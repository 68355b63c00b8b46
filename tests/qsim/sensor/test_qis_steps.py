"""Single steps of a QIS: the table's numbers, the table's codes, and little work however long the table is."""

import numpy as np
import pytest

from qsim.keys import Key
from qsim.sensor.code_search import decide
from qsim.sensor.qis import QIS, Thresholds, table_length, thresholds
from qsim.sensor.sensor import Sensor

EXPOSURE = 5e-4  # s


def random_qis(rng: np.random.Generator, longest: float) -> QIS:
    """Any QIS of at most 8 bits whose table has at most so many electrons: ties, tiny wells, offsets of both signs."""
    while True:
        sensor = QIS(
            rng.uniform(0.05, 1),
            10 ** rng.uniform(0, 5),
            float(rng.choice([0.0, rng.uniform(0, 10)])),
            int(rng.integers(1, 9)),
            gain=float(rng.choice([10 ** rng.uniform(-3, 3), 0.5 ** rng.integers(0, 6)])),
            offset=float(rng.choice([0.0, rng.uniform(-300, 300), rng.integers(-4, 4) + 0.5])),
            full_well=None if rng.random() < 0.6 else 10 ** rng.uniform(-2, 4),
        )
        if table_length(sensor) <= longest:
            return sensor


def light(rng: np.random.Generator, sensor: QIS, n: int) -> np.ndarray:
    """Photons: dark, usual, bright."""
    white = min(sensor.white(EXPOSURE), 1e6)
    return np.concatenate([[0, 1e-9, 1e6], rng.uniform(0, 20, n), rng.uniform(0, 1.5 * white, n)])


@pytest.mark.parametrize("seed", range(60))
def test_steps_and_their_slopes_are_the_tables(seed):
    rng = np.random.default_rng(seed)
    sensor = random_qis(rng, 5000)
    photons = light(rng, sensor, 12)
    steps = thresholds(sensor)
    mean = sensor.arrivals(photons, EXPOSURE)
    codes = np.tile(np.arange(sensor.levels - 1), len(mean))
    each = np.repeat(mean, sensor.levels - 1)
    table, slope = (f(photons, EXPOSURE)[:, :-1] for f in (sensor.cdf, sensor.dcdf))
    np.testing.assert_allclose(
        steps.cdf(codes, each).reshape(table.shape), table, rtol=0, atol=1e-12, err_msg=repr(sensor)
    )
    found = steps.slope(codes, each).reshape(table.shape) * sensor.efficiency
    np.testing.assert_allclose(found, slope, rtol=0, atol=1e-12, err_msg=repr(sensor))


@pytest.mark.parametrize("seed", range(30))
def test_codes_found_step_by_step_are_those_of_the_whole_table(seed):
    """The same law at the same numbers: `decide` of the sensor against the base class, which compares all steps."""
    rng = np.random.default_rng(1000 + seed)
    sensor = random_qis(rng, 5000)
    photons = rng.permutation(np.tile(light(rng, sensor, 100), 2))
    u = np.concatenate([rng.uniform(0, 1, photons.size - 4), [2.0**-33, 1 - 2.0**-33, 0.5, 2.0**-20]])
    expected, tails = Sensor.decide(sensor, u, photons, EXPOSURE)
    steps = thresholds(sensor)
    mean = sensor.arrivals(photons, EXPOSURE)
    for guess in (expected, np.zeros(u.size), np.full(u.size, sensor.levels)):  # the guess only saves time
        found, near = decide(steps.cdf, sensor.levels - 1, u, mean, guess)
        np.testing.assert_array_equal(found, expected, err_msg=repr(sensor))
        np.testing.assert_array_equal(near <= 2.0**-32, tails)
    np.testing.assert_array_equal(sensor.decide(u, photons, EXPOSURE)[0], expected)


@pytest.mark.parametrize(("bits", "gain", "noise"), [(8, 0.0085, 0.0), (8, 0.05, 2.0), (8, 1e-3, 10.0), (3, 1e-3, 5.0)])
def test_a_long_table_costs_a_few_steps_a_pixel(bits, gain, noise, monkeypatch):
    """Steps computed and electrons summed per pixel are bounded by bits and read noise, not by the table's length."""
    sensor = QIS(0.8, 1.6, noise, bits, gain=gain)
    photons = np.random.default_rng(0).uniform(0, 1.2 * sensor.white(EXPOSURE), (64, 64))
    looked = []
    whole = Thresholds.cdf

    def counted(self, codes, mean):
        looked.append(len(codes) * (1 + self.weights.shape[1]))
        return whole(self, codes, mean)

    monkeypatch.setattr(Thresholds, "cdf", counted)
    codes = sensor.sample(photons, EXPOSURE, key=Key(1, 2), engine="reference")
    assert 0.3 * sensor.levels < codes.max() <= sensor.levels - 1
    assert sum(looked) / photons.size <= 5 * (2 + 17 * noise)
