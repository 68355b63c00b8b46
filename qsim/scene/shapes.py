"""Builds meshes in metres from primitives, outlines, paths and noise, or reads them from files.

Unless stated otherwise, every mesh is centred on its origin and has texture coordinates. Solids of flat faces are
mapped face by face (a texture keeps its size in metres), round ones around and along their axis.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qsim import limits, opening
from qsim.scene.animated.gltf_body import GLTF_SUFFIXES, still_pieces
from qsim.scene.materials import Material
from qsim.scene.mesh_pieces import Piece, material_of, mesh_of
from qsim.scene.obj_file import obj_pieces
from qsim.scene.scene import Mesh

Array = NDArray[np.float64]
MESH_SUFFIXES = frozenset({".obj", ".ply", ".stl", ".off", ".glb", ".gltf"})

# Working with meshes -----------------------------------------------------------------------------------------------


def moved(mesh: Mesh, pose: Array) -> Mesh:
    """Return the mesh after a 4x4 matrix (rotation, shift, scale), with outward winding."""
    vertices = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
    faces = mesh.faces if np.linalg.det(pose[:3, :3]) > 0 else mesh.faces[:, ::-1]
    return Mesh(vertices, faces, mesh.uv, mesh.smooth)


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """Return several meshes as one, smooth if all are; missing texture coordinates become zeros."""
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    faces = np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=False)])
    uv = np.concatenate([np.zeros((len(m.vertices), 2)) if m.uv is None else m.uv for m in meshes])
    return Mesh(np.concatenate([m.vertices for m in meshes]), faces, uv, all(m.smooth for m in meshes))


def box_mapped(vertices: ArrayLike, faces: ArrayLike, size: float = 1.0) -> Mesh:
    """Return separate flat faces, each mapped along the axis nearest to its normal, one picture per `size` [m]."""
    corners = np.asarray(vertices, np.float64)[np.asarray(faces)]  # [F, 3, 3]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.argmax(np.abs(normal), axis=1)
    pair = np.array([[2, 1], [0, 2], [0, 1]])[axis]  # the coordinates that become u, v
    uv = np.take_along_axis(corners, np.repeat(pair[:, None, :], 3, axis=1), axis=2) / size
    flip = np.sign(normal[np.arange(len(axis)), axis]) * np.where(axis == 2, 1, -1)
    uv[..., 0] *= np.where(flip == 0, 1, flip)[:, None]  # readable from outside
    return Mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), uv.reshape(-1, 2) + 0.5)


# Sheets and primitives ---------------------------------------------------------------------------------------------


def sheet(width: float, height: float, columns: int = 1, rows: int = 1) -> Mesh:
    """Return a rectangle in the plane z = 0 facing +z, u to the right, v up, with `columns` x `rows` cells."""
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    vertices = np.stack([(u - 0.5) * width, (v - 0.5) * height, np.zeros_like(u)], -1).reshape(-1, 3)
    return Mesh(
        vertices, _grid_faces(rows + 1, columns + 1), np.stack([u, v], -1).reshape(-1, 2), smooth=rows * columns > 1
    )


def box(width: float, height: float, depth: float, texture_size: float = 1.0) -> Mesh:
    """Return a cuboid [m]."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    return box_mapped(corners * (width, height, depth), faces, texture_size)


