"""Tests afterpulses and crosstalk: rates, margins, dead pixels, refusals."""

import re
from dataclasses import replace

import numpy as np
import pytest
from stats import assert_mean, assert_share

from qsim.keys import Key, uniform, words
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects.correlated_noise import CorrelatedNoise
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.fixed_pattern import PERFECT, DarkSpread, FixedPattern, Maps, draw_maps
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD

KEY = Key(seed=3, clip=5)
EXPOSURE = 5e-4  # s
SENSORS = [
    QIS(0.8, 1.6, 0.2, 3, gain=1.1),
    BinarySPAD(0.5, 100.0),
    BinarySPAD(0.5, 100.0, 3),
    CountingSPAD(0.5, 100.0, 1e-5, 3),
]


def light(shape: tuple[int, ...] = (3, 8, 10), seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 6, shape)


def sample(sensor, photons, exposure=EXPOSURE, *, key=KEY, maps=PERFECT, afterpulse=0.0, crosstalk=0.0, origin=(0, 0)):
    array = PixelArray(sensor, maps, Defects(afterpulse=afterpulse, crosstalk=crosstalk))
    return array.sample(photons, exposure, key=key, origin=origin)


def test_vanishing_probabilities_change_nothing():
    """At a probability of 1e-12, 5000 avalanches cause a change once in 10^7 runs."""
    plane = BinarySPAD(0.5, 0.0, 3)
    expected = plane.sample(light(), EXPOSURE, key=KEY)
    weak = sample(plane, light(), EXPOSURE, afterpulse=1e-12, crosstalk=1e-12)
    np.testing.assert_array_equal(weak, expected)


def test_dead_pixels_never_fire_and_do_not_change_others():
    sensor = BinarySPAD(0.5, 100.0, 3)
    maps = draw_maps(FixedPattern(dead=0.1), (30, 31))
    photons = np.full((2, 30, 31), 50.0)
    codes = sample(sensor, photons, EXPOSURE, maps=maps, crosstalk=0.3, afterpulse=0.3)
    assert (codes[:, maps.dead] == 0).all()
    alone = sample(sensor, photons, EXPOSURE, maps=maps)
    np.testing.assert_array_equal(
        alone, np.where(maps.dead, 0, sensor.sample(photons, EXPOSURE, key=KEY)).astype(np.uint8)
    )
    assert_share(int(draw_maps(FixedPattern(dead=0.1), (200, 201)).dead.sum()), 200 * 201, 0.1)


def test_afterpulses_reach_the_stationary_rate():
    """P(fire) = p / (1 - a (1 - p)) after some planes; neighbouring planes are then correlated with a (1 - p)."""
    p = 0.3
    a = 0.4
    photons = np.full((60, 40, 50), -np.log1p(-p))
    planes = sample(BinarySPAD(1.0, 0.0), photons, EXPOSURE, afterpulse=a)[20:].astype(float)
    rate = p / (1 - a * (1 - p))
    correlation = a * (1 - p)  # P(fire | fired before) - P(fire | not)
    inflated = rate * (1 - rate) * (1 + correlation) / (1 - correlation)
    assert_mean(planes, rate, inflated)
    found = np.corrcoef(planes[:-1].ravel(), planes[1:].ravel())[0, 1]
    assert abs(found - correlation) < 6 * 2 / np.sqrt(planes.size)


def test_crosstalk_raises_the_rate_as_four_neighbours_can():
    """Inside, P(fire) = 1 - (1 - p)(1 - p c)^4; at an edge with three neighbours, to the third power."""
    p = 0.2
    c = 0.15
    planes = sample(BinarySPAD(1.0, 0.0), np.full((60, 40, 50), -np.log1p(-p)), EXPOSURE, crosstalk=c).astype(float)
    inside = planes[:, 1:-1, 1:-1]
    edge = planes[:, 0, 1:-1]
    for part, neighbours in ((inside, 4), (edge, 3)):
        rate = 1 - (1 - p) * (1 - p * c) ** neighbours
        spread = rate * (1 - rate) * (1 + 12 * c * p)  # neighbours share sources: a bound on their covariance
        assert_mean(part, rate, spread, checks=2)


