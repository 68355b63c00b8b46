"""Complete scenes of glTF files: what is shown where, how it moves, and what is refused or told."""

from __future__ import annotations

import io
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gltf_files import Gltf
from mutations import attempt, places, replaced
from PIL import Image

from qsim import scenes
from qsim.cli.program import main
from qsim.rendering.mitsuba_mesh import vertex_normals
from qsim.scene import (
    Constant,
    DirectionalLight,
    MetallicRoughness,
    NormalMap,
    PointLight,
    Skinned,
    SpotLight,
    Texture,
    VertexColours,
    read_gltf,
)
from qsim.scene.animated.attached import Attached
from qsim.scene.animated.gltf_scene import INSTANCES, cameras_in

TURN = [0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)]  # a quarter of a turn about y
PUNCTUAL = "KHR_lights_punctual"
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)


def png(values: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, "PNG")
    return stream.getvalue()


def square(file: Gltf, material: int | None = 0, **more: Any) -> dict[str, Any]:
    """Return a mesh of one square that faces +z."""
    attributes = {
        "POSITION": file.add(SQUARE),
        "NORMAL": file.add(np.tile([0.0, 0, 1], (4, 1))),
        "TEXCOORD_0": file.add([[0.0, 1], [1, 1], [1, 0], [0, 0]]),
        **more,
    }
    primitive: dict[str, Any] = {"attributes": attributes, "indices": file.add([0, 1, 2, 0, 2, 3], "u2")}
    return {"primitives": [primitive | ({} if material is None else {"material": material})]}


def stage(nodes: list[dict[str, Any]], materials: list[dict[str, Any]] | None = None, **content: Any) -> Gltf:
    """Return a file of a square, mesh 0, and a camera that carries a light at z = 5, node 0."""
    file = Gltf()
    view = {"name": "view", "camera": 0, "translation": [0.0, 0, 5], "extensions": {PUNCTUAL: {"light": 0}}}
    file.content |= {
        "nodes": [view, *nodes],
        "extensions": {PUNCTUAL: {"lights": [{"type": "directional"}]}},
        "cameras": [{"type": "perspective", "perspective": {"yfov": 0.5, "aspectRatio": 2.0}}],
        "materials": materials or [{}],
        "meshes": [square(file)],
    } | content
    return file


def read(file: Gltf, folder: Path, **options: Any):
    return read_gltf(file.write(folder / "scene.glb"), **options)


def test_the_camera_looks_as_its_node_does_and_follows_it(tmp_path: Path):
    file = stage([{"mesh": 0}])
    file.content["animations"] = [
        {
            "channels": [
                {"sampler": 0, "target": {"node": 0, "path": "translation"}},
                {"sampler": 1, "target": {"node": 0, "path": "rotation"}},
            ],
            "samplers": [
                {"input": file.add([0.0, 1.0]), "output": file.add([[0.0, 0, 5], [2, 0, 5]])},
                {"input": file.add([0.0, 1.0]), "output": file.add([[0.0, 0, 0, 1], TURN])},
            ],
        }
    ]
    scene = read(file, tmp_path)
    assert (scene.camera.width, scene.camera.height) == (1024, 512)
    seen, depth = scene.camera.project(np.array([[0.0, math.tan(0.25) * 5, 0.0]]), 0.0)
    np.testing.assert_allclose(seen[0], (512, 0), atol=1e-6)  # the upper edge of the view
    assert depth[0] == pytest.approx(5)
    half = scene.camera.pose(0.5)
    np.testing.assert_allclose(half[:3, 3], (1, 0, 5), atol=1e-12)
    np.testing.assert_allclose(half[:3, 2], (-math.sin(math.pi / 4), 0, -math.cos(math.pi / 4)), atol=1e-12)
    linear, angular = scene.camera.motion.velocity(0.5)
    np.testing.assert_allclose(angular, (0, -math.pi / 2, 0), atol=1e-6)  # its own y points down
    np.testing.assert_allclose(linear, (2, 0, 0), atol=1e-6)


