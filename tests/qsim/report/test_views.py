"""Tests that views are the declared functions of the numbers."""

from dataclasses import replace

import numpy as np
from clips import describe_video, square_clip, write_clip

from qsim import colour as pictures
from qsim.cli.program import main
from qsim.report.views import Source, open_source
from qsim.sensor import packing
from qsim.sensor.qis import QIS
from qsim.streams.photons import clip_photons
from qsim.streams.stream import Stream, write_packed


def test_views_are_the_declared_functions_of_the_numbers(clip):
    views = open_source(clip.path).views
    assert list(views) == ["sharp", "codes", "average", "flow", "depth"]
    white = views["sharp"].scale["brightest_shown"]
    assert white == pictures.peak(np.stack([clip.sharp(t) for t in range(5)]))
    assert np.array_equal(views["sharp"].picture(2)[..., 1], pictures.tone(clip.sharp(2), white))
    assert np.array_equal(views["codes"].picture(2)[..., 0], np.rint(clip.stream("mine").codes(2, 3)[0] * 255.0 / 7))
    assert views["flow"].picture(1)[3, 3].tolist() == [255, 0, 0], "to the right at full speed"
    assert "2 px/frame" in views["flow"].declared
    assert views["depth"].picture(1)[-1].max() == 0
    assert f"brightest shown = {white:.4g} relative" in views["sharp"].declared


def test_average_is_of_the_frames_around(clip):
    view = open_source(clip.path).views["average"]
    mean = clip.stream("mine").codes().mean(axis=0) / 7  # five frames: every window of eleven holds all of them
    assert np.array_equal(view.picture(0)[..., 0], pictures.tone(mean, view.scale["brightest_shown"]))


def test_restored_video_names_its_method(tmp_path):
    np.save(tmp_path / "video.npy", np.full((3, 4, 5), 6.5, np.float32))
    describe_video(tmp_path / "video.json", frame_rate=2000.0)
    view = open_source(tmp_path / "video.npy").views["values"]
    assert view.declared.startswith("restored by moment: brightest shown = 6.5 photons")
    assert (view.picture(0) == 255).all()


def test_packed_planes_are_unpacked(tmp_path):
    planes = np.random.default_rng(0).integers(0, 2, (3, 4, 13)).astype(np.uint8)
    np.save(tmp_path / "cube.npy", packing.pack(planes, 1))
    view = open_source(tmp_path / "cube.npy", width=13).views["codes"]
    assert np.array_equal(view.picture(2)[..., 0], planes[2] * 255)


def test_a_clip_without_streams_shows_its_light(tmp_path):
    clip = write_clip(tmp_path / "plain", frames=3)
    assert list(open_source(clip.path).views) == ["sharp"]


def test_a_clip_with_flow_alone_shows_it(tmp_path):
    """As clips of warped pictures: every preview of them ended with "has no channel 'Z' (depth)"."""
    clip = square_clip(tmp_path / "flow")
    assert list(open_source(clip.path).views) == ["sharp", "flow"]
    assert main(["preview", str(clip.path), "-o", str(tmp_path / "a.png")]) == 0


def slow_codes(source: Source, stream: Stream) -> list[int]:
    """Return the number of the code that a source shows at each of its frames; all codes differ."""
    codes = [np.rint(code * 255.0 / (2**stream.bits - 1)) for code in stream.codes()]
    shown = [source.views["codes"].picture(t)[..., 0] for t in range(source.length)]
    return [next(n for n, code in enumerate(codes) if np.array_equal(code, picture)) for picture in shown]


def test_codes_of_several_clip_frames_stand_beside_the_light_of_their_exposure(tmp_path):
    """Codes of seven planes: clip frames 0 ... 6 have code 0; the last clip frame of 22 has none."""
    clip = write_clip(tmp_path / "c", frames=22, height=9, width=11)
    stream = clip.sense("spad-320x240", ppp=3.0, bits=3, group=True)
    source = open_source(clip.path)
    assert (len(stream), source.length) == (3, 21)
    assert slow_codes(source, stream) == [0] * 7 + [1] * 7 + [2] * 7
    assert source.views["codes"].declared.endswith("; each over 7 frames of the clip")
    white = source.views["sharp"].scale["brightest_shown"]
    assert np.array_equal(source.views["sharp"].picture(20)[..., 1], pictures.tone(clip.sharp(20), white))
    assert slow_codes(open_source(stream.path), stream) == [0, 1, 2], "a stream alone is shown code by code"


def test_codes_of_rows_at_their_own_time_stand_beside_the_middle_of_the_readout(tmp_path):
    """Eight rows of 7/8 of a clip frame each: the middle of the readout is 3.06 frames late."""
    clip = write_clip(tmp_path / "c", frames=28, height=8, width=11)
    stream = clip.sense(QIS(0.8, 1.6, 0.2, 3), ppp=3.0, slices=7, row_delay=7 / 8 / clip.frame_rate)
    source = open_source(clip.path)
    shown = slow_codes(source, stream)
    assert (len(stream), len(shown)) == (3, 24)
    assert shown == [0] * 10 + [1] * 7 + [2] * 7
    middle = [stream.truth(t, t + 1, at="frame")[0] for t in range(3)]
    for n, truth in enumerate(middle):
        at = 7 * n + 6
        np.testing.assert_allclose(clip_photons(clip, at, 7 * stream.photons_factor, sharp=True), truth)
        assert shown[at] == n


def test_planes_of_another_clip_are_one_code_per_frame(tmp_path):
    """Bit-depth studies state planes of their fast clip in the streams of its grouped one."""
    clip = write_clip(tmp_path / "c", frames=3, height=9, width=11)
    stream = clip.sense(ppp=3.0, bits=3, name="planes")
    write_packed(stream.path, [stream.packed], replace(stream.info, planes_per_code=7))
    source = open_source(clip.path)
    assert slow_codes(source, stream) == [0, 1, 2]
    assert "each over" not in source.views["codes"].declared
