"""Clips: interrupted ones resume with the same bytes, and fireflies are counted."""

from __future__ import annotations

from dataclasses import replace

import pytest
from small_scenes import CHEAP, mirrored_sun, plate, renderer

from qsim import scenes
from qsim.backend import choose
from qsim.clip.clip_info import SceneName
from qsim.process import resident_memory
from qsim.rendering.budget import Budget
from qsim.rendering.clip_rendering import render_clip
from qsim.scene import Constant, Spin


class Stop(Exception):
    pass


def stop(done, frames):
    if done == 2:
        raise Stop


def test_an_interrupted_clip_resumes_with_the_same_bytes(tmp_path):
    made = plate(Spin((0, 0, 1), 200.0))

    whole = render_clip(made, tmp_path / "whole", frames=4, budget=CHEAP)
    with pytest.raises(Stop):
        render_clip(made, tmp_path / "broken", frames=4, budget=CHEAP, progress=stop)
    assert not (tmp_path / "broken").exists()
    resumed = render_clip(made, tmp_path / "broken", frames=4, budget=CHEAP)
    assert resumed.info.checksums == whole.info.checksums
    assert len(resumed.info.error_per_frame) == 4
    assert resumed.flow(1).shape == (2, 24, 33)
    with pytest.raises(ValueError, match="at least one frame"):
        render_clip(made, tmp_path / "none", frames=0, budget=CHEAP)


def test_an_interrupted_clip_does_not_resume_with_another_scene(tmp_path):
    made = plate(Spin((0, 0, 1), 200.0))
    with pytest.raises(Stop):
        render_clip(made, tmp_path / "clip", frames=3, budget=CHEAP, progress=stop)
    others = [plate(Spin((0, 0, 1), 300.0)), replace(made, lights=(Constant(0.8),))]
    for other in others:
        with pytest.raises(ValueError, match="2 frames exist, begun with other settings"):
            render_clip(other, tmp_path / "clip", frames=3, budget=CHEAP)
    clip = render_clip(plate(Spin((0, 0, 1), 200.0)), tmp_path / "clip", frames=3, budget=CHEAP)
    assert len(clip.info.scene_sha256) == 64
    assert clip.info.scene == SceneName(family="test", seed=0, speed=1.0)


def test_a_clip_counts_its_fireflies(tmp_path):
    """clip.json has the number for every frame, with the measured errors and the budget."""
    made = mirrored_sun()
    clip = render_clip(made, tmp_path / "mirror", frames=2, budget=Budget(8, 4))
    counted = [renderer(made, budget=Budget(8, 4)).frame(t, with_truth=False).fireflies for t in range(2)]
    assert list(clip.info.fireflies_per_frame) == counted
    assert sum(counted) > 0
    assert len(clip.info.error_per_frame) == 2
    assert clip.info.render.bounces == 4


@pytest.mark.skipif(choose().backend == "scalar", reason="the scalar engine keeps no memory of freed arrays")
def test_a_clip_does_not_keep_the_memory_of_the_one_before(tmp_path):
    """The large frame takes about 90 MB more. Part of it stays with libraries that keep their own memory."""
    held = []
    for name, height, samples in (("small", 16, 8), ("large", 384, 32), ("again", 16, 8)):
        made = scenes.load("plain", seed=1).resized(height, 2 * height)
        render_clip(made, tmp_path / name, frames=1, budget=Budget(samples, 4))
        held.append(resident_memory())
    small, large, again = held
    assert again - small < 0.8 * (large - small)
