"""Builds gears, rotors, letters and springs from the outlines and paths of `shapes`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from qsim.scene.scene import Mesh
from qsim.scene.shapes import extruded, merged, moved, sheet, wire

Array = NDArray[np.float64]
CURVE = 3  # matplotlib's path code of a quadratic curve's points; 1 starts a loop, 2 is a line, 79 closes


def gear(teeth: int, radius: float, thickness: float, depth: float = 0.18, spokes: int = 0) -> Mesh:
    """Return a spur gear in the plane z = 0: tip `radius`, teeth `depth` radii high, a bore, windows if spoked."""
    if teeth < 3:
        raise ValueError(f"gear: at least 3 teeth, got {teeth!r}")
    root = radius * (1 - depth)
    shares = np.array([-0.30, -0.16, 0.16, 0.30])  # of a tooth's pitch: root, tip, tip, root
    angle = (np.arange(teeth)[:, None] + shares).reshape(-1) * 2 * np.pi / teeth
    rim = np.tile([root, radius, radius, root], teeth)
    loops = [_polar(rim, angle), _polar(0.14 * radius, np.linspace(0, 2 * np.pi, 25)[:-1])]
    for spoke in range(spokes):
        a = np.linspace(0.16, 0.84, 12) / spokes * 2 * np.pi + spoke * 2 * np.pi / spokes
        loops.append(np.concatenate([_polar(0.82 * root, a), _polar(0.30 * root, a[::-1])]))
    return extruded(loops, thickness, texture_size=radius)


def rotor(blades: int, radius: float, pitch: float = 0.5, width: float = 0.9, sweep: float = 0.3) -> Mesh:
    """Return a fan's blades about the z axis without a hub; they widen outward, with `pitch` [rad] to the plane.

    `width` is about the angle [rad] of a blade at its tip, `sweep` the lead of the tip [rad].
    """
    flat = sheet(1.0, 1.0, 16, 24)
    # 0..1 from root to tip; -0.5..0.5 across
    along = flat.vertices[:, 1] + 0.5
    across = flat.vertices[:, 0]
    r = radius * (0.16 + 0.84 * along)
    round_off = np.sqrt(np.clip(1 - np.clip((along - 0.8) / 0.2, 0, 1) ** 2 * 0.6, 0, 1))
    chord = width * radius * (0.35 + 0.65 * along) * round_off * across
    tilt = pitch * (1 - 0.5 * along)  # twisted: flatter outside
    lift = chord * np.sin(tilt) + 0.04 * radius * (1 - (2 * across) ** 2)  # a little camber
    angle = sweep * along**1.5 + chord * np.cos(tilt) / r
    places = np.stack([-r * np.sin(angle), r * np.cos(angle), lift], 1)
    blade = Mesh(places, flat.faces[:, ::-1], flat.uv, smooth=True)
    return merged([moved(blade, _turn_z(2 * np.pi * k / blades)) for k in range(blades)])


def letters(text: str, height: float, depth: float, font: str = "DejaVuSans-Bold") -> Mesh:
    """Return extruded text in the plane z = 0, centred, capitals about `height` [m] high, in a matplotlib font."""
    loops_of_glyphs = glyph_outlines(text, font)
    if not loops_of_glyphs:
        raise ValueError(f"letters: nothing to draw in {text!r}")
    scale = height / 0.73  # capitals are 0.73 em high
    solids = [extruded([loop * scale for loop in loops], depth, height) for loops in loops_of_glyphs]
    mesh = merged(solids)
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    return Mesh(mesh.vertices - middle, mesh.faces, mesh.uv)


def glyph_outlines(text: str, font: str = "DejaVuSans-Bold") -> list[list[Array]]:
    """Return closed outlines [N, 2] of every visible character in em, from left to right on the line y = 0."""
    import matplotlib as mpl
    from matplotlib.ft2font import FT2Font, LoadFlags

    path = Path(mpl.get_data_path()) / "fonts" / "ttf" / f"{font}.ttf"
    if not path.is_file():
        raise ValueError(
            f"font {font!r} is not among matplotlib's: {', '.join(sorted(p.stem for p in path.parent.glob('*.ttf')))}"
        )
    face = FT2Font(str(path))
    em = 1000.0
    face.set_size(em, 72)  # one point is one pixel
    outlines = []
    pen = 0.0
    for character in text:
        glyph = face.load_char(ord(character), flags=LoadFlags.NO_HINTING)
        points, codes = face.get_path()
        loops = [(loop + np.array([pen, 0])) / em for loop in _flattened(np.asarray(points), np.asarray(codes))]
        if loops:
            outlines.append(loops)
        pen += glyph.linearHoriAdvance / 65536
    return outlines


def spring(radius: float, length: float, turns: float, thickness: float) -> Mesh:
    """Return a helix of wire along y; lengths in m."""
    a = np.linspace(0, 2 * np.pi * turns, int(24 * turns) + 1)
    height = np.linspace(-length / 2, length / 2, len(a))
    return wire(np.stack([radius * np.cos(a), height, radius * np.sin(a)], 1), thickness, sides=8)


def _polar(radius: float | Array, angle: Array) -> Array:
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)


def _turn_z(angle: float) -> Array:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return pose


def _flattened(points: Array, codes: NDArray[np.integer], steps: int = 5) -> list[Array]:
    """Return loops of lines [N, 2] from a glyph's lines and quadratic curves."""
    # Codes of matplotlib.path: 1 begins a loop, 2 draws a line, CURVE takes two points, a control and an end.
    loops: list[list[Array]] = []
    i = 0
    while i < len(codes):
        if codes[i] == 1:
            loops.append([points[i]])
        elif codes[i] == 2:
            loops[-1].append(points[i])
        elif codes[i] == CURVE:
            s = np.linspace(0, 1, steps + 1)[1:, None]
            start = loops[-1][-1]
            control = points[i]
            end = points[i + 1]
            loops[-1].extend((1 - s) ** 2 * start + 2 * s * (1 - s) * control + s**2 * end)
            i += 1
        i += 1
    return [np.array(loop) for loop in loops if len(loop) > 2]
