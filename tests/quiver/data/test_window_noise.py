"""A training window has the defects that its pixels have in the full frame, turned, drifting or reversed."""

from __future__ import annotations

import json
import math
import random
from dataclasses import replace

import numpy as np
import pytest
from clips import ClipMaker
from numpy import ndarray as Array
from sensor_files import COUNTER, QIS, SPAD, sensor_file
from stats import assert_mean

from qsim.keys import Key
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.fixed_pattern import DarkSpread, FixedPattern
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons, light_level
from quiver.data.code_table import draw_codes
from quiver.data.codes import sensed
from quiver.data.illumination import Illumination
from quiver.data.window_noise import WindowPlace, window_codes
from quiver.data.windows import TRAINING, Windows, WindowSettings, turned


def random_defects(rng: random.Random, qis: bool, spad: bool) -> Defects:
    """One or more defects that a window can have."""
    some = lambda value: value if rng.random() < 0.5 else 0.0  # noqa: E731
    pattern = FixedPattern(
        device_seed=rng.randrange(100),
        prnu=some(0.2),
        dark=DarkSpread() if rng.random() < 0.5 else None,
        dead=some(0.1),
        offset=some(0.4) if qis else 0.0,
        read_noise=some(0.3) if qis else 0.0,
    )
    return Defects(pattern, crosstalk=0.0 if qis else some(0.1), afterpulse=some(0.2) if spad else 0.0)


def whole_frames(noise: Illumination, clip: Clip, key: Key, light: Array) -> Array:
    """Codes of complete frames from the first one on, by the reference engine, as `qsim sense` stores them."""
    draw = noise.draw(clip)
    array = PixelArray.of(draw.defects, draw.plane, *clip.shape[1:])
    return next(array.blocks([light], clip.exposure, key, engine="reference"))


@pytest.mark.parametrize("cases", [12, pytest.param(200, marks=pytest.mark.slow)])
def test_a_window_is_the_crop_of_the_sensed_frames(make_clip: ClipMaker, tmp_path, cases):
    """Random defects, sensors, light, places: under the key of a stream the same codes, to the last one.

    A sum of planes without afterpulses and crosstalk is drawn from other numbers than by `qsim sense`; the next test
    compares its distribution.
    """
    rng = random.Random(cases)
    clip = make_clip(frames=16, height=20, width=26)
    for number in range(cases):
        model, bits = rng.choice([(SPAD, 1), (SPAD, 2), (QIS, 3), (COUNTER, 3)])
        found = random_defects(rng, model is QIS, model is SPAD)
        if found.none or (bits == 2 and not (found.crosstalk or found.afterpulse)):
            continue
        file = sensor_file(tmp_path, model, bits)
        light = Illumination.of(file, rng.choice([0.3, 2.0, 20.0]), bits)
        noise = replace(light.stated(), defects=json.dumps(found.to_dict()))
        key = Key(seed=number, clip=3, stage=TRAINING)
        place = WindowPlace(
            0, rng.randrange(12), rng.choice([0, 1, 2, 9]), rng.choice([0, 3, 4, 18]), (0, 0), 0, 0, False, key
        )
        side = min(8, 20 - place.y, 26 - place.x)
        frames = min(4, 16 - place.start)
        draw = noise.draw(clip)
        photons = np.stack([clip_photons(clip, t, draw.level.factor) for t in range(16)])
        whole = whole_frames(noise, clip, key, photons)
        part = window_codes(noise, draw, clip, place, frames, side)
        crop = (slice(place.y, place.y + side), slice(place.x, place.x + side))
        np.testing.assert_array_equal(part, whole[place.start : place.start + frames][(slice(None), *crop)])


