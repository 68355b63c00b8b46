"""The parts of a report: players, tables, figures, text -> one self-contained HTML page.

Nothing here knows clips or sensors: frames come as uint8 arrays, text is escaped by templates/, and `report.py` decides
what to show.
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
    """One moving picture: uint8 frames [T, H, W] or [T, H, W, 3], and the words below it."""

    caption: str
    frames: NDArray[np.uint8]


@dataclass(frozen=True)
class Table:
    """Rows of text or numbers under their headers; `best` marks rows to be shown bold."""

    caption: str
    headers: Sequence[str]
    rows: Sequence[Sequence[object]]
    best: frozenset[int] = frozenset()


def picture_uri(pixels: NDArray[np.uint8], *, quality: int | None = None) -> str:
    """A data: address of a grey or colour picture: PNG, or JPEG where `quality` is given."""
    from PIL import Image

    buffer = io.BytesIO()
    if quality is None:
        Image.fromarray(pixels).save(buffer, "PNG", optimize=True)
    else:
        Image.fromarray(pixels).save(buffer, "JPEG", quality=quality)
    kind = "png" if quality is None else "jpeg"
    return f"data:image/{kind};base64," + base64.b64encode(buffer.getvalue()).decode()


MAX_STRIP = 32_000  # rows: browsers stop drawing taller pictures


def strip(frames: NDArray[np.uint8]) -> str:
    """All frames below each other as one picture: PNG up to 256 columns, JPEG above."""
    tall = frames.reshape(-1, *frames.shape[2:])
    if len(tall) > MAX_STRIP:
        raise ValueError(f"a strip of {len(tall)} rows is too tall for browsers ({MAX_STRIP}): show fewer frames")
    return picture_uri(tall, quality=None if frames.shape[2] <= 256 else 88)


def player(panels: Sequence[Panel], *, left: int = -1, milliseconds: int = 120) -> Markup:
    """Panels that play together, a scrubber, and a slider that reveals panel `left` over the first one."""
    count = len(panels[0].frames)
    for panel in panels:
        if len(panel.frames) != count:
            raise ValueError(f"panel {panel.caption!r} has {len(panel.frames)} frames, the first has {count}")
    strips = [(panel.caption, strip(panel.frames)) for panel in panels]
    return _parts().player(strips, count, left % len(panels), milliseconds)


def table(content: Table) -> Markup:
    """A table; numbers are shown to four digits and aligned to the right."""
    numeric = [
        bool(content.rows) and all(isinstance(row[i], int | float) or row[i] is None for row in content.rows)
        for i in range(len(content.headers))
    ]
    rows = [[number_text(value) for value in row] for row in content.rows]
    return _parts().table(content.caption, content.headers, rows, numeric, content.best)


def number_text(value: object) -> str:
    """Four significant digits for floats, a dash for nothing, text as it is."""
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def text(words: str) -> Markup:
    """A paragraph."""
    return _parts().text(words)


def bullets(lines: Sequence[str]) -> Markup:
    """A list of lines."""
    return _parts().bullets(lines)


def figure(png: bytes, caption: str) -> Markup:
    """A PNG figure with its caption."""
    return _parts().figure("data:image/png;base64," + base64.b64encode(png).decode(), caption)


def axes(x_label: str, y_label: str) -> tuple[Any, Callable[[], bytes]]:
    """One small set of axes, and a function that gives its picture as PNG bytes."""
    drawing = new_figure(6.4, 3.0)
    own = drawing.subplots()
    own.set_xlabel(x_label)
    own.set_ylabel(y_label)
    own.grid(alpha=0.3)
    return own, lambda: figure_png(drawing)


def picture(pixels: NDArray[np.uint8], caption: str) -> Markup:
    """A small picture with its caption, in its own size."""
    return _parts().picture(picture_uri(pixels), caption)


def grid(figures: Sequence[Markup]) -> Markup:
    """Figures side by side where there is room."""
    return _parts().grid(figures)


def section(title: str, *parts: Markup | None) -> Markup:
    """A section with its heading; parts that are None are left out."""
    return _parts().section(title, parts)


def together(sections: Sequence[Markup]) -> Markup:
    """Several sections as one piece."""
    from markupsafe import Markup

    return Markup("\n").join(sections)


def page(title: str, subtitle: str, sections: Sequence[Markup]) -> str:
    """The whole page as text; it loads nothing from anywhere."""
    return _templates().get_template("page.html").render(title=title, subtitle=subtitle, sections=sections)


@cache
def _templates() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(Path(__file__).parent / "templates")
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)


@cache
def _parts() -> Any:
    """The macros of parts.html; each returns `Markup`."""
    return _templates().get_template("parts.html").module
