"""Tests the checks of clip.json: impossible clips, other versions, damage."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from tiny_clip import meta, write

from qsim import descriptions, files
from qsim.clip.writer import ClipWriter
from qsim.formats.exporting import camera_file
from qsim.optics.camera import Camera
from qsim.optics.lens import Lens
from qsim.optics.radiometry import expected_photons
from qsim.optics.zoom import Zoom
from qsim.scene import describe
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shape": [0, 8, 10]}, r"a: shape\[0\]: expected a whole number from 1, got 0"),
        ({"shape": [3, 8]}, "a: shape: expected a list of 3: a whole number from 1"),
        ({"exposure": 0}, "a: exposure: expected a number above 0, got 0"),
        ({"frame_rate": None}, "a: frame_rate: expected a number above 0, got None"),
        ({"radiance_unit": "nits"}, "a: radiance_unit: expected one of"),
        ({"camera": None}, "needs a camera"),
        ({"mode": 1}, "a: unknown key 'mode'"),
    ],
)
def test_impossible_clips_are_refused_before_anything_is_written(tmp_path: Path, changes: dict, message: str):
    with pytest.raises(ValueError, match=message):
        ClipWriter(tmp_path / "a", meta(**changes))
    assert list(tmp_path.iterdir()) == []


def test_other_format_versions_are_refused_with_both_numbers(tmp_path: Path):
    clip = write(tmp_path / "a")
    for version, advice in [(2, "newer qsim"), (0, "make it again"), (None, "make it again")]:
        files.write_json(
            clip.path / "clip.json", files.read_json(clip.path / "clip.json") | {"format_version": version}
        )
        with pytest.raises(ValueError, match=rf"format version {version}, this qsim reads version 1; .*{advice}"):
            Clip.open(clip.path)


def test_a_damaged_manifest_is_named(tmp_path: Path):
    clip = write(tmp_path / "a")
    manifest = clip.path / "clip.json"
    whole = manifest.read_bytes()
    for content in (whole[:50], b"[]", b"\xff\xfe"):
        manifest.write_bytes(content)
        with pytest.raises(ValueError, match=r"clip\.json"):
            Clip.open(clip.path)
    for key in ("shape", "exposure"):
        manifest.write_text(json.dumps({k: v for k, v in json.loads(whole).items() if k != key}))
        with pytest.raises(ValueError, match=f"key '{key}' is missing"):
            Clip.open(clip.path)
    with pytest.raises(FileNotFoundError, match="no such clip"):
        Clip.open(tmp_path / "b")
    with pytest.raises(FileNotFoundError, match="not a clip folder"):
        Clip.open(tmp_path)


def test_a_lens_is_stored_and_read_again(tmp_path: Path):
    radial = Lens(-0.2, 0.1, (-0.3, 0.1), (0.02, -0.01))
    camera = Camera(8e-3, 2.8, 1.1e-6, 10, 7, lens=radial)
    every = dataclasses.replace(radial, k3=0.03, k4=-0.02, p1=0.002, p2=-0.001, aspect=1.1)
    for i, lens in enumerate((radial, every)):
        assert write(tmp_path / str(i), camera=dataclasses.replace(camera, lens=lens)).camera.lens == lens
    zoom = Zoom((0.0, 0.5), (7e3, 8e3), (radial, dataclasses.replace(every, aspect=1.0)))
    changing = write(tmp_path / "z", camera=dataclasses.replace(camera, zoom=zoom)).camera
    assert changing.zoom == zoom


def test_each_frame_has_the_light_and_the_lens_of_its_time(tmp_path: Path):
    """The aspect of a lens changes a pixel's area, and its fall-off with the focal length the corners."""
    zoom = Zoom((0.0, 1e-3), (70.0, 20.0), (Lens(0.1, 0.0, (-0.2,)), Lens(0.3, 0.0, (-0.2,), aspect=2.0)))
    camera = Camera(8e-3, 2.8, 1.1e-6, 8, 10, zoom=zoom)
    clip = write(tmp_path / "z", camera=camera)
    each = [clip_photons(clip, t) for t in range(len(clip))]
    for t, photons in enumerate(each):
        seen = camera.at(t / clip.frame_rate)
        wanted = expected_photons(clip.radiance(t), seen, clip.exposure, origin=clip.origin)
        np.testing.assert_allclose(photons, wanted, rtol=1e-12)
    assert clip.mean_photons == pytest.approx(np.mean(each), rel=1e-9)
    frames = camera_file(clip)["frames"]
    for t, frame in enumerate(frames):
        assert frame["fl_y"] == pytest.approx(camera.at(t / clip.frame_rate).focal_pixels)
    assert frames[0]["fl_y"] > 1.2 * frames[-1]["fl_y"]
    with pytest.raises(ValueError, match=r"the lens changes with time; pass camera.at\(t\)"):
        expected_photons(clip.radiance(0), camera, clip.exposure)


def test_an_ideal_lens_is_not_described():
    camera = Camera(8e-3, 2.8, 1.1e-6, 10, 7)
    ideal = describe(dataclasses.replace(camera, lens=Lens()))
    assert not {"lens", "zoom"} & ideal.keys()


def test_a_damaged_lens_is_named(tmp_path: Path):
    clip = write(tmp_path / "a")
    good = {"k1": -0.2, "k2": 0.1, "falloff": [], "shift": [0.0, 0.0]}
    for damage in ({"k1": "x"}, {"falloff": 3}, {"shift": [1.0]}, {"falloff": [None]}, {"k5": 0.1}, {"k1": -1e9}):
        about = files.read_json(clip.path / "clip.json")
        about["camera"]["lens"] = good | damage
        descriptions.write_values(clip.path / "clip.json", about)
        with pytest.raises(ValueError, match=r"clip\.json: .*camera.*lens"):
            assert Clip.open(clip.path).camera
