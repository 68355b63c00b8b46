"""Tests the coordinates and colours of mesh files: rendered pixels against the picture, and what is refused."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from gltf_files import Gltf, arm
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from qsim.colour import LUMINANCE, to_linear
from qsim.optics import RGB
from qsim.optics.camera import Camera
from qsim.rendering.budget import Budget
from qsim.rendering.renderer import Renderer
from qsim.scene import Body, Constant, Diffuse, Patches, Scene, Still, Texture, animated_file
from qsim.scene.shapes import mesh_file, mesh_material

SIDE = 12  # pixels, of the quad and of the frame that it fills
QUAD = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
UPRIGHT = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])  # v up
CODES = np.random.default_rng(5).integers(0, 256, (4, 3, 3), dtype=np.uint8)


def png(codes: np.ndarray = CODES) -> bytes:
    """Return the bytes of a picture."""
    data = io.BytesIO()
    Image.fromarray(codes).save(data, "png")
    return data.getvalue()


def quad_file(path: Path, uv: np.ndarray = UPRIGHT, codes: np.ndarray = CODES, factor: Any = (1.0, 1.0, 1.0)) -> Path:
    """Write a textured square as trimesh does, its colour times `factor`."""
    picture = Image.fromarray(codes)
    if path.suffix == ".obj":
        material = SimpleMaterial(image=picture, diffuse=np.uint8(np.rint(np.array(factor) * 255)))
    else:
        material = PBRMaterial(baseColorTexture=picture, baseColorFactor=[*factor, 1.0])
    visual = TextureVisuals(uv=uv, material=material)
    trimesh.Trimesh(QUAD, FACES, visual=visual, process=False).export(path)
    return path


def gltf(samplers: Any = None, info: Any = None, image: Any = None, **attributes: np.ndarray) -> Gltf:
    """Return a square with a picture in the file, and coordinates with v down as glTF has them."""
    file = Gltf()
    places = {"TEXCOORD_0": UPRIGHT * (1, -1) + (0, 1)} | attributes
    primitive = {
        "attributes": {"POSITION": file.add(QUAD)} | {name: file.add(each) for name, each in places.items()},
        "indices": file.add(FACES.ravel(), "u2"),
        "material": 0,
    }
    file.content |= {
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0} | (info or {})}}],
        "textures": [{"source": 0} | ({"sampler": 0} if samplers else {})],
        "images": [image or {"bufferView": file.view(png()), "mimeType": "image/png"}],
    }
    if samplers:
        file.content["samplers"] = [samplers]
    return file


def shown(paths: list[Path], *, colour: bool) -> list[np.ndarray]:
    """Return the reflectances of squares under even light, [SIDE, SIDE, 3] or [SIDE, SIDE]: the means of pixels.

    They stand side by side, far away; a sky of radiance 1 makes the radiance the reflectance.
    """
    bodies = [
        Body(str(i), mesh_file(path), mesh_material(path) or Diffuse(0.0), Still((2.0 * i - len(paths) + 1, 0.0, 0.0)))
        for i, path in enumerate(paths)
    ]
    camera = Camera(SIDE * 5e-4, 2.8, 1e-6, SIDE, SIDE * len(paths), origin=(0, 0, 1000.0), vignetting=False)
    scene = Scene("squares", 0, camera, (Constant(1.0),), tuple(bodies), bands=RGB if colour else None)
    frame = Renderer(scene, frame_rate=1000.0, budget=Budget(256, 1)).frame(0).radiance
    return np.split(np.moveaxis(frame, 0, -1) if colour else frame, len(paths), axis=1)


def looked_up(
    picture: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    modes: tuple[str, str] = ("wrap", "wrap"),
    *,
    nearest: bool = False,
) -> np.ndarray:
    """Return the values of a picture [H, W, C] at coordinates, v down, as OpenGL looks them up; modes are NumPy's."""
    height, width = picture.shape[:2]
    pad = 3
    padded = picture
    for axis, mode in ((1, modes[0]), (0, modes[1])):
        widths = [(0, 0)] * 3
        widths[axis] = (pad * picture.shape[axis],) * 2
        padded = np.pad(padded, widths, mode=mode)
    x = (u + pad) * width - 0.5
    y = (v + pad) * height - 0.5
    if nearest:
        return padded[np.rint(y).astype(int), np.rint(x).astype(int)]
    left = np.floor(x).astype(int)
    top = np.floor(y).astype(int)
    a = (x - left)[..., None]
    b = (y - top)[..., None]
    upper = padded[top, left] * (1 - a) + padded[top, left + 1] * a
    lower = padded[top + 1, left] * (1 - a) + padded[top + 1, left + 1] * a
    return upper * (1 - b) + lower * b


