"""glTF files: random skeletons against a reference in SciPy, every way of storing numbers, and what is refused."""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from gltf_files import Gltf, arm
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from qsim.scene import Body, Translation, animated_file
from qsim.scene.animated.gltf_body import animations_in
from qsim.scene.shapes import mesh_file

KINDS = ("STEP", "LINEAR", "CUBICSPLINE")
SINGLE = 3e-6  # relative: files hold single precision, chains of five matrices add up


def f4(values: Any) -> np.ndarray:
    """Return numbers as a file holds them."""
    return np.asarray(values, np.float32).astype(np.float64)


class Reference:
    """A random glTF file with a skin, a mesh without one, morph targets and all kinds of keys, and its vertices."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.file = Gltf()
        self.nodes: list[dict[str, Any]] = []
        self.curves: dict[tuple[int, str], tuple[str, np.ndarray, np.ndarray]] = {}
        self.channels: list[Any] = []
        self.samplers: list[Any] = []
        count = int(rng.integers(2, 7))
        self.parent = [-1, *(int(rng.integers(-1, i)) for i in range(1, count))]
        for i in range(count):
            self.nodes.append(self.node(i))
        for i, parent in enumerate(self.parent):
            if parent >= 0:
                self.nodes[parent].setdefault("children", []).append(i)
        self.vertices, self.mesh = self.skinned(int(rng.integers(3, 9)), range(count))
        self.file.content |= {
            "nodes": [*self.nodes, {"mesh": 0, "skin": 0, "translation": [9, 9, 9]}],  # which a skin ignores
            "meshes": [self.mesh],
            "animations": [{"channels": self.channels, "samplers": self.samplers}],
        }
        if rng.random() < 0.5:
            self.nodes[0]["mesh"] = 0
            self.file.content["nodes"] = [*self.nodes, *self.file.content["nodes"][count:]]

    def keyed(self, node: int, path: str, numbers: int, make: Callable[[int], np.ndarray]) -> None:
        """Add a channel with random keys."""
        kind = str(self.rng.choice(KINDS))
        k = int(self.rng.integers(1, 5))
        times = f4(np.cumsum(self.rng.uniform(0.05, 0.5, k)))
        values = f4(make(k))
        stored = values
        if kind == "CUBICSPLINE":
            stored = f4(self.rng.normal(size=(k, 3, numbers)))
            stored[:, 1] = values
        self.samplers.append(
            {
                "input": self.file.add(times),
                "output": self.file.add(stored.reshape(-1, 1 if path == "weights" else numbers)),
            }
            | ({} if kind == "LINEAR" else {"interpolation": kind})
        )
        self.channels.append({"sampler": len(self.samplers) - 1, "target": {"node": node, "path": path}})
        self.curves[node, path] = kind, times, stored

    def turns(self, k: int) -> np.ndarray:
        return Rotation.random(k, rng=self.rng).as_quat()

    def node(self, i: int) -> dict[str, Any]:
        rng = self.rng
        if rng.random() < 0.25:
            return {"matrix": f4(np.vstack([rng.normal(size=(3, 4)), [0, 0, 0, 1]])).T.ravel().tolist()}
        made: dict[str, Any] = {}
        for path, numbers, make in (
            ("translation", 3, lambda k: rng.normal(size=(k, 3))),
            ("rotation", 4, self.turns),
            ("scale", 3, lambda k: rng.uniform(0.5, 1.5, (k, 3))),
        ):
            if rng.random() < 0.5:
                made[path] = f4(make(1)[0]).tolist()
            if rng.random() < 0.6:
                self.keyed(i, path, numbers, make)
        return made

    def skinned(self, vertices: int, nodes: range) -> tuple[np.ndarray, dict[str, Any]]:
        """Return vertices, and a mesh whose triangles are three vertices in order; the skin is stored, too."""
        rng = self.rng
        file = self.file
        order = rng.permutation(len(nodes))
        self.bones = order[: int(rng.integers(1, len(nodes) + 1))].tolist()
        self.binds = f4([np.vstack([rng.normal(size=(3, 4)), [0, 0, 0, 1]]) for _ in self.bones])
        place = f4(rng.normal(size=(vertices, 3)))
        sets = int(rng.integers(1, 3))
        self.owners = rng.integers(0, len(self.bones), (vertices, 4 * sets))
        self.shares = f4(rng.dirichlet(np.ones(4 * sets), vertices))
        attributes = {"POSITION": file.add(place)}
        for i in range(sets):
            columns = slice(4 * i, 4 * i + 4)
            attributes[f"JOINTS_{i}"] = file.add(self.owners[:, columns], str(rng.choice(["u1", "u2"])))
            attributes[f"WEIGHTS_{i}"] = file.add(self.shares[:, columns])
        primitive: dict[str, Any] = {"attributes": attributes}
        self.corners = rng.integers(0, vertices, 3 * 5)
        primitive["indices"] = file.add(self.corners, str(rng.choice(["u1", "u2", "u4"])))
        file.content["skins"] = [
            {
                "joints": self.bones,
                "inverseBindMatrices": file.add(self.binds.transpose(0, 2, 1).reshape(-1, 16)),
            }
        ]
        targets = int(rng.integers(0, 3))
        self.shifts = f4(rng.normal(size=(targets, vertices, 3)))
        self.resting = f4(rng.normal(size=targets))
        if targets:
            primitive["targets"] = [{"POSITION": file.add(shift)} for shift in self.shifts]
            if rng.random() < 0.7:
                self.keyed(len(nodes), "weights", targets, lambda k: rng.normal(size=(k, targets)))
        return place, {"primitives": [primitive]} | ({"weights": self.resting.tolist()} if targets else {})

    def curve(self, node: int, path: str, t: float, rest: Any) -> np.ndarray:
        if (node, path) not in self.curves:
            return np.asarray(rest, float)
        kind, times, stored = self.curves[node, path]
        t = float(np.clip(t, times[0], times[-1]))
        if kind == "STEP":
            return stored[np.searchsorted(times, t, side="right") - 1]
        if kind == "LINEAR":
            if len(times) == 1:
                return stored[0]
            if path == "rotation":
                return Slerp(times, Rotation.from_quat(stored))(t).as_quat()
            return np.array([np.interp(t, times, column) for column in stored.T])
        if len(times) == 1:
            return stored[0, 1]
        i = min(int(np.searchsorted(times, t, side="right")) - 1, len(times) - 2)
        return CubicHermiteSpline(times[i : i + 2], stored[i : i + 2, 1], [stored[i, 2], stored[i + 1, 0]])(t)

    def world(self, i: int, t: float) -> np.ndarray:
        node = self.nodes[i]
        if "matrix" in node:
            own = np.reshape(node["matrix"], (4, 4)).T
        else:
            own = np.eye(4)
            turn = Rotation.from_quat(self.curve(i, "rotation", t, node.get("rotation", (0, 0, 0, 1)))).as_matrix()
            own[:3, :3] = turn @ np.diag(self.curve(i, "scale", t, node.get("scale", (1, 1, 1))))
            own[:3, 3] = self.curve(i, "translation", t, node.get("translation", (0, 0, 0)))
        return own if self.parent[i] < 0 else self.world(self.parent[i], t) @ own

    def expected(self, t: float) -> np.ndarray:
        """Return the vertices of the file's coordinates at a time of the animation: the plain mesh, then the skin."""
        worlds = [self.world(i, t) for i in range(len(self.nodes))]
        found = []
        if "mesh" in self.nodes[0]:  # its morph weights are those of the mesh
            shape = self.vertices + np.tensordot(self.resting, self.shifts, 1)
            found += [(worlds[0] @ (*p, 1))[:3] for p in shape]
        weights = self.curve(len(self.nodes), "weights", t, self.resting)
        shape = self.vertices + np.tensordot(weights, self.shifts, 1)
        for v, p in enumerate(shape):
            total = np.zeros(3)
            for owner, share in zip(self.owners[v], self.shares[v], strict=True):
                total += share * (worlds[self.bones[owner]] @ self.binds[owner] @ (*p, 1))[:3]
            found.append(total / self.shares[v].sum())
        return np.array(found)


