"""Tests rendering in one call: families, files and records, with and without a folder."""

import gc
import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from qsim import scenes
from qsim.dataset.scene_rendering import SIDE, load_scene, render
from qsim.optics.camera import Camera
from qsim.optics.lens import Lens
from qsim.rendering.budget import Budget
from qsim.rendering.render_settings import RenderSettings
from qsim.scene import Spin, Translation
from qsim.scene.camera_path import write_camera_path
from qsim.temporary_folder import TemporaryFolder

QUICK = {"frames": 2, "height": 12, "width": 14, "budget": Budget(samples=8, bounces=2)}


def test_a_family_its_record_and_its_file_give_the_same_clip(tmp_path: Path):
    file = tmp_path / "own.py"
    file.write_text("from qsim.scenes.fan import scene\n")
    clips = [render(source, **QUICK, seed=3) for source in ("fan", file, scenes.load("fan", 3))]
    for clip in clips[1:]:
        np.testing.assert_array_equal(clip[:], clips[0][:])
        assert clip.info.checksums == clips[0].info.checksums
    assert list(clips[1].info.reads) == ["own.py"]
    stored = render("fan", tmp_path / "fan", **QUICK, seed=3)
    assert stored.path == tmp_path / "fan"
    np.testing.assert_array_equal(stored.sense(ppp=3.25).codes, clips[0].sense(ppp=3.25).codes)


def test_sizes_default_to_the_camera_of_a_record_and_to_a_small_square(tmp_path: Path):
    record = scenes.load("fan").resized(9, 8)
    size = load_scene(record, 0, None, RenderSettings())[0].camera
    assert (size.height, size.width) == (9, 8)
    assert load_scene(record, 0, None, RenderSettings(width=5))[0].camera.width == 5
    family = load_scene("fan", 0, None, RenderSettings(width=40))[0].camera
    assert (family.height, family.width) == (SIDE, 40)
    for source in (record, "fan", "lamp"):  # 0 gave the size of a record's camera
        for size in ({"height": 0, "width": 5}, {"height": 5, "width": 0}):
            with pytest.raises(ValueError, match=r"(height|width): expected a whole number from 1 to 100000, got 0"):
                render(source, **size)
    with pytest.raises(ValueError, match="has its motions already; leave speed= out"):
        load_scene(record, 0, 2.0, RenderSettings())
    with pytest.raises(ValueError, match="no path is given"):
        render("fan", force=True)
    with pytest.raises(ValueError, match=r"no scene family 'fam' \(did you mean 'fan'\?\)"):
        render("fam")


def test_a_camera_path_replaces_the_camera_of_a_scene(tmp_path: Path):
    """Its poses at the rate of the file, faster by `speed`; a file without a rate has one pose per frame."""
    motion = Spin((0, 1, 0), 40.0) @ Translation((9.0, 0, 5))
    camera = Camera(3e-4, 2.8, 1e-5, 12, 14, lens=Lens(-0.05), origin=(0, 1, 3), motion=motion)
    file = tmp_path / "transforms.json"
    write_camera_path(file, camera, frames=5, frame_rate=1000.0)
    clip = render("fan", **QUICK, camera_path=file)
    for t, pose in enumerate(clip.info.poses):
        np.testing.assert_allclose(pose, camera.pose(t / 2000.0), atol=1e-4)  # between two poses of the file
    assert clip.camera.lens == Lens(-0.05)
    assert clip.camera.focal_pixels == pytest.approx(camera.focal_pixels)
    fast, _ = load_scene("fan", 0, 2.0, RenderSettings(height=12, width=14, camera_path=str(file)))
    np.testing.assert_allclose(fast.camera.pose(1 / 2000), camera.pose(1 / 1000), atol=1e-12)
    content = json.loads(file.read_text())
    del content["frame_rate"]
    file.write_text(json.dumps(content))
    slow, _ = load_scene(
        scenes.load("fan"), 0, None, RenderSettings(height=12, width=14, camera_path=str(file), frame_rate=50.0)
    )
    np.testing.assert_allclose(slow.camera.pose(1 / 50), camera.pose(1 / 1000), atol=1e-12)


def test_a_temporary_clip_lasts_as_long_as_its_streams():
    clip = render("fan", **QUICK)
    stream = clip.sense(ppp=3.25)
    folder = clip.path.parent
    again = clip.stream(stream.name)
    del clip, stream
    gc.collect()
    assert again.codes.shape == (2, 12, 14)
    assert again.truth().shape == (2, 12, 14)
    del again
    gc.collect()
    assert not folder.exists()


def test_only_the_process_that_made_a_temporary_folder_deletes_it():
    folder = TemporaryFolder()
    path = folder.path
    copied = pickle.loads(pickle.dumps(folder))  # as workers of a loader receive it
    assert copied.path == path
    del copied
    gc.collect()
    assert path.is_dir()
    child = os.fork()
    if not child:
        del folder
        gc.collect()
        os._exit(0)
    os.waitpid(child, 0)
    assert path.is_dir()
    del folder
    gc.collect()
    assert not path.exists()


@pytest.mark.parametrize("reuse", [True, False])
def test_a_budget_and_a_wish_for_its_choice_are_refused(reuse):
    """False was ignored: the budget's neighbours were used."""
    with pytest.raises(ValueError, match="reuse= is part of the choice of a budget"):
        render("fan", budget=Budget(neighbours=2), reuse=reuse)