def expected(change: Any = lambda u, v: (u, v), **how: Any) -> np.ndarray:
    """Return the means of pixels whose coordinates, u right and v down, `change` maps to those in the picture."""
    fine = 16
    at = (np.arange(SIDE * fine) + 0.5) / (SIDE * fine)
    v, u = np.meshgrid(at, at, indexing="ij")
    values = looked_up(to_linear(CODES, "srgb", 255).astype(np.float64), *change(u, v), **how)
    return values.reshape(SIDE, fine, SIDE, fine, 3).mean(axis=(1, 3))


SAMPLERS = {  # of glTF: the modes of NumPy's pad along u and v
    "repeat": ({"wrapS": 10497, "wrapT": 10497}, ("wrap", "wrap")),
    "clamp": ({"wrapS": 33071, "wrapT": 33071}, ("edge", "edge")),
    "mirror": ({"wrapS": 33648, "wrapT": 33648}, ("symmetric", "symmetric")),
    "mirror u": ({"wrapS": 33648, "wrapT": None}, ("symmetric", "wrap")),
    "mirror v": ({"wrapT": 33648}, ("wrap", "symmetric")),
    "nearest": ({"wrapT": 33648, "magFilter": 9728}, ("wrap", "symmetric")),
}
FACTOR = np.array([1.0, 0.6, 0.2])  # whole 255ths
DOWN = UPRIGHT * (1, -1) + (0, 1)  # coordinates with v down


def squares(folder: Path) -> dict[str, tuple[Path, np.ndarray]]:
    """Write squares with coordinates and pictures of many kinds; return each with the pixels that it must show."""
    turned = np.stack([0.1 + 0.7 * UPRIGHT[:, 1], 0.2 + 0.6 * UPRIGHT[:, 0]], axis=-1)  # u along +y, v along +x
    wanted = expected(lambda u, v: (0.1 + 0.7 * (1 - v), 1 - (0.2 + 0.6 * u))) * FACTOR
    found = {kind: (quad_file(folder / f"quad.{kind}", turned, factor=FACTOR), wanted) for kind in ("obj", "glb")}
    for name, (sampler, modes) in SAMPLERS.items():
        path = gltf(sampler, TEXCOORD_0=DOWN * (2.5, 2.25) - (0.75, 0.5)).write(folder / f"{name}.glb")
        how = {"modes": modes, "nearest": "magFilter" in sampler}
        found[name] = path, expected(lambda u, v: (2.5 * u - 0.75, 2.25 * v - 0.5), **how)
    path = gltf({"wrapT": 33071}, TEXCOORD_0=DOWN * (2.5, 1) - (0.75, 0)).write(folder / "one axis.glb")
    found["clamp v"] = path, expected(lambda u, v: (2.5 * u - 0.75, v), modes=("wrap", "edge"))
    path = gltf(info={"texCoord": 1}, TEXCOORD_1=DOWN * 0.5 + 0.25).write(folder / "second.glb")
    found["second set"] = path, expected(lambda u, v: (0.25 + 0.5 * u, 0.25 + 0.5 * v))
    # The example in the extension's text, which shows the lower left quarter of the picture
    turn = {"KHR_texture_transform": {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}}
    path = gltf(info={"extensions": turn}).write(folder / "turned.glb")
    found["transform"] = path, expected(lambda u, v: (0.5 * v, 1 - 0.5 * u))
    return found


@pytest.mark.parametrize("colour", [True, False])
def test_pixels_show_the_picture_at_the_coordinates_of_the_file(tmp_path, colour):
    """A 16 x 16 grid of samples per pixel misses the mean of a texel's edge, nearest, by up to 1/16 of its contrast."""
    made = dict(list(squares(tmp_path).items())[: 2 if colour else None])  # a kernel of three bands takes long
    images = shown([path for path, _ in made.values()], colour=colour)
    for (name, (_, wanted)), image in zip(made.items(), images, strict=True):
        bound = 0.07 if name == "nearest" else 0.012
        np.testing.assert_allclose(image, wanted if colour else wanted @ LUMINANCE, atol=bound, err_msg=name)


def test_a_picture_that_repeats_in_a_way_that_cannot_be_shown_is_refused(tmp_path):
    path = gltf({"wrapS": 33071}, TEXCOORD_0=DOWN * (2.5, 1) - (0.75, 0)).write(tmp_path / "quad.glb")
    with pytest.raises(ValueError, match=r"materials\[0\]: its picture is clamped along u, not along the other axis"):
        mesh_material(path)
    path = gltf(info={"texCoord": 3}).write(tmp_path / "turned.glb")
    with pytest.raises(ValueError, match="has no TEXCOORD_3, which the picture of its material needs"):
        mesh_file(path)


