"""Reads the nodes of a glTF file as joints, with one of its animations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, NotRequired, TypedDict

import numpy as np
from msgspec import Meta

from qsim.checks import suggest
from qsim.kinds import Count, Number
from qsim.records import convert
from qsim.scene.animated.gltf_buffers import Document, entries_of
from qsim.scene.animated.skinning import Joint, Placed
from qsim.scene.animated.tracks import Fixed, Keyed, Track

PATHS = {"translation": 3, "rotation": 4, "scale": 3}  # numbers per key; "weights" has one per morph target
REST = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}
INTERPOLATION = {"STEP": "step", "LINEAR": "linear", "CUBICSPLINE": "cubic"}
UNIT = 0.02  # by which the length of a quaternion may differ from 1: bytes round by less

Indices = list[Count]


class Node(TypedDict):
    name: NotRequired[str]
    camera: NotRequired[Count]
    extensions: NotRequired[dict[str, Any]]
    children: NotRequired[Indices]
    mesh: NotRequired[Count]
    skin: NotRequired[Count]
    matrix: NotRequired[Annotated[list[Number], Meta(min_length=16, max_length=16)]]
    weights: NotRequired[list[Number]]
    translation: NotRequired[tuple[Number, Number, Number]]
    rotation: NotRequired[tuple[Number, Number, Number, Number]]
    scale: NotRequired[tuple[Number, Number, Number]]


class Target(TypedDict):
    node: NotRequired[Count]
    path: str


class Channel(TypedDict):
    sampler: Count
    target: Target


class TrackSampler(TypedDict):
    input: Count
    output: Count
    interpolation: NotRequired[Literal["STEP", "LINEAR", "CUBICSPLINE"]]


class Animation(TypedDict):
    name: NotRequired[str]


Tracks = dict[tuple[int, str], Track]  # of (node, path)


def animation_names(document: Document) -> list[str]:
    """Return the names of a file's animations; one without a name has its number, and so have repeated names."""
    found: list[str] = []
    for i, entry in enumerate(entries_of(document.path, document.content, "animations")):
        about = convert(entry, Animation, f"{document.path}: animations[{i}]")
        name = about.get("name", str(i))
        found.append(f"{name} #{i}" if name in found else name)
    return found


def chosen_animation(document: Document, name: str | None) -> int:
    """Return the number of an animation by name; without one, of the only animation."""
    names = animation_names(document)
    if not names:
        raise ValueError(f"{document.path}: has no animation; use shapes.mesh_file for a mesh that keeps its shape")
    listed = ", ".join(names[:20])
    if name is None:
        if len(names) > 1:
            raise ValueError(f"{document.path}: has {len(names)} animations, choose one: {listed}")
        return 0
    if name not in names:
        raise ValueError(f"{document.path}: has no animation {name!r}{suggest(name, names)}; there are {listed}")
    return names.index(name)


def nodes_of(document: Document) -> list[Node]:
    """Return all nodes, checked one by one."""
    entries = entries_of(document.path, document.content, "nodes")
    return [convert(entry, Node, f"{document.path}: nodes[{i}]") for i, entry in enumerate(entries)]


def parents_first(document: Document, nodes: list[Node]) -> tuple[list[int], dict[int, int]]:
    """Return the numbers of all nodes, parents before children, and the parent of each child."""
    parents: dict[int, int] = {}
    for i, node in enumerate(nodes):
        for child in node.get("children", []):
            if child >= len(nodes) or child in parents:
                problem = "has two parents" if child in parents else f"does not exist; there are {len(nodes)} nodes"
                raise ValueError(f"{document.path}: nodes[{i}]: its child {child} {problem}")
            parents[child] = i
    order = [i for i in range(len(nodes)) if i not in parents]
    for i in order:  # grows
        order += nodes[i].get("children", [])
    if len(order) < len(nodes):
        wrong = min(set(range(len(nodes))) - set(order))
        raise ValueError(f"{document.path}: nodes[{wrong}] is among its own children")
    return order, parents


