"""The keyed draw of codes by the reference engine, and the record of a sensor."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from sensor_cases import EXPOSURE, SENSORS, each
from stats import assert_histogram, assert_mean, assert_share

from qsim.keys import Key, uniform, uniform_pair, words
from qsim.sensor.compiled import jit
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor, fast_engine_works
from qsim.sensor.spad import BinarySPAD


@each
def test_samples_have_the_distribution(sensor: Sensor):
    for i, light in enumerate((0.3, 3.25, 20.0)):
        codes = sensor.sample(np.full((150, 301), light), EXPOSURE, key=Key(1, i), engine="reference")
        assert_histogram(codes, sensor.pmf(light, EXPOSURE), checks=3 * len(SENSORS))


@each
def test_a_crop_of_codes_is_the_code_of_the_crop(sensor: Sensor):
    light = np.random.default_rng(1).uniform(0, 15, (4, 21, 19))
    key = Key(3, 4, frame=11)
    whole = sensor.sample(light, EXPOSURE, key=key, engine="reference")
    for y, x, h, w in ((0, 0, 8, 7), (3, 5, 10, 7), (13, 18, 8, 1)):
        crop = np.ascontiguousarray(light[1:3, y : y + h, x : x + w])
        codes = sensor.sample(crop, EXPOSURE, key=key.at(12), origin=(y, x), engine="reference")
        np.testing.assert_array_equal(codes, whole[1:3, y : y + h, x : x + w])


@each
def test_frames_may_be_drawn_in_any_order(sensor: Sensor):
    light = np.random.default_rng(1).uniform(0, 15, (6, 8, 10))
    whole = sensor.sample(light, EXPOSURE, key=Key(5, 6), engine="reference")
    for t in (4, 0, 5, 2):
        alone = sensor.sample(light[t], EXPOSURE, key=Key(5, 6, t), engine="reference")
        np.testing.assert_array_equal(alone, whole[t])


def test_another_process_draws_the_same():
    """Frames 3 and 1 by a fresh interpreter with another hash seed: state, order and worker change no noise."""
    light = np.full((4, 7, 9), 3.25)
    here = SENSORS[0].sample(light, EXPOSURE, key=Key(5, 6), engine="reference")
    program = (
        "import numpy as np; from qsim.keys import Key; from qsim.sensor.qis import QIS\n"
        f"sensor, light = {SENSORS[0]!r}, np.full((7, 9), 3.25)\n"
        f"print([sensor.sample(light, {EXPOSURE}, key=Key(5, 6, t), engine='reference').tolist() for t in (3, 1)])"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "7", "PYTHONPATH": str(Path(__file__).parents[3])}
    there = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    np.testing.assert_array_equal(json.loads(there.stdout), here[[3, 1]])


@each
def test_no_two_frames_or_clips_share_their_noise(sensor: Sensor):
    """Constant light: 12 frames of 3 clips are all different."""
    light = np.full((12, 9, 17), sensor.white(EXPOSURE) / 2)
    codes = np.concatenate([sensor.sample(light, EXPOSURE, key=Key(1, clip), engine="reference") for clip in range(3)])
    assert len(np.unique(codes.reshape(36, -1), axis=0)) == 36


def test_blocks_of_rows_do_not_show():
    """More levels mean fewer rows at a time: the same frame in one piece, row by row."""
    sensor = QIS(0.8, 1.6, 0.2, 6)
    light = np.random.default_rng(0).uniform(0, 60, (90, 65))
    whole = sensor.sample(light, EXPOSURE, key=Key(1, 1), engine="reference")
    key = Key(1, 1)
    rows = [sensor.sample(light[y : y + 1], EXPOSURE, key=key, origin=(y, 0), engine="reference") for y in range(90)]
    np.testing.assert_array_equal(whole, np.concatenate(rows))


@pytest.mark.parametrize("sensor", SENSORS[:-1])
def test_more_light_never_lowers_a_code(sensor: Sensor):
    """At a fixed key u is fixed and F falls with light (but for paralysis): more light changes codes upwards only."""
    low, high = (sensor.sample(np.full((40, 41), v), EXPOSURE, key=Key(2, 2), engine="reference") for v in (3.0, 3.6))
    assert np.all(high >= low)
    assert np.any(high > low)


@pytest.mark.parametrize("sensor", [BinarySPAD(1.0, 0.0), QIS(1.0, 0.0, 0.0, 1)])
def test_the_second_word_is_drawn_when_the_first_cannot_decide(sensor: Sensor):
    """A pixel whose F_0 lies in the middle of the cell of its first word is decided by the second word alone."""
    key = Key(9, 9)
    first, second = (words(key, (16, 16), redraw=r) for r in (0, 1))
    light = -np.log(uniform(first))  # F_0 = exp(-photons) = u of the first word
    codes = sensor.sample(light, EXPOSURE, key=key, engine="reference")
    below, _ = uniform_pair(first, second)
    np.testing.assert_array_equal(codes, below >= np.exp(-light))
    assert_share(int(codes.sum()), codes.size, 0.5)


def test_rare_codes_are_as_rare_as_they_should_be():
    """1e-5 photons: 2^20 pixels expect 10.5 ones, an exact binomial test."""
    codes = BinarySPAD(1.0, 0.0).sample(np.full((1024, 1024), 1e-5), EXPOSURE, key=Key(0, 3), engine="reference")
    assert_share(int(codes.sum()), codes.size, -np.expm1(-1e-5))


def test_types_and_shapes_of_codes():
    light = np.full((2, 3, 5), 2.0, np.float32)
    assert QIS(0.8, 1.6, 0.2, 8).sample(light, EXPOSURE, key=Key(0, 0), engine="reference").dtype == np.uint8
    assert QIS(0.8, 1.6, 0.2, 9).sample(light, EXPOSURE, key=Key(0, 0), engine="reference").dtype == np.uint16
    assert QIS(0.8, 1.6, 0.2, 3).sample(light[:0], EXPOSURE, key=Key(0, 0), engine="reference").shape == (0, 3, 5)
    with pytest.raises(ValueError, match=r"photons have the shape \[H, W\] or \[T, H, W\], got \[5\]"):
        QIS(0.8, 1.6, 0.2, 3).sample(light[0, 0], EXPOSURE, key=Key(0, 0))
    with pytest.raises(ValueError, match="engine is one of auto, reference, fast, got 'gpu'"):
        QIS(0.8, 1.6, 0.2, 3).sample(light, EXPOSURE, key=Key(0, 0), engine="gpu")


def test_without_a_compiler_the_reference_serves_and_says_so_once(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(jit, "available", lambda: False)
    fast_engine_works.cache_clear()
    sensor = SENSORS[0]
    light = np.full((4, 5), 2.0)
    try:
        with pytest.warns(UserWarning, match="no usable LLVM or CUDA: codes are drawn by the NumPy engine"):
            codes = sensor.sample(light, EXPOSURE, key=Key(1, 1))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            sensor.sample(light, EXPOSURE, key=Key(1, 1), engine="fast")
    finally:
        fast_engine_works.cache_clear()
    np.testing.assert_array_equal(codes, sensor.sample(light, EXPOSURE, key=Key(1, 1), engine="reference"))


def test_mean_of_a_stack_is_the_closed_form_and_a_bias_is_caught():
    sensor = SENSORS[0]
    light = np.full((10, 80, 81), 3.25)
    codes = sensor.sample(light, EXPOSURE, key=Key(4, 4), engine="reference")
    variance = float(sensor.variance(3.25, EXPOSURE))
    assert_mean(codes, float(sensor.mean(3.25, EXPOSURE)), variance)
    with pytest.raises(AssertionError, match="z = "):
        assert_mean(codes, float(sensor.mean(3.25 * 1.02, EXPOSURE)), variance)


@each
def test_records_name_themselves(sensor: Sensor):
    settings = sensor.to_dict()
    assert settings.pop("model") == type(sensor).__name__
    assert type(sensor)(**settings) == sensor
