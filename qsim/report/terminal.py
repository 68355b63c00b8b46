"""Pictures in a terminal: two pixels per character, in true colour; shades of text where there is no colour."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from qsim.colour import luminance

HALF = "▀"  # upper half block: its foreground is the upper pixel, its background the lower one
SHADES = " .:-=+*#%@"  # dark to light, for outputs without colour


def fit(picture: NDArray[np.uint8], columns: int, rows: int) -> NDArray[np.uint8]:
    """A picture [H, W, 3] made smaller (by areas) to at most `columns` x 2 `rows` pixels; small ones stay."""
    from PIL import Image

    height, width = picture.shape[:2]
    factor = min(1.0, columns / width, 2 * rows / height)
    size = (max(1, int(width * factor)), max(1, int(height * factor)))
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX)) if factor < 1 else picture


def blocks(picture: NDArray[np.uint8]) -> str:
    """Lines of half blocks in 24-bit colour; an odd last row is drawn over the terminal's own background."""
    lines = []
    for upper, lower in zip(picture[::2], _lower(picture), strict=True):
        cells = []
        for i, (r, g, b) in enumerate(upper):
            below = "\x1b[49m" if lower is None else "\x1b[48;2;{};{};{}m".format(*lower[i])
            cells.append(f"\x1b[38;2;{r};{g};{b}m{below}{HALF}")
        lines.append("".join(cells) + "\x1b[0m")
    return "\n".join(lines)


def _lower(picture: NDArray[np.uint8]) -> list[NDArray[np.uint8] | None]:
    rows: list[NDArray[np.uint8] | None] = list(picture[1::2])
    return rows + [None] * (len(picture) % 2)


def shades(picture: NDArray[np.uint8]) -> str:
    """The same in ten shades of plain text: every second row, as characters are twice as high as wide."""
    grey = luminance(picture[::2])
    steps = np.minimum((grey / 256 * len(SHADES)).astype(int), len(SHADES) - 1)
    return "\n".join("".join(SHADES[i] for i in row) for row in steps)


def up(text: str) -> str:
    """The escape that puts the next picture over `text`; print it as a line of its own."""
    return f"\x1b[{text.count(chr(10)) + 2}A"
