"""Tests pictures as light and as codes: PNG and TIFF."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from recordings import everything, random_planes

from qsim.calibration.sensor_file import read_stack
from qsim.colour import code_levels, to_linear
from qsim.formats import images, importing
from qsim.formats.recording import Hints


def test_png_and_tiff_pictures_of_light(tmp_path: Path):
    tifffile = pytest.importorskip("tifffile")
    rng = np.random.default_rng(0)
    for dtype in (np.uint8, np.uint16):
        pictures = rng.integers(0, np.iinfo(dtype).max, (3, 9, 7)).astype(dtype)
        folder = tmp_path / f"png{np.dtype(dtype).name}"
        folder.mkdir()
        images.write_png(folder, iter(pictures))
        expected = to_linear(pictures, "srgb", np.iinfo(dtype).max)
        np.testing.assert_array_equal(everything(folder, transfer="srgb"), expected)
        for photometric, stored in [("minisblack", pictures), ("miniswhite", np.iinfo(dtype).max - pictures)]:
            path = tmp_path / f"{photometric}.tif"
            tifffile.imwrite(path, stored, photometric=photometric)
            np.testing.assert_array_equal(everything(path, transfer="srgb"), expected)
        with pytest.raises(ValueError, match="does not state its transfer curve"):
            importing.read(folder)


def test_colour_becomes_luminance(tmp_path: Path):
    from PIL import Image

    colour = np.random.default_rng(0).integers(0, 255, (9, 7, 3)).astype(np.uint8)
    Image.fromarray(colour).save(tmp_path / "a.png")
    expected = to_linear(colour, "gamma 2.2", 255) @ np.array([0.2126, 0.7152, 0.0722])
    np.testing.assert_allclose(everything(tmp_path / "a.png", transfer="gamma 2.2")[0], expected, rtol=1e-5)


def test_colour_of_16_bits_is_read_in_full_or_refused(tmp_path: Path):
    """TIFF keeps all bits; a PNG would lose the lower eight, in colour and in grey with opacity."""
    import tifffile

    colour = np.random.default_rng(0).integers(0, 65535, (9, 7, 3)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", colour, photometric="rgb")
    expected = to_linear(colour, "linear", 65535) @ np.array([0.2126, 0.7152, 0.0722])
    np.testing.assert_allclose(everything(tmp_path / "a.tif", transfer="linear")[0], expected, rtol=1e-6)
    for kind, channels in ((2, 3), (4, 2), (6, 4)):  # colour, grey with opacity, colour with opacity
        (tmp_path / "a.png").write_bytes(png_16(np.resize(colour, (9, 7, channels)), kind))
        with pytest.raises(ValueError, match=r"a\.png: colour of 16 bits per channel would lose 8; store it as TIFF"):
            everything(tmp_path / "a.png", transfer="linear")
    (tmp_path / "a.png").write_bytes(png_16(colour[..., :1], 0))
    grey = everything(tmp_path / "a.png", transfer="linear")[0]
    np.testing.assert_array_equal(grey, to_linear(colour[..., 0], "linear", 65535))


def png_16(pixels: np.ndarray, kind: int) -> bytes:
    """Return a PNG of uint16 [H, W, channels]; the library writes grey only."""
    height, width, _ = pixels.shape
    raw = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(raw)), (b"IEND", b""))
    chunks = (struct.pack(">I", len(b)) + name + b + struct.pack(">I", zlib.crc32(name + b)) for name, b in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def test_codes_in_pictures(tmp_path: Path):
    """One-bit PNG, unstretched codes, stretched codes; stretched files need `stretched`."""
    bits1 = random_planes(2, 5, 7).astype(bool)
    codes = np.random.default_rng(1).integers(0, 8, (2, 5, 7)).astype(np.uint8)
    codes[0, 0, :2] = 0, 7
    for name, pictures in [("one", bits1), ("three", codes), ("wide", code_levels(codes, 7))]:
        (tmp_path / name).mkdir()
        images.write_png(tmp_path / name, iter(pictures))
    np.testing.assert_array_equal(everything(tmp_path / "one"), bits1)
    np.testing.assert_array_equal(everything(tmp_path / "three", bits=3), codes)
    np.testing.assert_array_equal(everything(tmp_path / "wide", bits=3, stretched=True), codes)
    with pytest.raises(ValueError, match=r"value \d+ at \(t, y, x\) = .* is not a 3-bit code .* stretched=True"):
        everything(tmp_path / "wide", bits=3)
    lossy = code_levels(codes, 7)
    lossy[1, 2, 3] ^= 2
    (tmp_path / "lossy").mkdir()
    images.write_png(tmp_path / "lossy", iter(lossy))
    with pytest.raises(ValueError, match=r"\(t, y, x\) = \(1, 2, 3\).*compressed with loss"):
        everything(tmp_path / "lossy", bits=3, stretched=True)


@pytest.mark.parametrize("imagej", [False, True])
def test_a_stack_behind_a_single_page_is_refused(tmp_path: Path, imagej: bool):
    """As ImageJ writes stacks above 4 GB: one page, and all frames behind it. With a page per frame all are read."""
    import tifffile

    frames = np.random.default_rng(0).integers(0, 256, (5, 9, 7)).astype(np.uint8)
    for truncate in (False, True):
        tifffile.imwrite(
            tmp_path / "a.tif",
            frames,
            imagej=imagej,
            truncate=truncate,
            photometric="minisblack",
            metadata={"axes": "TYX"},
        )
        if truncate:
            with pytest.raises(ValueError, match=r"a\.tif: holds more frames than the 1 that its pages describe"):
                importing.read(tmp_path / "a.tif", Hints(bits=8))
        else:
            np.testing.assert_array_equal(everything(tmp_path / "a.tif", bits=8), frames)


@pytest.mark.parametrize("wrong", [np.float32(2.5), np.float64(np.nan), np.int16(-1), np.int32(8)])
def test_numbers_that_are_no_codes_are_named(tmp_path: Path, wrong: np.generic):
    """A fraction was cut off, and -1 became 255: in imports, and in the frames of a calibration."""
    import tifffile

    frames = np.full((2, 5, 6), 7, wrong.dtype)
    tifffile.imwrite(tmp_path / "a.tif", frames, photometric="minisblack")
    np.testing.assert_array_equal(everything(tmp_path / "a.tif", bits=3), frames)
    frames[1, 2, 3] = wrong
    tifffile.imwrite(tmp_path / "a.tif", frames, photometric="minisblack")
    message = rf"a\.tif: value {wrong} at \(t, y, x\) = \(1, 2, 3\) is not a 3-bit code \(0\.\.7\); "
    with pytest.raises(ValueError, match=message):
        everything(tmp_path / "a.tif", bits=3)
    with pytest.raises(ValueError, match=message):
        read_stack(tmp_path / "a.tif", bits=3, exposure=1e-3, photons=0.0)


def test_one_bit_tiff_of_both_polarities(tmp_path: Path):
    tifffile = pytest.importorskip("tifffile")
    bits = random_planes(1, 5, 11)[0].astype(bool)
    for photometric, stored in [("minisblack", bits), ("miniswhite", ~bits)]:
        path = tmp_path / f"{photometric}.tif"
        tifffile.imwrite(path, stored, photometric=photometric)
        np.testing.assert_array_equal(everything(path)[0], bits)


def test_tiff_of_other_colours_is_not_read_as_grey_or_rgb(tmp_path: Path):
    """Indices of a palette were light, cyan was red; `bits` says that the indices are codes."""
    import tifffile

    path = tmp_path / "a.tif"
    pixels = np.random.default_rng(0).integers(0, 256, (9, 7, 4)).astype(np.uint8)
    table = np.random.default_rng(1).integers(0, 65536, (3, 256)).astype(np.uint16)
    tifffile.imwrite(path, pixels, photometric="separated")
    with pytest.raises(ValueError, match=r"a\.tif: page 0 holds SEPARATED pixels; save it as grey or RGB"):
        everything(path, transfer="srgb")
    tifffile.imwrite(path, pixels[..., 0], photometric="palette", colormap=table)
    with pytest.raises(ValueError, match=r"a\.tif: page 0 holds PALETTE pixels; save it as grey or RGB"):
        everything(path, transfer="srgb")
    np.testing.assert_array_equal(everything(path, bits=8)[0], pixels[..., 0])


@pytest.mark.parametrize("depth", [1, 2, 4])
@pytest.mark.parametrize("kind", ["grey", "ramp", "shuffled", "colours"])
def test_few_bit_pictures_hold_their_codes(tmp_path: Path, kind: str, depth: int):
    """Palettes were refused, and grey of 2 or 4 bits was stretched to 0 ... 255: 17 times too large."""
    rng = np.random.default_rng(depth)
    top = 2**depth - 1
    codes = rng.integers(0, top + 1, (7, 11)).astype(np.uint8)
    write_few_bits(tmp_path / "a.png", codes, depth, kind, rng)
    np.testing.assert_array_equal(everything(tmp_path / "a.png", **({} if depth == 1 else {"bits": depth}))[0], codes)
    if kind != "colours" and depth > 1:
        assert importing.read(tmp_path / "a.png").bits == depth
        light = importing.read(tmp_path / "a.png", Hints(transfer="linear"))
        np.testing.assert_allclose(light.read(0, 1)[0], codes / top, rtol=1e-6)


def write_few_bits(path: Path, codes: np.ndarray, depth: int, kind: str, rng: np.random.Generator) -> None:
    """A PNG by the standard: grey of a depth, or a palette whose entry shows the code, in order or shuffled."""
    import struct
    import zlib

    top = 2**depth - 1
    order = rng.permutation(top + 1) if kind == "shuffled" else np.arange(top + 1)  # code of each index
    stored = np.argsort(order)[codes]
    bits = np.unpackbits(stored.astype(np.uint8)[..., None], axis=-1)[..., 8 - depth :].reshape(len(codes), -1)
    rows = b"".join(b"\0" + np.packbits(row).tobytes() for row in bits)
    greys = (order * (255 // top)).astype(np.uint8)
    colours = np.stack([greys, greys, greys if kind != "colours" else 255 - greys], axis=1)

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    header = struct.pack(">IIBBBBB", codes.shape[1], codes.shape[0], depth, 0 if kind == "grey" else 3, 0, 0, 0)
    parts = [chunk(b"IHDR", header)]
    parts += [] if kind == "grey" else [chunk(b"PLTE", colours.tobytes())]
    parts += [chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


@pytest.mark.parametrize("kind", ["tif", "png"])
def test_orientation_tags_are_applied(tmp_path: Path, kind: str):
    """The right answer is Pillow's transposition of a picture with the tag."""
    import tifffile
    from PIL import Image, ImageOps

    pixels = np.random.default_rng(0).integers(0, 256, (5, 8)).astype(np.uint8)
    for tag in range(1, 9):
        path = tmp_path / f"{tag}.{kind}"
        exif = Image.Exif()
        exif[274] = tag
        if kind == "tif":
            tifffile.imwrite(path, pixels, extratags=[(274, "H", 1, tag, True)])
        else:
            Image.fromarray(pixels).save(path, exif=exif)
        shown = Image.fromarray(pixels)
        shown.getexif()[274] = tag
        expected = np.asarray(ImageOps.exif_transpose(shown))
        recording = importing.read(path, Hints(bits=8))
        np.testing.assert_array_equal(recording.read(0, 1)[0], expected)
        assert recording.source.orientation == (
            "upright" if tag == 1 else f"upright: turned by its orientation tag {tag}"
        )


