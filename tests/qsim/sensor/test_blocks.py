"""Blocks of frames continue each other, and end where the counters of random numbers do."""

from __future__ import annotations

import numpy as np
import pytest

from qsim.keys import Key
from qsim.sensor.qis import QIS

SENSOR = QIS(0.8, 1.6, 0.2, 3)
LIGHT = np.random.default_rng(0).uniform(0, 6, (6, 4, 5))


def test_blocks_are_the_frames_of_one_draw():
    drawn = np.concatenate(list(SENSOR.blocks([LIGHT[:2], LIGHT[2:3], LIGHT[3:]], 5e-4, Key(1, 2, frame=7))))
    np.testing.assert_array_equal(drawn, SENSOR.sample(LIGHT, 5e-4, key=Key(1, 2, frame=7)))


def test_a_block_beyond_the_counters_repeats_no_frame():
    """The key of the last frame was taken again."""
    blocks = SENSOR.blocks([LIGHT[:2], LIGHT[:2]], 5e-4, Key(1, 2, frame=2**32 - 2))
    next(blocks)
    with pytest.raises(ValueError, match=r"counters|2\^32"):
        next(blocks)
