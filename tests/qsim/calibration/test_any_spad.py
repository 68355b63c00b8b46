"""Any array gets finite values inside their intervals, or one sentence; never another error or a warning of NumPy."""

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from qsim.calibration.frame_statistics import FrameStatistics, measure
from qsim.calibration.results import Calibration
from qsim.calibration.spad import calibrate_spad

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
from calibration_simulator import SPADArray, vignetting


def recorded(rng: np.random.Generator, most_frames: int) -> tuple[list[FrameStatistics], list[FrameStatistics], int]:
    """Return dark frames, flats and bits of an array that nobody would choose: few pixels, wild rates, any light."""
    bits = int(rng.choice([1, 1, 2, 3, 4, 5, 6, 8]))
    shape = (int(rng.integers(4, 28)), int(rng.integers(4, 28)))
    frames = int(np.exp(rng.uniform(np.log(2), np.log(most_frames))))
    exposure = float(10 ** rng.uniform(-8, 2))
    rate = 10 ** rng.uniform(-6, 0.5) * rng.lognormal(0, rng.uniform(0, 1.5), shape)
    hot = rng.random(shape) < rng.choice([0, 0.01, 0.1, 0.5])
    rate[hot] *= 10 ** rng.uniform(0, 4)
    efficiency = np.clip(0.4 * (1 + rng.uniform(0, 0.3) * rng.standard_normal(shape)), 0.01, 1)
    dead_time = 0.0 if bits == 1 else float(rng.choice([0, 0.001, 0.01, 0.1, 0.5])) * exposure
    effects = float(rng.choice([0, 0.03, 0.1, 0.3])), float(rng.choice([0, 0.003, 0.03]))
    array = SPADArray(efficiency, np.minimum(rate, 1e3) / exposure, bits, dead_time, *effects)

    def stack(photons: float, times: float) -> FrameStatistics:
        light = photons * vignetting(shape, 0.3, (0, 0))
        drawn = array.frames(rng, light, exposure * times, frames, 0.005)
        return measure([drawn], bits=bits, exposure=exposure * times, photons=photons)

    darks = [stack(0.0, times) for times in rng.choice([1, 2, 10], rng.integers(0, 3), replace=False)]
    flats = [stack(photons, 1.0) for photons in 10 ** rng.uniform(-3, 2, rng.integers(0, 4))]
    return darks, flats, bits


def outcome(seed: int, most_frames: int) -> Calibration | str:
    """Return the calibration of a random array, or the sentence that refuses it."""
    rng = np.random.default_rng([77, seed])
    darks, flats, bits = recorded(rng, most_frames)
    paralyzable = bool(1 < bits < 5 and rng.random() < 0.15)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return calibrate_spad(darks, flats, bits=bits, paralyzable=paralyzable)
        except ValueError as error:
            return str(error)


def assert_sound(seed: int, most_frames: int) -> None:
    found = outcome(seed, most_frames)
    if isinstance(found, str):
        assert found.startswith("calibrate: "), (seed, found)
        return
    for name, value in found.values.items():
        assert np.isfinite(value.value), (seed, name)
        assert not value.low > value.value * (1 + 1e-9), (seed, name)
        assert not value.high < value.value * (1 - 1e-9), (seed, name)


@pytest.mark.parametrize("seed", [*range(20), 131, 154, 156, 330])  # the last ended in errors of NumPy
def test_an_array_gets_sound_values_or_one_sentence(seed):
    assert_sound(seed, 60 if seed < 20 else 600)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1000))
def test_any_array_gets_sound_values_or_one_sentence(seed):
    assert_sound(seed, 600)
