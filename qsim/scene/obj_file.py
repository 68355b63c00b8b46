"""Reads faces, texture coordinates and base colours of a Wavefront .obj file and its .mtl files.

    v, vt, f, usemtl; newmtl, Kd, map_Kd -> pieces

Read are polygons, cut into fans, and indices from either end. Of a material count the diffuse colour `Kd` (linear) and
the picture `map_Kd` (sRGB), which are multiplied, with the options -s, -o and -clamp. All else is left out: normals,
lines, points, curves, and other colours. Sources: Wavefront, Advanced Visualizer manual, appendix B; P. Bourke, "MTL".
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from qsim.scene.files_beside import file_beside, picture_of, regular_bytes
from qsim.scene.materials import Picture
from qsim.scene.mesh_pieces import Paint, Piece, by_paint

# Options of map_Kd, and the largest number of values of each; those of _LEFT_OUT do not change the picture here.
_OPTIONS = {"-s": 3, "-o": 3, "-clamp": 1, "-blendu": 1, "-blendv": 1, "-boost": 1, "-cc": 1, "-texres": 1, "-bm": 1}
_READ = ("-s", "-o", "-clamp")


class _Materials:
    """The paints of the .mtl files of an .obj file, and the scale and offset [2, 2] of their pictures."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.paints: dict[str, Paint] = {}
        self.placed: dict[str, np.ndarray] = {}
        self._pictures: dict[tuple[Path, str], tuple[Picture, str]] = {}
        self.problem: OSError | ValueError | None = None  # of a file that is missing or outside of the folder

    def read(self, named: str) -> None:
        """Read the files that a line `mtllib` names: one with spaces in its name, or several."""
        names = [named] if (self.path.parent / named).is_file() else named.split()
        for name in names:
            where = f"mesh {self.path}: mtllib"
            try:
                file = file_beside(self.path, where, name)
                text = _text(regular_bytes(file, where))
            except (OSError, ValueError) as error:
                self.problem = error
                continue
            self._parse(file, text)

    def use(self, where: str, name: str) -> None:
        """Check the name of a material; where a file of materials could not be read, its use is refused, not faces."""
        if name in self.paints:
            return
        if self.problem is None:
            raise ValueError(f"{where}: usemtl {name:.60}: no material of this name is in its .mtl files")
        self.paints[name] = _refused(where, self.problem)

    def _parse(self, file: Path, text: str) -> None:
        name = ""
        for number, words in _lines(text):
            where = f"{file}, line {number}"
            if words[0] == "newmtl":
                name = " ".join(words[1:])
                self.paints[name] = Paint(f"{file}: material {name!r:.60}")
                self.placed[name] = np.array([[1.0, 1.0], [0.0, 0.0]])
            elif words[0] == "Kd":
                self._colour(where, name, words[1:])
            elif words[0].lower() == "map_kd":
                self._picture(file, where, name, words[1:])

    def _colour(self, where: str, name: str, words: list[str]) -> None:
        if name not in self.paints:
            raise ValueError(f"{where}: Kd stands before the first newmtl")
        if words[:1] in (["spectral"], ["xyz"]):
            raise ValueError(f"{where}: Kd {words[0]} is not read; state three numbers, red, green and blue")
        found = _numbers(where, words)
        colour = found * 3 if len(found) == 1 else found
        if len(colour) != 3 or not all(0 <= value <= 1 for value in colour):
            raise ValueError(f"{where}: Kd needs three numbers from 0 to 1, found {' '.join(words):.40}")
        old = self.paints[name]
        red, green, blue = colour
        self.paints[name] = Paint(old.where, (red, green, blue), old.image, old.wrap)

    def _read_picture(self, where: str, named: str, folder: Path) -> tuple[Picture, str]:
        """Return a picture; several materials may share it."""
        if (folder, named) not in self._pictures:
            self._pictures[folder, named] = picture_of(self.path, where, named, folder)
        return self._pictures[folder, named]

    def finish(self) -> None:
        """Let materials be refused in use whose colour blackens their picture, as some programs write by mistake."""
        for name, paint in self.paints.items():
            if paint.image is not None and max(paint.factor) == 0:
                wrong = ValueError(f"{paint.where}: Kd 0 0 0 makes its picture black; set Kd to 1 1 1")
                self.paints[name] = _refused(paint.where, wrong)

    def _picture(self, file: Path, where: str, name: str, words: list[str]) -> None:
        if name not in self.paints:
            raise ValueError(f"{where}: map_Kd stands before the first newmtl")
        wrap = "repeat"
        rest = list(words)
        while rest and rest[0].startswith("-"):
            option = rest.pop(0).lower()
            if option not in _OPTIONS:
                raise ValueError(f"{where}: the option {option:.20} of map_Kd is not read; bake it into the picture")
            values: list[str] = []
            while rest and len(values) < _OPTIONS[option] and (option not in ("-s", "-o") or _is_number(rest[0])):
                values.append(rest.pop(0))
            if option == "-clamp":
                wrap = "clamp" if values == ["on"] else "repeat"
            elif option in _READ:
                row = 0 if option == "-s" else 1
                given = _numbers(where, values)[:2]
                self.placed[name][row, : len(given)] = given
        if not rest:
            raise ValueError(f"{where}: map_Kd names no picture")
        named = " ".join(rest).replace("\\", "/")
        old = self.paints[name]
        read = functools.partial(self._read_picture, old.where, named, file.parent)
        self.paints[name] = Paint(old.where, old.factor, read, (wrap, wrap))


