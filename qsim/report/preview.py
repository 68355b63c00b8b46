"""Writes views as PNG, GIF or mp4 with captions that state their scales, or as text for a terminal.

    views -> Sheet (side by side, with captions) -> PNG, GIF, mp4; or a view -> text for a terminal

Nothing is computed from these pictures. A terminal shows two pixels per character in true colour, or shades of text.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from qsim import files
from qsim.colour import luminance
from qsim.files import Progress
from qsim.report.views import CURVE, Picture, View, declaration


@dataclass(frozen=True)
class Sheet:
    """Views side by side, each enlarged by a whole factor, above their captions and legends."""

    views: list[View]
    scale: int
    caption: Picture  # drawn once, the same for all frames

    def frame(self, t: int) -> Picture:
        """Return frame t, uint8 [H, W, 3], with an even number of rows and columns, as video codecs require."""
        enlarged = [v.picture(t).repeat(self.scale, axis=0).repeat(self.scale, axis=1) for v in self.views]
        column = (self.caption.shape[1] + GAP) // len(self.views)
        row = [np.pad(p, ((0, 0), (0, column - p.shape[1]), (0, 0)), constant_values=PAPER) for p in enlarged]
        sheet = np.concatenate([np.concatenate(row, axis=1)[:, :-GAP], self.caption])
        return np.pad(sheet, ((0, sheet.shape[0] % 2), (0, sheet.shape[1] % 2), (0, 0)), constant_values=PAPER)


GAP = 6
PAPER = 250
INK = (40, 40, 44)
SMALLEST = 224  # least columns of an enlarged picture
NARROWEST = 112  # least columns of a caption and its legend


def sheet(views: list[View], scale: int | None = None) -> Sheet:
    """Lay out views; `scale` is the enlargement (default: the least that gives SMALLEST columns)."""
    width = views[0].picture(0).shape[1]
    scale = scale or max(1, -(-SMALLEST // width))
    captions = [_caption(view, max(width * scale, NARROWEST)) for view in views]
    height = max(caption.shape[0] for caption in captions)
    padded = [np.pad(c, ((0, height - len(c)), (0, GAP), (0, 0)), constant_values=PAPER) for c in captions]
    return Sheet(views, scale, np.concatenate(padded, axis=1)[:, :-GAP])


def _caption(view: View, width: int) -> Picture:
    """Return the declaration in lines of at most `width` pixels, with the legend below it."""
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(size=11)
    lines: list[str] = []
    for word in view.declared.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and font.getlength(longer) <= width - 8:
            lines[-1] = longer
        else:
            lines.append(word)
    legend = view.legend
    height = 8 + 14 * len(lines) + (0 if legend is None else legend.shape[0] + 6)
    image = Image.new("RGB", (width, height), (PAPER,) * 3)
    pen = ImageDraw.Draw(image)
    for i, line in enumerate(lines):
        pen.text((4, 4 + 14 * i), line, fill=INK, font=font)
    if legend is not None:
        image.paste(Image.fromarray(legend), (4, 8 + 14 * len(lines)))
    return np.asarray(image)


# Files


def write(
    path: Path, page: Sheet, frames: range, fps: float, about: Mapping[str, object], progress: Progress | None = None
) -> None:
    """Write PNG (the first of `frames`), GIF or mp4 by the suffix of `path`, and a sidecar with `about` and the scales.

    Both appear together.
    """
    views = [declaration(view) for view in page.views]
    declared: dict[str, object] = {"format": "qsim-preview-1", "curve": CURVE, "views": views}
    drawn = _drawn(page, frames, progress)
    with files.replacing_together(path, sidecar(path)) as (made, described):
        if path.suffix == ".png":
            _write_png(made, next(drawn), declared)
        elif path.suffix == ".gif":
            _write_gif(made, drawn, fps)
        else:
            from qsim.formats.video import write_video

            write_video(made, drawn, fps, lossless=False)
        files.write_json(described, {**declared, **about})


def sidecar(path: Path) -> Path:
    """Return the file beside a preview that states its scales: OUT.mp4.json of OUT.mp4."""
    return path.with_name(path.name + ".json")


def _drawn(page: Sheet, frames: range, progress: Progress | None) -> Iterator[Picture]:
    for n, t in enumerate(frames, 1):
        yield page.frame(t)
        if progress is not None:
            progress(n, len(frames))


def _write_png(path: Path, picture: Picture, declared: Mapping[str, object]) -> None:
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    text = PngInfo()
    text.add_text("Description", json.dumps(declared))
    with files.replacing(path) as file:
        Image.fromarray(picture).save(file, format="png", pnginfo=text)


def _write_gif(path: Path, frames: Iterator[Picture], fps: float) -> None:
    from PIL import Image

    images = [Image.fromarray(frame).quantize(256) for frame in frames]
    with files.replacing(path) as file:
        ends = np.rint(np.arange(len(images) + 1) * (100 / fps)).astype(int)  # a GIF counts in hundredths of a second
        durations = (10 * np.diff(ends)).tolist()  # ms
        images[0].save(file, format="gif", save_all=True, append_images=images[1:], duration=durations, loop=0)


# Terminals

HALF = "▀"  # upper half block: the foreground is the upper pixel, the background the lower one
NEARLY_EQUAL = 16  # grey levels of 255, within which a picture is noise around one level
SHADES = " .:-=+*#%@"  # dark to light, for outputs without colour


def fit_terminal(picture: NDArray[np.uint8], columns: int, rows: int) -> NDArray[np.uint8]:
    """Return a picture [H, W, 3] reduced (by areas) to at most `columns` x 2 `rows` pixels; smaller ones stay."""
    from PIL import Image

    height, width = picture.shape[:2]
    factor = min(1.0, columns / width, 2 * rows / height)
    size = (max(1, int(width * factor)), max(1, int(height * factor)))
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX)) if factor < 1 else picture


def half_blocks(picture: NDArray[np.uint8]) -> str:
    """Return a picture [H, W, 3] as lines of half blocks in 24-bit colour; an odd last row has no lower half."""
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
    """Return every second row of a picture [H, W, 3] in ten shades of text; characters are twice as high as wide.

    The shades run from the 1st to the 99th percentile of the picture's grey levels, unless these are nearly equal.
    """
    grey = luminance(picture[::2])
    low, high = np.percentile(grey, [1, 99])
    low, high = (low, high) if high - low > NEARLY_EQUAL else (0.0, 255.0)
    steps = np.clip((grey - low) / (high - low) * len(SHADES), 0, len(SHADES) - 1).astype(int)
    return "\n".join("".join(SHADES[i] for i in row) for row in steps)


def cursor_up(text: str) -> str:
    """Return the escape sequence that moves the cursor above `text`; print it as a separate line."""
    return f"\x1b[{text.count(chr(10)) + 2}A"
