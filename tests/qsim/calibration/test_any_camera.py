"""Any camera gets finite values inside their intervals, or one sentence; never another error or a warning of NumPy."""

import warnings

import numpy as np
import pytest

from qsim.calibration.frame_statistics import FrameStatistics, measure
from qsim.calibration.qis import calibrate_qis
from qsim.calibration.results import Calibration


def recorded(rng: np.random.Generator) -> tuple[list[FrameStatistics], list[FrameStatistics], int]:
    """Return dark frames, flats and bits of a camera that nobody would choose: few pixels, wild rates, any light."""
    bits = int(rng.choice([1, 1, 2, 3, 4, 6, 8, 10, 12, 14, 16]))
    shape = (int(rng.integers(2, 20)), int(rng.integers(2, 20)))
    frames = int(np.exp(rng.uniform(np.log(2), np.log(40))))
    top = (1 << bits) - 1
    gain = 10 ** rng.uniform(-2, 1.5)
    offset = rng.uniform(0, min(top * 0.3, 200))
    noise = 10 ** rng.uniform(-1.5, 1.5)
    dark = 10 ** rng.uniform(-4, 2) * rng.lognormal(0, rng.uniform(0, 1), shape)
    hot = rng.random(shape) < rng.choice([0, 0.02, 0.2])
    dark[hot] *= 10 ** rng.uniform(0, 4)
    pattern = np.clip(1 + rng.uniform(0, 0.3) * rng.standard_normal(shape), 0.01, None) * 0.5
    exposure = float(10 ** rng.uniform(-7, 3))

    def stack(photons: float, times: float) -> FrameStatistics:
        light = np.minimum(dark * times + pattern * photons, 1e9)
        electrons = rng.poisson(light, (frames, *shape)) + noise * rng.standard_normal((frames, *shape))
        codes = np.clip(np.round(gain * electrons + offset), 0, top).astype(np.uint16)
        return measure([codes], bits=bits, exposure=exposure * times, photons=photons)

    darks = [stack(0.0, times) for times in rng.choice([1, 3, 20], rng.integers(0, 4), replace=False)]
    flats = [stack(photons, 1.0) for photons in 10 ** rng.uniform(-2, 4.5, rng.integers(0, 5))]
    return darks, flats, bits


def outcome(seed: int) -> Calibration | str:
    """Return the calibration of a random camera, or the sentence that refuses it."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            darks, flats, bits = recorded(np.random.default_rng([78, seed]))
            return calibrate_qis(darks, flats, bits=bits)
        except ValueError as error:
            return str(error)


def assert_sound(seed: int) -> None:
    found = outcome(seed)
    if isinstance(found, str):
        assert found.startswith("calibrate: "), (seed, found)
        return
    for name, value in found.values.items():
        assert np.isfinite(value.value), (seed, name)
        assert not value.low > value.value + 1e-9 * abs(value.value), (seed, name)
        assert not value.high < value.value - 1e-9 * abs(value.value), (seed, name)


@pytest.mark.parametrize("seed", [*range(6), 42])  # the last ended in a division by zero
def test_a_camera_gets_sound_values_or_one_sentence(seed):
    assert_sound(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1000))
def test_any_camera_gets_sound_values_or_one_sentence(seed):
    assert_sound(seed)
