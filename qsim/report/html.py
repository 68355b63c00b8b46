"""Builds the parts of a page (players, tables, figures, text) and the self-contained HTML page from templates/.

Frames are uint8 arrays, and the templates escape all text. This module imports nothing of clips and sensors.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from math import floor, log10
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qsim.figures import figure_svg, new_figure

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


@dataclass(frozen=True)
class Panel:
    """One moving picture: uint8 frames [T, H, W] or [T, H, W, 3], and the caption below it."""

    caption: str
    frames: NDArray[np.uint8]
    score: str = ""  # behind the caption, as in "24.1 dB"


@dataclass(frozen=True)
class Fact:
    """A headline number and what it is."""

    value: str
    what: str


@dataclass(frozen=True)
class Section:
    """A section of a page: heading and content, with a sentence and numbers for the top of the page."""

    title: str
    body: Markup
    story: str = ""
    facts: tuple[Fact, ...] = ()


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


def player(panels: Sequence[Panel], *, left: int = -1, right: int = 0, milliseconds: int = 120) -> Markup:
    """Return panels that play together, and a large picture in which a dragged line parts panels `left` and `right`."""
    count = len(panels[0].frames)
    for panel in panels:
        if len(panel.frames) != count:
            raise ValueError(f"panel {panel.caption!r} has {len(panel.frames)} frames, the first has {count}")
    strips = [(panel, strip(panel.frames)) for panel in panels]
    height, width = panels[0].frames.shape[1:3]
    return _parts().player(
        strips, count, left % len(panels), right % len(panels), f"{width / height:.4f}", milliseconds
    )


def table(content: Table) -> Markup:
    """Return a table; numbers have four digits, and columns of numbers are aligned to the right."""
    rows = [[number_text(value) for value in row] for row in content.rows]
    numeric = [
        bool(rows)
        and all(
            isinstance(row[i], int | float) or _NUMBER.match(own[i])
            for row, own in zip(content.rows, rows, strict=True)
        )
        for i in range(len(content.headers))
    ]
    return _parts().table(content.caption, content.headers, rows, numeric, content.best)


_NUMBER = re.compile(r"[-+−]?[\d.]+([eE][-+]?\d+)?( ± [\d.]+)?( [†%a-zµ/]+)*$|–$|n/a$|failed$|inf$")


def number_text(value: object) -> str:
    """Return a float with four digits, without an exponent from 1e-4 to 1e7; None as a dash, other things as text."""
    if value is None:
        return "–"
    if not isinstance(value, float):
        return str(value)
    if value and 1e-4 <= abs(value) < 1e7:
        shown = f"{value:.{max(3 - floor(log10(abs(value))), 0)}f}"
        return shown.rstrip("0").rstrip(".") if "." in shown else shown
    return f"{value:.4g}"


def seconds_text(seconds: float | None) -> str | None:
    """Return a time with three digits and its unit: 65 µs, 357 ms, 2.1 s; None stays None."""
    if seconds is None:
        return None
    for factor, unit in ((1e6, "µs"), (1e3, "ms")):
        if 0 < seconds * factor < 1000:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds:.3g} s"


def text(words: str) -> Markup:
    """Return a paragraph."""
    return _parts().text(words)


def bullets(lines: Sequence[str]) -> Markup:
    """Return a list of lines."""
    return _parts().bullets(lines)


def stored_figure(png: bytes, caption: str) -> Markup:
    """Return a stored PNG figure with its caption."""
    return _parts().stored("data:image/png;base64," + base64.b64encode(png).decode(), caption)


def axes(x_label: str, y_label: str) -> tuple[Any, Callable[[str], Markup]]:
    """Return small axes, and a function that returns their figure with a caption, in the colours of the page."""
    from markupsafe import Markup

    drawing = new_figure(4.6, 2.7)
    own = drawing.subplots()
    own.set_xlabel(x_label)
    own.set_ylabel(y_label)
    own.grid(alpha=0.3)

    def save(caption: str) -> Markup:
        opening = Markup('<svg role="img" aria-label="{}" ').format(caption)
        return _parts().drawing(Markup(figure_svg(drawing).replace("<svg ", opening, 1)), caption)

    return own, save


def picture(pixels: NDArray[np.uint8], caption: str) -> Markup:
    """Return a small picture, uint8 [H, W] or [H, W, 3], at its original size with its caption."""
    return _parts().picture(picture_uri(pixels), caption)


def grid(figures: Sequence[Markup]) -> Markup:
    """Return figures side by side where the page is wide enough."""
    return _parts().grid(figures)


def section(title: str, *parts: Markup | None, story: str = "", facts: Sequence[Fact] = ()) -> Section:
    """Return a section of these parts; those that are None are omitted."""
    from markupsafe import Markup

    return Section(title, Markup("\n").join(part for part in parts if part is not None), story, tuple(facts))


def page(title: str, story: Sequence[str], facts: Sequence[Fact], sections: Sequence[Section]) -> str:
    """Return the complete page as text: sentences and numbers, contents, sections. It loads nothing from elsewhere."""
    template = environment().get_template("page.html")
    return template.render(title=title, story=story, facts=facts, sections=sections, script=script("player.js"))


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