@pytest.mark.parametrize("seed", range(40))
def test_random_files_deform_as_the_reference(seed, tmp_path):
    reference = Reference(seed)
    if not reference.channels:
        reference.keyed(0, "scale", 3, lambda k: reference.rng.uniform(0.5, 1.5, (k, 3)))
        reference.nodes[0].pop("matrix", None)
    how = ("chunk", "beside", "text")[seed % 3]
    path = reference.file.write(tmp_path / ("body.glb" if how == "chunk" else "body.gltf"), how)
    size = None if seed % 2 else 0.3
    mesh, motion = animated_file(path, size, speed=1.5, start=0.1, repeat=False)
    length = max(times[-1] for _, times, _ in reference.curves.values())
    first = reference.expected(min(0.1, length))
    low = first.min(0)
    high = first.max(0)
    scale = 1.0 if size is None else size / (high - low).max()
    np.testing.assert_allclose(mesh.vertices, (first - (low + high) / 2) * scale, atol=SINGLE * scale * np.ptp(first))
    assert mesh.vertices.min(0) == pytest.approx(-mesh.vertices.max(0), abs=1e-6 * scale * np.ptp(first))
    for t in (-1.0, 0.0, 0.0713, 0.21, 0.5, 9.0):
        expected = reference.expected(min(max(0.1 + 1.5 * t, 0), length))
        found = motion.deform(t) / scale + (low + high) / 2
        np.testing.assert_allclose(found, expected, atol=SINGLE * np.abs(expected).max() * 10)


