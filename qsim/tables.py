"""Formats tables as text: aligned columns for a terminal, or Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from qsim.terminal import in_one_line


def text_table(rows: Iterable[Sequence[str]], header: Sequence[str], *, left: int = 1, gap: str = "  ") -> list[str]:
    """Return the lines of a table, its first `left` columns aligned to the left and the others to the right.

    A cell is one line: names of files may hold line breaks.
    """
    lines = [tuple(map(in_one_line, row)) for row in (header, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    styles = [f"<{width}" if i < left else f">{width}" for i, width in enumerate(widths)]
    return [gap.join(map(format, line, styles)).rstrip() for line in lines]


def markdown_table(rows: Iterable[Sequence[str]], header: Sequence[str]) -> list[str]:
    """Return the lines of a Markdown table; a vertical bar within a cell is escaped, and so are line breaks."""

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(in_one_line(cell).replace("|", "\\|") for cell in cells) + " |"

    found = [line(header), "|" + "---|" * len(header)]
    for row in rows:
        if len(row) != len(header):
            raise ValueError(f"a row of {len(row)} cells under a header of {len(header)}: {row!r:.200}")
        found.append(line(row))
    return found
