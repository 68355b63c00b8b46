"""Image files become linear light, Radiance files radiance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from qsim.scene import Texture
from qsim.scene.image_files import read_hdr


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


def test_grey_pictures_of_16_bits_are_read_in_full(tmp_path):
    """A code of 8 bits times 257 is the same light in either order of bytes; neighbouring codes differ."""
    import tifffile
    from PIL import Image

    rng = np.random.default_rng(0)
    codes = rng.integers(0, 256, (5, 7)).astype(np.uint8)
    Image.fromarray(codes).save(tmp_path / "8.png")
    expected, wide = Texture(str(tmp_path / "8.png")), codes.astype(np.uint16) * 257
    Image.fromarray(wide).save(tmp_path / "16.png")
    Image.fromarray(wide).save(tmp_path / "16.tif")
    tifffile.imwrite(tmp_path / "big.tif", wide, byteorder=">")
    Image.fromarray(wide.astype(np.int32)).save(tmp_path / "32.tif")
    for name in ("16.png", "16.tif", "big.tif", "32.tif"):
        found = Texture(str(tmp_path / name))
        np.testing.assert_array_equal(found.pixels(), expected.pixels(), err_msg=name)
        np.testing.assert_array_equal(found.colours(), expected.colours(), err_msg=name)
    Image.fromarray(np.array([[30000, 30001]], np.uint16)).save(tmp_path / "near.png")
    assert np.diff(Texture(str(tmp_path / "near.png")).pixels()) > 0


def test_pictures_without_a_known_white_and_too_large_ones_are_refused(tmp_path, monkeypatch):
    from PIL import Image

    Image.fromarray(np.full((2, 3), 0.5, np.float32)).save(tmp_path / "float.tif")
    with pytest.raises(ValueError, match=r"float.tif: holds floating-point numbers, .* array of linear values"):
        Texture(str(tmp_path / "float.tif")).pixels()
    Image.fromarray(np.full((2, 3), 65536, np.int32)).save(tmp_path / "high.tif")
    with pytest.raises(ValueError, match=r"high.tif: values of 0 to 65535 are read, found 65536 to 65536"):
        Texture(str(tmp_path / "high.tif")).pixels()
    Image.fromarray(np.zeros((9, 9), np.uint8)).save(tmp_path / "large.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 4)
    with pytest.raises(ValueError, match=r"large\.png: not a readable image"):
        Texture(str(tmp_path / "large.png")).pixels()


def radiance_file(path: Path, *header: str) -> Path:
    """Write a flat Radiance file of 2 x 3 px, each 96, 128, 160 times 1/128."""
    head = "\n".join(["#?RADIANCE", *header]).encode() + b"\n\n-Y 2 +X 3\n"
    path.write_bytes(head + bytes([96, 128, 160, 129]) * 6)
    return path


def test_the_exposures_of_a_radiance_file_are_divided_out(tmp_path):
    plain = read_hdr(radiance_file(tmp_path / "a.hdr", "FORMAT=32-bit_rle_rgbe"))
    np.testing.assert_array_equal(plain, np.broadcast_to([0.75, 1.0, 1.25], (2, 3, 3)))
    once = radiance_file(tmp_path / "b.hdr", "FORMAT=32-bit_rle_rgbe", "EXPOSURE=2")
    np.testing.assert_array_equal(read_hdr(once), plain / 2)
    twice = radiance_file(tmp_path / "c.hdr", "EXPOSURE= 2.0e+00", "FORMAT=32-bit_rle_rgbe", "EXPOSURE=4")
    np.testing.assert_array_equal(read_hdr(twice), plain / 8)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("FORMAT=32-bit_rle_xyze", r"x.hdr: its pixels are 32-bit_rle_xyze; convert the file to 32-bit_rle_rgbe"),
        *(
            (f"EXPOSURE={value}", f"x.hdr: EXPOSURE={value} in its header")
            for value in ("0", "-2", "nan", "inf", "two")
        ),
    ],
)
def test_headers_of_other_pixels_and_exposures_are_refused(tmp_path, line, message):
    with pytest.raises(ValueError, match=message):
        read_hdr(radiance_file(tmp_path / "x.hdr", line))
