"""Reads one body from a glTF file: animated, its mesh and the motion of its vertices, or at rest, its pieces.

    body.glb -> Mesh, Skinned          body.glb -> pieces

All meshes of the file's scene become one mesh. A mesh with a skin follows the joints of the skin; one without follows
its node. Normals are computed again from the vertices. Cameras and lights of the file are left out.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import numpy as np
from msgspec import Meta

from qsim import limits
from qsim.kinds import Count, Number
from qsim.records import convert
from qsim.scene.animated.draco import unpacked
from qsim.scene.animated.gltf_buffers import Accessor, Document, entries_of, open_document
from qsim.scene.animated.gltf_materials import Paints
from qsim.scene.animated.gltf_nodes import (
    Indices,
    Node,
    animation_names,
    chosen_animation,
    fixed,
    joints_of,
    nodes_of,
    parents_first,
    tracks_of,
)
from qsim.scene.animated.skinning import LARGEST, Joint, Morph, Skinned, check_shares
from qsim.scene.animated.tracks import Clock, Fixed, Keyed, Track
from qsim.scene.mesh_pieces import Paint, Piece, by_paint
from qsim.scene.motion import Motion, Still
from qsim.scene.rotation import pose_matrix
from qsim.scene.scene import Mesh

GLTF_SUFFIXES = (".glb", ".gltf")
ROUNDING = 0.01  # by which the weights of a file may differ from a sum of 1: four bytes round by less
# modes; those from points to before triangles are points and lines
POINTS = 0
TRIANGLES = 4
STRIP = 5
FAN = 6

Attributes = dict[Annotated[str, Meta(pattern=r"^\w+$")], Count]  # of what -> accessor


class Primitive(TypedDict):
    attributes: Attributes
    indices: NotRequired[Count]
    mode: NotRequired[Count]
    material: NotRequired[Count]
    targets: NotRequired[list[Attributes]]


class MeshEntry(TypedDict):
    primitives: Annotated[list[Any], Meta(min_length=1)]
    weights: NotRequired[list[Number]]


class Skin(TypedDict):
    joints: Indices
    inverseBindMatrices: NotRequired[Count]


class SceneEntry(TypedDict):
    nodes: NotRequired[Indices]


class SceneChoice(TypedDict):
    scene: NotRequired[Count]


@dataclass(frozen=True, eq=False)
class FilePiece:
    """One primitive of a node: vertices in the coordinates of its joints."""

    vertices: np.ndarray  # [V, 3]
    faces: np.ndarray  # [F, 3]
    uv: np.ndarray  # [V, 2], NaN where the file has none
    smooth: bool
    owners: np.ndarray  # [V, n]
    shares: np.ndarray  # [V, n]
    displacements: np.ndarray  # [M, V, 3]
    weights: Track | None  # [K, M]
    paint: Paint | None
    material: int | None = None  # of the file
    normals: np.ndarray | None = None  # [V, 3]
    colours: np.ndarray | None = None  # [V, 3], linear


def animations_in(path: str | Path) -> list[str]:
    """Return the names of the animations in a .glb or .gltf file; one without a name has its number."""
    return animation_names(open_document(Path(path)))


def animated_file(
    path: str | Path,
    size: float | None = None,
    *,
    animation: str | None = None,
    speed: float = 1.0,
    start: float = 0.0,
    repeat: bool = True,
    carrier: Motion | None = None,
) -> tuple[Mesh, Skinned]:
    """Return the mesh of a .glb or .gltf file and its motion, centred on the bounding box of the first pose.

    `size` [m] scales the longest side of that pose. `animation` may be left out for a file with one. `start` [s] is the
    time of the animation at t = 0 and `speed` its rate. At its end it starts again, or with `repeat=False` holds its
    last pose. `carrier` moves the complete body. `FileNotFoundError` for a missing file or buffer, `ValueError` with
    the name of the file and the entry for one that is damaged, that has no animation, or whose skin is incomplete.
    """
    document = unpacked(open_document(Path(path)))
    nodes = nodes_of(document)
    targets = {i: n for i, node in enumerate(nodes) if (n := target_count(document, node))}
    tracks = tracks_of(document, chosen_animation(document, animation), nodes, targets)
    pieces, joints = _read(document, nodes, tracks)
    clock = Clock(speed, start, max(float(track.times[-1]) for track in tracks.values()), repeat)
    return _joined(document, pieces, joints, clock, size, carrier or Still())


def still_pieces(path: str | Path) -> list[Piece]:
    """Return the faces of a .glb or .gltf file in the pose of its nodes, without any animation, and their paints.

    Points and lines are left out. Faces have the order of `animated_file`. Errors as of `animated_file`.
    """
    document = unpacked(open_document(Path(path)))
    pieces, joints = _read(document, nodes_of(document), {})
    raw = unscaled(pieces, joints)
    check_reach(document, raw)
    vertices = raw.deform(0.0)
    mirrored = np.linalg.det(raw.matrices(0.0)[:, :3, :3]) < 0
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)]).tolist()
    return [
        Piece(
            vertices[start : start + len(piece.vertices)],
            outward(piece, mirrored),
            None if np.isnan(piece.uv).any() else piece.uv,
            piece.paint,
        )
        for start, piece in zip(starts, pieces, strict=False)
    ]


def _read(
    document: Document, nodes: list[Node], tracks: dict[tuple[int, str], Track]
) -> tuple[list[FilePiece], list[Joint]]:
    """Return all primitives of the file's scene, and the joints that they follow."""
    order, parents = parents_first(document, nodes)
    joints, number = joints_of(document, nodes, tracks, order, parents)
    paints = Paints(document)
    pieces: list[FilePiece] = []
    told: list[str] = []
    for i in shown_nodes(document, nodes, order, parents):
        if "mesh" not in nodes[i]:
            continue
        for piece in pieces_of_node(document, i, nodes, tracks, joints, number, paints, told.append):
            pieces.append(piece)
            if sum(len(each.vertices) for each in pieces) > limits.VERTICES:  # a small file can name one array often
                raise ValueError(f"{document.path}: its meshes have more than {limits.VERTICES} vertices in all")
    if not pieces:
        raise ValueError(f"{document.path}: its scene has no mesh")
    if told:
        warnings.warn(f"{document.path}: {'; '.join(told[:10])}", stacklevel=4)
    return by_paint(pieces), joints