def test_bodies_move_rigidly_where_their_nodes_do_and_bend_elsewhere(tmp_path: Path):
    """A child of an evenly scaled parent is rigid; one that turns below an uneven scale, or grows, is not."""
    places = [{"name": "even", "scale": [2.0, 2, 2], "children": [2]}, {"name": "rigid", "mesh": 0}]
    places += [{"name": "uneven", "scale": [1.0, 2, 1], "children": [4]}, {"name": "sheared", "mesh": 0}]
    places += [{"name": "grown", "mesh": 0}, {"name": "still", "mesh": 0, "translation": [0.0, 3, 0]}]
    file = stage(places)
    turning = {"input": file.add([0.0, 1.0]), "output": file.add([[0.0, 0, 0, 1], TURN])}
    growing = {"input": file.add([0.0, 1.0]), "output": file.add([[1.0, 1, 1], [2, 2, 2]])}
    targets = [(0, 2, "rotation"), (0, 4, "rotation"), (1, 5, "scale")]
    channels = [{"sampler": k, "target": {"node": node, "path": path}} for k, node, path in targets]
    file.content["animations"] = [{"channels": channels, "samplers": [turning, growing]}]
    scene = read(file, tmp_path)
    kinds = {body.name: type(body.motion) for body in scene.bodies}
    assert kinds == {"rigid": Attached, "sheared": Skinned, "grown": Skinned, "still": type(None)}
    half = np.array([[math.cos(math.pi / 4), 0, math.sin(math.pi / 4)], [0, 1, 0], [-math.sin(math.pi / 4), 0, 0]])
    half[2, 2] = math.cos(math.pi / 4)
    expected = {
        "rigid": 2 * SQUARE @ half.T,
        "sheared": SQUARE @ half.T * (1, 2, 1),
        "grown": 1.5 * SQUARE,
        "still": SQUARE + np.array([0.0, 3, 0]),
    }
    for body in scene.bodies:
        placed = body.vertices(0.5) @ body.pose(0.5)[:3, :3].T + body.pose(0.5)[:3, 3]
        np.testing.assert_allclose(placed, expected[body.name], atol=1e-6)


def test_lights_are_in_watts_where_their_nodes_are(tmp_path: Path):
    down = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]  # from -z to -y
    lights = [
        {"type": "point", "intensity": 683.0, "color": [1.0, 0.5, 0.0]},
        {"type": "directional", "intensity": 1366.0},
        {"type": "spot", "intensity": 68.3, "spot": {"innerConeAngle": 0.2, "outerConeAngle": 0.6}},
    ]
    nodes = [{"extensions": {PUNCTUAL: {"light": i}}, "translation": [0.0, i, 0], "rotation": down} for i in range(3)]
    file = stage([{"mesh": 0}, *nodes], extensions={PUNCTUAL: {"lights": lights}})
    _, point, sun, spot = read(file, tmp_path, bands="rgb").lights
    assert isinstance(point, PointLight)
    assert isinstance(sun, DirectionalLight)
    assert isinstance(spot, SpotLight)
    assert point.intensity == pytest.approx((1.0, 0.5, 0.0))
    assert sun.irradiance == pytest.approx((2.0, 2.0, 2.0))
    np.testing.assert_allclose(sun.direction, (0, -1, 0), atol=1e-7)
    assert spot.position == pytest.approx((0, 2, 0))
    assert (spot.inner, spot.outer, spot.smooth) == (0.2, 0.6, False)
    file.content["asset"]["generator"] = "Khronos glTF Blender I/O"
    blender = read(file, tmp_path).lights[3]
    assert blender.smooth
    assert math.cos(blender.inner) == pytest.approx(math.cos(0.6) + (1 - math.cos(0.6)) * (1 - 0.2 / 0.6))


