"""Tests the draw of a clip: packed codes are the codes of single frames."""

import numpy as np
import pytest
from clips import write_clip

from qsim.clip.sensing import Sensing, prepare
from qsim.sensor import packing


@pytest.fixture
def clip(tmp_path):
    return write_clip(tmp_path / "moving", frames=6, height=10, width=13)


def test_packed_blocks_are_the_codes(clip):
    """`packed` writes the codes that `frames` draws."""
    draw = prepare(clip, Sensing("quiver-physical", bits=3, ppp=3.25))
    packed = np.concatenate(list(draw.packed(clip, 6)))
    np.testing.assert_array_equal(packed, packing.pack(draw.frames(clip, 0, 6), 3))
