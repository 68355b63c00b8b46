"""Image files become linear light, Radiance files radiance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from qsim.colour import to_linear
from qsim.scene import Texture
from qsim.scene.image_files import read_grey, read_hdr


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
    expected = Texture(str(tmp_path / "8.png"))
    wide = codes.astype(np.uint16) * 257
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


def rgbe_file(path: Path, body: bytes, size: tuple[int, int], line: str = "\n") -> Path:
    head = line.join(["#?RADIANCE", "FORMAT=32-bit_rle_rgbe", "", f"-Y {size[0]} +X {size[1]}", ""])
    path.write_bytes(head.encode() + body)
    return path


def test_old_run_lengths_and_line_ends_of_windows_are_read(tmp_path: Path):
    """A repeat of (1, 1, 1, n) counts n pixels, a second one in a row 256 n more."""
    pixels = np.array([[200, 100, 50, 129], [128, 255, 3, 120]], np.uint8)
    row = pixels[0].tobytes() + bytes([1, 1, 1, 43]) + bytes([1, 1, 1, 1]) + pixels[1].tobytes()  # 1 + 43 + 256 + 1
    expected = pixels[[0] * 300 + [1]]
    flat = np.stack([expected, expected]).tobytes()
    for body, line in ((row + row, "\n"), (flat, "\n"), (flat, "\r\n"), (row + row, "\r\n")):
        found = read_hdr(rgbe_file(tmp_path / "a.hdr", body, (2, 301), line))
        right = np.ldexp(expected[:, :3].astype(float), expected[:, 3:].astype(int) - 136)
        np.testing.assert_allclose(found, np.stack([right, right]), rtol=1e-6)
    for body in (
        row + row[:-1],
        bytes([1, 1, 1, 5]) + row + row,
        row + pixels[0].tobytes() + bytes([1, 1, 1, 255]) * 2,
    ):
        with pytest.raises(ValueError, match=r"a\.hdr: damaged at byte"):
            read_hdr(rgbe_file(tmp_path / "a.hdr", body, (2, 301)))


def test_parts_of_an_exr_are_looked_through(tmp_path: Path):
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    colours = np.random.default_rng(0).random((4, 6, 3)).astype(np.float32)

    def part(name: str, channels: dict) -> OpenEXR.Part:
        return OpenEXR.Part(dict(header), channels, name)

    depth = {"Z": colours[..., 0].copy()}
    picture = {"RGB": colours}
    OpenEXR.File([part("depth", depth), part("beauty", picture)]).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_hdr(tmp_path / "a.exr"), colours)
    OpenEXR.File([part("left", picture), part("right", picture)]).write(str(tmp_path / "b.exr"))
    with pytest.raises(ValueError, match="has 2 parts with a picture; save the one to use alone"):
        read_hdr(tmp_path / "b.exr")


def test_photographs_stand_upright(tmp_path: Path):
    """As Pillow turns them; JPEG and PNG of cameras state it in their EXIF."""
    from PIL import Image, ImageOps

    pixels = np.random.default_rng(0).integers(0, 256, (16, 24), np.uint8)
    for ending in ("png", "jpg"):
        exif = Image.Exif()
        exif[274] = 6
        Image.fromarray(pixels).save(tmp_path / f"a.{ending}", exif=exif)
        with Image.open(tmp_path / f"a.{ending}") as opened:
            expected = np.asarray(ImageOps.exif_transpose(opened))
        assert read_grey(tmp_path / f"a.{ending}").shape == (24, 16)
        np.testing.assert_allclose(read_grey(tmp_path / f"a.{ending}"), to_linear(expected, "srgb", 255), rtol=1e-5)