def test_images_in_the_file_beside_it_and_as_text_are_one_picture(tmp_path):
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "a picture.png").write_bytes(png())
    text = json.loads(gltf().write(tmp_path / "t.gltf", "text").read_text())["buffers"][0]["uri"]
    assert text.startswith("data:")
    beside = {"uri": "below/a%20picture.png"}
    written = gltf(image=beside).write(tmp_path / "beside.gltf", "beside")
    trimesh_made = quad_file(tmp_path / "quad.obj")
    found = [mesh_material(each) for each in (gltf().write(tmp_path / "in.glb"), written, trimesh_made)]
    linear = to_linear(CODES, "srgb", 255)
    for each in found[:2]:
        np.testing.assert_array_equal(each.reflectance.colours(), linear)
        assert each.reflectance.source == found[0].reflectance.source
    np.testing.assert_allclose(found[2].reflectance.colours(), linear, rtol=1e-6)


@pytest.mark.parametrize("leads", ["../away.png", "link.png", "pipe", "/dev/zero", "%2e%2e/away.png"])
def test_an_image_is_a_regular_file_beside_the_mesh(tmp_path, leads):
    folder = tmp_path / "here"
    folder.mkdir()
    (tmp_path / "away.png").write_bytes(png())
    (folder / "link.png").symlink_to(tmp_path / "away.png")
    os.mkfifo(folder / "pipe")
    path = gltf(image={"uri": leads}).write(folder / "quad.gltf", "text")
    assert len(mesh_file(path).faces) == 2
    with pytest.raises(ValueError, match=r"images\[0\]: .*(leads out of|no regular file)"):
        mesh_material(path)
    quad_file(folder / "quad.obj")
    text = (folder / "material.mtl").read_text().replace("material_0.png", leads.replace("%2e", "."))
    (folder / "material.mtl").write_text(text)
    with pytest.raises(ValueError, match=r"material 'material_0': .*(leads out of|no regular file)"):
        mesh_material(folder / "quad.obj")


def test_missing_and_damaged_pictures_are_one_sentence(tmp_path):
    path = gltf(image={"uri": "lost.png"}).write(tmp_path / "quad.gltf", "text")
    with pytest.raises(FileNotFoundError, match=r"images\[0\]: the file is missing: .*lost\.png; put it there"):
        mesh_material(path)
    (tmp_path / "lost.png").write_bytes(b"text")
    with pytest.raises(ValueError, match=r"images\[0\]: lost\.png: not a readable image"):
        mesh_material(path)
    path = quad_file(tmp_path / "quad.obj")
    (tmp_path / "material_0.png").unlink()
    assert mesh_file(path).uv is not None
    with pytest.raises(FileNotFoundError, match=r"material 'material_0': the file is missing: .*material_0\.png"):
        mesh_material(path)
    (tmp_path / "material.mtl").unlink()
    assert mesh_file(path).uv is not None
    with pytest.raises(FileNotFoundError, match=r"mtllib: the file is missing: .*material\.mtl"):
        mesh_material(path)
    basis = gltf()
    basis.content["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
    with pytest.raises(ValueError, match="has only one of KHR_texture_basisu, which is not read; export PNG or JPEG"):
        mesh_material(basis.write(tmp_path / "basis.glb"))


OBJ = """mtllib two.mtl
v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt 0 0
vt 1 0
vt 1 1
usemtl painted # a comment
f 1/1 2/2 -2/-1
usemtl plain
f 1//1 3//1 4//1
"""
MTL = "newmtl painted\nKd 1 1 1\nmap_Kd -s 2 3 -o 0.5 picture.png\nnewmtl plain\nKd 0.25 0.5 0.75\n"


def write_obj(folder: Path, obj: str = OBJ, mtl: str = MTL) -> Path:
    (folder / "picture.png").write_bytes(png())
    (folder / "two.mtl").write_text(mtl)
    (folder / "two.obj").write_text(obj)
    return folder / "two.obj"


def test_a_file_of_two_materials_is_one_body_of_patches(tmp_path):
    path = write_obj(tmp_path)
    mesh = mesh_file(path)
    material = mesh_material(path)
    assert isinstance(material, Patches)
    assert material.counts == (1, 1)
    np.testing.assert_allclose(mesh.uv[mesh.faces[0]], [(0.5, 0), (2.5, 0), (2.5, 3)])
    np.testing.assert_allclose(material.materials[1].reflectance.colours(), [[(0.25, 0.5, 0.75)]])
    with pytest.raises(ValueError, match="its Patches are of 2 faces, its mesh has 1"):
        Body("part", type(mesh)(mesh.vertices, mesh.faces[:1], mesh.uv), material)


def test_texts_of_older_and_of_other_programs_are_read(tmp_path):
    """A mark of UTF-8 and ends of lines as on Windows; names in Latin-1."""
    path = write_obj(tmp_path, OBJ, MTL)
    wanted = mesh_material(path).materials[0].reflectance.colours()
    path.write_bytes(b"\xef\xbb\xbf" + OBJ.replace("\n", "\r\n").encode())
    (tmp_path / "two.mtl").write_bytes(MTL.replace("picture.png", "bäd name.png").encode("latin-1"))
    (tmp_path / "picture.png").rename(tmp_path / "bäd name.png")
    np.testing.assert_array_equal(mesh_material(path).materials[0].reflectance.colours(), wanted)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("f 1/1 2/2 -2/-1", "f 1/1 2/2 9/1"), "line 10: vertex 9 does not exist; 4 stand before this line"),
        (("f 1/1 2/2 -2/-1", "f 1/1 2/2"), "line 10: a face needs three corners, found 2"),
        (("f 1/1 2/2 -2/-1", "f 1/1 2/x 3/1"), "line 10: 2/x is no corner of a face"),
        (("v 1 1 0", "v 1 nan 0"), "line 4: finite numbers are expected, found 1 nan 0"),
        (("usemtl plain", "usemtl lost"), "line 11: usemtl lost: no material of this name"),
        (("Kd 1 1 1", "Kd 0 0 0"), "material 'painted': Kd 0 0 0 makes its picture black; set Kd to 1 1 1"),
        (("Kd 1 1 1", "Kd 1 2 1"), "line 2: Kd needs three numbers from 0 to 1, found 1 2 1"),
        (("-s 2 3", "-mm 0 1"), "line 3: the option -mm of map_Kd is not read; bake it into the picture"),
        ((" picture.png", ""), "line 3: map_Kd names no picture"),
    ],
)
def test_a_wrong_obj_file_is_refused_in_one_sentence(tmp_path, change, message):
    path = write_obj(tmp_path, OBJ.replace(*change), MTL.replace(*change))
    with pytest.raises(ValueError, match=message) as error:
        mesh_material(path)
    assert "\n" not in str(error.value)


