"""Describes the parts of a mesh file by their paint, and makes one mesh and one material of them.

    pieces (vertices, faces, texture coordinates, paint) -> Mesh, Diffuse or Patches

A paint is the base colour of a material: a linear factor, times a picture. Pieces without coordinates have the picture
projected along the nearest axis, as have meshes of files without any.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from qsim import limits
from qsim.scene.bands import Colour
from qsim.scene.materials import Diffuse, Patches, Picture, Texture
from qsim.scene.scene import Mesh

Array = NDArray[np.float64]
OUTSIDE = 1e-6  # by which coordinates on a clamped axis may leave 0 .. 1


@dataclass(frozen=True, eq=False)
class Paint:
    """The base colour of a file's material."""

    where: str  # file and material, for messages
    factor: Colour = (1.0, 1.0, 1.0)  # linear, 0..1
    image: Callable[[], tuple[Picture, str]] | None = None  # reads the picture, and names it by its SHA-256
    wrap: tuple[str, str] = ("repeat", "repeat")  # of u and v: "repeat", "mirror" or "clamp"
    nearest: bool = False


class HasPaint(Protocol):
    """A piece of any file."""

    @property
    def paint(self) -> Paint | None:
        """The base colour of its faces."""


Painted = TypeVar("Painted", bound=HasPaint)


@dataclass(frozen=True, eq=False)
class Piece:
    """Faces of one paint."""

    vertices: Array  # [V, 3]
    faces: NDArray[np.int64]  # [F, 3]
    uv: Array | None  # [V, 2], v up
    paint: Paint | None  # None: the file states no material for it


def material_of(pieces: Sequence[Piece]) -> Diffuse | Patches | None:
    """Return the material of a mesh that has the faces of all pieces in their order; None if no piece has a paint.

    The pieces are those of `by_paint`.
    A piece without a paint beside others is white. `ValueError` and `FileNotFoundError` for pictures that are missing,
    cannot be read, or repeat in a way that cannot be shown, with the name of the file and of the material.
    """
    if all(piece.paint is None for piece in pieces):
        return None
    materials: list[Diffuse] = []
    counts: list[int] = []
    shown: dict[int, int] = {}  # pixels of each picture; materials may share one
    for _, group in itertools.groupby(pieces, lambda piece: id(piece.paint)):
        alike = list(group)
        paint = alike[0].paint or _WHITE
        texture = texture_of(paint, [piece.uv for piece in alike if piece.uv is not None])
        assert isinstance(texture.image, Picture)
        shown[id(texture.image.colours)] = texture.image.colours.size // 3
        if sum(shown.values()) > limits.TEXELS:
            raise ValueError(
                f"{paint.where}: the pictures of the file have over {limits.TEXELS} pixels in all; export smaller ones"
            )
        materials.append(Diffuse(texture))
        counts.append(sum(len(piece.faces) for piece in alike))
    return materials[0] if len(materials) == 1 else Patches(tuple(materials), tuple(counts))


def by_paint(pieces: Sequence[Painted]) -> list[Painted]:
    """Return pieces whose paints follow one another, in the order of their first piece."""
    first: dict[int, int] = {}
    for i, piece in enumerate(pieces):
        first.setdefault(id(piece.paint), i)
    return sorted(pieces, key=lambda piece: first[id(piece.paint)])


def texture_of(paint: Paint, coordinates: Sequence[Array]) -> Texture:
    """Return the texture of a paint, which is shown at these coordinates [V, 2] of some pieces."""
    factor = np.array(paint.factor, np.float32)
    if paint.image is None:
        return Texture(Picture(factor.reshape(1, 1, 3)))
    picture, source = paint.image()
    colours = picture.colours * factor if paint.factor != (1.0, 1.0, 1.0) else picture.colours
    wrap = list(paint.wrap)
    repeat = [1.0, 1.0]
    if wrap[0] != wrap[1] and coordinates:
        # Mitsuba wraps both axes alike. Within 0 .. 1 a mirrored picture is a clamped one, also between the outermost
        # texels, and a mirrored picture is its double, repeated half as often.
        for axis, name in enumerate("uv"):
            along = np.concatenate([each[:, axis] for each in coordinates])
            if wrap[axis] == "clamp" and (along.min() < -OUTSIDE or along.max() > 1 + OUTSIDE):
                raise ValueError(
                    f"{paint.where}: its picture is clamped along {name}, not along the other axis, and {name} runs "
                    f"from {along.min():.3g} to {along.max():.3g}; let it repeat along both axes"
                )
            wrap[axis] = wrap[axis].replace("clamp", "mirror")
        if wrap == ["mirror", "repeat"]:
            colours = np.concatenate([colours, colours[:, ::-1]], axis=1)
            repeat[0] = 0.5
        elif wrap == ["repeat", "mirror"]:
            colours = np.concatenate([colours[::-1], colours], axis=0)
            repeat[1] = 0.5
        wrap = ["mirror" if wrap[0] == wrap[1] else "repeat"]
    return Texture(
        Picture(np.ascontiguousarray(colours)),
        (repeat[0], repeat[1]),
        nearest=paint.nearest,
        source=source,
        wrap=wrap[0],
    )


def mesh_of(pieces: Sequence[Piece], projected: Callable[[Piece, float], Mesh], where: str, size: float | None) -> Mesh:
    """Return all pieces as one mesh, centred on its bounding box; `size` [m] scales its longest side.

    `projected` maps a piece without coordinates, one picture per length. The order of faces is that of the pieces.
    """
    if not sum(len(piece.faces) for piece in pieces):
        raise ValueError(f"mesh {where}: it contains no triangles")
    used = np.concatenate([piece.vertices[piece.faces].reshape(-1, 3) for piece in pieces])
    low = used.min(0)
    high = used.max(0)
    longest = float((high - low).max())
    if longest == 0:
        raise ValueError(f"mesh {where}: all its vertices lie in one point")
    corners = used.reshape(-1, 3, 3)
    if not np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() > 0:
        raise ValueError(
            f"mesh {where}: all its triangles have no area; the file is damaged or of a kind not read here"
        )
    scale = 1.0 if size is None else size / longest
    vertices = []
    faces = []
    coordinates = []
    start = 0
    for piece in pieces:
        placed = replace(piece, vertices=(piece.vertices - (low + high) / 2) * scale)
        if placed.uv is None:
            flat = projected(placed, size or longest)
            assert flat.uv is not None
            placed = replace(placed, vertices=flat.vertices, faces=flat.faces.astype(np.int64), uv=flat.uv)
        assert placed.uv is not None
        vertices.append(placed.vertices)
        faces.append(placed.faces + start)
        coordinates.append(placed.uv)
        start += len(placed.vertices)
    return Mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(coordinates))


_WHITE = Paint("the default material")