def shown_nodes(document: Document, nodes: list[Node], order: list[int], parents: Mapping[int, int]) -> Iterator[int]:
    """Yield the nodes of the file's scene; without scenes, all nodes."""
    scenes = entries_of(document.path, document.content, "scenes")
    if not scenes:
        yield from order
        return
    about = convert(document.content, SceneChoice, str(document.path))
    roots = set(document.entry("scenes", about.get("scene", 0), SceneEntry, "scene").get("nodes", []))
    # Parents come first, so that a child finds its parent among the roots.
    for i in order:
        if i in roots or parents.get(i) in roots:
            roots.add(i)
            yield i


def target_count(document: Document, node: Node) -> int:
    """Return how many morph targets the mesh of a node has."""
    if "mesh" not in node:
        return 0
    mesh = document.entry("meshes", node["mesh"], MeshEntry, "a node")
    where = f"{document.path}: meshes[{node['mesh']}]"
    counts = {
        len(convert(each, Primitive, f"{where}.primitives[{i}]").get("targets", []))
        for i, each in enumerate(mesh["primitives"])
    }
    if len(counts) > 1:
        raise ValueError(f"{where}: its primitives have {sorted(counts)} morph targets; all need as many")
    return counts.pop()


def pieces_of_node(
    document: Document,
    number: int,
    nodes: list[Node],
    tracks: Mapping[tuple[int, str], Track],
    joints: list[Joint],
    joint_of: Mapping[int, int],
    paints: Paints,
    tell: Callable[[str], None],
) -> Iterator[FilePiece]:
    """Yield the primitives of a node; joints that a skin adds are appended to `joints`.

    Points and lines of a file that does not move are left out, and `tell` hears of them.
    """
    node = nodes[number]
    mesh = document.entry("meshes", node["mesh"], MeshEntry, f"nodes[{number}]")
    # glTF: a skinned mesh follows its bones alone; the transform of its own node is ignored.
    bones = _bones(document, node["skin"], f"nodes[{number}]", joints, joint_of) if "skin" in node else None
    for i, each in enumerate(mesh["primitives"]):
        where = f"meshes[{node['mesh']}].primitives[{i}]"
        primitive = convert(each, Primitive, f"{document.path}: {where}")
        attributes = primitive["attributes"]
        mode = primitive.get("mode", TRIANGLES)
        if POINTS <= mode < TRIANGLES and not tracks:
            tell(f"{where}: points or lines are left out")
            continue
        if mode not in (TRIANGLES, STRIP, FAN):
            raise ValueError(f"{document.path}: {where} is not made of triangles (mode 4); export triangles")
        if "POSITION" not in attributes:
            raise ValueError(f"{document.path}: {where} has no POSITION")
        vertices = document.array(attributes["POSITION"], where, "VEC3").astype(np.float64)
        count = len(vertices)
        # A vertex belongs to its node, or in shares to the bones of a skin
        if bones is None:
            owners = np.full((count, 1), joint_of[number])
            shares = np.ones((count, 1))
        else:
            owners, shares = _influences(document, attributes, where, count, len(bones))
            owners = bones[owners]
        placed = paints.coordinates(primitive.get("material"), attributes, where, count)
        uv = np.full((count, 2), np.nan) if placed is None else placed
        displacements = np.array(
            [
                document.array(target["POSITION"], where, "VEC3", count)
                if "POSITION" in target
                else np.zeros((count, 3))
                for target in primitive.get("targets", [])
            ],
            np.float64,
        ).reshape(-1, count, 3)
        weights = _weights(document, number, node, mesh, tracks, len(displacements)) if len(displacements) else None
        faces = _faces(document, primitive, where, count)
        paint = paints.paint(primitive.get("material"), where)
        yield FilePiece(
            vertices,
            faces,
            uv,
            "NORMAL" in attributes,
            owners,
            shares,
            displacements,
            weights,
            paint,
            primitive.get("material"),
            document.array(attributes["NORMAL"], where, "VEC3", count) if "NORMAL" in attributes else None,
            _colours(document, attributes, where, count),
        )


