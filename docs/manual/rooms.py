"""Draws the rooms of the code and who imports whom, from the imports themselves: docs/pictures/rooms.svg.

    python docs/manual/rooms.py

A room is a package of `qsim` or `quiver`; the files beside them are the ground floor. An arrow leads from a room to one
that it imports. Arrows that follow from others are left out, and those to the ground floor, which all rooms import.
"""

from __future__ import annotations

import ast
import itertools
from html import escape
from pathlib import Path

ROOT = Path(__file__).parents[2]
PICTURE = ROOT / "docs" / "pictures" / "rooms.svg"
WIDTH = 2000  # px that rooms may spread over
ROW = 78  # px, from one row of rooms to the next
BOX = (124, 40)  # px
EDGE = 20  # px, around the picture
BEND = 26  # px, the width of an arrow that passes a row
SWEEPS = 24  # up and down, that put each room near those it is tied to
COLOURS = {"qsim": "#1f6f8b", "quiver": "#8b4a1f"}
FOLDERS = {"qsim": ROOT / "qsim", "quiver": ROOT / "quiver", "qsim.scenes": ROOT / "scenes"}

Lane = tuple[str, ...]  # the rooms of an arrow, with a place in each row that it passes


def imports() -> dict[str, set[str]]:
    """Return the rooms that each room imports; names of type checkers count, too."""
    found: dict[str, set[str]] = {}
    for name, folder in FOLDERS.items():
        for path in sorted(folder.rglob("*.py")):
            parts = (*name.split("."), *path.relative_to(folder).parts)
            room = ".".join(parts[:2])
            if len(parts) > 2:  # a file beside the rooms is the ground floor
                found.setdefault(room, set()).update(_asked(path) - {room})
    return {room: asked & set(found) for room, asked in found.items()}


def _asked(path: Path) -> set[str]:
    """Return the packages, two names deep, that a file imports."""
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module is not None and not node.level:
            names += [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
    return {".".join(name.split(".")[:2]) for name in names if name.split(".")[0] in COLOURS}


def reduced(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return a graph without circles and without the arrows that follow from others."""
    below: dict[str, set[str]] = {}

    def reached(room: str) -> set[str]:
        if room not in below:
            below[room] = set().union(*(reached(one) | {one} for one in graph[room]))
        return below[room]

    return {
        room: {one for one in asked if not any(one in reached(other) for other in asked)}
        for room, asked in graph.items()
    }


def heights(graph: dict[str, set[str]]) -> dict[str, int]:
    """Return the row of each room, from 0 at the bottom: above all that it imports."""
    found: dict[str, int] = {}

    def height(room: str) -> int:
        if room not in found:
            found[room] = 1 + max((height(one) for one in graph[room]), default=-1)
        return found[room]

    for room in graph:
        height(room)
    return found


def lanes(arrows: dict[str, set[str]], rows: dict[str, int]) -> tuple[list[Lane], dict[str, int]]:
    """Return the arrows with a place in each row that they pass, and the row of every room and place."""
    every = dict(rows)
    paths = []
    for room, asked in sorted(arrows.items()):
        for one in sorted(asked):
            passed = [f"{room}>{one}>{row}" for row in range(rows[room] - 1, rows[one], -1)]
            every |= {place: int(place.rpartition(">")[2]) for place in passed}
            paths.append((room, *passed, one))
    return paths, every


def places_of(paths: list[Lane], rows: dict[str, int]) -> dict[str, float]:
    """Return where rooms and places lie along their row [px]: near what they are tied to, without touching."""
    tied: dict[str, list[str]] = {one: [] for one in rows}
    for path in paths:
        for one, other in itertools.pairwise(path):
            tied[one].append(other)
            tied[other].append(one)
    levels = [sorted(one for one, row in rows.items() if row == level) for level in range(max(rows.values()) + 1)]
    found = {one: WIDTH * (0.75 if one.startswith("quiver") else 0.35) for one in rows}
    for sweep in range(SWEEPS):
        for level in levels if sweep % 2 else levels[::-1]:
            wanted = {one: sum(found[other] for other in tied[one]) / max(1, len(tied[one])) for one in level}
            _spread(sorted(level, key=lambda one: (wanted[one], one)), wanted, found)
    left = min(found.values()) - BOX[0] / 2 - EDGE
    return {one: at - left for one, at in found.items()}


def _spread(order: list[str], wanted: dict[str, float], found: dict[str, float]) -> None:
    """Place what stands in a row in an order, as near to what is wanted as their widths allow."""
    widths = [BEND if ">" in one else BOX[0] + 16 for one in order]
    at = 0.0
    for one, width in zip(order, widths, strict=True):
        found[one] = max(at + width / 2, wanted[one])
        at = found[one] + width / 2
    at = WIDTH
    for one, width in zip(order[::-1], widths[::-1], strict=True):
        found[one] = min(at - width / 2, found[one])
        at = found[one] - width / 2


def drawing() -> str:
    """Return the picture."""
    arrows = reduced(imports())
    rooms = heights(arrows)
    paths, rows = lanes(arrows, rooms)
    along = places_of(paths, rows)
    top = max(rows.values())
    height = ROW * (top + 1) + 60
    width = round(max(along.values()) + BOX[0] / 2 + EDGE)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" '
        'font-size="14">',
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    for path in paths:
        points = [(along[one], 30 + ROW * (top - rows[one])) for one in path]
        parts.append(f'<path d="{_curve(points)}" fill="none" stroke="#9aa5ab" stroke-width="1.5"/>')
    for room, row in sorted(rooms.items()):
        package, _, name = room.partition(".")
        x = along[room]
        y = 30 + ROW * (top - row)
        parts.append(
            f'<rect x="{x - BOX[0] / 2:.0f}" y="{y - BOX[1] / 2:.0f}" width="{BOX[0]}" height="{BOX[1]}" rx="6" '
            f'fill="{COLOURS[package]}"/>'
        )
        parts.append(f'<text x="{x:.0f}" y="{y + 5:.0f}" text-anchor="middle" fill="#ffffff">{escape(name)}</text>')
    floor = height - 50
    parts.append(f'<rect x="{EDGE}" y="{floor}" width="{width - 2 * EDGE}" height="34" rx="6" fill="#e7ecee"/>')
    said = "ground floor: records, settings, files, keys, limits"
    parts.append(
        f'<text x="{width / 2:.0f}" y="{floor + 22}" text-anchor="middle" fill="#333333">{escape(said)}</text>'
    )
    return "\n".join([*parts, "</svg>", ""])


def _curve(points: list[tuple[float, float]]) -> str:
    """Return the path of an arrow through points, upright at each."""
    (x, y), *more = points
    found = [f"M {x:.0f} {y:.0f}"]
    for to_x, to_y in more:
        middle = (y + to_y) / 2
        found.append(f"C {x:.0f} {middle:.0f} {to_x:.0f} {middle:.0f} {to_x:.0f} {to_y:.0f}")
        x = to_x
        y = to_y
    return " ".join(found)


if __name__ == "__main__":
    PICTURE.write_text(drawing(), encoding="utf-8")