def ball(radius: float, segments: int = 48) -> Mesh:
    """Return a smooth sphere of `segments` meridians and half as many parallels."""
    return revolved(
        [(radius * np.sin(a), -radius * np.cos(a)) for a in np.linspace(0, np.pi, segments // 2 + 1)], segments
    )


def torus(radius: float, tube: float, segments: int = 64) -> Mesh:
    """Return a smooth ring around the y axis: `radius` to the tube's centre line, `tube` the tube's radius."""
    angles = np.linspace(-np.pi, np.pi, segments // 2 + 1)
    return revolved([(radius + tube * np.cos(a), tube * np.sin(a)) for a in angles], segments)


def cylinder(radius: float, height: float, segments: int = 48, taper: float = 1.0) -> Mesh:
    """Return a faceted cylinder around y; `taper` is the top radius over the bottom radius, 0 a cone."""
    h = height / 2
    top = max(radius * taper, 0.0)
    side = revolved([(radius, -h), (top, h)], segments)
    caps = [revolved([(0, -h), (radius, -h)], segments)]
    if top > 0:
        caps.append(revolved([(top, h), (0, h)], segments))
    return merged([Mesh(m.vertices, m.faces, m.uv, smooth=False) for m in (side, *caps)])


def polyhedron(rng: np.random.Generator, radius: float, corners: int = 12, texture_size: float = 1.0) -> Mesh:
    """Return a random convex stone: the hull of `corners` points spread over a ball."""
    import trimesh

    points = rng.standard_normal((corners, 3))
    for _ in range(20):  # points repel one another: a rounder stone
        away = points[:, None] - points[None]
        points = points + 0.3 * (away / (np.sum(away**2, -1, keepdims=True) + 0.1)).sum(1) / corners
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    hull = trimesh.convex.convex_hull(points * radius * rng.uniform(0.85, 1.1, (corners, 1)))
    return box_mapped(hull.vertices, hull.faces, texture_size)


def blob(rng: np.random.Generator, radius: float, roughness: float = 0.25, segments: int = 96) -> Mesh:
    """Return a ball displaced by smooth noise (sums of plane waves in space); `roughness` is in radii."""
    mesh = ball(1.0, segments)
    push = np.zeros(len(mesh.vertices))
    for scale in (1.5, 2.5, 4.0, 6.5):
        waves = rng.standard_normal((6, 3)) * scale
        push += np.sin(mesh.vertices @ waves.T + rng.uniform(0, 2 * np.pi, 6)).sum(1) / (np.sqrt(3) * scale)
    return Mesh(mesh.vertices * radius * (1 + roughness * push)[:, None], mesh.faces, mesh.uv, smooth=True)


def revolved(profile: Sequence[tuple[float, float]], segments: int = 48) -> Mesh:
    """Return a smooth solid: a profile of (radius, y) revolved around y, with u around and v along the profile.

    The outside is on the right of the profile: it runs upwards for a cylinder's side.
    """
    line = np.asarray(profile, np.float64)
    u = np.linspace(0, 1, segments + 1)
    steps = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    angle = 2 * np.pi * u[None, :]
    r = line[:, :1]
    y = np.repeat(line[:, 1:], segments + 1, axis=1)
    vertices = np.stack([r * np.sin(angle), y, r * np.cos(angle)], -1).reshape(-1, 3)
    uv = np.stack(np.broadcast_arrays(u[None, :], (steps / steps[-1])[:, None]), -1).reshape(-1, 2)
    return Mesh(vertices, _grid_faces(len(line), segments + 1), uv, smooth=True)


# Outlines and paths ------------------------------------------------------------------------------------------------


def extruded(outlines: Sequence[ArrayLike], depth: float, texture_size: float = 1.0) -> Mesh:
    """Return a plate of closed outlines [N, 2] (x, y), z from -depth/2 to depth/2; inner outlines are holes."""
    loops = [_without_repeats(np.asarray(loop, np.float64)) for loop in outlines]
    flat, triangles = filled(loops)
    front = np.column_stack([flat, np.full(len(flat), depth / 2)])
    back = front * (1, 1, -1)
    vertices = [front, back]
    faces = [triangles, triangles[:, ::-1] + len(flat)]
    start = 2 * len(flat)
    for loop in loops:
        n = len(loop)
        ring = np.column_stack([loop, np.full(n, depth / 2)])
        i = np.arange(n)
        j = (np.arange(n) + 1) % n
        wall = np.concatenate([np.stack([i, i + n, j + n], 1), np.stack([i, j + n, j], 1)])
        if not _outside_is_right(loop, loops):
            wall = wall[:, ::-1]
        vertices += [ring, ring * (1, 1, -1)]
        faces.append(wall + start)
        start += 2 * n
    return box_mapped(np.concatenate(vertices), np.concatenate(faces), texture_size)


def filled(loops: Sequence[Array]) -> tuple[Array, NDArray[np.int64]]:
    """Return the inside (even-odd) of closed loops [N, 2] as points [P, 2] and counter-clockwise triangles [T, 3].

    The inside is cut into trapezoids between neighbouring heights. No edge ends in a band between two vertices, and
    every second gap between the edges sorted along x is inside. Loops must not cross one another.
    """
    start = np.concatenate(loops)
    end = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
    heights = np.unique(start[:, 1])
    points: list[Array] = []
    for low, high in itertools.pairwise(heights):
        a = np.minimum(start[:, 1], end[:, 1])
        b = np.maximum(start[:, 1], end[:, 1])
        crossing = (a <= low) & (b >= high) & (b > a)
        p = start[crossing]
        q = end[crossing]
        slope = (q[:, 0] - p[:, 0]) / (q[:, 1] - p[:, 1])
        x = np.stack([p[:, 0] + slope * (y - p[:, 1]) for y in (low, high)], 1)
        x = x[np.argsort(x.sum(1), kind="stable")]
        for left, right in zip(x[0::2], x[1::2], strict=True):
            points.append(np.array([[left[0], low], [right[0], low], [right[1], high], [left[1], high]]))
    if not points:
        raise ValueError("the outline has no area: all its points lie on one line")
    quads = 4 * np.arange(len(points))[:, None]
    return np.concatenate(points), np.concatenate([quads + np.array(t) for t in ((0, 1, 2), (0, 2, 3))])


def wire(path: ArrayLike, radius: float, sides: int = 8, closed: bool = False) -> Mesh:
    """Return a tube of `radius` along a path [N, 3]: with open ends, or closed from the last point to the first.

    Frames follow the path by parallel transport. The twist that a closed path accumulates is spread over it.
    """
    points = np.asarray(path, np.float64)
    tangent = np.gradient(np.concatenate([points[-1:], points, points[:1]]), axis=0)[1:-1] if closed else None
    tangent = np.gradient(points, axis=0) if tangent is None else tangent
    tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent[0], np.eye(3)[int(np.argmin(np.abs(tangent[0])))])
    sides_along = []
    for along in [*tangent, tangent[0]]:
        # Projected onto the next normal plane the side turns as little as it can: parallel transport.
        side = side - along * (side @ along)
        side = side / np.linalg.norm(side)
        sides_along.append(side)
    first = sides_along[0]
    last = sides_along[-1]
    gained = float(np.arctan2(np.cross(first, last) @ tangent[0], first @ last)) if closed else 0.0
    rings = []
    around = np.linspace(0, 2 * np.pi, sides + 1)
    for i, (place, along) in enumerate(zip(points, tangent, strict=True)):
        angle = (around - gained * i / len(points))[:, None]
        across = np.cross(along, sides_along[i])
        rings.append(place + radius * (np.cos(angle) * sides_along[i] + np.sin(angle) * across))
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    if closed:
        rings = [*rings, rings[0]]
        length = np.append(length, length[-1] + np.linalg.norm(points[0] - points[-1]))
    uv = np.stack(np.broadcast_arrays(around[None, :] / (2 * np.pi), (length / length[-1])[:, None]), -1)
    return Mesh(np.concatenate(rings), _grid_faces(len(rings), sides + 1), uv.reshape(-1, 2), smooth=True)


def mesh_file(path: str | Path, size: float | None = None) -> Mesh:
    """Return all meshes of a file as one, centred on its bounding box; `size` [m] scales its longest side.

    Texture coordinates are those of the file (.obj, .glb, .gltf); where it has none, a picture is projected along the
    nearest axis. Normals of the file are left out: faces are flat. `mesh_material` returns its material.
    `FileNotFoundError`, or `ValueError` with the name of a file that cannot be read.
    """
    pieces = _pieces(Path(path))
    if pieces is None:
        return _trimesh_file(path, size)
    return mesh_of(pieces, lambda piece, length: box_mapped(piece.vertices, piece.faces, length), str(path), size)


def mesh_material(path: str | Path) -> Material | None:
    """Return the base colours of an .obj, .glb or .gltf file as the material of its `mesh_file` or `animated_file`.

    A file with several materials has `Patches`. Pictures become luminance in scenes of one band. None if the file
    states no material, and for other kinds of files. `FileNotFoundError` or `ValueError` for a picture or a file of
    materials that is missing, lies outside of the folder of the mesh, or cannot be read.
    """
    pieces = _pieces(Path(path))
    return None if pieces is None else material_of(pieces)


def _pieces(path: Path) -> list[Piece] | None:
    """Return the parts of a file with their coordinates and colours; None for a file that can have none."""
    try:
        opening.regular(path, most=limits.ASSET)
    except (FileNotFoundError, ValueError) as error:
        raise type(error)(f"mesh {error}") from None
    if path.suffix.lower() in GLTF_SUFFIXES:
        return still_pieces(path)
    has_more = re.compile(rb"(?m)^(\xef\xbb\xbf)?\s*(vt|mtllib)\s")
    if path.suffix.lower() == ".obj" and has_more.search(opening.content(path, most=limits.ASSET)):
        return obj_pieces(path)
    return None


def _trimesh_file(path: str | Path, size: float | None) -> Mesh:
    """Return the mesh of a file without texture coordinates, as `mesh_file`."""
    import trimesh

    try:
        loaded: Any = trimesh.load(path, force="mesh")
    except Exception as error:  # trimesh raises many types for a broken file
        raise ValueError(f"mesh {path}: not readable ({error})") from error
    vertices = np.asarray(loaded.vertices, np.float64)
    if len(vertices) == 0 or len(loaded.faces) == 0:
        raise ValueError(f"mesh {path}: it contains no triangles")
    low = vertices.min(0)
    high = vertices.max(0)
    longest = float((high - low).max())
    if longest == 0:
        raise ValueError(f"mesh {path}: all its vertices lie in one point")
    if not loaded.area > 0:
        raise ValueError(f"mesh {path}: all its triangles have no area; the file is damaged or of a kind not read here")
    scale = 1.0 if size is None else size / longest
    return box_mapped((vertices - (low + high) / 2) * scale, loaded.faces, size or longest)


def _grid_faces(rows: int, columns: int) -> NDArray[np.int64]:
    """Return two counter-clockwise triangles per cell of a vertex grid, rows upwards, columns to the right."""
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (corner.reshape(-1) for corner in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def _without_repeats(loop: Array) -> Array:
    """Return a closed loop without points equal to their predecessor."""
    keep = np.any(np.abs(loop - np.roll(loop, 1, axis=0)) > 1e-12, axis=1)
    return loop[keep]


def _outside_is_right(loop: Array, loops: Sequence[Array]) -> bool:
    """Return whether the inside of the complete figure is on the left of the loop."""
    area = 0.5 * np.sum(loop[:, 0] * np.roll(loop[:, 1], -1) - loop[:, 1] * np.roll(loop[:, 0], -1))
    depth = sum(_contains(other, loop[0]) for other in loops if other is not loop)
    return bool((area > 0) == (depth % 2 == 0))


def _contains(loop: Array, point: Array) -> bool:
    """Return whether a point lies inside one closed loop (even-odd)."""
    x, y = point
    p = loop
    q = np.roll(loop, -1, axis=0)
    # A ray to the right crosses the loop an odd number of times from inside; one end of each edge counts, not both.
    straddles = (p[:, 1] > y) != (q[:, 1] > y)
    p = p[straddles]
    q = q[straddles]
    return bool(np.sum(x < p[:, 0] + (y - p[:, 1]) / (q[:, 1] - p[:, 1]) * (q[:, 0] - p[:, 0])) % 2)
