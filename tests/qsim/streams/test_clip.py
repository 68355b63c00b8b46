"""Tests what a notebook does with clips and streams: sense, index, iterate, compare with the truth, show."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import tiny_clip
from clips import write_clip

from qsim.sensor import packing
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.fixed_pattern import FixedPattern
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from qsim.streams.stream import Stream, write_packed
from qsim.streams.stream_info import StreamInfo

SENSOR = QIS(0.7, 2.0, 0.3, 3, gain=0.8)


def test_a_clip_is_a_sequence_of_radiance(tmp_path: Path):
    clip = tiny_clip.write(tmp_path / "a")
    stack = np.stack([clip.radiance(t) for t in range(len(clip))])
    np.testing.assert_array_equal(np.stack(list(clip)), stack)
    np.testing.assert_array_equal(clip[1:4, 2:, 3], stack[1:4, 2:, 3])
    np.testing.assert_array_equal(clip[-1], stack[-1])
    with pytest.raises(IndexError):
        clip[tiny_clip.FRAMES]


def test_names_files_and_records_of_a_sensor_give_the_same_codes(tmp_path: Path):
    clip = write_clip(tmp_path / "c", frames=4, height=9, width=10)
    file = tmp_path / "own.toml"
    fields = "\n".join(f"{key} = {value}" for key, value in SENSOR.to_dict().items() if type(value) in (int, float))
    file.write_text(f'[sensor]\nmodel = "QIS"\n{fields}\n')
    record = clip.sense(SENSOR, ppp=2.5)
    stored = clip.sense(file, ppp=2.5)
    np.testing.assert_array_equal(record.codes, stored.codes)
    assert record.sensor == stored.sensor == SENSOR
    assert clip.sense("quiver-paper", ppp=2.5).sensor == QIS(0.8, 1.6, 0.2, 3)
    same, line = sense(clip, Sensing(SENSOR, ppp=2.5))
    assert (same.name, clip.sense(SENSOR, ppp=2.5).name) == (record.name, record.name)
    assert "to 2.5 photons/pixel" in line


def test_records_of_other_parameters_are_other_streams(tmp_path: Path):
    clip = write_clip(tmp_path / "c", frames=2, height=5, width=6)
    sensors = [QIS(0.7, 2.0, noise, 3) for noise in (0.1, 0.2, 0.3)] + [BinarySPAD(0.4, 20.0)]
    names = {clip.sense(sensor, ppp=1.0).name for sensor in sensors}
    assert names == set(clip.streams)
    assert len(names) == 4
    with pytest.raises(ValueError, match=r"QIS: has bits = 3, the request 5"):
        clip.sense(SENSOR, ppp=1.0, bits=5)


def test_defects_may_be_a_record(tmp_path: Path):
    clip = write_clip(tmp_path / "c", frames=2, height=16, width=20)
    stream = clip.sense(BinarySPAD(0.4, 20.0), ppp=30.0, defects=Defects(FixedPattern(dead=0.3)))
    dark = (stream.codes == 0).all(axis=0).mean()
    assert 0.1 < dark < 0.5
    assert stream.info.defects["dead"] == 0.3


def test_a_stream_is_a_sequence_of_codes(tmp_path: Path):
    stream = write_clip(tmp_path / "c", frames=6, height=7, width=9).sense(SENSOR, ppp=2.0)
    codes = stream.codes(0, 6)
    np.testing.assert_array_equal(np.stack(list(stream)), codes)
    np.testing.assert_array_equal(stream[4:1:-2], codes[4:1:-2])
    np.testing.assert_array_equal(stream.codes(2, 3, (1, 2, 3, 4)), codes[2:3, 1:4, 2:6])
    with pytest.raises(IndexError):
        stream[6]
    for start, stop in ((0, 7), (-1, 2), (3, 3)):
        with pytest.raises(ValueError, match="do not all exist; the stream has 6"):
            stream.codes(start, stop)


def test_the_truth_is_the_sharp_light_of_the_middle_of_each_code(tmp_path: Path):
    clip = write_clip(tmp_path / "c", frames=7, height=5, width=6, sharp=True)
    single = clip.sense(SENSOR, ppp=2.0)
    factor = single.photons_factor
    expected = np.stack([clip_photons(clip, t, factor, sharp=True) for t in range(7)])
    np.testing.assert_allclose(single.truth(), expected, rtol=1e-12)
    np.testing.assert_allclose(single.truth(2, 4), expected[2:4], rtol=1e-12)
    grouped = clip.sense(BinarySPAD(0.4, 0.0, 2), ppp=2.0, group=True)
    assert grouped.shape == (2, 5, 6)
    middle = [3 * clip_photons(clip, t, grouped.photons_factor, sharp=True) for t in (1, 4)]
    np.testing.assert_allclose(grouped.truth(), middle, rtol=1e-12)
    with pytest.raises(ValueError, match="do not all exist"):
        single.truth(5, 9)


def test_the_truth_has_the_light_level_of_the_stream(tmp_path: Path):
    clip = write_clip(tmp_path / "c", frames=6, height=8, width=9)
    for sensor, planes in ((SENSOR, 1), (CountingSPAD(0.4, 20.0, 1e-8, 5), 2)):
        stream = clip.sense(sensor, ppp=4.0, slices=planes, name=f"of{planes}")
        assert stream.truth().mean() == pytest.approx(4.0, rel=0.05)


def test_a_stream_without_its_clip_has_no_truth(tmp_path: Path):
    clip = write_clip(tmp_path / "c", frames=2, height=5, width=6)
    stream = clip.sense(SENSOR, ppp=2.0)
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for file in (stream.path, stream.path.with_suffix(".json")):
        file.rename(moved / file.name)
    with pytest.raises(FileNotFoundError, match="does not lie in the folder of a clip"):
        type(stream).open(moved / f"{stream.name}.json").truth()


def test_an_imported_stream_has_no_truth(tmp_path: Path):
    """It ended in a TypeError: a stream without a clip is not found, one in a clip has no light level."""
    clip = write_clip(tmp_path / "c", frames=2, height=5, width=6)
    (clip.path / "streams").mkdir()
    packed = packing.pack(np.ones((2, 5, 6), np.uint8), SENSOR.bits)
    info = StreamInfo.of(SENSOR, shape=(2, 5, 6), exposure=5e-4, frame_rate=2000.0)
    with pytest.raises(FileNotFoundError, match="does not lie in the folder of a clip"):
        write_packed(tmp_path / "capture.npy", [packed], info).truth()
    with pytest.raises(ValueError, match=r"capture\.npy: was imported, so its light is not known"):
        write_packed(clip.path / "streams" / "capture.npy", [packed], info).truth()


def test_known_pixels_are_those_that_did_not_saturate(tmp_path: Path):
    clip = write_clip(tmp_path / "c", frames=2, height=5, width=6)
    assert clip.sense(SENSOR, ppp=2.0).known() is None
    from qsim.clip.writer import ClipWriter

    mask = np.random.default_rng(0).random((2, 5, 6)) < 0.3
    with ClipWriter(tmp_path / "s", tiny_clip.meta(shape=[2, 5, 6], camera=None, radiance_unit="relative")) as writer:
        for t in range(2):
            writer.add(t, np.ones((5, 6)), saturated=mask[t])
    stream = Clip.open(tmp_path / "s").sense(SENSOR, ppp=2.0)
    np.testing.assert_array_equal(stream.known(), ~mask)


def test_clips_and_streams_show_themselves(tmp_path: Path):
    clip = write_clip(tmp_path / "c", frames=3, height=5, width=6)
    stream = clip.sense(SENSOR, ppp=2.0)
    for thing in (clip, stream):
        html = thing._repr_html_()
        assert html.count("data:image/png;base64,") == 1
        assert repr(thing).strip("<>")[:12] in html
        assert thing.show().pictures.shape == (3, 5, 6)
        assert "data:image/gif" in thing.show()._repr_html_()
        assert thing.show(1, 2).pictures.shape == (1, 5, 6)


def test_files_are_named_by_text_or_path(tmp_path: Path):
    """A stream took a path alone, and tables of a sensor text alone: the others ended in an `AttributeError`."""
    clip = write_clip(tmp_path / "c")
    (tmp_path / "d.toml").write_text("[defects]\ndead = 0.1\n")
    one, two = (
        clip.sense("spad-320x240", ppp=1.0, name=name, defects=kind(tmp_path / "d.toml"))
        for name, kind in (("a", str), ("b", Path))
    )
    assert np.array_equal(one.codes(), two.codes())
    description = one.path.with_suffix(".json")
    assert Stream.open(str(description)).info == Stream.open(description).info


def test_a_clip_that_became_another_says_so(tmp_path: Path):
    """Light of the new frames with the camera and the units of the old ones is nobody's."""
    first = write_clip(tmp_path / "c", frames=2, height=6, width=8, seed=1)
    light = first.radiance(0)
    shutil.rmtree(tmp_path / "c")
    with pytest.raises(FileNotFoundError, match="no such file"):
        first.radiance(0)
    write_clip(tmp_path / "c", frames=2, height=6, width=8, seed=2)
    for read in (lambda: first.radiance(0), lambda: first[1], lambda: first.sharp(0)):
        with pytest.raises(ValueError, match=r"clip\.json: was replaced since it was opened; open the clip again"):
            read()
    shutil.rmtree(tmp_path / "c")
    write_clip(tmp_path / "c", frames=2, height=6, width=8, seed=1)
    np.testing.assert_array_equal(first.radiance(0), light)  # the same clip again


