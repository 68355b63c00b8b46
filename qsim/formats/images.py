"""Reads and writes pictures: folders of PNG, TIFF and EXR files.

A picture holds light (grey or colour, coded by a declared transfer curve) or codes (a given number of bits, one code a
pixel, or stretched to 0 ... 255). Colour becomes linear luminance (Rec. 709). Memory does not grow with T.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import files
from qsim.checks import MAX_PIXELS, check_shape
from qsim.clip import exr
from qsim.colour import from_linear, luminance, to_linear
from qsim.file_order import numbered
from qsim.files import decoding_errors
from qsim.formats.recording import (
    Hints,
    Recording,
    checked_codes,
    light_recording,
    need_transfer,
    reached,
    white_of,
)

_GREY_OR_RGB = (0, 1, 2, 32803, 34892)  # TIFF: MinIsWhite, MinIsBlack, RGB, and the grey of raw pixels (CFA, LinearRaw)
_JPEG = (6, 7, 33007, 34892)  # compressions whose YCbCr becomes RGB when it is decoded


def read_png(path: Path, hints: Hints) -> Recording:
    """Read a PNG, or a folder of PNGs in the order of their numbers; see `picture`."""
    pictures = [path] if path.is_file() else _pngs(path)
    if not pictures:
        raise FileNotFoundError(f"{path}: holds no .png")
    first = _png(pictures[0])
    shape = check_shape(path, (len(pictures), *first.shape[:2]))

    def raw(start: int, stop: int) -> Array:
        return _same_size(pictures[start:stop], [_png(p) for p in pictures[start:stop]], first.shape, first.dtype)

    return picture(path, shape, raw, first.dtype, "PNG", hints)


def read_pictures(folder: Path) -> Iterator[Array]:
    """Yield the PNGs of a folder in the order of their numbers: 8-bit grey [H, W], or red, green and blue [H, W, 3].

    `ValueError` for a folder without any, for numbers that leave one out, and for pictures of another depth or of
    different sizes.
    """
    first: Array | None = None
    _check_complete(folder, _pngs(folder))
    for file in _pngs(folder):
        image = _png(file)
        first = image if first is None else first
        if image.dtype != np.uint8:
            raise ValueError(f"{file}: pixels of {image.dtype}, not of 8 bits")
        yield _same_size([file], [image], first.shape, first.dtype)[0]


def _pngs(folder: Path) -> list[Path]:
    return _files(folder, ".png")


def _files(folder: Path, *endings: str) -> list[Path]:
    """Return the files of a folder with these endings, in any case, by their numbers."""
    return numbered([file for file in folder.iterdir() if file.suffix.lower() in endings])


def _check_complete(folder: Path, pictures: list[Path]) -> None:
    """Raise `ValueError` if there are no pictures, or if their numbers, the last in each name, leave one out."""
    if not pictures:
        raise ValueError(f"{folder}: holds no .png; give its frames as PNG")
    numbers = [re.findall(r"\d+", file.stem) for file in pictures]
    for i in range(1, len(pictures)):
        if numbers[i - 1] and numbers[i] and int(numbers[i][-1]) > int(numbers[i - 1][-1]) + 1:
            raise ValueError(
                f"{folder}: no frame is between {pictures[i - 1].name} and {pictures[i].name}; add what is missing"
            )


def read_tiff(path: Path, hints: Hints) -> Recording:
    """Read a TIFF with one page per frame, or a folder of TIFFs; MinIsWhite is converted to MinIsBlack.

    `ValueError` for other colours than grey and RGB, unless the pixels of a palette are codes (--bits).
    """
    found = [path] if path.is_file() else _files(path, ".tif", ".tiff")
    if not found:
        raise FileNotFoundError(f"{path}: holds no .tif or .tiff")
    counts = [_tiff_pages(file) for file in found]
    where = [(file, page) for file, count in zip(found, counts, strict=True) for page in range(count)]
    first = _tiff(*where[0], hints)
    shape = check_shape(path, (len(where), *first.shape[:2]))

    def raw(start: int, stop: int) -> Array:
        chosen = where[start:stop]
        pictures = [_tiff(*place, hints) for place in chosen]
        return _same_size([file for file, _ in chosen], pictures, first.shape, first.dtype)

    return picture(path, shape, raw, first.dtype, "TIFF", hints)


def picture(path: Path, shape: tuple[int, int, int], raw: Any, dtype: np.dtype, source: str, hints: Hints) -> Recording:
    """Return pictures as codes if they are 1-bit or --bits is given, else as light by --transfer.

    `ValueError` if codes exceed 2^bits - 1, as codes stretched to 0 ... 255 do.
    """
    one_bit = dtype.kind == "b"  # then --bits and --stretched have no effect
    if one_bit or hints.bits is not None:
        bits = 1 if one_bit else int(hints.bits or 0)
        stretched = not one_bit and hints.stretched
        top = 2**bits - 1

        def read_codes(start: int, stop: int) -> Array:
            values = raw(start, stop)
            if values.ndim == 4:
                raise ValueError(f"{path}: colour pictures hold no codes")
            if stretched:
                return _unstretch(path, values, top, start)
            return checked_codes(path, values, bits, start)

        return Recording(shape, read_codes, source, bits)
    if dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: pixels of {dtype}; 1-, 8- and 16-bit pictures are read")
    transfer = need_transfer(path, hints)
    full = float(np.iinfo(dtype).max)

    white, _ = white_of(path, hints, full)

    def marked(start: int, stop: int) -> tuple[Array, Array]:
        values = raw(start, stop)
        colour = values.ndim == 4
        return to_luminance(values, transfer, full, colour), reached(values, white, colour)

    return light_recording(path, shape, marked, source, {"transfer": transfer}, hints, full)


def to_luminance(values: Array, transfer: str, top: float, colour: bool) -> Array:
    """Return linear light [..., H, W] of grey [..., H, W] or colour [..., H, W, 3]: linearised, then weighted."""
    if not colour:
        return to_linear(values, transfer, top)
    if (values == values[..., :1]).all():  # grey in three channels: exact without weights
        return to_linear(values[..., 0], transfer, top)
    return luminance(to_linear(values, transfer, top))


def write_png(folder: Path, images: Iterator[Array]) -> None:
    """Write one PNG per image, 000000.png ...: bool as 1-bit, uint8 as 8-bit, uint16 as 16-bit."""
    from PIL import Image

    for t, image in enumerate(images):
        with files.replacing(folder / f"{t:06d}.png") as file:
            Image.fromarray(image).save(file, format="png")


def write_exr(folder: Path, images: Iterator[Array]) -> None:
    """Write one float32 EXR per image, compressed without loss: channel Y of [H, W], or R, G, B of [3, H, W]."""
    for t, image in enumerate(images):
        channels = {"Y": image} if image.ndim == 2 else dict(zip("RGB", image, strict=True))
        single = {name: values.astype("<f4") for name, values in channels.items()}
        files.write_bytes(folder / f"{t:06d}.exr", exr.encode(single, compress=True))


def grey(light: Array, white: float, transfer: str, bits: int = 8) -> Array:
    """Return linear light [..., H, W] as grey of 8 or 16 bits; `white` becomes the largest value."""
    return from_linear(light / white, transfer, 2**bits - 1)


def _png(path: Path) -> Array:
    from PIL import Image

    with decoding_errors(path, "PNG"), Image.open(path, formats=["PNG"]) as opened:
        check_shape(path, (1, opened.height, opened.width))
        if opened.mode in ("RGB", "RGBA", "P", "LA"):
            if any(str(tile[3]).endswith(";16B") for tile in opened.tile):  # the library keeps the upper 8 bits
                raise ValueError(
                    f"{path}: colour of 16 bits per channel would lose 8; store it as TIFF, or with 8 bits"
                )
            return np.asarray(opened.convert("RGB"))
        if opened.mode not in ("1", "L", "I;16", "I"):
            raise ValueError(f"{path}: pixels of mode {opened.mode}; 1-, 8- and 16-bit pictures are read")
        pixels = np.asarray(opened)
        return pixels.astype(np.uint16) if pixels.dtype.kind == "i" or pixels.dtype.itemsize > 1 else pixels


def _tiff_pages(path: Path) -> int:
    """Return the number of pages; `ValueError` if frames lie behind them that no page describes."""
    import tifffile

    with decoding_errors(path, "TIFF"), tifffile.TiffFile(path) as opened:
        count = len(opened.pages)  # the library refuses a chain of pages in a circle
        own = not (opened.is_ome or opened.is_micromanager)  # these name further files, which are not opened
        if opened.is_shaped or (opened.is_imagej and own):
            frame = math.prod(opened.pages.first.shape)
            if any(math.prod(series.shape) > count * frame for series in opened.series):
                raise ValueError(
                    f"{path}: holds more frames than the {count} that its pages describe, as large stacks of ImageJ "
                    "do; save it with a page for each frame, or as a folder of TIFFs"
                )
        return count


def _tiff(path: Path, page: int, hints: Hints) -> Array:
    import tifffile

    with decoding_errors(path, "TIFF"), tifffile.TiffFile(path) as opened:
        found: Any = opened.pages[page]
        check_shape(path, (1, found.imagelength, found.imagewidth))
        kind, packed = found.photometric, found.compression
        codes = kind == tifffile.PHOTOMETRIC.PALETTE and hints.bits is not None  # stacks of ImageJ have a colour table
        if not (kind in _GREY_OR_RGB or codes or (kind == tifffile.PHOTOMETRIC.YCBCR and packed in _JPEG)):
            raise ValueError(f"{path}: page {page} holds {getattr(kind, 'name', kind)} pixels; save it as grey or RGB")
        promised, there = found.nbytes, path.stat().st_size
        if promised > 1032 * there or (found.compression == 1 and found.bitspersample >= 8 and promised > there):
            raise ValueError(f"{path}: page {page} states {promised} bytes, the file has {there}")
        if float(np.prod(found.chunks, dtype=float)) > max(MAX_PIXELS, 4 * found.imagelength * found.imagewidth):
            raise ValueError(
                f"{path}: page {page} is stored in tiles of {list(found.chunks)} pixels, too large to read"
            )
        pixels: Array = found.asarray()
        size = (found.imagelength, found.imagewidth)
        if pixels.shape not in (size, (*size, 3), (*size, 4)):
            raise ValueError(
                f"{path}: page {page} is {list(pixels.shape)}; grey or colour pictures [H, W(, 3)] are read"
            )
        if found.bitspersample == 1:
            pixels = pixels.astype(bool)
        if found.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
            pixels = ~pixels if pixels.dtype == bool else np.iinfo(pixels.dtype).max - pixels
        if pixels.ndim == 3 and pixels.shape[2] > 3:
            pixels = pixels[..., :3]
        return pixels


def _same_size(paths: list[Path], images: list[Array], shape: tuple[int, ...], dtype: np.dtype) -> Array:
    for path, image in zip(paths, images, strict=True):
        if image.shape != shape or image.dtype != dtype:
            raise ValueError(
                f"{path}: {image.dtype} {list(image.shape)}, but the first picture is {dtype} {list(shape)}"
            )
    return np.stack(images)


def _unstretch(path: Path, values: Array, top: int, first: int) -> Array:
    found = np.rint(values.astype(np.float64) * top / 255).astype(np.uint8 if top < 256 else np.uint16)
    back = np.rint(found.astype(np.float64) * 255 / top)
    if (back != values).any():
        t, y, x = (int(i) for i in np.argwhere(back != values)[0])
        raise ValueError(
            f"{path}: value {int(values[t, y, x])} at (t, y, x) = ({first + t}, {y}, {x}) is not a code 0..{top} "
            "stretched to 0..255: the pictures were compressed with loss; use lossless ones"
        )
    return found
