"""Reads and writes pictures: folders of PNG, TIFF and EXR files.

A picture holds light (grey or colour, coded by a declared transfer curve) or codes (a given number of bits, one code a
pixel, or stretched to 0 ... 255). Colour becomes linear luminance (Rec. 709). Memory does not grow with T.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import files, limits, opening
from qsim.checks import check_shape
from qsim.clip import exr
from qsim.clip.source import Source
from qsim.colour import from_linear, luminance, to_linear
from qsim.file_order import numbered, places
from qsim.files import decoding_errors
from qsim.formats import gaps, tiff
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
    codes = hints.bits is not None or (hints.transfer is None and hints.white is None)
    first = _png(pictures[0], codes)
    shape = check_shape(path, (len(pictures), *first.pixels.shape[:2]))

    def raw(start: int, stop: int) -> Array:
        return _same_kind(pictures[start:stop], [_png(p, codes) for p in pictures[start:stop]], first)

    return replace(picture(path, shape, raw, first, "PNG", hints), times=gaps.of_names(pictures))


def read_pictures(folder: Path) -> Iterator[Array]:
    """Yield the PNGs of a folder in the order of their numbers: 8-bit grey [H, W], or red, green and blue [H, W, 3].

    `ValueError` for a folder without any, for numbers that leave one out, and for pictures of another depth or of
    different sizes.
    """
    first: Page | None = None
    _check_complete(folder, _pngs(folder))
    for file in _pngs(folder):
        image = _png(file, codes=False)
        first = image if first is None else first
        if image.depth != 8:
            raise ValueError(f"{file}: pixels of {image.depth} bits, not of 8")
        yield _same_kind([file], [image], first)[0]


def _pngs(folder: Path) -> list[Path]:
    return _files(folder, ".png")


def _files(folder: Path, *endings: str) -> list[Path]:
    """Return the files of a folder with these endings, in any case, by their numbers."""
    return numbered([file for file in folder.iterdir() if file.suffix.lower() in endings])


def _check_complete(folder: Path, pictures: list[Path]) -> None:
    """Raise `ValueError` if there are no pictures, or if their numbers, the last in each name, leave one out."""
    if not pictures:
        raise ValueError(f"{folder}: holds no .png; give its frames as PNG")
    numbers = places(pictures) or []
    for before, after, name, following in zip(numbers, numbers[1:], pictures, pictures[1:], strict=False):
        if after > before + 1:
            raise ValueError(f"{folder}: no frame is between {name.name} and {following.name}; add what is missing")


@dataclass(frozen=True, eq=False)
class Page:
    """A picture as its file stores it, upright."""

    pixels: Array  # [H, W] or [H, W, 3]; bool of one bit
    depth: int  # bits per sample, as the header states
    orientation: int = 1  # tag that was applied

    @property
    def kind(self) -> str:
        return f"{self.depth}-bit {list(self.pixels.shape)}"


ORIENTATIONS = range(1, 9)  # of TIFF and EXIF


def turned(pixels: Array, orientation: int) -> Array:
    """Return a picture [H, W(, C)] upright, as a TIFF or EXIF orientation 1 ... 8 says.

    1 as stored, 2 mirrored left-right, 3 turned by 180 degrees, 4 mirrored up-down, 5 transposed, 6 turned by 90
    degrees clockwise, 7 transposed along the other diagonal, 8 turned by 90 degrees counterclockwise.
    """
    across = pixels.swapaxes(0, 1) if orientation >= 5 else pixels
    rows = -1 if orientation in (3, 4, 7, 8) else 1
    columns = -1 if orientation in (2, 3, 6, 7) else 1
    return np.ascontiguousarray(across[::rows, ::columns])


def read_tiff(path: Path, hints: Hints) -> Recording:
    """Read a TIFF with one page per frame, or a folder of TIFFs; MinIsWhite is converted to MinIsBlack.

    `ValueError` for other colours than grey and RGB, unless the pixels of a palette are codes (`bits`).
    """
    found = [path] if path.is_file() else _files(path, ".tif", ".tiff")
    if not found:
        raise FileNotFoundError(f"{path}: holds no .tif or .tiff")
    stacks = [tiff.frames_of(file, hints) for file in found]
    where = [(file, page) for file, stack in zip(found, stacks, strict=True) for page in stack.pages]
    first = _tiff(*where[0], hints)
    shape = check_shape(path, (len(where), *first.pixels.shape[:2]))

    def raw(start: int, stop: int) -> Array:
        chosen = where[start:stop]
        return _same_kind([file for file, _ in chosen], [_tiff(*place, hints) for place in chosen], first)

    recording = picture(path, shape, raw, first, "TIFF", hints)
    if len(where) != len(found):
        gaps.tell_files(found)
    alone = len(where) == len(found) > 1  # a frame in each file
    said = "; ".join(filter(None, (recording.reading, stacks[0].said)))
    return replace(recording, reading=said, times=gaps.of_names(found) if alone else None)


def picture(path: Path, shape: tuple[int, int, int], raw: Any, first: Page, form: str, hints: Hints) -> Recording:
    """Return pictures as codes if they have 1 bit or `bits` is given, else as light by `transfer`.

    Pictures of 2 to 7 bits are codes of their depth unless a transfer curve or a white is given. `ValueError` if codes
    exceed 2^bits - 1, as codes stretched to 0 ... 255 do.
    """
    source = Source(format=form)
    reading = ""
    if first.orientation != 1:
        turn = f"turned by its orientation tag {first.orientation}"
        source = replace(source, orientation=f"upright: {turn}")
        reading = f"turned upright by its orientation tag {first.orientation}"
    one_bit = first.depth == 1
    colour = first.pixels.ndim == 3
    full = 2**first.depth - 1
    few = 1 < first.depth < 8 and not colour
    codes = one_bit or hints.bits is not None or (few and hints.transfer is None and hints.white is None)
    if one_bit:
        hints.refuse(path, f"{form} of one bit", "stretched", *(() if hints.bits == 1 else ("bits",)))
    if codes:
        bits = first.depth if one_bit or hints.bits is None else hints.bits
        top = 2**bits - 1
        if few and hints.bits is None:
            reading = "; ".join(filter(None, (reading, f"read as codes of {bits} bits, the depth of its pixels")))

        def read_codes(start: int, stop: int) -> Array:
            values = raw(start, stop)
            if values.ndim == 4:
                raise ValueError(f"{path}: colour pictures hold no codes")
            if hints.stretched:
                return _unstretch(path, values, top, start, full)
            return checked_codes(path, values, bits, start)

        return Recording(shape, read_codes, source, bits, reading=reading)
    if first.pixels.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: pixels of {first.pixels.dtype}; pictures of up to 16 bits are read")
    transfer = need_transfer(path, hints)
    white, _ = white_of(path, hints, full)

    def marked(start: int, stop: int) -> tuple[Array, Array]:
        values = raw(start, stop)
        return to_luminance(values, transfer, full, values.ndim == 4), reached(values, white, values.ndim == 4)

    found = light_recording(path, shape, marked, replace(source, transfer=transfer), hints, full)
    return replace(found, reading=reading)


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


def _png(path: Path, codes: bool) -> Page:
    """Return a PNG in the values that it stores; a palette as its codes, or (not `codes`) in its colours."""
    from PIL import Image

    with (
        decoding_errors(path, "PNG"),
        opening.opened(path, most=limits.ASSET) as file,
        Image.open(file, formats=["PNG"]) as opened,
    ):
        check_shape(path, (1, opened.height, opened.width))
        header = os.pread(file.fileno(), 26, 0)
        # IHDR: bits per sample; 0 grey, 2 RGB, 3 palette, 4 and 6 with alpha
        depth = header[24]
        kind = header[25]
        if depth == 16 and kind != 0:  # the library keeps the upper 8 bits
            raise ValueError(f"{path}: colour of 16 bits per channel would lose 8; store it as TIFF, or with 8 bits")
        tag = int(opened.getexif().get(ORIENTATION_TAG, 1))
        tag = tag if tag in ORIENTATIONS else 1
        if kind == 3 and codes:
            pixels = _palette_codes(path, opened, depth)
        elif kind != 0:
            pixels = np.asarray(opened.convert("RGB"))
            depth = 8
        else:
            pixels = np.asarray(opened)
            if depth == 16:
                pixels = pixels.astype(np.uint16)
            elif depth in (2, 4):  # the library stretches them to 0 ... 255
                pixels = pixels // (255 // (2**depth - 1))
        return Page(turned(pixels.astype(bool) if depth == 1 else pixels, tag), depth, tag)


def _palette_codes(path: Path, opened: Any, depth: int) -> Array:
    """Return the codes [H, W] of a picture with a palette: its greys, or the indices of a palette of colours."""
    numbers = np.asarray(opened)
    palette = np.zeros((256, 3), np.uint8)
    stored = np.array(opened.getpalette("RGB"), np.uint8).reshape(-1, 3)
    palette[: len(stored)] = stored
    used = np.unique(numbers)
    greys = palette[used]
    if not (greys == greys[:, :1]).all() or (palette[used, 0] == used).all():
        return numbers
    top = 2**depth - 1
    if (palette[used, 0].astype(int) * top % 255).any():
        raise ValueError(
            f"{path}: the greys of its palette are not {top + 1} even steps, so they are no codes of {depth} bits; "
            "save it without a palette"
        )
    return (palette[:, 0].astype(int) * top // 255).astype(np.uint8)[numbers]


ORIENTATION_TAG = 274  # of TIFF and EXIF


def _tiff(path: Path, page: int, hints: Hints) -> Page:
    import tifffile

    with decoding_errors(path, "TIFF"), tifffile.TiffFile(opening.regular(path)) as opened:
        found: Any = opened.pages[page]
        check_shape(path, (1, found.imagelength, found.imagewidth))
        kind = found.photometric
        packed = found.compression
        codes = kind == tifffile.PHOTOMETRIC.PALETTE and hints.bits is not None  # stacks of ImageJ have a colour table
        if not (kind in _GREY_OR_RGB or codes or (kind == tifffile.PHOTOMETRIC.YCBCR and packed in _JPEG)):
            raise ValueError(f"{path}: page {page} holds {getattr(kind, 'name', kind)} pixels; save it as grey or RGB")
        tiff.check_size_of(path, page, found)
        pixels: Array = tiff.decoded(path, page, found)
        size = (found.imagelength, found.imagewidth)
        if pixels.shape not in (size, (*size, 3), (*size, 4)):
            raise ValueError(
                f"{path}: page {page} is {list(pixels.shape)}; grey or colour pictures [H, W(, 3)] are read"
            )
        depth = int(found.bitspersample)
        if depth == 1:
            pixels = pixels.astype(bool)
        if found.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
            pixels = ~pixels if pixels.dtype == bool else (2**depth - 1) - pixels
        if pixels.ndim == 3 and pixels.shape[2] > 3:
            pixels = pixels[..., :3]
        tag = found.tags.get(ORIENTATION_TAG)
        orientation = int(tag.value) if tag is not None and tag.value in ORIENTATIONS else 1
        return Page(turned(pixels, orientation), depth, orientation)


def _same_kind(paths: list[Path], images: list[Page], first: Page) -> Array:
    for path, image in zip(paths, images, strict=True):
        if image.kind != first.kind:
            raise ValueError(f"{path}: {image.kind}, but the first picture is {first.kind}")
    return np.stack([image.pixels for image in images])


def _unstretch(path: Path, values: Array, top: int, first: int, full: int) -> Array:
    found = np.rint(values.astype(np.float64) * top / full).astype(np.uint8 if top < 256 else np.uint16)
    back = np.rint(found.astype(np.float64) * full / top)
    if (back != values).any():
        t, y, x = (int(i) for i in np.argwhere(back != values)[0])
        raise ValueError(
            f"{path}: value {int(values[t, y, x])} at (t, y, x) = ({first + t}, {y}, {x}) is not a code 0..{top} "
            f"stretched to 0..{full}: the pictures were compressed with loss; use lossless ones"
        )
    return found