def test_materials_keep_what_they_state(tmp_path: Path):
    values = np.zeros((2, 2, 4), np.uint8)
    values[..., 0] = 255
    values[..., 1] = [[0, 128], [255, 64]]
    values[..., 2] = 51
    values[..., 3] = [[0, 255], [255, 0]]
    file = stage([{"mesh": 0}])
    file.content["images"] = [{"bufferView": file.view(png(values)), "mimeType": "image/png"}]
    file.content["textures"] = [{"source": 0}]
    shown = {"index": 0}
    file.content["materials"] = [
        {
            "pbrMetallicRoughness": {
                "baseColorTexture": shown,
                "baseColorFactor": [0.5, 1, 1, 1],
                "metallicRoughnessTexture": shown,
                "roughnessFactor": 0.5,
            },
            "normalTexture": {"index": 0, "scale": 0.5},
            "emissiveTexture": shown,
            "emissiveFactor": [1.0, 1, 1],
            "alphaMode": "MASK",
            "extensions": {
                "KHR_materials_emissive_strength": {"emissiveStrength": 4.0},
                "KHR_materials_ior": {"ior": 2.0},
                "KHR_materials_clearcoat": {"clearcoatFactor": 0.3, "clearcoatRoughnessFactor": 0.1},
            },
        }
    ]
    (body,) = read(file, tmp_path, bands="rgb").bodies
    found = body.material
    assert isinstance(found, MetallicRoughness)
    for name in ("reflectance", "emission", "metallic", "roughness", "opacity"):
        assert isinstance(getattr(found, name), Texture), name
    np.testing.assert_allclose(found.reflectance.colours()[0, 0], (0.5, 0, ((0.2 + 0.055) / 1.055) ** 2.4), atol=1e-6)
    np.testing.assert_allclose(found.emission.colours()[1, 0, :2], (4, 4), rtol=1e-6)
    np.testing.assert_allclose(found.roughness.pixels(), np.array([[0, 128], [255, 64]]) / 510, atol=1e-6)
    np.testing.assert_allclose(found.metallic.pixels(), 0.2, atol=1e-6)
    np.testing.assert_array_equal(found.opacity.pixels(), [[0, 1], [1, 0]])
    assert isinstance(found.relief, NormalMap)
    normal = found.relief.image[1, 0].astype(float) * 2 - 1
    stated = np.array([1.0, 1.0, 2 * 0.2 - 1]) * (0.5, 0.5, 1)
    np.testing.assert_allclose(normal, stated / np.linalg.norm(stated), atol=1e-6)
    assert (found.ior, found.clearcoat, found.clearcoat_roughness) == (pytest.approx(2.0), 0.3, 0.1)


