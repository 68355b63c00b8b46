"""The estimated error of restored light, against the true one, over random scenes, sensors and methods."""

from __future__ import annotations

import numpy as np
import pytest
from numpy import ndarray as Array
from scipy.ndimage import gaussian_filter

from qsim.keys import Key
from quiver.data.illumination import Illumination
from quiver.restoration.risk import Reading, block_sums, mean_and_error, redraw, scores

EXPOSURE = 5e-4
SIDE = 96
LIGHTS = (
    ("quiver-physical", 1.0, 1),
    ("quiver-physical", 3.25, 3),
    ("quiver-physical", 26.0, 3),
    ("spad-320x240", 1.0, 1),
)


def scene(rng: np.random.Generator, ppp: float) -> Array:
    """Light [H, W] of a few bright and dark boxes on a soft ground."""
    light = 1 + 0.5 * gaussian_filter(rng.normal(size=(SIDE, SIDE)), 4) * 8
    for _ in range(12):
        y, x = rng.integers(0, SIDE - 8, 2)
        height, width = rng.integers(2, 24, 2)
        light[y : y + height, x : x + width] = rng.uniform(0.2, 2.0)
    light = np.maximum(light, 0.05)
    return light * ppp / light.mean()


def blurred(frames: Array, table: object, sigma: float) -> Array:
    """Restore the last frame of codes [t, H, W]: the mean of all, blurred and inverted; it fits its own noise."""
    pooled = gaussian_filter(frames.mean(axis=0), sigma)
    found: Array = table.invert(pooled, 1000)  # type: ignore[attr-defined]
    return found


@pytest.mark.parametrize("light", LIGHTS)
def test_the_difference_of_two_methods_is_unbiased_and_its_error_is_right(light):
    """A sharp method of two frames, which fits much noise, against soft ones of one and of four."""
    rng = np.random.default_rng(3)
    sensor = Illumination.of(*light).device(EXPOSURE)
    reading = Reading.of(sensor, EXPOSURE)
    table = sensor.response(EXPOSURE)
    off = []
    bare = []
    for seed in range(24):
        truth = scene(rng, light[1])
        frames = sensor.sample(np.stack([truth] * 4), EXPOSURE, key=Key(seed, 1), engine="reference")
        settings = [(2, rng.uniform(1.0, 1.6)), (1, rng.uniform(1.5, 2.5)), (4, rng.uniform(1.0, 2.5))]
        restored = [blurred(frames[-count:], table, sigma) for count, sigma in settings]
        centre = np.mean(restored, axis=0)
        redrawn = redraw(frames[-1], centre, sensor, EXPOSURE, Key(seed, 2))
        other = np.concatenate([frames[:-1], redrawn.after[None]])
        again = [blurred(other[-count:], table, sigma) for count, sigma in settings]
        found = [scores(mine, after, redrawn, reading) for mine, after in zip(restored, again, strict=True)]
        for rival in (1, 2):
            gap, error = mean_and_error(block_sums(found[0] - found[rival]), SIDE * SIDE)
            true = np.mean((restored[0] - truth) ** 2 - (restored[rival] - truth) ** 2)
            off.append((gap - true) / error)
            mean, slope = reading.about(centre)
            codes_alone = (restored[0] - restored[rival]) * (
                restored[0] + restored[rival] - 2 * (centre + (frames[-1] - mean) / slope)
            )
            bare.append((codes_alone.mean() - true) / error)
    assert abs(np.mean(off)) < 0.6
    assert 0.25 < np.std(off) < 1.4  # blocks differ in their true gap, too, which widens the stated error
    assert np.mean(np.abs(off) < 2) > 0.88
    assert abs(np.mean(bare)) > 2 * abs(np.mean(off))  # the penalty is what makes it right


def test_codes_are_drawn_again_by_the_law_of_the_light():
    sensor = Illumination.of("quiver-physical", 3.25, 3).device(EXPOSURE)
    light = np.full((200, 200), 3.25)
    codes = np.zeros(light.shape, np.uint8)
    redrawn = redraw(codes, light, sensor, EXPOSURE, Key(1, 2))
    assert not redrawn.after[~redrawn.where].any()
    drawn = redrawn.after[redrawn.where]
    mean = float(sensor.mean(np.array([3.25]), EXPOSURE)[0])
    deviation = float(np.sqrt(sensor.variance(np.array([3.25]), EXPOSURE)[0]))
    assert abs(drawn.mean() - mean) < 4 * deviation / np.sqrt(drawn.size)
    same = redraw(codes, light, sensor, EXPOSURE, Key(1, 2))
    assert np.array_equal(same.after, redrawn.after)


def test_a_sensor_whose_saturated_codes_read_no_light_keeps_finite_scores():
    sensor = Illumination.of("quiver-physical", 0.5, 1).device(EXPOSURE)
    reading = Reading.of(sensor, EXPOSURE)
    light = np.full((32, 32), 1e4)
    codes = np.ones(light.shape, np.uint8)
    redrawn = redraw(codes, light, sensor, EXPOSURE, Key(1, 2))
    assert np.isfinite(scores(light, light, redrawn, reading)).all()


def test_one_block_has_no_standard_error():
    assert mean_and_error(np.array([4.0]), 2) == (2.0, float("inf"))