def test_the_arm_bends_by_its_second_joint(tmp_path):
    """A right angle in one second, in closed form; the animation starts again, but not before t = 0."""
    mesh, motion = animated_file(arm().write(tmp_path / "arm.glb"), carrier=Translation((0, 0, 1.0)))
    middle = np.array([1.0, 0.05, 0])
    rest = mesh.vertices + middle
    for t in (0.0, 0.25, 0.6, 1.6, -0.4):
        a = np.pi / 2 * (max(t, 0.0) % 1.0)
        c = np.cos(a)
        s = np.sin(a)
        bent = (rest - (1, 0, 0)) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + (1, 0, 0)
        share = np.where(np.isclose(rest[:, 0], 1), 0.5, rest[:, 0] > 1)[:, None]
        np.testing.assert_allclose(motion.deform(t), share * bent + (1 - share) * rest - middle, atol=1e-7)
    assert mesh.smooth
    np.testing.assert_allclose(mesh.uv, np.column_stack([rest[:, 0] / 2, rest[:, 1]]), atol=1e-7)
    body = Body("arm", mesh, motion=motion)
    assert body.deforms
    assert body.pose(2.0)[2, 3] == 2.0
    assert animations_in(tmp_path / "arm.glb") == ["bend"]
    _, held = animated_file(tmp_path / "arm.glb", repeat=False)
    assert np.array_equal(held.deform(7.0), held.deform(1.0))
    assert not np.array_equal(held.deform(1.0), motion.deform(1.0))


def stored_otherwise() -> Gltf:
    """Return the arm with interleaved vertices, bytes for weights, shorts for turns, and a sparse target."""
    file = arm()
    attributes = file.content["meshes"][0]["primitives"][0]["attributes"]
    mixed = np.zeros((14, 5), "<f4")
    place, share = (file.content["accessors"][attributes[name]] for name in ("POSITION", "WEIGHTS_0"))
    start = file.content["bufferViews"][place["bufferView"]]["byteOffset"]
    mixed[:, 2:] = np.frombuffer(bytes(file.data[start : start + 14 * 12]), "<f4").reshape(14, 3)
    view = file.view(mixed.tobytes(), byteStride=20)
    attributes["POSITION"] = file.accessor(view, (14, 3), byteOffset=8)
    start = file.content["bufferViews"][share["bufferView"]]["byteOffset"]
    weights = np.frombuffer(bytes(file.data[start : start + 14 * 16]), "<f4").reshape(14, 4)
    attributes["WEIGHTS_0"] = file.add(np.floor(weights * 255 + 0.4), "u1", normalized=True)  # 127 + 127: 254/255
    turns = np.array([[0, 0, 0, 1], [0, 0, np.sqrt(0.5), np.sqrt(0.5)]])
    sampler = file.content["animations"][0]["samplers"][0]
    sampler["output"] = file.add(np.round(turns * 32767), "i2", normalized=True)
    indices = {"bufferView": file.view(np.array([13], "<u2").tobytes()), "componentType": 5123}
    values = {"bufferView": file.view(np.array([0, 0, 7], "<f4").tobytes())}
    target = file.accessor(None, (14, 3), sparse={"count": 1, "indices": indices, "values": values})
    file.content["meshes"][0] |= {"weights": [0.5]}
    file.content["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": target}]
    return file


