"""The description of a clip: what is written is read again, and what does not fit is refused with its place."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import WRONG, at, attempt, places, replaced, tables

from qsim import descriptions, records
from qsim.clip.clip_info import (
    PHYSICAL,
    ClipInfo,
    Finding,
    FlickerInfo,
    Grouped,
    RenderInfo,
    Saturation,
    SceneName,
)
from qsim.clip.source import Source
from qsim.frame_times import Times
from qsim.optics.camera import Camera
from qsim.optics.lens import Lens
from qsim.optics.radiometry import RGB
from qsim.optics.zoom import Zoom

FULL = ClipInfo(
    name="fan_0000",
    shape=(2, 8, 10),
    frame_rate=2000,
    exposure=5e-4,
    shutter=0.5,
    radiance_unit=PHYSICAL,
    camera=Camera(8e-3, 2.8, 1.1e-6, 8, 10, zoom=Zoom((0.0, 1.0), (70.0, 20.0), (Lens(0.1), Lens(0.2)))),
    poses=[np.eye(4), 2 * np.eye(4)],
    origin=[3, 4],
    bands=RGB,
    flicker={"light0": FlickerInfo(kind="Mains", frequency=100.0, depth=0.3, strength=[1.0, 0.9])},
    scene_sha256="0" * 64,
    seed=3,
    render=RenderInfo(samples=8, findings=[Finding("shadows", "hard", "0.1 dB")], engine="llvm", variant="llvm_mono"),
    grouped=Grouped(clip="fan", frames=3),
    source=Source(format="zarr", attributes={"fps": 3, "name": ["any"]}, missing_frames=[1], sha256="a" * 64),
    saturation=Saturation(white=255.0, assumed=True),
    times=Times([0.0, 1.0], "s", "names of files", 0.1),
    job="b" * 64,
    split="val",
    scene=SceneName(family="fan", seed=3, speed=2.0),
    reads={"own.py": "c" * 64},
    assets=["mesh 1"],
    mean_radiance=0.5,
    error_per_frame=[0.1, 0.2],
    white=1.0,
    psnr_of_truth=40.0,
    psnr_unclamped=39.0,
    checksums={"radiance/000000.exr": "0" * 64, "radiance/000001.exr": "1" * 64},
    software={"qsim": "0.1.0"},
)
VALUES = json.loads(json.dumps(records.plain(FULL)))
ANY = ("source", "attributes")  # another program's values
PLACES = [path for path in places(VALUES) if path[:2] != ANY]
TABLES = [path for path in tables(VALUES) if path[:2] != ANY]


def test_what_is_written_is_read(tmp_path):
    descriptions.write(tmp_path / "clip.json", FULL)
    read = descriptions.read(tmp_path / "clip.json", ClipInfo, "make it again")
    assert records.plain(read, complete=True) == records.plain(FULL, complete=True)
    assert read.camera.zoom == FULL.camera.zoom
    assert not {"mean_photons", "clipped_pixels"} & VALUES.keys()  # defaults are not written
    assert not {"checksums", "white", "software"} & FULL.asked.keys()


@settings(max_examples=300)
@given(st.sampled_from(PLACES), st.sampled_from(WRONG))
def test_a_wrong_value_is_refused_with_its_place_or_is_allowed(path, wrong):
    """A value that passes is one that the type allows: it is kept as it is."""
    made, refusal = attempt(lambda: records.convert(replaced(VALUES, path, wrong), ClipInfo, "FILE"))
    if refusal:
        assert refusal.startswith("FILE: ")
        assert path[0] in refusal or "needs a camera" in refusal
        assert len(refusal) < 2000
    else:
        kept = at(records.plain(made, complete=True), path)
        assert kept == wrong


@settings(max_examples=60)
@given(st.sampled_from(TABLES), st.text(max_size=8))
def test_a_key_that_no_field_has_is_refused(path, key):
    inside = at(VALUES, path)
    named = path and path[0] in ("checksums", "flicker", "reads", "software")
    if key in inside or named:
        return
    with pytest.raises(ValueError, match="FILE: unknown key '"):
        records.convert(replaced(VALUES, (*path, key + "-"), 1), ClipInfo, "FILE")


def test_a_moving_camera_rests_in_the_description():
    class Turning:
        def pose(self, t):
            return np.eye(4)

        def velocity(self, t):
            return np.zeros(3), np.zeros(3)

    camera = Camera(8e-3, 2.8, 1.1e-6, 8, 10, motion=Turning())
    about = {"shape": (1, 8, 10), "frame_rate": 1.0, "exposure": 1.0, "radiance_unit": PHYSICAL, "camera": camera}
    assert ClipInfo(**about, poses=[np.eye(4)]).camera.motion is None
    with pytest.raises(ValueError, match="poses: a camera that moves needs its pose in each frame"):
        ClipInfo(**about)
    with pytest.raises(ValueError, match="poses: expected one for each of 1 frames, got 2"):
        ClipInfo(**about, poses=[np.eye(4)] * 2)
