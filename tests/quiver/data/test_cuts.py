"""Cuts, lamps that are switched, and faulty frames, found in the codes of random moving scenes; and no others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy import ndarray as Array
from scipy.ndimage import gaussian_filter

from qsim.keys import Key
from quiver.data.codes import Codes, array_codes
from quiver.data.cuts import cut_into_scenes, find_cuts
from quiver.data.illumination import Illumination

EXPOSURE = 5e-4
LIGHTS = (("quiver-physical", 1.0, 1), ("quiver-physical", 0.5, 3), ("quiver-physical", 26.0, 3))


def stream_of(light: Array, sensor: str, ppp: float, bits: int, seed: int) -> Codes:
    """Return codes of light [T, H, W] whose mean becomes `ppp` photons."""
    device = Illumination.of(sensor, ppp, bits).device(EXPOSURE)
    photons = light * (ppp / light.mean())
    return array_codes(device.sample(photons, EXPOSURE, key=Key(seed, 3)), device, EXPOSURE)


def moving(rng: np.random.Generator, frames: int, side: int, jolt: float = 0.0) -> Array:
    """Return grain of a random size, and boxes, that slide by up to 12 px/frame and jump once by `jolt` px."""
    speed = rng.choice([0.0, 0.5, 2.0, 6.0, 12.0])
    reach = int(speed * frames + jolt) + 1
    shape = (side, side + reach)
    noise = gaussian_filter(rng.normal(size=shape), float(rng.choice([1.0, 4.0, 12.0])))
    wide = np.exp(float(rng.uniform(0.2, 0.8)) * noise / noise.std())
    for _ in range(20 * shape[1] // side):
        y = int(rng.integers(side - 8))
        x = int(rng.integers(shape[1] - 8))
        height, width = (int(n) for n in rng.integers(8, 40, 2))
        wide[y : y + height, x : x + width] *= rng.uniform(0.3, 2.0)
    at = [int(speed * t + (jolt if t > frames // 2 else 0)) for t in range(frames)]
    return np.stack([wide[:, x : x + side] for x in at])


@pytest.mark.parametrize("scenes", [12, pytest.param(60, marks=pytest.mark.slow)])
@pytest.mark.parametrize("light", LIGHTS)
def test_motion_jolts_and_noise_are_no_cut(light, scenes):
    rng = np.random.default_rng(1)
    for seed in range(scenes):
        frames = moving(rng, 16, 128, float(rng.choice([0.0, 0.0, 6.0, 12.0])))
        found = find_cuts(stream_of(frames, *light, seed))
        assert (found.starts, found.faulty) == ((), ())


@pytest.mark.parametrize("light", LIGHTS)
def test_cuts_are_found(light):
    """Of scenes whose light at 16 px differs beyond noise; the finest grain does not, and is no cut that matters."""
    rng = np.random.default_rng(2)
    found = []
    for seed in range(12):
        at = int(rng.integers(3, 13))
        frames = np.concatenate([moving(rng, at, 128), moving(rng, 16 - at, 128)])
        cuts = find_cuts(stream_of(frames, *light, seed))
        assert set(cuts.starts) <= {at}
        found.append(cuts.starts == (at,))
    assert np.mean(found) >= 0.7


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize(("factor", "name"), [(0.0, "black"), (4.0, "flash")])
def test_a_faulty_frame_is_no_cut(light, factor, name):
    rng = np.random.default_rng(3)
    for seed in range(4):
        frames = moving(rng, 12, 128)
        frames[5] *= factor
        found = find_cuts(stream_of(frames, *light, seed))
        assert (found.starts, found.faulty) == ((), (5,)), name


@pytest.mark.parametrize("light", LIGHTS)
def test_a_lamp_that_is_switched_begins_another_light(light):
    rng = np.random.default_rng(4)
    for seed in range(4):
        frames = moving(rng, 12, 128)
        frames[7:] *= rng.choice([0.4, 2.5])
        assert find_cuts(stream_of(frames, *light, seed)).starts == (7,)


def test_blocks_of_frames_are_read_and_never_all():
    frames = np.concatenate([moving(np.random.default_rng(5), 20, 1024)] * 2).astype(np.float32)
    codes = stream_of(frames, "quiver-physical", 3.25, 3, 0)
    sizes = []

    def read(start: int, stop: int) -> Array:
        sizes.append(stop - start)
        return codes.read(start, stop)

    find_cuts(replace(codes, read=read))
    assert max(sizes) <= 4
    assert sum(sizes) == 40


def test_small_frames_and_exposures_that_take_turns_are_left_alone():
    codes = stream_of(np.ones((4, 16, 16)), "quiver-physical", 3.25, 3, 0)
    assert cut_into_scenes(codes) is codes
    turns = replace(stream_of(np.ones((4, 64, 64)), "quiver-physical", 3.25, 3, 0), shares=(1.0, 0.5))
    assert cut_into_scenes(turns) is turns
