"""Scenes of a user's folder fill the view: at least 30 % of the pixels move, with and without a moving camera."""

import numpy as np
import pytest
from PIL import Image

from qsim.rendering.budget import Budget
from qsim.rendering.renderer import Renderer
from qsim.scenes import asset_folder


@pytest.mark.parametrize("seed", [0, 1])
def test_bodies_fill_the_view_and_most_pixels_move(tmp_path, seed):
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (40, 50, 3), dtype=np.uint8)).save(tmp_path / "a.png")
    scene = asset_folder.scene(seed, speed=8.0, folder=tmp_path).resized(32, 32)
    assert (scene.camera.motion is None) == (seed == 0)
    flow = Renderer(scene, frame_rate=2000.0, budget=Budget(samples=1, bounces=1)).frame(16).flow
    assert np.mean(np.hypot(*flow) > 0.1) > (0.3 if seed == 0 else 0.95)