def _refused(where: str, error: OSError | ValueError) -> Paint:
    """Return a paint whose use raises an error."""

    def image() -> tuple[Picture, str]:
        raise error

    return Paint(where, image=image)


def obj_pieces(path: Path) -> list[Piece]:
    """Return the faces of an .obj file by material, in the order of their first use.

    `ValueError` with file and line for faces that name no vertex, and for materials that no .mtl file has.
    """
    text = _text(regular_bytes(path, f"mesh {path}"))
    vertices: list[tuple[float, ...]] = []
    coordinates: list[tuple[float, ...]] = []
    materials = _Materials(path)
    current = ""
    libraries = 0
    known: dict[str, tuple[int, int]] = {}  # corners by their words, which most vertices share
    faces: dict[tuple[str, bool], list[tuple[tuple[int, int], ...]]] = {}
    for number, words in _lines(text):
        where = f"mesh {path}, line {number}"
        match words[0]:
            case "v":
                vertices.append(tuple(_numbers(where, words[1:4])))
            case "vt":
                coordinates.append((*_numbers(where, words[1:3]), 0.0)[:2])
            case "mtllib":
                materials.read(" ".join(words[1:]))
                libraries += 1
            case "usemtl":
                current = " ".join(words[1:])
                if libraries:
                    materials.use(where, current)
            case "f":
                corners = _corners(where, words[1:], len(vertices), len(coordinates), known)
                mapped = all(at >= 0 for _, at in corners)
                fan = [(corners[0], corners[i], corners[i + 1]) for i in range(1, len(corners) - 1)]
                faces.setdefault((current, mapped), []).extend(fan)
    materials.finish()
    if any(len(vertex) != 3 for vertex in vertices):
        raise ValueError(f"mesh {path}: a vertex needs three numbers")
    points = np.array(vertices, np.float64).reshape(-1, 3)
    places = np.array(coordinates, np.float64).reshape(-1, 2)
    return by_paint([_piece(points, places, np.array(list(faces[key])), key, materials) for key in faces])


def _piece(
    points: np.ndarray, places: np.ndarray, corners: np.ndarray, key: tuple[str, bool], materials: _Materials
) -> Piece:
    """Return the faces [F, 3, (vertex, coordinate)] of one material; a vertex with several coordinates is split."""
    name, mapped = key
    pairs, index = np.unique(corners.reshape(-1, 2) * (1, mapped), axis=0, return_inverse=True)
    scale, offset = materials.placed.get(name, np.array([[1.0, 1.0], [0.0, 0.0]]))
    uv = places[pairs[:, 1]] * scale + offset if mapped else None
    return Piece(points[pairs[:, 0]], index.reshape(-1, 3).astype(np.int64), uv, materials.paints.get(name))


def _corners(
    where: str, words: list[str], vertices: int, coordinates: int, known: dict[str, tuple[int, int]]
) -> list[tuple[int, int]]:
    """Return the corners of a face, and add them to those that are `known`; `ValueError` for fewer than three."""
    corners = []
    for word in words:
        corner = known.get(word) or _corner(where, word, vertices, coordinates)
        if "-" not in word:  # others count from the end so far
            known[word] = corner
        corners.append(corner)
    if len(corners) < 3:
        raise ValueError(f"{where}: a face needs three corners, found {len(corners)}")
    return corners


def _corner(where: str, word: str, vertices: int, coordinates: int) -> tuple[int, int]:
    """Return the numbers, from 0, of the vertex and of the coordinate of a corner `v/vt/vn`; -1 for no coordinate."""
    parts = word.split("/")
    found = []
    for part, count, what in zip((*parts, "")[:2], (vertices, coordinates), ("vertex", "coordinate"), strict=True):
        if not part and what == "coordinate":
            found.append(-1)
            continue
        try:
            index = int(part)
        except ValueError:
            raise ValueError(f"{where}: {word:.40} is no corner of a face") from None
        place = index - 1 if index > 0 else count + index
        if not 0 <= place < count or index == 0:
            raise ValueError(f"{where}: {what} {index} does not exist; {count} stand before this line")
        found.append(place)
    return found[0], found[1]


def _text(raw: bytes) -> str:
    """Return a text in UTF-8, or in Latin-1, which older programs write."""
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def _lines(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield number and words of every line that has some, without comments; a backslash at its end continues a line."""
    kept = ""
    first = 0
    for number, line in enumerate(text.splitlines(), 1):
        first = first or number
        bare = line.partition("#")[0].rstrip()
        if bare.endswith("\\"):
            kept += bare[:-1] + " "
            continue
        words = (kept + bare).split()
        if words:
            yield first, words
        kept = ""
        first = 0


def _numbers(where: str, words: list[str]) -> list[float]:
    try:
        found = [float(word) for word in words]
    except ValueError:
        found = []
    if not found or not all(map(math.isfinite, found)):
        raise ValueError(f"{where}: finite numbers are expected, found {' '.join(words):.40}")
    return found


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False