def test_a_stream_that_is_cut_while_it_is_open_says_so(tmp_path: Path):
    """A map reads zeros behind the end of its file, and ends the process a page later."""
    stream = write_clip(tmp_path / "c", frames=3, height=6, width=8).sense("quiver-physical", ppp=3.25, bits=3)
    assert stream[2].max() > 0
    os.truncate(stream.path, 140)
    with pytest.raises(ValueError, match="became shorter since it was opened"):
        stream.codes(2, 3)


def test_streams_are_not_written_through_a_link(tmp_path: Path):
    clip = write_clip(tmp_path / "c", frames=2, height=6, width=8)
    (tmp_path / "elsewhere").mkdir()
    (clip.path / "streams").symlink_to("../elsewhere")
    with pytest.raises(ValueError, match="streams: is a link, and streams are written into the clip"):
        clip.sense("quiver-physical", ppp=3.25, bits=3)
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_stream_of_another_clip_is_not_of_this_one(tmp_path: Path):
    """A copied folder of streams; another name of the clip's own folder changes nothing."""
    first = write_clip(tmp_path / "a", frames=4, height=9, width=10)
    second = write_clip(tmp_path / "b", frames=4, height=9, width=10)
    first.sense("quiver-physical", ppp=3.25, bits=3, name="s")
    shutil.copytree(first.path / "streams", second.path / "streams")
    with pytest.raises(ValueError, match="was drawn from the clip 'a', and this one is 'b'"):
        second.stream("s")
    assert any("was drawn from the clip 'a'" in problem for problem in second.verify())
    moved = Clip.open(first.path.rename(tmp_path / "moved"))
    assert moved.stream("s").verify() == []
    assert moved.verify() == []
