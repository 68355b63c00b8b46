"""Tests the draw of a clip: packed codes are the codes of single frames, and crops have those of their place."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clips import sliding_pattern, write_clip
from compiled_cases import needs_engine

from qsim.sensor import packing
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.fixed_pattern import DarkSpread, FixedPattern
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD
from qsim.sensor.spike import SpikeCamera
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons
from qsim.streams.preparation import prepare
from qsim.streams.sensing import Sensing
from qsim.streams.storing import describe, replay, sense, stored, write_stream


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


@pytest.mark.parametrize(("bits", "stated"), [(1, False), (3, True)])
def test_codes_whose_truth_has_other_light_say_so(tmp_path, bits, stated):
    """An LED lights 5 frames of the first code of 7, its middle one too, and 2 frames of the second code."""
    strength = np.repeat([2.0, 0.0], 7)
    led = {"kind": "PulseWidth", "frequency": 1000.0, "strength": np.roll(strength, 2).tolist()}
    clip = write_clip(tmp_path / "c", frames=14, height=7, width=9, flicker={"light0": led})
    stream, line = sense(clip, Sensing(BinarySPAD(0.5, 200.0, bits), ppp=0.5 * (2**bits - 1), group=True, name="s"))
    assert len(stream) == 14 // (2**bits - 1)
    words = "light flickers within a code, by up to 57.1 % of its mean: its truth has the light of its middle clip"
    assert (f"; {words} frame; render at the code rate with an open shutter" in line) == stated


@pytest.mark.parametrize(
    ("how", "stated"),
    [({"slices": 2}, True), ({"slices": 3}, False), ({"slices": 1}, False), ({"slices": 2, "row_delay": 1e-5}, False)],
)
def test_a_truth_that_is_late_is_stated(tmp_path, how, stated):
    """Two slices have no middle frame; rows at their own time take the frame nearest to each."""
    clip = write_clip(tmp_path / "c", frames=9, height=7, width=9)
    stream, line = sense(clip, Sensing(BITS3, ppp=3.0, name="s", **how))
    assert ("; its truth is half a clip frame late, which an odd number of clip frames avoids" in line) == stated
    assert len(stream) >= 3


def test_what_a_spike_camera_does_not_model_is_refused(clip, tmp_path):
    (tmp_path / "d.toml").write_text("[defects]\nprnu = 0.1\n")
    sensor = SpikeCamera(0.6, 100.0, 8)
    with pytest.raises(ValueError, match="defects of spike cameras are not modelled; leave"):
        prepare(clip, Sensing(sensor, ppp=6.0, defects=str(tmp_path / "d.toml")))
    for settings, message in (
        ({"slices": 2}, "slices of an exposure are for a CountingSPAD or a QIS, this is a SpikeCamera"),
        ({"group": True, "bits": 1}, "group= is for a clocked SPAD"),
    ):
        with pytest.raises(ValueError, match=message):
            prepare(clip, Sensing(sensor, ppp=6.0, **settings))


# ---- Clips that are a crop of the frame

BITS3 = QIS(0.8, 1.6, 0.2, 3)
PLANE = BinarySPAD(0.5, 200.0)
COUNTER = CountingSPAD(0.5, 10.0, 5e-5, 3)
PATTERN = FixedPattern(device_seed=4, prnu=0.2, dark=DarkSpread(hot_share=0.1), dead=0.1)
CROPPED: dict[str, tuple[Sensor, dict[str, Any]]] = {
    "table": (BITS3, {}),
    "process": (QIS(0.8, 1.6, 0.2, 10), {}),
    "slices": (BITS3, {"slices": 2}),
    "exposures": (BITS3, {"exposures": (1.0, 0.25)}),
    "maps": (BITS3, {"defects": Defects(PATTERN)}),
    "maps, exposures": (BITS3, {"defects": Defects(PATTERN), "exposures": (1.0, 0.25)}),
    "read-out": (BITS3, {"defects": Defects(FixedPattern(offset=0.3, read_noise=0.2))}),
    "planes": (BinarySPAD(0.5, 200.0, 2), {}),
    "many planes": (BinarySPAD(0.5, 200.0, 10), {}),
    "summed planes": (BinarySPAD(0.5, 200.0, 2), {"group": True}),
    "afterpulses": (PLANE, {"defects": Defects(PATTERN, afterpulse=0.3)}),
    "closed form": (COUNTER, {}),
    "events": (COUNTER, {"follow": True, "defects": Defects(PATTERN, carry_dead_time=True)}),
    "spikes": (SpikeCamera(0.6, 10.0, 8), {}),
}


def whole_and_crop(folder: Path, place: tuple[int, int]) -> tuple[Clip, Clip]:
    """A clip, and one of the same name that is its crop of 7 x 9 pixels at a place: 3 photons per pixel."""
    whole = write_clip(folder / "whole" / "c", radiance=0.02 * sliding_pattern(6, 12, 18, 1))
    y, x = place
    light = np.stack([whole.radiance(t) for t in range(6)])[:, y : y + 7, x : x + 9]
    return whole, write_clip(folder / "crop" / "c", radiance=light, camera=whole.info.camera, origin=[y, x])


@pytest.mark.parametrize("place", [(3, 4), (5, 6)])  # packing begins inside a block of random words, or not
@pytest.mark.parametrize("kind", CROPPED)
def test_a_crop_has_the_defects_and_the_noise_of_its_place(tmp_path, kind, place):
    """Under the same name and light the codes are those of the whole clip: stored, packed, replayed, drawn again."""
    whole, crop = whole_and_crop(tmp_path, place)
    y, x = place
    sensor, how = CROPPED[kind]
    expected = sense(whole, Sensing(sensor, name="s", **how))[0]
    stream = sense(crop, Sensing(sensor, name="s", **how))[0]
    assert expected.origin == (0, 0)
    assert stream.origin == (y, x)
    assert 0 < stream.codes().mean() < sensor.levels - 1
    np.testing.assert_array_equal(stream.codes(), expected.codes()[:, y : y + 7, x : x + 9])
    np.testing.assert_array_equal(*replay(crop, stream, 1))
    again = replace(stored(stream), engine="reference").frames(crop, 0, len(stream))
    np.testing.assert_array_equal(again, stream.codes())
    assert sense(crop, Sensing(sensor, name="s", **how))[0].info == stream.info, "kept, not drawn again"


@needs_engine
@pytest.mark.parametrize("place", [(3, 4), (5, 6)])
def test_the_compiled_engine_draws_a_crop_at_its_place(tmp_path, monkeypatch, place):
    monkeypatch.setattr("qsim.sensor.sensor.SMALLEST", 0)
    whole, crop = whole_and_crop(tmp_path, place)
    y, x = place
    for how in ({}, {"defects": Defects(PATTERN)}):
        wanted = Sensing(BITS3, name="s", **how)
        reference = replace(prepare(whole, wanted), engine="reference").frames(whole, 0, 6)[:, y : y + 7, x : x + 9]
        fast = replace(prepare(crop, wanted), engine="fast")
        np.testing.assert_array_equal(fast.frames(crop, 0, 6), reference)
        np.testing.assert_array_equal(np.concatenate(list(fast.packed(crop, 6))), packing.pack(reference, 3))


def test_the_times_of_photons_of_a_crop_are_those_of_its_place(tmp_path):
    whole, crop = whole_and_crop(tmp_path, (3, 4))
    sensor, how = CROPPED["events"]
    wholes, crops = (
        list(stored(sense(clip, Sensing(sensor, name="s", **how))[0]).trace(clip, 6)) for clip in (whole, crop)
    )
    for n, (times, kinds) in enumerate(crops):
        y, x = divmod(n, 9)
        for found, expected in zip((times, kinds), wholes[(3 + y) * 18 + 4 + x], strict=True):
            np.testing.assert_array_equal(found, expected)


def test_a_crop_is_drawn_again_at_the_place_that_its_description_states(tmp_path):
    """Without an origin, defects and noise are those of the upper left corner."""
    _, crop = whole_and_crop(tmp_path, (3, 4))
    wanted = Sensing(BITS3, name="s", defects=Defects(PATTERN))
    draw = replace(prepare(crop, wanted), origin=(0, 0))
    old = write_stream(crop, "s", draw.blocks(crop, 0, 6, 6), describe(crop, wanted, draw))
    assert (old.codes() != prepare(crop, wanted).frames(crop, 0, 6)).any()
    np.testing.assert_array_equal(*replay(crop, old, 2))
    with pytest.raises(FileExistsError, match="exists with other settings"):
        sense(crop, wanted)