def test_numbers_are_read_in_every_form(tmp_path):
    plain, moving = animated_file(arm().write(tmp_path / "a.glb"))
    mesh, motion = animated_file(stored_otherwise().write(tmp_path / "b.glb"))
    lifted = np.zeros((14, 3))
    lifted[13, 2] = 3.5
    middle = np.array([0, 0, 1.75])  # of the bounding box
    assert np.array_equal(mesh.faces, plain.faces)
    for t in (0.0, 0.3, 0.8):
        np.testing.assert_allclose(motion.deform(t), moving.deform(t) + lifted - middle, atol=1e-4)


def test_meshes_without_normals_pictures_or_right_handed_nodes(tmp_path):
    """Flat shading, pictures along z, outward winding behind a mirror, and no vertex that the scene leaves out."""
    file = arm()
    attributes = file.content["meshes"][0]["primitives"][0]["attributes"]
    del attributes["NORMAL"], attributes["TEXCOORD_0"]
    file.content["nodes"] += [{"scale": [-1.0, 1, 1], "children": [4]}, {"mesh": 0}, {"mesh": 0}]
    file.content["scenes"][0]["nodes"] = [0, 2, 3]
    mesh, _ = animated_file(file.write(tmp_path / "a.glb"), 0.5)
    assert len(mesh.vertices) == 28
    assert not mesh.smooth
    np.testing.assert_allclose(mesh.uv, mesh.vertices[:, :2] / 0.5 + 0.5)
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).all()


def test_files_of_another_program_are_read_as_it_reads_them(tmp_path):
    """trimesh writes and reads meshes on nodes, without animations; one is added that leaves all at rest."""
    rng = np.random.default_rng(4)
    turned = trimesh.transformations.random_rotation_matrix(rng.random(3))
    turned[:3, 3] = 1, 2, 3
    smaller = np.diag([0.5, 0.7, 0.5, 1])
    written = trimesh.Scene()
    written.add_geometry(trimesh.creation.icosphere(1), node_name="a", transform=turned)
    written.add_geometry(trimesh.creation.box(), node_name="b", parent_node_name="a", transform=smaller)
    files = trimesh.exchange.gltf.export_gltf(written)
    content = json.loads(files["model.gltf"])
    key = base64.b64encode(np.array([0, 0, 0, 0], "<f4")).decode()
    content["buffers"].append({"byteLength": 16, "uri": f"data:;base64,{key}"})
    content["bufferViews"].append({"buffer": len(content["buffers"]) - 1, "byteLength": 16})
    view = len(content["bufferViews"]) - 1
    accessor = len(content["accessors"])
    content["accessors"] += [
        {"bufferView": view, "componentType": 5126, "count": 1, "type": "SCALAR"},
        {"bufferView": view, "componentType": 5126, "count": 1, "type": "VEC3", "byteOffset": 4},
    ]
    content["nodes"].append({})
    content["animations"] = [
        {
            "samplers": [{"input": accessor, "output": accessor + 1, "interpolation": "STEP"}],
            "channels": [{"sampler": 0, "target": {"node": len(content["nodes"]) - 1, "path": "translation"}}],
        }
    ]
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    (tmp_path / "model.gltf").write_text(json.dumps(content))
    mesh, motion = animated_file(tmp_path / "model.gltf")
    assert animations_in(tmp_path / "model.gltf") == ["0"]
    expected = trimesh.load(tmp_path / "model.gltf", force="mesh")
    assert len(mesh.faces) == len(expected.faces) == 80 + 12
    found, wanted = (
        np.sort(corners.mean(axis=1), axis=0) for corners in (mesh.vertices[mesh.faces], expected.triangles)
    )
    np.testing.assert_allclose(found, wanted - (expected.bounds[0] + expected.bounds[1]) / 2, atol=1e-6)
    assert np.array_equal(motion.deform(7.7), mesh.vertices)


