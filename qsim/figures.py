"""Draws figures in one house style: constrained layout, no window, 120 dots per inch."""

from __future__ import annotations

import io
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