def _colours(document: Document, attributes: Mapping[str, int], where: str, count: int) -> np.ndarray | None:
    """Return the linear colours [V, 3] of vertices, without their opacity; None if the file has none."""
    if "COLOR_0" not in attributes:
        return None
    about = document.entry("accessors", attributes["COLOR_0"], Accessor, where)
    found = document.array(attributes["COLOR_0"], where, "VEC4" if about["type"] == "VEC4" else "VEC3", count)
    return np.clip(found[:, :3].astype(np.float64), 0, 1)


def _bones(document: Document, skin: int, by: str, joints: list[Joint], joint_of: Mapping[int, int]) -> np.ndarray:
    """Return the joints of a skin, each behind its node and with its inverse bind matrix; they are appended."""
    about = document.entry("skins", skin, Skin, by)
    missing = [node for node in about["joints"] if node not in joint_of]
    if missing or not about["joints"]:
        found = missing[0] if missing else "none"
        raise ValueError(f"{document.path}: skins[{skin}]: its joints need nodes, found {found}")
    binds = np.tile(np.eye(4).ravel(), (len(about["joints"]), 1))
    if "inverseBindMatrices" in about:
        binds = document.array(about["inverseBindMatrices"], f"skins[{skin}]", "MAT4", len(binds))
    first = len(joints)
    where = f"{document.path}: skins[{skin}]"
    joints += [Joint(fixed(where, bind), joint_of[node]) for node, bind in zip(about["joints"], binds, strict=True)]
    return np.arange(first, len(joints))


