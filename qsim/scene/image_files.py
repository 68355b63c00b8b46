"""Reads pictures: image files as linear luminance, OpenEXR and Radiance files as radiance."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy import ndarray as Array

from qsim import limits, opening
from qsim.colour import luminance, to_linear
from qsim.files import native


def read_grey(path: Path) -> np.ndarray:
    """Return an image file as linear luminance, float32 [H, W]; `FileNotFoundError` or `ValueError`."""
    return luminance(_linear(path).astype(np.float64)).astype(np.float32)


def read_colour(path: Path) -> np.ndarray:
    """Return an image file as linear colours R, G, B, float32 [H, W, 3]; `FileNotFoundError` or `ValueError`."""
    return _linear(path).astype(np.float32)


def _linear(path: Path) -> np.ndarray:
    """Return linear colours [H, W, 3], upright; grey counts with all its 16 bits, colours with the upper 8."""
    with _asset(path, "texture") as file:
        return decoded(file, f"texture {path}")


def _asset(path: Path, role: str) -> BinaryIO:
    """Return an open file that a scene names; errors begin with its role."""
    try:
        return opening.opened(path, most=limits.ASSET)
    except (FileNotFoundError, ValueError) as error:
        raise type(error)(f"{role} {error}") from None


def stored(source: BinaryIO, where: str) -> np.ndarray:
    """Return the stored numbers of an image file in 0..1, float32 [H, W, 4], with an opacity of 1 where it has none.

    Rows are as they are stored. `ValueError` starts with `where`.
    """
    from PIL import Image

    try:
        with Image.open(source) as opened:
            if opened.mode.startswith("I"):
                grey = np.asarray(opened).astype(np.float32)[..., None] / np.float32(65535)
                return np.clip(np.concatenate([grey, grey, grey, np.ones_like(grey)], axis=-1), 0, 1)
            return np.asarray(opened.convert("RGBA"), np.float32) / np.float32(255)
    except (OSError, Image.DecompressionBombError) as error:
        raise ValueError(f"{where}: not a readable image ({error})") from error


def decoded(source: BinaryIO, where: str, *, turned: bool = True) -> np.ndarray:
    """Return linear colours, float32 [H, W, 3], of an open image file; `ValueError` starts with `where`.

    `turned` applies its orientation tag.
    """
    from PIL import Image, ImageOps

    try:
        with Image.open(source) as opened:
            if opened.mode == "F":
                raise ValueError(
                    f"{where}: holds floating-point numbers, whose white is unknown; store 8 or 16 bits, or "
                    "give Texture an array of linear values"
                )
            upright: Any = ImageOps.exif_transpose(opened) if turned else opened
            if not upright.mode.startswith("I"):
                return to_linear(np.asarray(upright.convert("RGB")), "srgb", 255)
            grey = np.asarray(upright)
    except (OSError, Image.DecompressionBombError) as error:
        raise ValueError(f"{where}: not a readable image ({error})") from error
    if grey.min() < 0 or grey.max() > 65535:
        raise ValueError(f"{where}: values of 0 to 65535 are read, found {grey.min()} to {grey.max()}")
    return np.repeat(to_linear(grey, "srgb", 65535)[..., None], 3, axis=2)


def read_hdr(path: Path) -> Array:
    """Return the linear picture [H, W] or [H, W, 3] of an .exr (OpenEXR) or .hdr (Radiance) file."""
    _asset(path, "environment").close()
    if path.suffix.lower() == ".hdr":
        return _read_radiance(path)
    import OpenEXR

    try:
        parts = [part.channels for part in OpenEXR.File(native(path)).parts]
    except Exception as error:  # the binding raises several types for a bad file
        raise ValueError(f"environment {path}: not a readable OpenEXR file ({error})") from error
    pictures = [part[name] for part in parts for name in ("RGB", "RGBA", "Y") if name in part]
    if len(pictures) == 1:
        return np.asarray(pictures[0].pixels, np.float32)
    if len(pictures) > 1:
        raise ValueError(f"environment {path}: has {len(pictures)} parts with a picture; save the one to use alone")
    raise ValueError(f"environment {path}: has channels {[sorted(part) for part in parts]}, expected RGB or Y")


def _read_radiance(path: Path) -> Array:
    """Decode Radiance RGBE (Ward, "Real pixels", Graphics Gems II, 1991), flat or with run lengths, old or new.

    Pixels are divided by the exposures of the header, which programs have multiplied into them.
    """
    content = opening.content(path, most=limits.ASSET)
    lines = re.match(rb"(#\?.*?)\r?\n\r?\n([^\n]*)\n", content, re.DOTALL)
    head, size = (b"", b"") if lines is None else (lines[1].replace(b"\r\n", b"\n"), lines[2])
    body = b"" if lines is None else content[lines.end() :]
    words = size.split()
    if not head.startswith(b"#?") or len(words) != 4 or (words[0], words[2]) != (b"-Y", b"+X"):
        raise ValueError(f"environment {path}: not a Radiance .hdr file with rows from top to bottom")
    exposure = _exposure(path, head.decode("latin-1"))
    height = int(words[1])
    width = int(words[3])
    rgbe = np.empty((height, width, 4), np.uint8)
    at = 0
    old = re.search(rb"\x01\x01\x01", body) is not None and body[:2] != b"\x02\x02"
    try:
        for y in range(height):
            at = _read_old_row(body, at, rgbe[y]) if old else _read_row(body, at, rgbe[y])
    except (IndexError, ValueError) as error:
        raise ValueError(f"environment {path}: damaged at byte {len(content) - len(body) + at}") from error
    # The exponent is stored with 128 added, and mantissas are in 1/256: 136 = 128 + 8.
    scale = np.ldexp(1.0, rgbe[..., 3].astype(np.int32) - 136)
    return (rgbe[..., :3] * np.where(rgbe[..., 3:] > 0, scale[..., None] / exposure, 0)).astype(np.float32)


def _exposure(path: Path, head: str) -> float:
    """Return the product of the exposures in a Radiance header, 1 for none; `ValueError` for pixels other than RGBE."""
    exposure = 1.0
    for line in head.split("\n"):
        name, _, value = line.partition("=")
        value = value.strip()
        if name == "FORMAT" and value != "32-bit_rle_rgbe":
            raise ValueError(f"environment {path}: its pixels are {value}; convert the file to 32-bit_rle_rgbe")
        if name == "EXPOSURE":
            exposure *= _positive(path, value)
    return exposure


def _positive(path: Path, value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise ValueError(f"environment {path}: EXPOSURE={value} in its header is not a positive number; correct it")
    return number


def _read_old_row(body: bytes, at: int, row: Array) -> int:
    """Read pixels of which (1, 1, 1, n) repeats the one before; a second such pixel counts 256 times as much."""
    x = 0
    shift = 0
    while x < len(row):
        pixel = np.frombuffer(body, np.uint8, 4, at)
        at += 4
        if tuple(pixel[:3]) != (1, 1, 1):
            row[x] = pixel
            x = x + 1
            shift = 0
            continue
        count = int(pixel[3]) << shift
        if not 0 < x + count <= len(row) or x == 0:
            raise ValueError("a run beyond the row")
        row[x : x + count] = row[x - 1]
        x = x + count
        shift = shift + 8
    return at


def _read_row(body: bytes, at: int, row: Array) -> int:
    width = len(row)
    if body[at : at + 2] != b"\x02\x02" or not 8 <= width < 32768:
        row[:] = np.frombuffer(body, np.uint8, 4 * width, at).reshape(width, 4)
        return at + 4 * width
    at += 4
    for channel in range(4):
        x = 0
        while x < width:
            # Above 128 one byte is repeated count - 128 times; up to 128 as many bytes follow as they are.
            count = body[at]
            if count > 128:
                row[x : x + count - 128, channel] = body[at + 1]
                x = x + count - 128
                at = at + 2
            else:
                row[x : x + count, channel] = np.frombuffer(body, np.uint8, count, at + 1)
                x = x + count
                at = at + 1 + count
    return at