def test_crosstalk_of_counts_adds_binomial_numbers():
    """Every count sends Binomial(1, c) to each of four neighbours: the mean grows by 4 c."""
    c = 0.05
    mean = 3.0
    sensor = CountingSPAD(1.0, 0.0, 0.0, 8)
    codes = sample(sensor, np.full((20, 40, 50), mean), EXPOSURE, crosstalk=c)[:, 1:-1, 1:-1].astype(float)
    total = mean * (1 + 4 * c)
    assert_mean(codes, total, total * (1 + 8 * c + 12 * c**2))


@pytest.mark.parametrize("bits", [1, 3])
def test_a_crop_with_a_margin_equals_the_frame(bits):
    sensor = BinarySPAD(0.5, 200.0, bits)
    photons = light((4, 17, 23), seed=1)
    maps = draw_maps(FixedPattern(prnu=0.1, dark=DarkSpread(), dead=0.05), (17, 23))
    settings = {"afterpulse": 0.2, "crosstalk": 0.2}
    whole = sample(sensor, photons, EXPOSURE, maps=maps, **settings)
    y = 4
    x = 5
    h = 6
    w = 7
    part = (slice(None), slice(y - 1, y + h + 1), slice(x - 1, x + w + 1))
    inner = maps.crop(y - 1, x - 1, h + 2, w + 2)
    crop = sample(sensor, photons[part], maps=inner, origin=(y - 1, x - 1), **settings)
    np.testing.assert_array_equal(crop[:, 1:-1, 1:-1], whole[:, y : y + h, x : x + w])
    corner = sample(sensor, photons[:, : h + 1, : w + 1], maps=maps.crop(0, 0, h + 1, w + 1), **settings)
    np.testing.assert_array_equal(corner[:, :h, :w], whole[:, :h, :w])


def test_frames_of_a_disturbed_clip_all_differ():
    frames = sample(BinarySPAD(0.5, 0.0), np.full((20, 8, 10), 1.0), EXPOSURE, afterpulse=0.3, crosstalk=0.1)
    assert len({frame.tobytes() for frame in frames}) == 20


@pytest.mark.parametrize("settings", [{"afterpulse": 0.3}, {"crosstalk": 0.3}])
def test_stages_of_a_key_share_no_noise(settings):
    """Training and validation windows differ in the stage of their keys only."""
    codes = np.zeros((2, 20, 20), np.uint8)
    codes[0] = 1
    noise = CorrelatedNoise(**settings)
    keys = (replace(KEY, stage=stage) for stage in range(3))
    stored, *windows = (noise.disturb(None, codes, 7, key, None, (0, 0))[0].astype(float) for key in keys)
    for one, other in ((stored, windows[0]), (stored, windows[1]), (windows[0], windows[1])):
        part = slice(1) if "crosstalk" in settings else slice(1, 2)
        assert abs(np.corrcoef(one[part].ravel(), other[part].ravel())[0, 1]) < 5 / 20  # 5 sigma of 400 pixels
    if "afterpulse" in settings:  # those of stored streams stay
        np.testing.assert_array_equal(stored[1], uniform(words(replace(KEY, frame=1, stage=101), (20, 20))) < 0.3)


@pytest.mark.parametrize(
    ("sensor", "settings", "text"),
    [
        (SENSORS[0], {"crosstalk": 0.1}, "a QIS has no avalanches"),
        (SENSORS[0], {"afterpulse": 0.1}, "defined per binary plane"),
        (SENSORS[3], {"afterpulse": 0.1}, "use event_simulation"),
        (SENSORS[1], {"afterpulse": 1.0}, "afterpulse must be a probability below 1, got 1.0"),
        (SENSORS[1], {"crosstalk": -0.1}, "crosstalk must be a probability below 1, got -0.1"),
        (SENSORS[1], {"maps": Maps(offset=np.ones((8, 10)))}, "BinarySPAD has no read-out"),
        (SENSORS[1], {"key": KEY.at(3), "afterpulse": 0.1}, "sample the clip from frame 0, not from frame 3"),
    ],
)
def test_impossible_settings_are_refused(sensor, settings, text):
    with pytest.raises(ValueError, match=re.escape(text)):
        sample(sensor, light(), **settings)
