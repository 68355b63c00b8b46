"""Says which pages of a TIFF are its frames, and decodes pages with the checks of their headers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import limits, opening
from qsim.files import DISTRIBUTION, decoding_errors
from qsim.formats import axes
from qsim.formats.recording import Hints


@dataclass(frozen=True)
class Stack:
    """The pages of a file that are frames, in order."""

    pages: tuple[int, ...]
    said: str


def frames_of(path: Path, hints: Hints) -> Stack:
    """Return the frames among the pages, by the axes that the file or the user states.

    `ValueError` for axes of which one index must be chosen, and if frames lie behind the pages that none describes.
    """
    import tifffile

    with decoding_errors(path, "TIFF"), tifffile.TiffFile(opening.regular(path)) as opened:
        count = len(opened.pages)  # the library refuses a chain of pages in a circle
        promised = count * _bytes_of(opened.pages.first)  # pages may name the same bytes
        if promised > limits.DEFLATED * path.stat().st_size:
            raise ValueError(f"{path}: {count} pages state {promised} bytes, the file has {path.stat().st_size}")
        own = not (opened.is_ome or opened.is_micromanager)  # these name further files, which are not opened
        if opened.is_shaped or (opened.is_imagej and own):
            frame = math.prod(opened.pages.first.shape)
            if any(math.prod(series.shape) > count * frame for series in opened.series):
                raise ValueError(
                    f"{path}: holds more frames than the {count} that its pages describe, as large stacks of ImageJ "
                    "do; save it with a page for each frame, or as a folder of TIFFs"
                )
        before, stated = _axes(opened, count)
        rows = opened.pages.first.imagelength
        columns = opened.pages.first.imagewidth
    if (hints.axes is None and len(before) < 2 and stated[:1] not in ("C", "S")) or count == 1:
        hints.refuse(path, "a TIFF without such an axis", *axes.PICKED.values())
        return Stack(tuple(range(count)), "")
    size = (*before, rows, columns)
    found = axes.named(path, size, hints, f"{stated}YX")
    places = np.broadcast_to(np.arange(count).reshape(*before, 1, 1), size)
    chosen = found.view(places)[:, 0, 0]
    return Stack(tuple(int(page) for page in chosen), found.said)


def _axes(opened: Any, count: int) -> tuple[tuple[int, ...], str]:
    """Return sizes and names of the axes of whole pages; ((count,), "I") where the file states no other."""
    if len(opened.series) == 1:
        series = opened.series[0]
        inside = len(opened.pages.first.shape)
        before = tuple(int(n) for n in series.shape[:-inside])
        names = series.axes[:-inside]
        if math.prod(before) == count and before:
            return before, names
    return (count,), "I"


def check_size_of(path: Path, page: int, found: Any) -> None:
    """Raise `ValueError` if a page states more bytes than the file can hold, or too large tiles."""
    there = path.stat().st_size
    promised = _bytes_of(found)
    if promised > limits.DEFLATED * there or (found.compression == 1 and promised > there):
        raise ValueError(f"{path}: page {page} states {promised} bytes, the file has {there}")
    if float(np.prod(found.chunks, dtype=float)) > max(limits.PIXELS, 4 * found.imagelength * found.imagewidth):
        raise ValueError(f"{path}: page {page} is stored in tiles of {list(found.chunks)} pixels, too large to read")


def _bytes_of(found: Any) -> int:
    """Return the bytes of the pixels of a page, whose rows begin at a byte."""
    row_bits = found.imagewidth * found.samplesperpixel * found.bitspersample
    return int(-(-row_bits // 8) * found.imagelength)


def decoded(path: Path, page: int, found: Any) -> Array:
    """Return the pixels of a page; `ModuleNotFoundError` of imagecodecs where its compression needs that package."""
    with _naming_the_package(path, page, found):
        pixels: Array = found.asarray()
        return pixels


@contextmanager
def _naming_the_package(path: Path, page: int, found: Any) -> Iterator[None]:
    try:
        yield
    except (ValueError, NotImplementedError, ImportError) as error:
        if "imagecodecs" not in str(error) and not isinstance(error, ImportError):
            raise
        how = getattr(found.compression, "name", found.compression)
        kind = f"{found.bitspersample}-bit pixels" if found.compression == 1 else f"compression {how}"
        raise ValueError(
            f"{path}: page {page} has {kind}, which the package imagecodecs decodes: "
            f"pip install '{DISTRIBUTION}[tiff]', or save it uncompressed with 8 or 16 bits"
        ) from None
