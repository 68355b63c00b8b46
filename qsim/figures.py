"""Draws figures in one house style: constrained layout, no window, 120 dots per inch; or SVG in a page's colours."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import TYPE_CHECKING

from qsim import files

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 120
KINDS = ("png", "svg", "pdf")


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of this size in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=DPI, layout="constrained")


def figure_png(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    return _encoded(figure, "png")


# Colours of Matplotlib -> those of a page, which follow its colour scheme (report/templates/style.css)
_PAGE_COLOURS = {"#000000": "currentColor", "#ffffff": "none", "#1f77b4": "var(--mark)"}


def figure_svg(figure: Figure) -> str:
    """Return a figure as an <svg> element for a page: its black is the page's text, its white is transparent."""
    import matplotlib

    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "qsim"}):
        text = _encoded(figure, "svg").decode()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg ") :], flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*"', "<g", text)  # several figures share a page
    text = re.sub(r"font: ([\d.]+px) [^;\"]*", r"font: \1 system-ui, sans-serif", text)
    for colour, own in _PAGE_COLOURS.items():
        text = text.replace(f": {colour}", f": {own}")
    return text


def check_figure(path: Path) -> str:
    """Return the format of a figure from its name's suffix; `ValueError` if it is not supported."""
    kind = path.suffix.lstrip(".").lower()
    if kind not in KINDS:
        raise ValueError(f"{path}: a figure is a .png, .svg or .pdf file")
    return kind


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure as .png, .svg or .pdf, and its folder if there is none."""
    content = _encoded(figure, check_figure(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write_bytes(path, content)


def _encoded(figure: Figure, kind: str) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind)
    return buffer.getvalue()
