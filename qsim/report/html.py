"""Builds the parts of a page (players, tables, figures, text) and the self-contained HTML page from templates/.

Frames are uint8 arrays, and the templates escape all text. This module imports nothing of clips and sensors.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qsim.figures import figure_png, new_figure

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


@dataclass(frozen=True)
class Panel:
    """One moving picture: uint8 frames [T, H, W] or [T, H, W, 3], and the caption below it."""

    caption: str
    frames: NDArray[np.uint8]


@dataclass(frozen=True)
class Table:
    """Rows of text or numbers under their headers; rows in `best` are bold."""

    caption: str
    headers: Sequence[str]
    rows: Sequence[Sequence[object]]
    best: frozenset[int] = frozenset()


def picture_uri(pixels: NDArray[np.uint8], *, quality: int | None = None) -> str:
    """Return a picture, uint8 [H, W] or [H, W, 3], as data: address; JPEG if `quality` is given, else PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    if quality is None:
        Image.fromarray(pixels).save(buffer, "PNG", optimize=True)
    else:
        Image.fromarray(pixels).save(buffer, "JPEG", quality=quality)
    kind = "png" if quality is None else "jpeg"
    return f"data:image/{kind};base64," + base64.b64encode(buffer.getvalue()).decode()


MAX_STRIP = 32_000  # rows; browsers do not draw taller pictures


def strip(frames: NDArray[np.uint8]) -> str:
    """Return all frames below each other as the address of one picture: PNG up to 256 columns, JPEG above."""
    tall = frames.reshape(-1, *frames.shape[2:])
    if len(tall) > MAX_STRIP:
        raise ValueError(
            f"a strip of {len(tall)} rows is too tall for browsers, which draw {MAX_STRIP} at most: show fewer frames"
        )
    return picture_uri(tall, quality=None if frames.shape[2] <= 256 else 88)


def player(panels: Sequence[Panel], *, left: int = -1, milliseconds: int = 120) -> Markup:
    """Return panels that play together, with a scrubber and a slider that reveals panel `left` over the first."""
    count = len(panels[0].frames)
    for panel in panels:
        if len(panel.frames) != count:
            raise ValueError(f"panel {panel.caption!r} has {len(panel.frames)} frames, the first has {count}")
    strips = [(panel.caption, strip(panel.frames)) for panel in panels]
    return _parts().player(strips, count, left % len(panels), milliseconds)


def table(content: Table) -> Markup:
    """Return a table; numbers have four digits and are aligned to the right."""
    numeric = [
        bool(content.rows) and all(isinstance(row[i], int | float) or row[i] is None for row in content.rows)
        for i in range(len(content.headers))
    ]
    rows = [[number_text(value) for value in row] for row in content.rows]
    return _parts().table(content.caption, content.headers, rows, numeric, content.best)


def number_text(value: object) -> str:
    """Return a float with four significant digits, None as a dash, and anything else as text."""
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def text(words: str) -> Markup:
    """Return a paragraph."""
    return _parts().text(words)


def bullets(lines: Sequence[str]) -> Markup:
    """Return a list of lines."""
    return _parts().bullets(lines)


def figure(png: bytes, caption: str) -> Markup:
    """Return a PNG figure with its caption."""
    return _parts().figure("data:image/png;base64," + base64.b64encode(png).decode(), caption)


def axes(x_label: str, y_label: str) -> tuple[Any, Callable[[], bytes]]:
    """Return small axes, and a function that returns their figure as PNG bytes."""
    drawing = new_figure(6.4, 3.0)
    own = drawing.subplots()
    own.set_xlabel(x_label)
    own.set_ylabel(y_label)
    own.grid(alpha=0.3)
    return own, lambda: figure_png(drawing)


def picture(pixels: NDArray[np.uint8], caption: str) -> Markup:
    """Return a small picture, uint8 [H, W] or [H, W, 3], at its original size with its caption."""
    return _parts().picture(picture_uri(pixels), caption)


def grid(figures: Sequence[Markup]) -> Markup:
    """Return figures side by side where the page is wide enough."""
    return _parts().grid(figures)


def section(title: str, *parts: Markup | None) -> Markup:
    """Return a section with its heading; parts that are None are omitted."""
    return _parts().section(title, parts)


def together(sections: Sequence[Markup]) -> Markup:
    """Return several sections as one."""
    from markupsafe import Markup

    return Markup("\n").join(sections)


def page(title: str, subtitle: str, sections: Sequence[Markup]) -> str:
    """Return the complete page as text; it loads nothing from elsewhere."""
    return environment().get_template("page.html").render(title=title, subtitle=subtitle, sections=sections)


def script(name: str) -> Markup:
    """Return a script of templates/ as the content of a <script> element."""
    from markupsafe import Markup

    return Markup((Path(__file__).parent / "templates" / name).read_text(encoding="utf-8"))


@cache
def environment() -> Environment:
    """Return the templates; all text is escaped, and an unknown name is an error."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(Path(__file__).parent / "templates")
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)


@cache
def _parts() -> Any:
    """Return the macros of parts.html; each of them returns `Markup`."""
    return environment().get_template("parts.html").module