@pytest.mark.parametrize("table", ["prnu = 0.2\ndead = 0.1\n", "dead = 0.1\ncrosstalk = 0.1\n"])
def test_a_window_of_a_clip_that_is_a_crop_is_that_of_its_place(make_clip: ClipMaker, tmp_path, table):
    clip = make_clip(frames=5, height=20, width=26, origin=[5, 6])
    file = sensor_file(tmp_path, (QIS if "prnu" in table else SPAD) + table)
    noise = Illumination.of(file, 2.0, 1).stated()
    draw = noise.draw(clip)
    part = window_codes(noise, draw, clip, WindowPlace(0, 1, 3, 7, (0, 0), 0, 0, False, draw.key), 3, 8)
    np.testing.assert_array_equal(part, draw.frames(clip, 1, 4)[:, 3:11, 7:15])


def test_sums_of_planes_have_the_distribution_of_their_pixels(make_clip: ClipMaker, tmp_path):
    """Flat light on hot and dull pixels: the mean code of each kind over many windows is that of its cdf."""
    gain = np.tile([1.0, 0.25, 0.0], (20, 9))[:, :26]
    np.save(tmp_path / "gain.npy", gain)
    file = sensor_file(tmp_path, SPAD + 'gain_map = "gain.npy"\n', 3)
    clip = make_clip(radiance=np.full((14, 20, 26), 0.5), relative=True)
    data = Windows([clip], WindowSettings(crop=12, lights=(Illumination.of(file, 5.0, 3),), frames=11, flips=False))
    sums = np.zeros(3)
    counts = np.zeros(3)
    for n in range(12):
        codes = data[n]["codes"].numpy() * 7
        x = data.place(n).x
        for kind in range(3):
            chosen = codes[..., (np.arange(x, x + 12) % 3) == kind]
            sums[kind] = sums[kind] + chosen.sum()
            counts[kind] = counts[kind] + chosen.size
    sensor = Illumination.of(file, 5.0, 3).stated().draw(clip).sensor
    for kind, level in enumerate((5.0, 1.25, 0.0)):
        light = np.array([level])
        spread = math.sqrt(sensor.variance(light, clip.exposure)[0] / counts[kind])
        assert abs(sums[kind] / counts[kind] - sensor.mean(light, clip.exposure)[0]) < 5 * spread


def test_a_window_is_turned_with_its_defects(make_clip: ClipMaker, tmp_path):
    """Blind pixels of a turned and reversed window lie where the turn brings them, in codes and in the target."""
    dead = np.zeros((20, 26))
    dead[:, 4] = dead[7] = 1
    np.save(tmp_path / "gain.npy", 1 - dead)
    file = sensor_file(tmp_path, QIS + 'gain_map = "gain.npy"\n', 3)
    clip = make_clip(radiance=np.full((14, 20, 26), 0.5), relative=True)
    data = Windows([clip], WindowSettings(crop=16, lights=(Illumination.of(file, 60.0, 3),)))
    for n in range(40):
        place = data.place(n)
        window = np.broadcast_to(dead[place.y : place.y + 16, place.x : place.x + 16], (11, 16, 16))
        assert ((data[n]["codes"].numpy()[:, 0] < 0.5) == (turned(window, place) == 1)).all()
    assert {data.place(n).turn for n in range(40)} == set(range(8))


def test_filled_windows_are_prepared_with_the_dark_rate_of_good_pixels(make_clip: ClipMaker, tmp_path):
    """As in restoring: the mean over all pixels belongs mostly to the hot ones."""
    dark = np.ones((20, 26))
    dark[::5, ::5] = 1e4
    np.save(tmp_path / "dark.npy", dark)
    file = sensor_file(tmp_path, QIS + 'dark_map = "dark.npy"\n', 3)
    clip = make_clip(radiance=np.full((14, 20, 26), 0.5), relative=True)
    light = Illumination.of(file, 10.0, 3)
    seen = []
    data = Windows([clip], WindowSettings(crop=16, lights=(light,)), prepare=lambda codes, n: seen.append(codes) or {})
    data[0]
    assert seen[0].sensor == sensed(clip, light)[0].sensor
    assert seen[0].sensor.dark_rate < 0.01 * data.noise.noises[0].draw(clip).sensor.dark_rate


