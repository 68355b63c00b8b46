"""Bodies of glTF files without a camera keep their materials, and have the places that one body of the file has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gltf_files import Gltf, arm

from qsim import scenes
from qsim.dataset.scene_rendering import load_scene
from qsim.rendering.render_settings import RenderSettings
from qsim.scene import MetallicRoughness, Still, animated_file
from qsim.scene.animated.gltf_scene import gltf_parts
from qsim.scene.shapes import mesh_file
from qsim.scenes import asset_folder, gltf_file

METAL = {
    "pbrMetallicRoughness": {"metallicFactor": 0.75, "roughnessFactor": 0.25, "baseColorFactor": [0.9, 0.1, 0.1, 1]}
}
GLOWING = {"emissiveFactor": [0.0, 0.5, 0.0]}


def two_parts() -> Gltf:
    """Return a strip that bends, of metal, and a triangle that moves as a whole, and glows."""
    file = arm()
    triangle = {"POSITION": file.add([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])}
    file.content["materials"] = [METAL, GLOWING]
    file.content["meshes"][0]["primitives"][0]["material"] = 0
    file.content["meshes"].append({"primitives": [{"attributes": triangle, "material": 1}]})
    file.content["nodes"].append({"mesh": len(file.content["meshes"]) - 1, "scale": [2.0, 2, 2]})
    keys = {"input": file.add([0.0, 1.0]), "output": file.add([[0.0, 0, 0], [0, 0, 3]])}
    (bending,) = file.content["animations"]
    bending["samplers"].append(keys)
    target = {"node": len(file.content["nodes"]) - 1, "path": "translation"}
    bending["channels"].append({"sampler": len(bending["samplers"]) - 1, "target": target})
    for scene in file.content.get("scenes", []):
        scene["nodes"].append(target["node"])
    return file


def places(bodies, t: float) -> np.ndarray:
    """Return the vertices of bodies in the world, [V, 3]."""
    return np.concatenate([body.vertices(t) @ body.pose(t)[:3, :3].T + body.pose(t)[:3, 3] for body in bodies])


def test_parts_move_as_the_one_body_of_the_file(tmp_path: Path):
    path = two_parts().write(tmp_path / "two.glb")
    carrier = Still((0.5, 0.0, -1.0), (0.0, 0.7, 0.0))
    mesh, motion = animated_file(path, 0.26, speed=1.5, start=0.1, carrier=carrier)
    parts = gltf_parts(path, 0.26, pose=carrier.pose(0.0), animation="bend", speed=1.5, start=0.1)
    assert [type(part.material) for part in parts] == [MetallicRoughness] * 2
    for t in (0.0, 0.21, 0.5, 2.0):
        turn = motion.pose(t)
        expected = motion.deform(t) @ turn[:3, :3].T + turn[:3, 3]
        np.testing.assert_allclose(places(parts, t), expected, atol=1e-6)
    assert sum(len(part.mesh.faces) for part in parts) == len(mesh.faces)


@pytest.mark.parametrize("bands", [None, "rgb"])
def test_a_standing_body_keeps_its_materials(tmp_path: Path, bands):
    path = two_parts().write(tmp_path / "two.glb")
    settings = RenderSettings(height=8, width=8, bands=bands)
    scene = load_scene(str(path), 1, None, settings)[0]
    metal, glowing = (body.material for body in scene.bodies[2:])
    assert (metal.metallic, metal.roughness) == (0.75, 0.25)
    assert glowing.glows
    if bands is None:
        assert 0.1 < metal.reflectance < 0.9
    else:
        assert metal.reflectance == pytest.approx((0.9, 0.1, 0.1))
        assert (
            len(set(np.ravel(scene.bodies[0].material.reflectance.colours()[0, 0]))) > 1
        )  # the floor is coloured, too
    low = places(scene.bodies[2:], 0.0)[:, 1].min()
    assert low == pytest.approx(scene.bodies[0].mesh.vertices[0, 1])
    assert gltf_file.played(scene, path).startswith("plays the animation bend of 1 s at 1 times its speed")


@pytest.mark.parametrize("bands", [None, "rgb"])
def test_a_mesh_folder_keeps_the_materials_of_gltf_files(tmp_path: Path, bands):
    two_parts().write(tmp_path / "two.glb")
    settings = RenderSettings(height=8, width=8, bands=bands)
    scene = load_scene(str(tmp_path), 1, None, settings)[0]
    kept = [body for body in scene.bodies if ", part " in body.name]
    assert len(kept) == 2 * len({body.motion for body in kept}) == 2 * (len(scene.bodies) - 2 - len(kept) // 2)
    for metal, glowing in zip(kept[::2], kept[1::2], strict=True):
        assert (metal.material.metallic, glowing.material.glows) == (0.75, True)
        corners = np.concatenate([metal.mesh.vertices, glowing.mesh.vertices])
        assert 0.08 <= np.ptp(corners, axis=0).max() <= 0.16
        np.testing.assert_allclose(corners.max(0), -corners.min(0), atol=1e-6)


def test_files_without_a_material_are_drawn_as_before(tmp_path: Path):
    path = arm().write(tmp_path / "arm.glb")
    assert gltf_parts(path, 0.1) == ()
    assert scenes.load(path, 1).bodies[2].name == "bend"
    scene = asset_folder.scene(1, folder=tmp_path)
    assert not any(", part " in body.name for body in scene.bodies)


def test_lines_and_lights_that_are_left_out_are_named(tmp_path: Path):
    file = two_parts()
    line = {"POSITION": file.add([[0.0, 0, 0], [1, 0, 0]])}
    file.content["meshes"].append({"primitives": [{"attributes": line, "mode": 1}]})
    file.content["nodes"].append({"mesh": len(file.content["meshes"]) - 1})
    file.content["nodes"].append({"extensions": {"KHR_lights_punctual": {"light": 0}}})
    for scene in file.content.get("scenes", []):
        scene["nodes"] += [len(file.content["nodes"]) - 2, len(file.content["nodes"]) - 1]
    path = file.write(tmp_path / "two.glb")
    with pytest.warns(UserWarning, match=r"primitives\[0\]: points or lines are left out; the lights of a file"):
        assert len(gltf_parts(path, 0.1)) == 2
    with pytest.warns(UserWarning, match="points or lines are left out"):
        mesh_file(path)
