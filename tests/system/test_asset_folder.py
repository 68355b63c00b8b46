"""Scenes of a user's folder fill the view with moving pixels, and show pictures in their colours."""

import numpy as np
import pytest
from PIL import Image

from qsim.rendering.budget import Budget
from qsim.rendering.renderer import Renderer
from qsim.scene import Texture
from qsim.scenes import asset_folder
from qsim.scenes.colours import coloured


@pytest.mark.parametrize("seed", [0, 1])
def test_bodies_fill_the_view_and_most_pixels_move(tmp_path, seed):
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (40, 50, 3), dtype=np.uint8)).save(tmp_path / "a.png")
    scene = asset_folder.scene(seed, speed=8.0, folder=tmp_path).resized(32, 32)
    assert (scene.camera.motion is None) == (seed == 0)
    flow = Renderer(scene, frame_rate=2000.0, budget=Budget(samples=1, bounces=1)).frame(16).flow
    assert np.mean(np.hypot(*flow) > 0.1) > (0.3 if seed == 0 else 0.95)


def test_colour_pictures_keep_their_colours_and_grey_scenes_their_numbers(tmp_path):
    Image.fromarray(np.full((4, 5, 3), (255, 0, 0), np.uint8)).save(tmp_path / "red.png")
    scene = asset_folder.scene(0, folder=tmp_path)
    for grey, red in zip(scene.bodies, coloured(scene).bodies, strict=True):
        np.testing.assert_allclose(red.material.reflectance.colours(), np.full((4, 5, 3), (0.9, 0, 0)), rtol=1e-6)
        expected = np.float32(0.9) * Texture(str(tmp_path / "red.png")).pixels()
        np.testing.assert_array_equal(grey.material.reflectance.pixels(), expected)


def test_a_picture_that_cannot_be_read_is_named_before_anything_is_rendered(tmp_path):
    (tmp_path / "red.png").write_bytes(b"text")
    with pytest.raises(ValueError, match=r"red\.png: not a readable image"):
        asset_folder.scene(0, folder=tmp_path)