def test_vertex_colours_unlit_and_the_default_material(tmp_path: Path):
    file = stage([{"mesh": 1}, {"mesh": 2}, {"mesh": 3}])
    colours = file.add(np.array([[1.0, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [1, 1, 1, 1]]))
    file.content["meshes"] += [square(file, 0, COLOR_0=colours), square(file, 1), square(file, None)]
    file.content["materials"] = [
        {"pbrMetallicRoughness": {"baseColorFactor": [0.5, 1, 1, 1]}},
        {"pbrMetallicRoughness": {"baseColorFactor": [0.2, 0.4, 0.6, 1]}, "extensions": {"KHR_materials_unlit": {}}},
    ]
    painted, unlit, default = (body.material for body in read(file, tmp_path, bands="rgb").bodies)
    assert isinstance(painted.reflectance, VertexColours)
    np.testing.assert_allclose(painted.reflectance.colours[0], (0.5, 0, 0))
    assert unlit.emission == pytest.approx((0.2, 0.4, 0.6))
    assert unlit.reflectance == 0
    assert (default.metallic, default.roughness) == (1, 1)


def test_instances_are_repeated(tmp_path: Path):
    file = stage([{"mesh": 0}])
    attributes = {
        "TRANSLATION": file.add([[0.0, 0, 0], [4, 0, 0], [8, 0, 0]]),
        "ROTATION": file.add([[0, 0, 0, 1], TURN, [0, 0, 0, 1]]),
        "SCALE": file.add([[1.0, 1, 1], [1, 1, 1], [-2, 1, 1]]),
    }
    file.content["nodes"][1]["extensions"] = {INSTANCES: {"attributes": attributes}}
    file.content["extensionsRequired"] = [INSTANCES]
    (body,) = read(file, tmp_path).bodies
    assert body.mesh.vertices.shape == (12, 3)
    np.testing.assert_allclose(body.mesh.vertices[4:8, 2], (1, -1, -1, 1), atol=1e-6)
    np.testing.assert_allclose(body.mesh.vertices[8:, 0], (10, 6, 6, 10), atol=1e-6)
    normals = vertex_normals(body.mesh.vertices, body.mesh.faces)
    np.testing.assert_allclose(normals[[0, 4, 8]], [(0, 0, 1), (1, 0, 0), (0, 0, 1)], atol=1e-6)


def test_both_sides_of_a_seam_share_a_normal(tmp_path: Path):
    """Two squares at a right angle: split vertices with one normal are smooth, with two are an edge."""
    upright = np.array([[1.0, -1, 0], [1, -1, -2], [1, 1, -2], [1, 1, 0]])
    for smooth in (True, False):
        file = stage([{"mesh": 0}])
        slanted = np.sqrt(0.5)
        normals = np.tile([0.0, 0, 1], (8, 1))
        normals[4:] = (1, 0, 0)
        if smooth:
            normals[[1, 2, 4, 7]] = (slanted, 0, slanted)
        attributes = {"POSITION": file.add(np.concatenate([SQUARE, upright])), "NORMAL": file.add(normals)}
        corners = file.add([0, 1, 2, 0, 2, 3, 4, 5, 6, 4, 6, 7], "u2")
        file.content["meshes"] = [{"primitives": [{"attributes": attributes, "indices": corners, "material": 0}]}]
        (body,) = read(file, tmp_path).bodies
        found = vertex_normals(body.mesh.vertices, body.mesh.faces, body.mesh.groups)
        np.testing.assert_allclose(found, normals, atol=1e-6)


def test_all_animations_play_unless_two_move_the_same(tmp_path: Path):
    file = stage([{"mesh": 0}, {"mesh": 0}])
    moved = {"input": file.add([0.0, 2.0]), "output": file.add([[0.0, 0, 0], [2, 0, 0]])}
    for node in (1, 2):
        channels = [{"sampler": 0, "target": {"node": node, "path": "translation"}}]
        file.content.setdefault("animations", []).append(
            {"name": f"move {node}", "channels": channels, "samplers": [moved]}
        )
    scene = read(file, tmp_path, start=0.5, speed=2.0)
    for body in scene.bodies:
        np.testing.assert_allclose(body.pose(0.25)[:3, 3], (1, 0, 0), atol=1e-9)
    file.content["animations"][1]["channels"][0]["target"]["node"] = 1
    with pytest.raises(ValueError, match=r"animations move 1 and move 2 both move nodes\[1\], choose one"):
        read(file, tmp_path)
    assert isinstance(read(file, tmp_path, animation="move 2").bodies[0].motion, Attached)


def test_what_is_left_out_is_told_and_what_is_required_refused(tmp_path: Path):
    volume = {"extensions": {"KHR_materials_volume": {}}, "occlusionTexture": {"index": 0}}
    file = stage([{"mesh": 0}], [volume], extensionsUsed=["KHR_materials_volume"])
    del file.content["nodes"][0]["extensions"]
    with pytest.warns(
        UserWarning, match="the extension KHR_materials_volume; .*occlusion.*; no light: lit evenly by 1 W"
    ):
        scene = read(file, tmp_path)
    assert isinstance(scene.lights[0], Constant)
    file.content["extensionsRequired"] = ["KHR_materials_volume"]
    with pytest.raises(ValueError, match="needs the extension KHR_materials_volume, which is not read"):
        read(file, tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": [{"type": "orthographic"}]}, r"cameras\[0\] is orthographic; export a perspective camera"),
        ({"nodes": [{"mesh": 0}]}, "has no camera; export the cameras, too"),
        ({"nodes": [{"camera": 0}]}, "its scene has no mesh"),
        ({"nodes": [{"camera": 0, "scale": [-1.0, 1, 1]}, {"mesh": 0}]}, "is mirrored by a negative scale"),
        ({"nodes": [{"camera": 3}, {"mesh": 0}]}, r"names cameras\[3\]; there are 1"),
        ({"materials": [{"alphaMode": "GLOW"}]}, r"materials\[0\].*alphaMode"),
        ({"nodes": [{"camera": 0}, {"mesh": 0, "extensions": {PUNCTUAL: {"light": 1}}}]}, "there are 1"),
    ],
)
def test_a_file_that_is_no_scene_is_refused(tmp_path: Path, change: dict[str, Any], message: str):
    file = stage([{"mesh": 0}])
    file.content |= change
    with pytest.raises(ValueError, match=message):
        read(file, tmp_path)


def test_several_cameras_are_chosen_by_name_or_by_the_seed(tmp_path: Path):
    file = stage([{"mesh": 0}, {"name": "side", "camera": 0, "translation": [5.0, 0, 0], "rotation": TURN}])
    path = file.write(tmp_path / "two.glb")
    assert cameras_in(path) == ["view", "side"]
    with pytest.raises(ValueError, match="has 2 cameras, choose one: view, side"):
        read_gltf(path)
    with pytest.raises(ValueError, match=r"has no camera 'sid' \(did you mean 'side'\?\)"):
        scenes.load(path, camera="sid")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        origins = [scenes.load(path, seed).camera.origin for seed in range(3)]
    assert origins == [(0.0, 0.0, 5.0), (5.0, 0.0, 0.0), (0.0, 0.0, 5.0)]
    for word, value in (("camera", "side"), ("start", 1.0)):
        with pytest.raises(ValueError, match=f"fan: {word} is for .glb and .gltf files"):
            scenes.load("fan", **{word: value})


