"""Tests compressed meshes of glTF files: what is read equals what was compressed, and damage is one sentence."""

from __future__ import annotations

import random
import sys

import numpy as np
import pytest
from gltf_files import Gltf

from qsim.scene.shapes import mesh_file

DracoPy = pytest.importorskip("DracoPy")
DRACO = "KHR_draco_mesh_compression"
STEP = 2.0**-14  # of the side of the mesh: half of it is what 14 bits lose at most


def compressed(seed: int = 0, **changes) -> tuple[Gltf, np.ndarray]:
    """A file with a compressed patch of waves, and the corners of its faces [F, 3, 3]."""
    rng = np.random.default_rng(seed)
    side = 9
    places = np.mgrid[:side, :side] / (side - 1)
    points = np.stack([places[1].ravel(), places[0].ravel(), 0.1 * rng.random(side * side)], axis=1).astype(np.float32)
    i = np.arange(side * side).reshape(side, side)
    a, b, c, d = (corner.ravel() for corner in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.uint32)
    uv = points[:, :2].astype(np.float64)
    raw = DracoPy.encode(points, faces, quantization_bits=14, tex_coord=uv)
    names = {
        kind: one["unique_id"] for one in DracoPy.decode(raw).attributes if (kind := one["attribute_type"]) in (0, 3)
    }
    document = Gltf(extensionsRequired=[DRACO], extensionsUsed=[DRACO])
    count = len(DracoPy.decode(raw).points)
    document.accessor(None, (count, 3))
    document.accessor(None, (count, 2))
    document.accessor(None, (faces.size, 1), "u4")
    data = {"bufferView": document.view(raw), "attributes": {"POSITION": names[0], "TEXCOORD_0": names[3]}}
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "extensions": {DRACO: data | changes}}
    document.content |= {"meshes": [{"primitives": [primitive]}], "nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}]}
    return document, points[faces]


def test_a_compressed_mesh_is_the_mesh_that_was_compressed(tmp_path):
    document, corners = compressed()
    mesh = mesh_file(document.write(tmp_path / "a.glb"))
    found = mesh.vertices[mesh.faces]
    middle = (corners.reshape(-1, 3).min(0) + corners.reshape(-1, 3).max(0)) / 2
    apart = np.abs(found.mean(1)[:, None] - (corners - middle).mean(1)[None]).max(axis=2)
    assert len(found) == len(corners)
    assert apart.min(axis=1).max() < STEP
    assert sorted(apart.argmin(axis=1)) == list(range(len(corners))), "every face once"
    flat = mesh.vertices[:, :2] + middle[:2]
    np.testing.assert_allclose(mesh.uv, flat * (1, -1) + (0, 1), atol=2 * STEP)


def test_a_file_that_has_its_meshes_uncompressed_too_needs_no_library(tmp_path, monkeypatch):
    document, _ = compressed()
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(ValueError, match="DracoPy is missing: pip install DracoPy, or export without compression"):
        mesh_file(document.write(tmp_path / "a.glb"))
    document.content["extensionsRequired"] = []
    accessors = document.content["accessors"]
    for accessor, values in ((0, np.eye(3)), (1, np.eye(3)[:, :2])):
        accessors[accessor] = accessors[document.add(values)]
    accessors[2] = accessors[document.add([0, 1, 2], "u4")]
    assert len(mesh_file(document.write(tmp_path / "b.glb")).faces) == 1


def test_what_does_not_fit_is_refused(tmp_path):
    def refused(words, change=lambda content: None, **changes):
        document, _ = compressed(**changes)
        change(document.content)
        with pytest.raises(ValueError, match=words):
            mesh_file(document.write(tmp_path / "a.glb"))

    refused("has no POSITION, which it names", attributes={"POSITION": 77})
    refused("has no NORMAL, which it names", attributes={"NORMAL": 1})
    refused("attributes: .*at least 1|attributes", attributes={})
    refused(r"bufferViews\[7\]|bufferViews; there|names bufferViews", bufferView=7)
    refused(r"states 80 of 'VEC3'", lambda content: content["accessors"][0].update(count=80))
    refused(r"an accessor states 1000000000 vertices", lambda content: content["accessors"][0].update(count=10**9))
    refused(
        "its data are no mesh of Draco", lambda content: content["bufferViews"][0].update(byteOffset=1, byteLength=60)
    )


def test_damaged_data_are_read_or_refused(tmp_path):
    """Bytes changed and cut, as in test_hostile_inputs: a mesh, or one sentence."""
    for seed in range(60):
        chance = random.Random(seed)
        document, _ = compressed()
        for _ in range(chance.choice([1, 3, 10])):
            document.data[chance.randrange(len(document.data))] = chance.randrange(256)
        path = document.write(tmp_path / "a.glb")
        said = ""
        try:
            assert np.isfinite(mesh_file(path).vertices).all()
        except ValueError as error:
            said = str(error)
        assert "\n" not in said