def test_animations_of_one_name_are_told_apart(tmp_path):
    """Names need not differ; only the first could be chosen."""
    file = arm()
    file.content["animations"] = [file.content["animations"][0] | {"name": "Take"} for _ in range(3)]
    path = file.write(tmp_path / "arm.glb")
    assert animations_in(path) == ["Take", "Take #1", "Take #2"]
    animated_file(path, animation="Take #2")


def nothing(file: Gltf) -> None:
    file.content["animations"] = []


def two(file: Gltf) -> None:
    file.content["animations"].append(file.content["animations"][0] | {"name": "wave"})


def primitive(file: Gltf) -> dict[str, Any]:
    return file.content["meshes"][0]["primitives"][0]


def sampler(file: Gltf) -> dict[str, Any]:
    return file.content["animations"][0]["samplers"][0]


def weights(values: Any, count: int = 14) -> Callable[[Gltf], None]:
    def change(file: Gltf) -> None:
        primitive(file)["attributes"]["WEIGHTS_0"] = file.add(np.tile(values, (count, 1)))

    return change


def attribute(name: str, values: Any, kind: str = "f4") -> Callable[[Gltf], None]:
    return lambda file: primitive(file)["attributes"].__setitem__(name, file.add(values, kind))


def lacking(name: str) -> Callable[[Gltf], None]:
    return lambda file: primitive(file)["attributes"].pop(name)


def put(place: str, value: Any) -> Callable[[Gltf], None]:
    """Return a change of one value, by a path such as `nodes.0.skin`."""

    def change(file: Gltf) -> None:
        *way, last = place.split(".")
        at: Any = file.content
        for key in way:
            at = at[int(key)] if isinstance(at, list) else at[key]
        at[int(last) if isinstance(at, list) else last] = value

    return change