def test_resting_copies_have_the_dark_rate_of_good_pixels(make_clip: ClipMaker, tmp_path):
    """As filled codes: the mean over all pixels, 4 % of them hot, would add two electrons to every code."""
    dark = np.ones((20, 26))
    dark[::5, ::5] = 1e5
    np.save(tmp_path / "dark.npy", dark)
    file = sensor_file(tmp_path, QIS + 'dark_map = "dark.npy"\n', 3)
    clip = make_clip(radiance=np.full((14, 20, 26), 0.5), relative=True)
    sample = Windows([clip], WindowSettings(crop=16, lights=(Illumination.of(file, 3.0, 3),), still=True))[0]
    assert abs(7 * float(sample["still"].mean() - sample["codes"].mean())) < 0.25


def test_a_drifting_window_keeps_its_pixels(make_clip: ClipMaker, tmp_path):
    """The scene moves through the window; the sensor under it does not, and its neighbours are within the frame."""
    dead = np.random.default_rng(0).random((48, 40)) < 0.2
    np.save(tmp_path / "dead.npy", dead)
    file = sensor_file(tmp_path, SPAD + 'dead_map = "dead.npy"\ncrosstalk = 0.1\nafterpulse = 0.1\n', 1)
    clip = make_clip(radiance=np.full((30, 48, 40), 0.5), relative=True)
    settings = WindowSettings(crop=16, lights=(Illumination.of(file, 60.0, 1),), flips=False, drift=2)
    data = Windows([clip], settings)
    moved = 0
    noise = data.noise.noises[0]
    draw = noise.draw(clip)
    for n in range(30):
        place = data.place(n)
        moved += place.drift != (0, 0)
        crop = dead[place.y : place.y + 16, place.x : place.x + 16]
        codes = window_codes(noise, draw, clip, place, 11, 16)
        assert ((codes == 0).all(axis=0) == crop).all()
    assert moved > 5


def test_afterpulses_of_a_reversed_window_follow_its_own_time(make_clip: ClipMaker, tmp_path):
    """Light that ends at once: afterpulses follow it in the order of exposure of the window, and never precede it."""
    radiance = np.zeros((24, 20, 26))
    radiance[:12] = 1.0
    clip = make_clip(radiance=radiance, relative=True)
    file = sensor_file(tmp_path, SPAD.replace("200.0", "0.0") + "afterpulse = 0.5\n", 1)
    noise = Illumination.of(file, 20.0, 1).stated()
    draw = noise.draw(clip)
    forward = window_codes(noise, draw, clip, WindowPlace(0, 8, 2, 2, (0, 0), 0, 0, False, Key(1, 2)), 11, 16)
    back = window_codes(noise, draw, clip, WindowPlace(0, 8, 2, 2, (0, 0), 0, 0, True, Key(1, 2)), 11, 16)
    assert_mean(forward[4].astype(float), 0.5, 0.25)  # frame 12, the first dark one
    assert back[:7].max() == 0  # frames 18 ... 12, before the light
    assert back[7:].mean() > 0.9


def test_no_defects_change_no_bit(make_clip: ClipMaker, tmp_path):
    """A sensor file without defects draws what its sensor draws, and a plain window is unchanged."""
    clip = make_clip()
    file = sensor_file(tmp_path, QIS + "prnu = 0.0\n", 3)
    data = Windows([clip], WindowSettings(crop=16, lights=(Illumination.of(file, 3.25, 3),)))
    place = data.place(0)
    noise = data.noise.noises[0]
    assert noise.defects is None
    sensor = noise.draw(clip).sensor
    factor = light_level(clip, ppp=3.25).factor
    crop = (place.y, place.x, 16, 16)
    photons = np.stack([clip_photons(clip, place.start + i, factor, crop) for i in range(11)])
    codes = draw_codes(sensor, turned(photons, place), clip.exposure, place.key)
    np.testing.assert_array_equal(np.rint(data[0]["codes"].numpy()[:, 0] * 7), codes)
