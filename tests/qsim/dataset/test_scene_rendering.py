"""Tests rendering in one call: families, files and records, with and without a folder."""

import gc
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from qsim import scenes
from qsim.dataset.scene_rendering import SIDE, TemporaryFolder, load_scene, render
from qsim.rendering.budget import Budget

QUICK = {"frames": 2, "height": 12, "width": 14, "budget": Budget(samples=8, bounces=2)}


def test_a_family_its_record_and_its_file_give_the_same_clip(tmp_path: Path):
    file = tmp_path / "own.py"
    file.write_text("from qsim.scenes.fan import scene\n")
    clips = [render(source, **QUICK, seed=3) for source in ("fan", file, scenes.load("fan", 3))]
    for clip in clips[1:]:
        np.testing.assert_array_equal(clip[:], clips[0][:])
        assert clip.meta["checksums"] == clips[0].meta["checksums"]
    assert list(clips[1].meta["reads"]) == ["own.py"]
    stored = render("fan", tmp_path / "fan", **QUICK, seed=3)
    assert stored.path == tmp_path / "fan"
    np.testing.assert_array_equal(stored.sense(ppp=3.25).codes, clips[0].sense(ppp=3.25).codes)


def test_sizes_default_to_the_camera_of_a_record_and_to_a_small_square(tmp_path: Path):
    record = scenes.load("fan").resized(9, 8)
    size = load_scene(record, None, None, 0, None)[0].camera
    assert (size.height, size.width) == (9, 8)
    assert load_scene(record, None, 5, 0, None)[0].camera.width == 5
    family = load_scene("fan", None, 40, 0, None)[0].camera
    assert (family.height, family.width) == (SIDE, 40)
    with pytest.raises(ValueError, match="has its motions already; leave speed= out"):
        load_scene(record, None, None, 0, 2.0)
    with pytest.raises(ValueError, match="no path is given"):
        render("fan", force=True)
    with pytest.raises(ValueError, match=r"no scene family 'fam' \(did you mean 'fan'\?\)"):
        render("fam")


def test_a_temporary_clip_lasts_as_long_as_its_streams():
    clip = render("fan", **QUICK)
    stream, folder = clip.sense(ppp=3.25), clip.path.parent
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