REFUSED = {
    "no animation": (nothing, "has no animation; use shapes.mesh_file"),
    "two animations": (two, "has 2 animations, choose one: bend, wave"),
    "no channels": (put("animations.0.channels", []), r"animations\[0\] moves no node"),
    "no weights": (lacking("WEIGHTS_0"), "has a skin but no WEIGHTS_0"),
    "no joints": (lacking("JOINTS_0"), "has a skin but no JOINTS_0"),
    "neither": (lambda file: (lacking("JOINTS_0")(file), lacking("WEIGHTS_0")(file)), "has a skin but no JOINTS_0"),
    "sum of 0.9": (weights([0.5, 0.4, 0, 0]), r"the weights of vertex 0 are \[0.5, 0.4, 0.0, 0.0\]; they must be 0 or"),
    "negative": (weights([1.5, -0.5, 0, 0]), "must be 0 or more"),
    "too few weights": (weights([1, 0, 0, 0], 13), r"needs 14 of VEC4, but accessors\[\d+\] has 13 of VEC4"),
    "joint 2 of 2": (attribute("JOINTS_0", np.full((14, 4), 2), "u1"), r"joints \[2, 2, 2, 2\]; there are 2"),
    "joints as floats": (attribute("JOINTS_0", np.zeros((14, 4))), "JOINTS are whole numbers"),
    "no position": (lacking("POSITION"), "has no POSITION"),
    "not finite": (attribute("POSITION", np.full((14, 3), np.nan)), r"accessors\[\d+\]: nan at index \(0, 0\)"),
    "far away": (attribute("POSITION", np.full((14, 3), 1e30)), "its numbers let vertices move"),
    "a point": (attribute("POSITION", np.zeros((14, 3))), "all its vertices lie in one point"),
    "loop of lines": (lambda file: primitive(file).update(mode=2), r"not made of triangles \(mode 4\)"),
    "index 14": (lambda file: primitive(file).update(indices=file.add([0, 1, 14], "u2")), "of its 14 vertices"),
    "two indices": (lambda file: primitive(file).update(indices=file.add([0, 1], "u2")), "three indices each"),
    "bind matrices": (
        lambda file: file.content["skins"][0].update(inverseBindMatrices=file.add(np.zeros((1, 16)))),
        r"skins\[0\] needs 2 of MAT4, but",
    ),
    "bind of a lens": (
        lambda file: file.content["skins"][0].update(inverseBindMatrices=file.add(np.ones((2, 16)))),
        r"skins\[0\]: the last row of its matrix is \[1.0, 1.0, 1.0, 1.0\], not 0, 0, 0, 1",
    ),
    "matrix of a lens": (put("nodes.0", {"matrix": [2] * 16, "children": [1]}), r"nodes\[0\]: the last row of its"),
    "joint node": (put("skins.0.joints", [0, 9]), r"skins\[0\]: its joints need nodes, found 9"),
    "no joints in skin": (put("skins.0.joints", []), r"skins\[0\]: its joints need nodes, found none"),
    "skin 3": (put("nodes.2.skin", 3), r"nodes\[2\] names skins\[3\]; there are 1"),
    "mesh 1": (put("nodes.2.mesh", 1), r"a node names meshes\[1\]; there are 1"),
    "no mesh": (put("scenes.0.nodes", [0]), "its scene has no mesh"),
    "own parent": (put("nodes.1.children", [0]), r"nodes\[0\] is among its own children"),
    "two parents": (put("nodes.2.children", [1]), "its child 1 has two parents"),
    "no such child": (put("nodes.2.children", [8]), "its child 8 does not exist; there are 3 nodes"),
    "quaternion": (put("nodes.0.rotation", [0, 0, 0, 2]), r"nodes\[0\]: rotation 0 has the length 2, not 1"),
    "key quaternion": (lambda file: sampler(file).update(output=file.add(np.zeros((2, 4)))), "0 has the length 0"),
    "times fall": (lambda file: sampler(file).update(input=file.add([1.0, 1.0])), "Track.times must increase, got 1 s"),
    "times before 0": (lambda file: sampler(file).update(input=file.add([-1.0, 1.0])), "its first key is at -1 s"),
    "spline of two": (lambda file: sampler(file).update(interpolation="CUBICSPLINE"), "needs 6 of VEC4, but"),
    "interpolation": (lambda file: sampler(file).update(interpolation="CURVE"), "expected one of STEP, LINEAR"),
    "twice": (
        lambda file: file.content["animations"][0].update(channels=2 * file.content["animations"][0]["channels"]),
        r"the rotation of nodes\[1\] has two channels",
    ),
    "keys of a matrix": (put("nodes.1", {"matrix": np.eye(4).ravel().tolist()}), r"nodes\[1\], which has a matrix"),
    "no targets": (put("animations.0.channels.0.target.path", "weights"), r"nodes\[1\], which has no morph targets"),
    "node 7": (put("animations.0.channels.0.target.node", 7), "its node 7 or its sampler 0 does not exist"),
    "extension": (put("extensionsRequired", ["EXT_meshopt_compression"]), "needs the extension EXT_meshopt"),
    "version": (put("asset", {"version": "1.0"}), "glTF of version 1.0; version 2.0 is read"),
    "view": (put("bufferViews.0.byteLength", 10), r"reaches byte 168 of buffers\[0\]; bufferViews\[0\] holds 10"),
    "stride": (put("bufferViews.0.byteStride", 4), r"accessors\[0\] reaches byte"),
    "huge count": (put("accessors.0.count", 2**39), r"reaches byte|needs 549755813888 of VEC4"),
    "no data": (lambda file: file.content["accessors"][0].pop("bufferView"), r"accessors\[0\] has no bufferView"),
    "component": (put("accessors.0.componentType", 5124), r"accessors\[0\]: componentType: expected one of 5120"),
    "key missing": (lambda file: file.content["accessors"][0].pop("count"), r"accessors\[0\]: key 'count' is missing"),
    "a text for a list": (put("nodes", "many"), "nodes: expected a list, got a str"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_wrong_file_is_refused_in_one_sentence(name, tmp_path):
    change, message = REFUSED[name]
    file = arm()
    change(file)
    path = file.write(tmp_path / "arm.glb")
    with pytest.raises(ValueError, match=message) as error:
        animated_file(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_buffers_that_are_missing_or_short_are_named(tmp_path):
    path = arm().write(tmp_path / "arm.gltf", "beside")
    animated_file(path)
    path.with_suffix(".bin").write_bytes(b"1234")
    with pytest.raises(ValueError, match=r"arm.gltf: buffers\[0\]: 4 bytes, but \d+ are stated; the file is truncated"):
        animated_file(path)
    path.with_suffix(".bin").unlink()
    with pytest.raises(
        FileNotFoundError, match=r"arm.gltf: buffers\[0\]: the file is missing: .*arm.bin; put it there"
    ):
        animated_file(path)
    content = json.loads(path.read_text())
    for uri, message in (
        ("https://here/arm.bin", "the name of a file beside it is expected"),
        ("data:text/plain,abc", "its data: uri is not base64|0 bytes"),
        (None, "the buffer is missing: no uri, and no binary chunk"),
    ):
        content["buffers"][0] = {"byteLength": 999} | ({} if uri is None else {"uri": uri})
        path.write_text(json.dumps(content))
        with pytest.raises(ValueError, match=message):
            animated_file(path)
    with pytest.raises(FileNotFoundError, match="no such file"):
        animated_file(tmp_path / "none.glb")


def test_every_truncation_of_a_file_is_refused(tmp_path):
    path = arm().write(tmp_path / "arm.glb")
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"arm.glb: ") as error:
            animated_file(path)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("seed", range(40))
def test_no_vertex_moves_beyond_the_bound_that_is_checked(seed, tmp_path):
    """The largest size at which a file is read keeps its vertices within 1e6 m at every time, and comes near."""
    reference = Reference(seed)
    path = reference.file.write(tmp_path / "body.glb")
    if not reference.channels:
        return
    low = 1.0
    high = 1e12
    for _ in range(40):
        middle = float(np.sqrt(low * high))
        try:
            _, motion = animated_file(path, middle)
            low = middle
            moved = motion
        except ValueError:
            high = middle
    farthest = max(np.abs(moved.deform(t)).max() for t in np.linspace(0, moved.clock.length, 301))
    assert 1e2 < farthest < 1e6


def test_choices_are_checked(tmp_path):
    path: Path = arm().write(tmp_path / "arm.glb")
    with pytest.raises(ValueError, match=r"has no animation 'bent' \(did you mean 'bend'\?\); there are bend"):
        animated_file(path, animation="bent")
    with pytest.raises(ValueError, match="size must be a length above 0"):
        animated_file(path, 0.0)
    with pytest.raises(ValueError, match=r"Clock.speed: expected a finite number, got nan"):
        animated_file(path, speed=float("nan"))


@pytest.mark.parametrize("reader", [animated_file, mesh_file])
@pytest.mark.parametrize("leads", ["../away.bin", "/away.bin", "link.bin", "pipe", "/dev/zero", "%2e%2e/away.bin"])
def test_a_uri_names_a_regular_file_beside_the_document(tmp_path, reader, leads):
    folder = tmp_path / "here"
    folder.mkdir()
    path = arm().write(folder / "arm.gltf", "beside")
    (tmp_path / "away.bin").write_bytes((folder / "arm.bin").read_bytes())
    (folder / "link.bin").symlink_to(tmp_path / "away.bin")
    os.mkfifo(folder / "pipe")
    content = json.loads(path.read_text())
    content["buffers"][0]["uri"] = leads.replace("/away", f"{tmp_path}/away") if leads == "/away.bin" else leads
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"buffers\[0\]: .*(leads out of|no regular file)"):
        reader(path)


@pytest.mark.parametrize("reader", [animated_file, mesh_file])
@pytest.mark.parametrize("name", ["EXT_meshopt_compression", "ACME_anything"])
def test_a_required_extension_is_refused_by_name(tmp_path, reader, name):
    document = arm()
    document.content["extensionsRequired"] = [name]
    with pytest.raises(ValueError, match=f"needs the extension {name}, which is not read; export without it"):
        reader(document.write(tmp_path / "arm.glb"))


def test_a_small_file_that_names_one_array_often_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("qsim.limits.VERTICES", 1000)
    document = arm()
    for mesh in document.content["meshes"]:
        mesh["primitives"] = mesh["primitives"] * 500
    with pytest.raises(ValueError, match="its meshes have more than 1000 vertices in all"):
        animated_file(document.write(tmp_path / "arm.glb"))
