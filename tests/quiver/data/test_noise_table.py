"""The noise table of a sensor against its exact law and against drawn codes, over random sensors; and who uses it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from compiled_cases import SENSORS
from stats import assert_variance

from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD
from quiver.data.noise_table import NODES, noise_table
from quiver.model.rivals.noise import deviation_map, table_of, variance_at

EXPOSURE = 5e-4
ERROR = 4e-3  # of the largest variance: straight lines between nodes; 2.1e-3 is the most of 298 random sensors


def any_sensor(rng: np.random.Generator) -> Sensor:
    """A sensor of any model, whose response reaches from one photon to thousands."""
    efficiency = rng.uniform(0.05, 1)
    dark = 10 ** rng.uniform(-1, 3)
    bits = int(rng.integers(1, 9))
    match rng.integers(4):
        case 0:
            return BinarySPAD(efficiency, dark, bits)
        case 1:
            return CountingSPAD(efficiency, dark, EXPOSURE * 10 ** rng.uniform(-5, -0.5), min(bits, 5))
        case 2:
            return CountingSPAD(efficiency, dark, EXPOSURE * 10 ** rng.uniform(-2, -0.5), min(bits, 4), True)
        case _:
            noise = float(rng.choice([0.0, rng.uniform(0, 4)]))
            gain = 10 ** rng.uniform(-1.3, 1)
            return QIS(efficiency, dark, noise, bits, gain, offset=float(rng.choice([0.0, rng.uniform(-1, 0.4)])))


def read(sensor: Sensor, mean_code: np.ndarray) -> np.ndarray:
    """The variance of codes [codes^2] that a network reads at these mean codes [n]."""
    top = sensor.levels - 1
    frames = torch.from_numpy(mean_code / top)[None]
    table = table_of(torch.tensor(noise_table(sensor, EXPOSURE)), frames)
    return variance_at(frames, table)[0].numpy() * top**2


def check(sensor: Sensor, rng: np.random.Generator, draws: int) -> None:
    """At random lights up to the end of the rise: within ERROR of the exact law; drawn codes have this variance."""
    most = float(sensor.response(EXPOSURE).photons[-1])
    photons = most * rng.uniform(0, 1, 24) ** 3
    mean = sensor.mean(photons, EXPOSURE)
    variance = sensor.variance(photons, EXPOSURE)
    largest = sensor.response(EXPOSURE).variance.max()
    assert np.abs(read(sensor, mean) - variance).max() < ERROR * largest, sensor
    for i in np.flatnonzero(variance > 0.1 * largest)[:draws]:
        codes = sensor.sample(np.full((48, 50), photons[i]), EXPOSURE, key=Key(5, int(i)), engine="reference")
        away = np.arange(sensor.levels) - mean[i]
        fourth = float((np.exp(sensor.log_pmf(photons[i : i + 1], EXPOSURE)[0]) * away**4).sum())
        assert_variance(codes, float(read(sensor, mean[i : i + 1])[0]), fourth, checks=100 * draws)


@pytest.mark.parametrize("seed", range(6))
def test_random_sensors_have_the_noise_of_their_table(seed):
    rng = np.random.default_rng(seed)
    check(any_sensor(rng), rng, 1)


@pytest.mark.slow
def test_many_random_sensors_have_the_noise_of_their_table():
    for seed in range(100, 200):
        rng = np.random.default_rng(seed)
        check(any_sensor(rng), rng, 2)


def test_beyond_the_response_the_ends_count():
    """A hot sensor in the dark, and a counter whose mean code falls again before its top code."""
    hot = QIS(0.8, 1e4, 0.2, 3)
    falling = SENSORS["paralyzable"]
    dark = hot.variance(np.zeros(1), EXPOSURE)[0] / 49
    assert noise_table(hot, EXPOSURE)[:100] == pytest.approx(dark, rel=1e-5)
    end = falling.response(EXPOSURE)
    assert end.mean[-1] < 4
    assert noise_table(falling, EXPOSURE)[-100:] == pytest.approx(end.variance[-1] / 49, rel=1e-5)
    assert noise_table(falling, EXPOSURE).shape == (NODES,)


def test_the_map_of_flat_light_is_the_deviation_of_its_codes():
    """Five bits: the mean of 25 codes estimates the mean, so maps lie around the exact deviation."""
    sensor = QIS(0.8, 1.6, 0.2, 5, gain=0.8)
    light = 12.0
    codes = sensor.sample(np.full((64, 64), light), EXPOSURE, key=Key(1, 0), engine="reference") / 31
    frames = torch.from_numpy(codes)[None, None, None]
    found = deviation_map(frames, table_of(torch.tensor(noise_table(sensor, EXPOSURE)), frames))[..., 2:-2, 2:-2]
    exact = float(sensor.variance(np.array([light]), EXPOSURE)[0]) ** 0.5 / 31
    assert float(found.mean()) == pytest.approx(exact, rel=0.02)  # bias of a root: 1/8 of (2 / 25 / 9.6), and slope
    assert float(found.std()) < 0.2 * exact


def test_a_sensor_without_a_response_is_refused():
    with pytest.raises(ValueError, match="does not rise with light"):
        noise_table(QIS(0.8, 1e9, 0.2, 3), EXPOSURE)