def tracks_of(document: Document, animation: int, nodes: list[Node], targets: Mapping[int, int]) -> Tracks:
    """Return the tracks of one animation; `targets` has the number of morph targets of each node that has some."""
    where = f"animations[{animation}]"
    entry = entries_of(document.path, document.content, "animations")[animation]
    lists: dict[str, Any] = {}
    for kind in ("channels", "samplers"):
        lists[kind] = entries_of(document.path, entry, kind)
    found: Tracks = {}
    for i, channel in enumerate(lists["channels"]):
        place = f"{document.path}: {where}.channels[{i}]"
        about = convert(channel, Channel, place)
        node = about["target"].get("node")
        path = about["target"]["path"]
        if node is None or path not in (*PATHS, "weights"):
            continue  # an extension animates something else: a light, a material
        if node >= len(nodes) or about["sampler"] >= len(lists["samplers"]):
            raise ValueError(f"{place}: its node {node} or its sampler {about['sampler']} does not exist")
        if path == "weights" and node not in targets:
            raise ValueError(f"{place}: animates morph weights of nodes[{node}], which has no morph targets")
        if path in PATHS and "matrix" in nodes[node]:
            raise ValueError(f"{place}: animates nodes[{node}], which has a matrix; keys need translation and rotation")
        if (node, path) in found:
            raise ValueError(f"{place}: the {path} of nodes[{node}] has two channels")
        sampler = f"{where}.samplers[{about['sampler']}]"
        table = convert(lists["samplers"][about["sampler"]], TrackSampler, f"{document.path}: {sampler}")
        found[node, path] = _track(document, table, sampler, path, PATHS.get(path) or targets[node])
    if not found:
        raise ValueError(f"{document.path}: {where} moves no node and no morph target")
    return found


def _track(document: Document, sampler: TrackSampler, where: str, path: str, numbers: int) -> Track:
    """Return the keys of one sampler."""
    times = document.array(sampler["input"], where, "SCALAR")[:, 0].astype(np.float64)
    kind = INTERPOLATION[sampler.get("interpolation", "LINEAR")]
    rows = len(times) * (3 if kind == "cubic" else 1)
    shape, count = ("SCALAR", rows * numbers) if path == "weights" else (f"VEC{numbers}", rows)
    values = document.array(sampler["output"], where, shape, count).astype(np.float64).reshape(rows, numbers)
    tangents = None
    if kind == "cubic":
        before, values, after = values.reshape(len(times), 3, numbers).transpose(1, 0, 2)
        tangents = np.stack([before, after])
    if path == "rotation":
        check_quaternions(f"{document.path}: {where}", values)
    if times[0] < 0:
        raise ValueError(f"{document.path}: {where}: its first key is at {times[0]:g} s; times from 0 are expected")
    try:
        return Track(times, values, kind, tangents)
    except ValueError as error:
        raise ValueError(f"{document.path}: {where}: {error}") from None


def fixed(where: str, numbers: Sequence[float]) -> Fixed:
    """Return the placement by 16 numbers, column by column; `ValueError` if its last row is not 0, 0, 0, 1."""
    matrix = np.array(numbers, np.float64).reshape(4, 4).T
    if not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-4):
        raise ValueError(f"{where}: the last row of its matrix is {matrix[3].tolist()}, not 0, 0, 0, 1")
    matrix[3] = 0, 0, 0, 1
    return Fixed(matrix)


def check_quaternions(where: str, quaternions: np.ndarray) -> None:
    """`ValueError` for the first quaternion [4] whose length is not 1."""
    lengths = np.linalg.norm(quaternions, axis=1)
    wrong = ~(np.abs(lengths - 1) <= UNIT)
    if wrong.any():
        raise ValueError(f"{where}: rotation {int(np.argmax(wrong))} has the length {lengths[wrong][0]:g}, not 1")


def joints_of(
    document: Document, nodes: list[Node], tracks: Tracks, order: list[int], parents: Mapping[int, int]
) -> tuple[list[Joint], dict[int, int]]:
    """Return a joint for every node, behind one for the place of the body, and the joint of each node."""
    joints = [Joint(Fixed(np.eye(4)))]
    number = {}
    for i in order:
        number[i] = len(joints)
        parent = number[parents[i]] if i in parents else 0
        joints.append(Joint(_motion(document, i, nodes[i], tracks), parent))
    return joints, number


def _motion(document: Document, number: int, node: Node, tracks: Tracks) -> Placed:
    if "matrix" in node:
        return fixed(f"{document.path}: nodes[{number}]", node["matrix"])
    given: dict[str, Any] = {**node}
    rest = {path: given.get(path, REST[path]) for path in PATHS}
    check_quaternions(f"{document.path}: nodes[{number}]", np.array([rest["rotation"]], np.float64))
    return Keyed(**{path: tracks.get((number, path)) or Track.constant(rest[path]) for path in PATHS})
