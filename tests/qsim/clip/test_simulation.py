"""Tests the draw of a clip: packed codes are the codes of single frames."""

import numpy as np
import pytest
from clips import write_clip

from qsim.clip.photons import clip_photons
from qsim.clip.sensing import Sensing, prepare, replay
from qsim.sensor import packing
from qsim.sensor.qis import QIS
from qsim.sensor.spike import SpikeCamera


@pytest.fixture
def clip(tmp_path):
    return write_clip(tmp_path / "moving", frames=6, height=10, width=13)


def test_packed_blocks_are_the_codes(clip):
    """`packed` writes the codes that `frames` draws."""
    draw = prepare(clip, Sensing("quiver-physical", bits=3, ppp=3.25))
    packed = np.concatenate(list(draw.packed(clip, 6)))
    np.testing.assert_array_equal(packed, packing.pack(draw.frames(clip, 0, 6), 3))


@pytest.mark.parametrize("bits", [3, 12])
@pytest.mark.parametrize("slices", [1, 2, 5])
def test_slices_of_a_qis_are_one_read_of_their_summed_light(clip, bits, slices):
    """Code t is that of one exposure with the photons of frames t slices ... and the key of frame t."""
    sensor = QIS(0.6, 100.0, 1.5, bits, gain=0.4)
    draw = prepare(clip, Sensing(sensor, ppp=20.0, slices=slices))
    length = 6 // slices
    light = np.stack([clip_photons(clip, t, draw.level.factor) for t in range(length * slices)])
    assert light.mean() * slices == pytest.approx(20.0, rel=0.02)
    summed = light.reshape(length, slices, *light.shape[1:]).sum(axis=1)
    expected = sensor.sample(summed, clip.exposure * slices, key=draw.key, engine="reference")
    np.testing.assert_array_equal(draw.frames(clip, 0, length), expected)
    np.testing.assert_array_equal(draw.frames(clip, length - 1, length), expected[-1:])


def test_spikes_of_a_clip_follow_each_other(clip):
    """Packed blocks, single frames and replayed frames are planes of one train from the first frame."""
    sensor = SpikeCamera(0.6, 100.0, 8)
    draw = prepare(clip, Sensing(sensor, ppp=6.0, name="s"))
    light = np.stack([clip_photons(clip, t, draw.level.factor) for t in range(6)])
    expected = sensor.sample(light, clip.exposure, key=draw.key)
    assert 0 < expected.mean() < 1
    np.testing.assert_array_equal(draw.frames(clip, 0, 6), expected)
    np.testing.assert_array_equal(np.concatenate(list(draw.packed(clip, 6))), packing.pack(expected, 1))
    np.testing.assert_array_equal(np.concatenate(list(draw.blocks(clip, 0, 6, 1))), expected)
    stream = clip.sense(sensor, ppp=6.0, name="s")
    for t in (0, 3, 5):
        again, stored = replay(clip, stream, t)
        np.testing.assert_array_equal(again, stored)
        np.testing.assert_array_equal(again, expected[t])


def test_what_a_spike_camera_does_not_model_is_refused(clip, tmp_path):
    (tmp_path / "d.toml").write_text("[defects]\nprnu = 0.1\n")
    sensor = SpikeCamera(0.6, 100.0, 8)
    with pytest.raises(ValueError, match="defects of spike cameras are not modelled; leave"):
        prepare(clip, Sensing(sensor, ppp=6.0, defects=str(tmp_path / "d.toml")))
    for settings, message in (
        ({"slices": 2}, "slices of an exposure are for a CountingSPAD or a QIS, this is a SpikeCamera"),
        ({"group": True, "bits": 1}, "only a clocked SPAD"),
    ):
        with pytest.raises(ValueError, match=message):
            prepare(clip, Sensing(sensor, ppp=6.0, **settings))
