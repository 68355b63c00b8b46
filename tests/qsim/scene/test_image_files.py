"""Textures of image files become linear light."""

from __future__ import annotations

import numpy as np
import pytest

from qsim.scene import Texture


def test_texture_files_become_linear_light(tmp_path):
    from PIL import Image

    path = tmp_path / "grey.png"
    Image.fromarray(np.full((2, 3), 188, np.uint8)).save(path)
    pixels = Texture(str(path)).pixels()
    assert pixels.shape == (2, 3)
    np.testing.assert_allclose(pixels, ((188 / 255 + 0.055) / 1.055) ** 2.4, rtol=1e-5)  # about a half
    with pytest.raises(FileNotFoundError, match="nothing"):
        Texture(str(tmp_path / "nothing.png")).pixels()
    path.write_bytes(b"text")
    with pytest.raises(ValueError, match="not a readable image"):
        Texture(str(path)).pixels()
