"""The parts of a report: players, tables, figures, text -> one self-contained HTML page.

Nothing here knows clips or sensors: frames come as uint8 arrays, words as text. `report.py` decides what to show.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


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


def player(panels: Sequence[Panel], *, left: int = -1, milliseconds: int = 120) -> str:
    """Panels that play together, a scrubber, and a slider that reveals panel `left` over the first one."""
    count = len(panels[0].frames)
    for panel in panels:
        if len(panel.frames) != count:
            raise ValueError(f"panel {panel.caption!r} has {len(panel.frames)} frames, the first has {count}")
    figures = "".join(
        f'<figure data-strip="{strip(p.frames)}"><canvas role="img" aria-label="{html.escape(p.caption)}"></canvas>'
        f"<figcaption>{html.escape(p.caption)}</figcaption></figure>"
        for p in panels
    )
    controls = (
        '<div class="controls"><button class="play" type="button" aria-pressed="false">play</button>'
        f'<input class="frame" type="range" min="0" max="{count - 1}" value="0" aria-label="frame">'
        "<output></output></div>"
    )
    comparison = _comparison(panels, left % len(panels)) if len(panels) > 1 else ""
    return (
        f'<div class="player" tabindex="0" data-frames="{count}" data-milliseconds="{milliseconds}">'
        f'<div class="panels">{figures}</div>{controls}{comparison}</div>'
    )


def _comparison(panels: Sequence[Panel], left: int) -> str:
    def choice(chosen: int, side: str) -> str:
        options = "".join(
            f'<option value="{i}"{" selected" if i == chosen else ""}>{html.escape(p.caption)}</option>'
            for i, p in enumerate(panels)
        )
        return f'<select aria-label="{side} picture">{options}</select>'

    return (
        '<details><summary>compare two</summary><div class="compare"><div style="position:relative">'
        '<canvas class="under"></canvas><canvas class="over"></canvas></div>'
        '<input class="reveal" type="range" min="0" max="100" value="50" aria-label="share of the left picture">'
        f'<div class="controls">{choice(left, "left")}{choice(0, "right")}</div></div></details>'
    )


def table(content: Table) -> str:
    """A table; numbers are shown to four digits and aligned to the right."""

    def cell(value: object, tag: str, is_number: bool) -> str:
        kind = ' class="number"' if is_number else ""
        return f"<{tag}{kind}>{html.escape(number_text(value))}</{tag}>"

    numeric = [
        bool(content.rows) and all(isinstance(row[i], int | float) or row[i] is None for row in content.rows)
        for i in range(len(content.headers))
    ]
    head = "".join(cell(h, "th", n) for h, n in zip(content.headers, numeric, strict=True))
    body = "".join(
        f"<tr{' class=best' if i in content.best else ''}>"
        + "".join(cell(v, "td", n) for v, n in zip(row, numeric, strict=True))
        + "</tr>"
        for i, row in enumerate(content.rows)
    )
    return (
        f'<div class="scroll"><table><caption>{html.escape(content.caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def number_text(value: object) -> str:
    """Four significant digits for floats, a dash for nothing, text as it is."""
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def text(words: str) -> str:
    return f"<p>{html.escape(words)}</p>"


def bullets(lines: Sequence[str]) -> str:
    return '<ul class="plain">' + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>"


def figure(png: bytes, caption: str) -> str:
    """A PNG figure with its caption."""
    uri = "data:image/png;base64," + base64.b64encode(png).decode()
    words = html.escape(caption)
    return f'<figure><img src="{uri}" alt="{words}"><figcaption>{words}</figcaption></figure>'


def axes(x_label: str, y_label: str) -> tuple[Any, Callable[[], bytes]]:
    """One small set of axes, and a function that gives its picture as PNG bytes."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(6.4, 3.0), dpi=110, layout="constrained")
    own = drawing.subplots()
    own.set_xlabel(x_label)
    own.set_ylabel(y_label)
    own.grid(alpha=0.3)

    def save() -> bytes:
        buffer = io.BytesIO()
        drawing.savefig(buffer, format="png")
        return buffer.getvalue()

    return own, save


def picture(pixels: NDArray[np.uint8], caption: str) -> str:
    """A small picture with its caption, in its own size."""
    words = html.escape(caption)
    image = f'<img src="{picture_uri(pixels)}" alt="{words}">'
    return f'<figure class="small">{image}<figcaption>{words}</figcaption></figure>'


def grid(figures: Sequence[str]) -> str:
    """Figures side by side where there is room."""
    return f'<div class="figures">{"".join(figures)}</div>' if figures else ""


def section(title: str, *parts: str) -> str:
    return f"<section><h2>{html.escape(title)}</h2>{''.join(parts)}</section>"


def page(title: str, subtitle: str, sections: Sequence[str]) -> str:
    """The whole page as text; it loads nothing from anywhere."""
    template = (Path(__file__).parent / "report.html").read_text(encoding="utf-8")
    for name, value in {"title": html.escape(title), "subtitle": html.escape(subtitle)}.items():
        template = template.replace("{{" + name + "}}", value)
    return template.replace("{{body}}", "\n".join(sections))