def _influences(
    document: Document, attributes: Mapping[str, int], where: str, count: int, joints: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the joints [V, n] of a skin and the weights [V, n] of its vertices, from all sets of four."""
    sets = [i for i in range(len(attributes)) if f"JOINTS_{i}" in attributes or f"WEIGHTS_{i}" in attributes]
    for i in sets or [0]:
        for name in (f"JOINTS_{i}", f"WEIGHTS_{i}"):
            if name not in attributes:
                raise ValueError(f"{document.path}: {where} has a skin but no {name}")
    owners, shares = (
        np.concatenate([document.array(attributes[f"{name}_{i}"], where, "VEC4", count) for i in sets], axis=1)
        for name in ("JOINTS", "WEIGHTS")
    )
    if owners.dtype != np.int64:
        raise ValueError(f"{document.path}: {where}: JOINTS are whole numbers, found an accessor of other numbers")
    return owners, check_shares(f"{document.path}: {where}", owners, shares, count, joints, ROUNDING)


def _weights(
    document: Document,
    number: int,
    node: Mapping[str, Any],
    mesh: Mapping[str, Any],
    tracks: Mapping[tuple[int, str], Track],
    targets: int,
) -> Track:
    """Return the morph weights of a node: animated, its own, those of its mesh, or zeros."""
    if (number, "weights") in tracks:
        return tracks[number, "weights"]
    found = node.get("weights", mesh.get("weights", [0.0] * targets))
    if len(found) != targets:
        raise ValueError(f"{document.path}: nodes[{number}]: {len(found)} weights for {targets} morph targets")
    return Track.constant(found)


def _faces(document: Document, primitive: Mapping[str, Any], where: str, count: int) -> np.ndarray:
    """Return triangles [F, 3]."""
    if "indices" not in primitive:
        corners = np.arange(count)
    else:
        corners = document.array(primitive["indices"], where, "SCALAR")[:, 0]
    mode = primitive.get("mode", TRIANGLES)
    whole = len(corners) % 3 == 0 if mode == TRIANGLES else len(corners) >= 3
    if not whole or corners.dtype != np.int64 or corners.max() >= count or corners.min() < 0:
        raise ValueError(f"{document.path}: {where}: triangles need three indices each, of its {count} vertices")
    if mode == TRIANGLES:
        return corners.reshape(-1, 3)
    if mode == FAN:
        return np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], axis=1)
    strip = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    strip[1::2] = strip[1::2, [1, 0, 2]]  # every second triangle runs the other way
    return strip


def _joined(
    document: Document, pieces: list[FilePiece], joints: list[Joint], clock: Clock, size: float | None, carrier: Motion
) -> tuple[Mesh, Skinned]:
    """Return all pieces as one mesh and one motion, centred and scaled."""
    if size is not None and not 0 < size < np.inf:
        raise ValueError(f"animated_file: size must be a length above 0 [m], got {size!r}")
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)]).tolist()
    raw = unscaled(pieces, joints)
    moment = clock.at(0.0)
    reach = check_reach(document, raw)
    first = raw.deform(moment)
    scale, place = centring(document, first, size)
    if not 2 * reach * scale <= LARGEST:
        raise ValueError(f"{document.path}: scaled by {scale:.2g} to {size:g} m, it moves beyond {LARGEST:g} m")
    motion = replace(raw, joints=(Joint(Fixed(place)), *raw.joints[1:]), clock=clock, carrier=carrier)
    vertices = motion.deform(0.0)
    uv = np.concatenate([piece.uv for piece in pieces])
    longest = float(np.ptp(first, axis=0).max())
    # Without coordinates of its own a texture is laid on from the front, once over the longest side.
    uv = np.where(np.isnan(uv), vertices[:, :2] / (longest * scale) + 0.5, uv)
    mirrored = np.linalg.det(motion.matrices(moment)[:, :3, :3]) < 0
    faces = [outward(piece, mirrored) + start for piece, start in zip(pieces, starts, strict=False)]
    return Mesh(vertices, np.concatenate(faces), uv, all(piece.smooth for piece in pieces)), motion


def centring(document: Document, vertices: np.ndarray, size: float | None) -> tuple[float, np.ndarray]:
    """Return the factor that makes the longest side of vertices [V, 3] `size` [m], and the pose that also centres them.

    `ValueError` if they lie in one point.
    """
    low = vertices.min(0)
    high = vertices.max(0)
    longest = float((high - low).max())
    if not longest > 0:
        raise ValueError(f"{document.path}: all its vertices lie in one point")
    scale = 1.0 if size is None else size / longest
    return scale, pose_matrix(scale * np.eye(3), -scale * (low + high) / 2)


def outward(piece: FilePiece, mirrored: np.ndarray) -> np.ndarray:
    """Return the faces of a piece, wound the other way if its first joint mirrors it."""
    return piece.faces[:, ::-1] if mirrored[piece.owners[0, 0]] else piece.faces


def unscaled(pieces: list[FilePiece], joints: list[Joint]) -> Skinned:
    """Return all pieces as one motion in the lengths of the file."""
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)]).tolist()
    most = max(piece.owners.shape[1] for piece in pieces)
    # Pieces have other numbers of bones per vertex: those that are missing get the weight 0.
    wide = [((0, 0), (0, most - piece.owners.shape[1])) for piece in pieces]
    return Skinned(
        np.concatenate([piece.vertices for piece in pieces]),
        tuple(joints),
        np.concatenate([np.pad(piece.owners, pad) for piece, pad in zip(pieces, wide, strict=True)]),
        np.concatenate([np.pad(piece.shares, pad) for piece, pad in zip(pieces, wide, strict=True)]),
        tuple(
            Morph(start, piece.displacements, piece.weights)
            for start, piece in zip(starts, pieces, strict=False)
            if piece.weights is not None
        ),
    )


def check_reach(document: Document, body: Skinned) -> float:
    """Return a distance [m] that no vertex exceeds; `ValueError` if that is too far."""
    with np.errstate(over="ignore", invalid="ignore"):
        reach = _reach(body)
    if not reach <= LARGEST:
        raise ValueError(f"{document.path}: its numbers let vertices move {reach:.2g} m away, beyond {LARGEST:g} m")
    return reach


def _reach(body: Skinned) -> float:
    """Return a distance [m] from the origin that no vertex exceeds at any time."""
    grown: list[tuple[float, float]] = []  # factor and shift of each joint
    for joint in body.joints:
        assert isinstance(joint.motion, Keyed | Fixed)
        factor, shift = joint.motion.bounds()
        above = grown[joint.parent] if joint.parent >= 0 else (1.0, 0.0)
        # A motion scales a length by at most `factor` and moves it by at
        # most `shift`; chains of joints multiply and add these.
        grown.append((above[0] * factor, above[0] * shift + above[1]))
    farthest = float(np.linalg.norm(body.rest, axis=1).max())
    for morph in body.morphs:
        longest = np.linalg.norm(morph.displacements, axis=2).max(axis=1)
        farthest += float(longest.sum()) * morph.weights.largest()
    factors, shifts = np.array(grown)[np.unique(body.owners)].T
    return float(np.max(factors * farthest + shifts))  # NaN if one is