@pytest.mark.parametrize("moves", [False, True])
def test_the_command_renders_a_file_and_says_what_it_shows(tmp_path: Path, capsys, moves: bool):
    file = stage([{"mesh": 0}])
    if moves:
        keys = {"input": file.add([0.0, 2.0]), "output": file.add([[0.0, 0, 0], [2, 0, 0]])}
        channels = [{"sampler": 0, "target": {"node": 1, "path": "translation"}}]
        file.content["animations"] = [{"channels": channels, "samplers": [keys]}]
    path = file.write(tmp_path / "s.glb")
    words = f"render {path} -o {tmp_path}/out --frames 2 --height 8 --psnr 20 --camera view"
    if not moves:
        for word in ("start", "speed"):
            assert main(f"{words} --{word} 2".split()) == 2
            assert f"has no animation, nothing moves; leave --{word} out" in capsys.readouterr().err
    assert main((f"{words} --start 1" if moves else words).split()) == 0
    said = capsys.readouterr().out
    assert "2 frames of 8 x 16" in said
    expected = "and plays its animations of 2 s, again and again, at 1 times" if moves else ", at rest"
    assert f"shows 1 bodies of {path}{' ' if moves else ''}{expected}" in said


def everything(folder: Path) -> Gltf:
    """Return a file with an animation, a light, a picture in all places, instances and colours of vertices."""
    values = np.full((2, 2, 4), 128, np.uint8)
    copies = {INSTANCES: {"attributes": {}}}
    file = stage([{"mesh": 0}, {"mesh": 1, "extensions": copies}, {"children": [1], "scale": [2.0, 2, 2]}])
    copies[INSTANCES]["attributes"]["TRANSLATION"] = file.add([[0.0, 0, 0], [4, 0, 0]])
    file.content["images"] = [{"bufferView": file.view(png(values)), "mimeType": "image/png"}]
    file.content["textures"] = [{"source": 0, "sampler": 0}]
    file.content["samplers"] = [{"wrapS": 33648, "wrapT": 10497, "magFilter": 9729}]
    info = {"index": 0, "texCoord": 0, "extensions": {"KHR_texture_transform": {"scale": [2.0, 1.0], "rotation": 0.1}}}
    metal = {"baseColorTexture": info, "metallicRoughnessTexture": info, "baseColorFactor": [1.0, 1, 1, 1]}
    extensions = {
        "KHR_materials_ior": {"ior": 1.4},
        "KHR_materials_specular": {"specularFactor": 0.5},
        "KHR_materials_transmission": {"transmissionFactor": 0.5},
        "KHR_materials_emissive_strength": {"emissiveStrength": 2.0},
        "KHR_materials_clearcoat": {"clearcoatFactor": 0.5},
    }
    file.content["materials"] = [
        {
            "pbrMetallicRoughness": metal,
            "normalTexture": info | {"scale": 1.0},
            "emissiveTexture": info,
            "emissiveFactor": [1.0, 1, 1],
            "alphaMode": "MASK",
            "alphaCutoff": 0.5,
            "extensions": extensions,
        },
        {},
    ]
    file.content["meshes"].append(square(file, 1, COLOR_0=file.add(np.ones((4, 3)))))
    keys = {"input": file.add([0.0, 1.0]), "output": file.add([[0.0, 0, 0, 1], TURN]), "interpolation": "LINEAR"}
    channels = [{"sampler": 0, "target": {"node": 3, "path": "rotation"}}]
    file.content["animations"] = [{"name": "turn", "channels": channels, "samplers": [keys]}]
    file.write(folder / "whole.glb")
    return file


def searched(folder: Path, only: slice) -> int:
    """Read files of which one value is wrong; return how many were refused. Any other error is a fault."""
    file = everything(folder)
    content = file.content
    refused = 0
    for place in list(places(content))[only]:
        for wrong in (None, -1, 1e300, "text", [], {}, 10**9, [[[]]]):
            file.content = replaced(content, place, wrong)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                _, message = attempt(lambda: read(file, folder))
            assert len(message.splitlines()) <= 1
            refused += bool(message)
    return refused


def test_a_file_with_a_wrong_value_is_read_or_refused(tmp_path: Path):
    assert searched(tmp_path, slice(None, None, 29)) > 10


@pytest.mark.slow
def test_every_wrong_value_is_read_or_refused(tmp_path: Path):
    assert searched(tmp_path, slice(None)) > 500