def test_tiff_that_needs_a_decoder_names_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A 12-bit packed file was called truncated. Its bytes: two pixels in three, highest bit first."""
    import struct
    import sys

    pixels = np.array([[0x123, 0xABC], [0xFFF, 0x000]])
    content = bytes([0x12, 0x3A, 0xBC, 0xFF, 0xF0, 0x00])
    tags = [
        (256, 3, 1, 2),
        (257, 3, 1, 2),
        (258, 3, 1, 12),
        (259, 3, 1, 1),
        (262, 3, 1, 1),
        (273, 4, 1, 8),
        (277, 3, 1, 1),
        (278, 3, 1, 2),
        (279, 4, 1, 6),
    ]
    table = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    head = struct.pack("<2sHI", b"II", 42, 14) + content
    (tmp_path / "a.tif").write_bytes(head + struct.pack("<H", len(tags)) + table + bytes(4))
    recording = importing.read
    try:
        import imagecodecs  # noqa: F401
    except ImportError:
        with pytest.raises(ValueError, match=r"12-bit pixels, which the package imagecodecs decodes: pip install"):
            recording(tmp_path / "a.tif", Hints(transfer="linear"))
        return
    found = recording(tmp_path / "a.tif", Hints(transfer="linear"))
    np.testing.assert_allclose(found.read(0, 1)[0], pixels / 4095, rtol=1e-6)
    monkeypatch.setitem(sys.modules, "imagecodecs", None)


def test_pages_of_one_strip_are_refused(tmp_path):
    """A file of 60 kB with 400 pages of the same bytes stated 100 MB."""
    tifffile = pytest.importorskip("tifffile")
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((512, 512), np.uint8), compression="zlib", photometric="minisblack")
    content = path.read_bytes()
    (start,) = struct.unpack_from("<I", content, 4)
    (tags,) = struct.unpack_from("<H", content, start)
    page = content[start : start + 2 + 12 * tags]
    pages = [len(content) + number * (len(page) + 4) for number in range(400)]
    chain = b"".join(page + struct.pack("<I", after) for after in [*pages[1:], 0])
    path.write_bytes(
        content[: start + len(page)] + struct.pack("<I", pages[0]) + content[start + len(page) + 4 :] + chain
    )
    with pytest.raises(ValueError, match=r"a\.tif: 401 pages state \d+ bytes, the file has"):
        importing.read(path, Hints(transfer="linear"))
