"""A stream with a cut is restored as two streams: nothing of one scene shows in the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy import ndarray as Array
from scipy.ndimage import gaussian_filter

import quiver
from qsim.keys import Key
from quiver.data.codes import Codes, array_codes
from quiver.data.illumination import Illumination
from quiver.restoration.interface import codes_between, scenes
from quiver.restoration.restorers import restorer

EXPOSURE = 5e-4
SENSOR = Illumination.of("quiver-physical", 3.25, 3).device(EXPOSURE)


def still(seed: int, frames: int, side: int = 64) -> Array:
    """Return codes of a soft still picture, [T, H, W]."""
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=(side, side)), 5)
    light = np.exp(0.7 * noise / noise.std())
    return SENSOR.sample(np.stack([light * 3.25 / light.mean()] * frames), EXPOSURE, key=Key(seed, 0))


def stream(codes: Array) -> Codes:
    return replace(array_codes(codes, SENSOR, EXPOSURE), ppp=3.25)


@pytest.mark.parametrize("method", ["moment", "qbp-bm3d", "mergenet"])
def test_each_scene_is_restored_alone(method):
    parts = [still(1, 5), still(2, 6)]
    joined = replace(stream(np.concatenate(parts)), cuts=(5,))
    runner = restorer(method)
    calls: list[tuple[int, int]] = []
    restored = runner.restore(joined, 3, 9, lambda done, total: calls.append((done, total)))
    alone = [runner.restore(stream(parts[0]), 3, 5), runner.restore(stream(parts[1]), 0, 4)]
    np.testing.assert_array_equal(restored, np.concatenate(alone))
    across = runner.restore(replace(joined, cuts=()), 3, 9)
    assert np.abs(restored[2] - across[2]).mean() > 0.01
    assert [done for done, _ in calls] == sorted(done for done, _ in calls)
    assert calls[-1][0] == calls[-1][1]


def test_scenes_are_the_frames_between_cuts():
    codes = replace(stream(np.zeros((9, 4, 4), np.uint8)), cuts=(2, 7))
    assert scenes(codes) == [range(2), range(2, 7), range(7, 9)]
    assert codes_between(codes, range(2, 7)).shape == (5, 4, 4)
    assert codes_between(codes, range(2, 7)).cuts == ()


def test_a_cut_is_found_by_restore_and_a_faulty_frame_told():
    light = [still(3, 8, 160), still(4, 8, 160)]
    joined = np.concatenate(light)
    joined[12] = 0
    with pytest.warns(UserWarning, match=r"unlike both frames beside them .*: 12"):
        restored = quiver.restore(joined, "moment", sensor=SENSOR, exposure=EXPOSURE, scan=False)
    alone = quiver.restore(light[0], "moment", sensor=SENSOR, exposure=EXPOSURE, scan=False)
    np.testing.assert_array_equal(restored[:8], alone)
