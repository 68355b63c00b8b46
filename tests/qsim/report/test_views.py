"""Tests that views are the declared functions of the numbers."""

import json

import numpy as np
from clips import write_clip

from qsim import colour as pictures
from qsim.report.views import open_source
from qsim.sensor import packing


def test_views_are_the_declared_functions_of_the_numbers(clip):
    views = open_source(clip.path).views
    assert list(views) == ["sharp", "codes", "average", "flow", "depth"]
    white = views["sharp"].scale["white"]
    assert white == pictures.peak(np.stack([clip.sharp(t) for t in range(5)]))
    assert np.array_equal(views["sharp"].picture(2)[..., 1], pictures.tone(clip.sharp(2), white))
    assert np.array_equal(views["codes"].picture(2)[..., 0], np.rint(clip.stream("mine").codes(2, 3)[0] * 255.0 / 7))
    assert views["flow"].picture(1)[3, 3].tolist() == [255, 0, 0], "to the right at full speed"
    assert "2 px/frame" in views["flow"].declared
    assert views["depth"].picture(1)[-1].max() == 0
    assert f"white = {white:.4g} relative" in views["sharp"].declared


def test_average_is_of_the_frames_around(clip):
    view = open_source(clip.path).views["average"]
    mean = clip.stream("mine").codes().mean(axis=0) / 7  # five frames: every window of eleven holds all of them
    assert np.array_equal(view.picture(0)[..., 0], pictures.tone(mean, view.scale["white"]))


def test_restored_video_names_its_method(tmp_path):
    np.save(tmp_path / "video.npy", np.full((3, 4, 5), 6.5, np.float32))
    described = {"format": "quiver-restored-1", "method": "moment", "unit": "photons", "frame_rate": 2000.0}
    (tmp_path / "video.json").write_text(json.dumps(described))
    view = open_source(tmp_path / "video.npy").views["values"]
    assert view.declared.startswith("restored by moment: white = 6.5 photons")
    assert (view.picture(0) == 255).all()


def test_packed_planes_are_unpacked(tmp_path):
    planes = np.random.default_rng(0).integers(0, 2, (3, 4, 13)).astype(np.uint8)
    np.save(tmp_path / "cube.npy", packing.pack(planes, 1))
    view = open_source(tmp_path / "cube.npy", width=13).views["codes"]
    assert np.array_equal(view.picture(2)[..., 0], planes[2] * 255)


def test_a_clip_without_streams_shows_its_light(tmp_path):
    clip = write_clip(tmp_path / "plain", frames=3)
    assert list(open_source(clip.path).views) == ["sharp"]