def test_a_body_that_bends_has_its_colours_and_the_truth_of_all_its_patches(tmp_path):
    """Each triangle of a patch is found under its number in the whole mesh: flow follows the skin on both."""
    file = arm()
    primitive = file.content["meshes"][0]["primitives"][0]
    whole = np.concatenate([[(i, i + 2, i + 1), (i + 1, i + 2, i + 3)] for i in range(0, 12, 2)])
    parts = [(whole[:3], 0), (whole[3:8], 1), (whole[8:], 0)]  # those of one material become one patch
    file.content["meshes"][0]["primitives"] = [
        primitive | {"indices": file.add(faces.ravel(), "u2"), "material": i} for faces, i in parts
    ]
    file.content["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [c, c, c, 1]}} for c in (0.2, 0.8)]
    path = file.write(tmp_path / "arm.glb")
    mesh, motion = animated_file(path, 2.0, carrier=Still())
    material = mesh_material(path)
    assert isinstance(material, Patches)
    assert material.counts == (7, 5)
    frames = []
    for each in (material, Diffuse(0.5)):
        camera = Camera(3e-5, 2.8, 1e-6, 12, 40, origin=(0, 0, 2.0))
        scene = Scene("arm", 0, camera, (Constant(1.0),), (Body("arm", mesh, each, motion),))
        frames.append(Renderer(scene, frame_rate=10.0, budget=Budget(16, 1)).frame(2))
    np.testing.assert_array_equal(frames[0].flow, frames[1].flow)
    np.testing.assert_array_equal(frames[0].body_id, frames[1].body_id)
    assert np.hypot(*frames[0].flow)[frames[0].body_id == 0].max() > 1
    on = frames[0].radiance[frames[0].body_id == 0]
    assert on.min() < 0.45
    assert on.max() > 0.75


def test_a_small_file_that_shows_one_picture_often_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("qsim.limits.TEXELS", 100)
    file = gltf()
    primitive = file.content["meshes"][0]["primitives"][0]
    file.content["meshes"][0]["primitives"] = [primitive | {"material": i} for i in range(20)]
    file.content["materials"] *= 20
    assert len(mesh_material(file.write(tmp_path / "often.glb")).materials) == 20  # all share one picture
    for material in file.content["materials"]:
        material["pbrMetallicRoughness"]["baseColorFactor"] = [0.5, 1, 1, 1]
    with pytest.raises(ValueError, match=r"materials\[8\]: the pictures of the file have over 100 pixels in all"):
        mesh_material(file.write(tmp_path / "often.glb"))


def test_a_texture_wraps_in_a_known_way():
    with pytest.raises(ValueError, match="one of repeat, mirror, clamp is expected, got 'border'"):
        Texture(np.zeros((2, 2)), wrap="border")
