"""Codes from memory and from clips: checked, and with their truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from clips import ClipMaker
from random_codes import random_codes
from sensor_files import COUNTER, sensor_file

from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from qsim.streams.clip import Clip
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from qsim.studies.bit_depth.clips import write_streams
from qsim.studies.bit_depth.readout import StudySettings
from quiver.data.clips import open_clips
from quiver.data.codes import array_codes, filled, frame_reader, light_of, sensed, stored
from quiver.data.illumination import Illumination
from quiver.data.windows import as_input

EXPOSURE = 5e-4

SENSORS = (
    QIS(0.8, 1.6, 0.2, 3, gain=3.5 / 3.25),
    QIS(0.8, 3200.0, 0.0, 2),
    QIS(0.8, 1.6, 2.0, 5, gain=0.3, full_well=20.0),
    BinarySPAD(0.4, 100.0, bits=1),
    CountingSPAD(0.5, 25.0, 5e-5, 3),
)


def test_sensed_codes_and_truth(make_clip: ClipMaker):
    """Drawn frame by frame or at once, the codes are the same; the truth has the requested light level."""
    clip = make_clip()
    codes, truth = sensed(clip, Illumination(), seed=2)
    whole = codes.read(0, 14)
    np.testing.assert_array_equal(np.concatenate([codes.read(t, t + 1) for t in range(14)]), whole)
    assert truth.video().mean() == pytest.approx(3.25, rel=1e-6)
    assert codes.white == pytest.approx(8.75)
    assert (sensed(clip, Illumination(), seed=3)[0].read(0, 1) != whole[:1]).any()


def test_planes_that_a_study_summed_have_the_truth_of_its_clip(make_clip: ClipMaker, tmp_path):
    """Codes of the study's clip are scored; the same codes beside the planes that they sum are not."""
    clip = make_clip("fast", frames=14, frame_rate=20000.0, exposure=5e-5)
    (path,) = write_streams(clip, tmp_path, StudySettings(bits=(3,), ppp=0.65))
    grouped = Clip.open(path)
    codes, truth = stored(grouped, "planes")
    assert codes.shape == (2, *clip.shape[1:])
    np.testing.assert_array_equal(truth.sharp(1), grouped.stream("planes").truth(1, 2)[0])
    (clip.path / "streams").mkdir(exist_ok=True)
    for name in ("planes.npy", "planes.json"):
        (clip.path / "streams" / name).write_bytes((path / "streams" / name).read_bytes())
    with pytest.raises(ValueError, match=r"planes\.npy: "):
        stored(Clip.open(clip.path), "planes")


@pytest.mark.parametrize("table", ["afterpulse = 0.3\nafterpulse_delay = 1e-5\n", "carry_dead_time = true\n"])
def test_counting_pixels_with_a_memory_are_followed_as_by_qsim_sense(make_clip: ClipMaker, tmp_path, table):
    """The closed form drew them: without afterpulses, and live at the start of every exposure."""
    clip = make_clip(frames=4, height=6, width=7)
    file = sensor_file(tmp_path, COUNTER.replace("1e-5", "1e-4") + table, bits=3)
    now = sensed(clip, Illumination.of(file, 3.0, None))[0]
    stored = sense(clip, Sensing(file, ppp=3.0))[0]
    assert stored.info.drawn_by == "events"
    np.testing.assert_array_equal(now.read(0, 4), stored.codes(0, 4))
    np.testing.assert_array_equal(now.read(2, 3), stored.codes(2, 3))


def test_a_map_without_defects_has_the_size_of_the_frames():
    codes = array_codes(np.zeros((3, 4, 5), np.uint8), SENSORS[0], EXPOSURE)
    assert filled(codes, np.zeros((4, 5), bool)) is codes
    with pytest.raises(ValueError, match="has 3 x 5 pixels, the frames 4 x 5; give the map of this sensor"):
        filled(codes, np.zeros((3, 5), bool))


def test_codes_in_memory_are_checked():
    sensor = SENSORS[0]
    codes = np.zeros((3, 4, 5), np.uint8)
    codes[2, 1, 3] = 8
    with pytest.raises(ValueError, match=r"code 8 at \(t, y, x\) = \(2, 1, 3\); a 3-bit sensor has 0\.\.7"):
        array_codes(codes, sensor, EXPOSURE).read(1, 3)
    with pytest.raises(ValueError, match=r"expected whole codes \[T, H, W\]"):
        array_codes(np.zeros((0, 4, 5), np.uint8), sensor, EXPOSURE)
    assert as_input(np.full((1, 2, 2), 7, np.uint8), sensor).max() == 1.0


def test_splits(tiny_dataset):
    assert [len(open_clips(tiny_dataset, split)) for split in ("train", "val", "test", None)] == [3, 2, 2, 7]
    assert open_clips(open_clips(tiny_dataset)[0].path)[0].shape == (14, 36, 44)


def test_single_frames_are_read_in_blocks(monkeypatch):
    """Blocks of four frames: three reads for ten frames in order, and each frame is that of the stream."""
    source = random_codes(10, 5, 7)
    reads = []

    def read(start: int, stop: int) -> np.ndarray:
        reads.append((start, stop))
        return source.read(start, stop)

    monkeypatch.setattr("quiver.data.codes.BLOCK_PIXELS", 4 * 5 * 7 + 3)
    frame = frame_reader(replace(source, read=read))
    for t in (*range(10), 3, 9):
        np.testing.assert_array_equal(frame(t), source.read(t, t + 1)[0])
    assert reads == [(0, 4), (4, 8), (8, 10), (0, 4)]


@pytest.mark.parametrize(
    "sensor",
    [
        QIS(0.8, 3200.0, 0.2, 3),
        QIS(0.8, 1.6, 1.0, 4),
        BinarySPAD(0.4, 2000.0, bits=3),
        CountingSPAD(0.5, 2000.0, 1e-6, 4),
    ],
)
@pytest.mark.parametrize("frames", [1, 4, 30])
def test_the_estimated_light_holds_no_noise(sensor, frames):
    """Half of the picture is nearly dark. Where noise below darkness was cut off, the estimate was up to 2.3 times
    too high."""
    light = np.full((frames, 64, 64), 0.05)
    light[:, :, 32:] = 0.95
    codes = sensor.sample(light, EXPOSURE, key=Key(0, frames), engine="reference")
    found = light_of(array_codes(codes, sensor, EXPOSURE))
    table = sensor.response(EXPOSURE)
    read = min(frames, 11)
    slope, variance = (
        np.interp(light[0], table.photons, x) for x in (np.gradient(table.photons, table.mean), table.variance)
    )
    sigma = np.sqrt((slope**2 * variance).sum() / read) / light[0].size
    assert found == pytest.approx(0.5, abs=5 * sigma + 0.02 * 0.5)  # 2 %: few codes and a bent response


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 5, 7), (3, 1, 9)])
def test_light_is_estimated_at_any_size_and_below_any_threshold(shape):
    for gain in (1.0, 0.5 / 26, 0.5 / 400):
        sensor = QIS(0.8, 1.6, 0.2, 1, gain=gain)
        dark, full = (light_of(array_codes(np.full(shape, x, np.uint8), sensor, EXPOSURE)) for x in (0, 1))
        assert 0 < dark < 0.1 * sensor.white(EXPOSURE) < full < np.inf
