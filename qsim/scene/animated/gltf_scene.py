"""Reads a complete scene from a glTF file: its bodies with their materials, its lights, and one of its cameras.

    scene.glb -> Scene

A node is a body; each material of its mesh is one more. What moves rigidly has a rigid motion; skins, morph targets and
scales that change deform their body. What the program does not model is named in one warning, what it cannot
understand is refused. Source: Khronos, glTF 2.0.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypedDict

import numpy as np

from qsim import limits
from qsim.checks import suggest
from qsim.kinds import Count
from qsim.optics.camera import Camera
from qsim.optics.radiometry import RGB
from qsim.records import convert
from qsim.scene.animated.attached import Attached, inverse, placement, rigid_part
from qsim.scene.animated.draco import unpacked
from qsim.scene.animated.gltf_body import (
    FilePiece,
    centring,
    check_reach,
    outward,
    pieces_of_node,
    shown_nodes,
    target_count,
    unscaled,
)
from qsim.scene.animated.gltf_buffers import DRACO, Document, open_document
from qsim.scene.animated.gltf_materials import WEBP, Paints
from qsim.scene.animated.gltf_nodes import (
    Node,
    Tracks,
    animation_names,
    check_quaternions,
    chosen_animation,
    joints_of,
    nodes_of,
    parents_first,
    tracks_of,
)
from qsim.scene.animated.gltf_surfaces import MATERIALS, Surfaces
from qsim.scene.animated.gltf_views import PUNCTUAL, camera_names, camera_of, light_of
from qsim.scene.animated.skinning import Joint, Placed
from qsim.scene.animated.tracks import Clock, Fixed, Keyed, rotation_of
from qsim.scene.lights import Constant, Light
from qsim.scene.scene import Body, Mesh, Scene

INSTANCES = "EXT_mesh_gpu_instancing"
UNDERSTOOD = (*MATERIALS, "KHR_texture_transform", WEBP, PUNCTUAL, "KHR_mesh_quantization", DRACO, INSTANCES)
EVEN = 1e-6  # relative difference of lengths up to which a placement scales evenly


class LightChoice(TypedDict):
    light: Count


class Copies(TypedDict):
    attributes: dict[str, Count]


def cameras_in(path: str | Path) -> list[str]:
    """Return the names of the cameras that a .glb or .gltf file shows; errors as of `read_gltf`."""
    return list(_File(open_document(Path(path), UNDERSTOOD)).cameras())


def read_gltf(
    path: str | Path,
    *,
    camera: str | None = None,
    animation: str | None = None,
    speed: float = 1.0,
    start: float = 0.0,
    repeat: bool = True,
    seed: int = 0,
    bands: Literal["rgb"] | None = None,
) -> Scene:
    """Return the scene of a .glb or .gltf file in metres, seen by a camera of the file.

    `camera` is the name of its node, needed where the file has several. All animations play at once; where two of them
    move the same node, `animation` names one. `start` [s] is their time at t = 0 and `speed` their rate. At the end of
    the longest they start again, or with `repeat=False` hold the last pose. Candela and lux are divided by 683 lm/W,
    an emission of 1 is 1 W m^-2 sr^-1. A file without light is lit evenly by 1 W m^-2 sr^-1. With `bands="rgb"` the
    scene has colours, else their luminance.

    `FileNotFoundError` for a missing file, picture or buffer; `ValueError` for a damaged file, one without a
    perspective camera or a mesh, or one that requires an extension that is not read. A `UserWarning` names all that is
    left out.
    """
    document = unpacked(open_document(Path(path), UNDERSTOOD))
    file = _File(document)
    played = file.played(animation)
    clock = _clock(played, speed, start, repeat=repeat)
    stage = _Stage(file, played, clock, coloured=bands == "rgb")
    names = file.cameras()
    if not names:
        raise ValueError(f"{path}: has no camera; export the cameras, too (Blender: Include, Cameras)")
    if camera is None and len(names) > 1:
        raise ValueError(f"{path}: has {len(names)} cameras, choose one: {', '.join(list(names)[:20])}")
    if camera is not None and camera not in names:
        raise ValueError(f"{path}: has no camera {camera!r}{suggest(camera, names)}; there are {', '.join(names)}")
    chosen = names[camera if camera is not None else next(iter(names))]
    bodies = tuple(stage.bodies())
    lights = tuple(stage.lights())
    seen = Scene(
        Path(path).stem,
        seed,
        stage.camera(chosen),
        lights or (() if any(_glows(body) for body in bodies) else (Constant(1.0),)),
        bodies,
        speed,
        bands=RGB if bands == "rgb" else None,
    )
    if seen.lights and not lights:
        stage.tell("no light: lit evenly by 1 W m^-2 sr^-1")
    stage.warn()
    return seen


def gltf_parts(
    path: str | Path,
    size: float,
    *,
    pose: np.ndarray | None = None,
    animation: str | None = None,
    speed: float = 1.0,
    start: float = 0.0,
    bands: Literal["rgb"] | None = None,
) -> tuple[Body, ...]:
    """Return the meshes of a .glb or .gltf file as bodies with its materials; none if it states no material or colour.

    The bounding box of the first pose is centred, its longest side becomes `size` [m], and `pose` [4, 4] places it.
    The `animation` of this name plays again and again at `speed`, from `start` [s] on; without a name nothing moves.
    Cameras and lights are left out. Colours, errors and the warning are as of `read_gltf`.
    """
    document = unpacked(open_document(Path(path), UNDERSTOOD))
    file = _File(document)
    played = {} if animation is None else file.played(animation)
    clock = _clock(played, speed, start, repeat=True)
    coloured = bands == "rgb"
    as_stored = _Stage(file, played, clock, coloured)
    if not as_stored.has_materials():
        return ()
    corners = np.concatenate([in_first_pose(body) for body in as_stored.bodies()])
    _, centred = centring(document, corners, size)
    stage = _Stage(file, played, clock, coloured, centred if pose is None else pose @ centred)
    bodies = tuple(stage.bodies())
    if any(PUNCTUAL in node.get("extensions", {}) for node in file.nodes):
        stage.tell("the lights of a file that is shown without its own camera are left out")
    stage.warn()
    return bodies


def _clock(played: Tracks, speed: float, start: float, *, repeat: bool) -> Clock:
    """Return the clock of tracks; they are as long as the longest."""
    length = max((float(track.times[-1]) for track in played.values()), default=0.0)
    return Clock(speed, start, length, repeat)


def in_first_pose(body: Body) -> np.ndarray:
    """Return the vertices of a body in the world at t = 0, [V, 3]."""
    pose = body.pose(0.0)
    return body.vertices(0.0) @ pose[:3, :3].T + pose[:3, 3]


def _glows(body: Body) -> bool:
    return bool(getattr(body.material, "glows", False))


@dataclass(frozen=True, eq=False)
class _File:
    """The nodes of a document that its scene shows."""

    document: Document
    nodes: list[Node] = field(init=False)
    order: list[int] = field(init=False)
    parents: dict[int, int] = field(init=False)
    shown: list[int] = field(init=False)

    def __post_init__(self) -> None:
        document = self.document
        nodes = nodes_of(document)
        order, parents = parents_first(document, nodes)
        shown = list(shown_nodes(document, nodes, order, parents))
        for name, value in (("nodes", nodes), ("order", order), ("parents", parents), ("shown", shown)):
            object.__setattr__(self, name, value)

    def cameras(self) -> dict[str, int]:
        """Return the node of each camera by name."""
        placed = [i for i in self.shown if "camera" in self.nodes[i]]
        named = [(self.nodes[i].get("name", ""), self.nodes[i]["camera"]) for i in placed]
        return dict(zip(camera_names(self.document, named), placed, strict=True))

    def played(self, animation: str | None) -> Tracks:
        """Return the tracks of all animations, or of one; `ValueError` where two move the same."""
        document = self.document
        names = animation_names(document)
        targets = {i: n for i, node in enumerate(self.nodes) if (n := target_count(document, node))}
        if animation is not None:
            return tracks_of(document, chosen_animation(document, animation), self.nodes, targets)
        found: Tracks = {}
        by: dict[tuple[int, str], str] = {}
        for number, name in enumerate(names):
            for key, track in tracks_of(document, number, self.nodes, targets).items():
                if key in found:
                    raise ValueError(
                        f"{document.path}: the animations {by[key]} and {name} both move nodes[{key[0]}], choose one: "
                        f"{', '.join(names[:20])}"
                    )
                found[key] = track
                by[key] = name
        return found

    def name(self, i: int) -> str:
        """Return the name of a node, or a made-up one."""
        return self.nodes[i].get("name") or f"node {i}"


class _Stage:
    """What a file shows while its animations play."""

    def __init__(
        self, file: _File, tracks: Tracks, clock: Clock, coloured: bool, place: np.ndarray | None = None
    ) -> None:
        self._file = file
        self._document = file.document
        self._tracks = tracks
        self._clock = clock
        self._coloured = coloured
        self._told: dict[str, None] = {}
        self._joints, self._joint_of = joints_of(self._document, file.nodes, tracks, file.order, file.parents)
        self._place = () if place is None else (Fixed(place),)  # of the complete file
        if self._place:
            self._joints[0] = Joint(self._place[0])
        self._paints = Paints(self._document, complete=True)
        self._surfaces = Surfaces(self._document, self._paints, coloured, self.tell)
        for name in self._document.content.get("extensionsUsed", []):
            if name not in UNDERSTOOD:
                self.tell(f"the extension {name!s:.60}")

    def tell(self, what: str) -> None:
        """Keep what was left out, for one warning."""
        self._told[what] = None

    def warn(self) -> None:
        """Warn of all that was left out."""
        if self._told:
            listed = "; ".join(list(self._told)[:10])
            more = len(self._told) - 10
            warnings.warn(
                f"{self._document.path}: not modelled as the file states it: {listed}"
                + (f"; and {more} more" if more > 0 else ""),
                stacklevel=3,
            )

    def camera(self, node: int) -> Camera:
        """Return the camera of a node."""
        number = self._file.nodes[node]["camera"]
        chain = self._chain(node)
        return camera_of(self._document, number, chain, self._clock, self._moves(node))

    def lights(self) -> Iterator[Light]:
        """Yield the lights of all nodes."""
        for i in self._file.shown:
            given = self._file.nodes[i].get("extensions", {}).get(PUNCTUAL)
            if given is not None:
                where = f"{self._document.path}: nodes[{i}]: {PUNCTUAL}"
                number = convert(given, LightChoice, where)["light"]
                yield light_of(
                    self._document,
                    number,
                    f"nodes[{i}]",
                    self._chain(i),
                    self._clock,
                    self._moves(i),
                    self._coloured,
                )

    def bodies(self) -> Iterator[Body]:
        """Yield a body per node with a mesh and per material of it."""
        names: set[str] = set()
        vertices = 0
        for i in self._file.shown:
            if "mesh" not in self._file.nodes[i]:
                continue
            for piece in self._pieces(i):
                vertices += len(piece.vertices)
                if vertices > limits.VERTICES or len(names) >= limits.BODIES:
                    raise ValueError(
                        f"{self._document.path}: its meshes have more than {limits.VERTICES} vertices or "
                        f"{limits.BODIES} parts in all"
                    )
                name = _unused(self._file.name(i), names)
                names.add(name)
                yield self._body(i, name, piece)
        if not names:
            raise ValueError(f"{self._document.path}: its scene has no mesh")

    def has_materials(self) -> bool:
        """Return whether the file states a material or colours for any of its faces."""
        pieces = (piece for i in self._file.shown if "mesh" in self._file.nodes[i] for piece in self._pieces(i))
        return any(piece.material is not None or piece.colours is not None for piece in pieces)

    def _pieces(self, i: int) -> Iterator[FilePiece]:
        """Yield the primitives of a node, repeated for each of its instances."""
        nodes = self._file.nodes
        found = pieces_of_node(
            self._document, i, nodes, self._tracks or _STILL, self._joints, self._joint_of, self._paints, self.tell
        )
        copies = nodes[i].get("extensions", {}).get(INSTANCES)
        if copies is None:
            yield from found
            return
        where = f"{self._document.path}: nodes[{i}]: {INSTANCES}"
        matrices = _copies(self._document, convert(copies, Copies, where)["attributes"], where)
        for piece in found:
            if piece.weights is not None or "skin" in nodes[i]:
                raise ValueError(f"{where}: a mesh with a skin or morph targets is repeated; make the copies real")
            if len(matrices) * len(piece.vertices) > limits.VERTICES:
                raise ValueError(f"{where}: its copies have more than {limits.VERTICES} vertices")
            yield _repeated(piece, matrices)

    def _body(self, node: int, name: str, piece: FilePiece) -> Body:
        """Return one primitive as a body: at rest in the world, moved rigidly, or deformed."""
        where = f"nodes[{node}]"
        raw = replace(unscaled([piece], self._joints), clock=self._clock)
        check_reach(self._document, raw)
        vertices = raw.deform(0.0)
        mirrored = np.linalg.det(raw.matrices(self._clock.at(0.0))[:, :3, :3]) < 0
        uv = None if np.isnan(piece.uv).any() else piece.uv
        material = self._surfaces.surface(piece.material, where, uv, piece.colours)
        faces = outward(piece, mirrored)
        mesh = Mesh(vertices, faces, uv, piece.smooth, _groups(piece))
        bends = piece.weights is not None or "skin" in self._file.nodes[node]
        if bends and self._tracks:
            return Body(name, mesh, material, raw)
        if bends or not self._moves(node):
            return Body(name, mesh, material)
        if not self._rigid(node):
            return Body(name, mesh, material, raw)
        # The body's own axes are those of the world, its origin is that of the node at t = 0.
        chain = self._chain(node)
        first = placement(chain, self._clock.at(0.0))
        origin = np.eye(4)
        origin[:3, 3] = first[:3, 3]
        motion = Attached(chain, self._clock, after=inverse(rigid_part(first)) @ origin)
        return Body(name, replace(mesh, vertices=vertices - first[:3, 3]), material, motion)

    def _ancestors(self, node: int) -> list[int]:
        """Return a node and all above it, outermost first."""
        found = [node]
        while found[-1] in self._file.parents:
            found.append(self._file.parents[found[-1]])
        return found[::-1]

    def _chain(self, node: int) -> tuple[Placed, ...]:
        return (*self._place, *(self._joints[self._joint_of[i]].motion for i in self._ancestors(node)))

    def _moves(self, node: int) -> bool:
        """Return whether any placement above a node changes over time."""
        return any((i, path) in self._tracks for i in self._ancestors(node) for path in _PLACES)

    def _rigid(self, node: int) -> bool:
        """Return whether a node keeps its lengths: no scale changes, and nothing turns below an uneven scale."""
        uneven = False
        for motion in self._chain(node):
            if isinstance(motion, Fixed):
                sizes = np.linalg.svd(motion.matrix[:3, :3], compute_uv=False)
                uneven = uneven or bool(sizes[0] - sizes[-1] > EVEN * sizes[0])
                continue
            assert isinstance(motion, Keyed)
            if np.ptp(motion.scale.values, axis=0).any() or (uneven and np.ptp(motion.rotation.values, axis=0).any()):
                return False
            sizes = np.abs(motion.scale.values[0])
            uneven = uneven or bool(np.ptp(sizes) > EVEN * sizes.max())
        return True


_PLACES = ("translation", "rotation", "scale")
_STILL: Tracks = {}


def _unused(name: str, names: set[str]) -> str:
    """Return a name, with a number if it is taken."""
    if name not in names:
        return name
    number = 2
    while f"{name} #{number}" in names:
        number += 1
    return f"{name} #{number}"


def _groups(piece: FilePiece) -> np.ndarray | None:
    """Return which vertices share a normal: those that are alike in place and normal, as on both sides of a seam."""
    if piece.normals is None:
        return None
    # What moves alike: place, normal, and for skins and morphs the same influences.
    rows = [piece.vertices, np.round(piece.normals, 3), piece.owners, piece.shares]
    rows += list(piece.displacements)
    joined = np.concatenate([np.asarray(each, np.float64) for each in rows], axis=1)
    _, groups = np.unique(joined, axis=0, return_inverse=True)
    groups = groups.reshape(-1)
    return None if groups.max() + 1 == len(groups) else groups


def _copies(document: Document, attributes: Mapping[str, int], where: str) -> np.ndarray:
    """Return the placement of each instance of a mesh, float64 [K, 4, 4]."""
    shapes = {"TRANSLATION": "VEC3", "ROTATION": "VEC4", "SCALE": "VEC3"}
    found = {
        name: document.array(attributes[name], where, shape).astype(np.float64)
        for name, shape in shapes.items()
        if name in attributes
    }
    counts = {len(values) for values in found.values()}
    if len(counts) != 1:
        raise ValueError(f"{where}: as many translations, rotations and scales are needed, found {sorted(counts)}")
    matrices = np.tile(np.eye(4), (counts.pop(), 1, 1))
    if "ROTATION" in found:
        check_quaternions(where, found["ROTATION"])
        unit = found["ROTATION"] / np.linalg.norm(found["ROTATION"], axis=1, keepdims=True)
        matrices[:, :3, :3] = [rotation_of(each) for each in unit]
    if "SCALE" in found:
        matrices[:, :3, :3] *= found["SCALE"][:, None, :]
    if "TRANSLATION" in found:
        matrices[:, :3, 3] = found["TRANSLATION"]
    return matrices


def _repeated(piece: FilePiece, matrices: np.ndarray) -> FilePiece:
    """Return a piece once per matrix [K, 4, 4]."""
    count = len(piece.vertices)
    starts = count * np.arange(len(matrices))
    placed = np.einsum("kij,vj->kvi", matrices[:, :3, :3], piece.vertices) + matrices[:, None, :3, 3]
    mirrored = np.linalg.det(matrices[:, :3, :3]) < 0
    faces = np.where(mirrored[:, None, None], piece.faces[None, :, ::-1], piece.faces[None]) + starts[:, None, None]
    normals = None
    if piece.normals is not None:
        # Normals stay at right angles to surfaces by the inverse transpose.
        normals = np.einsum("kij,vj->kvi", np.linalg.inv(matrices[:, :3, :3]).transpose(0, 2, 1), piece.normals)
        normals = (normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)).reshape(-1, 3)

    def each(values: Any) -> Any:
        return None if values is None else np.tile(values, (len(matrices), 1))

    return replace(
        piece,
        vertices=placed.reshape(-1, 3),
        faces=faces.reshape(-1, 3),
        uv=each(piece.uv),
        owners=each(piece.owners),
        shares=each(piece.shares),
        displacements=np.zeros((0, count * len(matrices), 3)),
        normals=normals,
        colours=each(piece.colours),
    )
