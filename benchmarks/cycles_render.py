"""Renders a neutral file of cycles_scene.py with Blender's Cycles: linear radiance and seconds of every frame.

    python cycles_render.py SCENE.npz OUT.npz --samples 16 --denoise ACCURATE/HIGH

It runs in its own environment (`pip install bpy==5.0.0 numpy`) and imports nothing of this project. Blender is under
the GPL, so nothing of this project imports this file either. OUT.npz holds `radiance` float32 [T, H, W] and `seconds`
[T, 2]: wall and processor seconds from the poses of a frame to its picture, without writing. Cycles gets a pixel's own
area as filter, no clamp and no other approximation that changes the mean.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

FORMAT = 1
VERSION = (5, 0)  # of Blender; others have other defaults
UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # y up -> Blender's z up
CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])  # x right, y down, z forward -> Blender's y up, looking along -z
LAMP = np.diag([1.0, -1.0, -1.0, 1.0])  # emits towards +z -> Blender's -z
BEHIND = 1e-4  # of a lamp's size: distance of its black back
Moving = list[tuple[Any, np.ndarray]]  # objects and their matrices [T, 4, 4]


def read(path: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the description and the arrays of a neutral file."""
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    description = json.loads(str(arrays.pop("description")))
    if description["format"] != FORMAT:
        raise ValueError(f"{path}: expected format {FORMAT}, found {description['format']}")
    return description, arrays


def parts(arrays: dict[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    """Return the arrays of one body or light, by the rest of their names."""
    start = f"{name}_"
    return {key[len(start) :]: value for key, value in arrays.items() if key.startswith(start)}


def build(description: dict[str, Any], arrays: dict[str, np.ndarray]) -> Moving:
    """Fill an empty scene; return what is placed at every frame."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    moving: Moving = [(camera(description), arrays["cameras"] @ CAMERA)]
    for i, body in enumerate(description["bodies"]):
        found = parts(arrays, f"body{i}")
        moving.append((add(mesh(found, material(body, found))), found["poses"]))
    for i, light in enumerate(description["lights"]):
        found = parts(arrays, f"light{i}")
        if light["light"] == "area":
            moving += lamp(light, found["poses"])
        else:
            surroundings(light, found)
    return [(thing, UP @ matrices) for thing, matrices in moving]


def add(data: Any) -> Any:
    """Return a new object of the scene."""
    thing = bpy.data.objects.new("thing", data)
    thing.cycles.shadow_terminator_geometry_offset = 0.0
    thing.visible_camera = True  # lamps are invisible by default
    bpy.context.scene.collection.objects.link(thing)
    return thing


def camera(description: dict[str, Any]) -> Any:
    """Return the camera, of the field of view of the description, as an object of the scene."""
    data = bpy.data.cameras.new("camera")
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = 36.0
    data.clip_start = 1e-3
    data.lens = 36.0 * description["focal_pixels"] / description["width"]
    bpy.context.scene.camera = add(data)
    return bpy.context.scene.camera


def mesh(found: dict[str, np.ndarray], coat: Any) -> Any:
    """Return a mesh of one material."""
    data = bpy.data.meshes.new("mesh")
    data.from_pydata(found["vertices"].tolist(), [], found["faces"].tolist())
    data.materials.append(coat)
    data.polygons.foreach_set("use_smooth", np.full(len(found["faces"]), "normals" in found))
    if "normals" in found:
        normals = data.attributes.new("custom_normal", "FLOAT_VECTOR", "POINT")
        normals.data.foreach_set("vector", np.ravel(found["normals"]).astype(np.float32))
    if "uv" in found:
        corners = found["uv"][np.ravel(found["faces"])]
        data.uv_layers.new().data.foreach_set("uv", np.ravel(corners).astype(np.float32))
    data.update()
    return data


def picture(values: np.ndarray) -> Any:
    """Return an image of grey values [H, W], row 0 on top, which Cycles takes as they are."""
    height, width = values.shape
    image = bpy.data.images.new("picture", width, height, float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    image.use_half_precision = False
    four = np.repeat(values[::-1, :, None].astype(np.float32), 4, axis=2)
    four[..., 3] = 1
    image.pixels.foreach_set(four.ravel())
    image.pack()
    return image


def tree_of(owner: Any, output: str) -> tuple[Any, Any]:
    """Return the empty node tree of a material or world, and its output."""
    with warnings.catch_warnings():  # it is true from the start in a later Blender, which warns of setting it
        warnings.simplefilter("ignore", DeprecationWarning)
        owner.use_nodes = True
    owner.node_tree.nodes.clear()
    return owner.node_tree, owner.node_tree.nodes.new(output).inputs["Surface"]


def material(body: dict[str, Any], found: dict[str, np.ndarray]) -> Any:
    """Return the material of a body."""
    coat = bpy.data.materials.new("material")
    tree, output = tree_of(coat, "ShaderNodeOutputMaterial")
    if body["material"] == "conductor":
        node = tree.nodes.new("ShaderNodeBsdfMetallic")
        node.distribution = "GGX"
        node.fresnel_type = "PHYSICAL_CONDUCTOR"
        node.inputs["IOR"].default_value = [body["eta"]] * 3
        node.inputs["Extinction"].default_value = [body["k"]] * 3
        node.inputs["Roughness"].default_value = math.sqrt(body["alpha"])
    else:
        node = tree.nodes.new("ShaderNodeBsdfDiffuse")
        if body["material"] == "textured":
            texture = tree.nodes.new("ShaderNodeTexImage")
            texture.image = picture(found["texture"])
            texture.extension = "REPEAT"
            texture.interpolation = "Closest" if body["nearest"] else "Linear"
            tree.links.new(texture.outputs["Color"], node.inputs["Color"])
        else:
            node.inputs["Color"].default_value = (*[body["reflectance"]] * 3, 1.0)
    tree.links.new(node.outputs["BSDF"], output)
    return coat


def lamp(light: dict[str, Any], poses: np.ndarray) -> Moving:
    """Return an area lamp and its black back, which hides what is behind it, as objects with matrices."""
    sizes = 2 * np.linalg.norm(poses[0, :3, :2], axis=0)
    data = bpy.data.lights.new("lamp", "AREA")
    data.shape = "RECTANGLE"
    data.size, data.size_y = sizes.tolist()
    data.energy = light["radiance"] * math.pi * float(np.prod(sizes))
    rigid = poses @ np.diag([*(2 / sizes), 1, 1])
    x, y = np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]]) * sizes[:, None] / 2
    corners = np.stack([x, y, np.full(4, -BEHIND * sizes.max())], axis=1)
    black = material({"material": "diffuse", "reflectance": 0.0}, {})
    back = mesh({"vertices": corners, "faces": np.array([[0, 1, 2], [0, 2, 3]])}, black)
    return [(add(data), rigid @ LAMP), (add(back), rigid)]


def surroundings(light: dict[str, Any], found: dict[str, np.ndarray]) -> None:
    """Light the scene from all sides."""
    world = bpy.context.scene.world = bpy.data.worlds.new("world")
    tree, output = tree_of(world, "ShaderNodeOutputWorld")
    node = tree.nodes.new("ShaderNodeBackground")
    if light["light"] == "constant":
        node.inputs["Color"].default_value = (*[light["radiance"]] * 3, 1.0)
    else:
        texture = tree.nodes.new("ShaderNodeTexEnvironment")
        quarter = found["map"].shape[1] // 4  # our middle, +z, is Blender's -y, a quarter of a turn from its middle
        texture.image = picture(np.roll(found["map"], quarter, axis=1))
        tree.links.new(texture.outputs["Color"], node.inputs["Color"])
    tree.links.new(node.outputs["Background"], output)


def configure(description: dict[str, Any], options: argparse.Namespace) -> None:
    """Set film, samples, depth and denoiser; nothing is clamped, filtered, cut or adapted."""
    scene = bpy.context.scene
    render = scene.render
    cycles = scene.cycles
    render.engine = "CYCLES"
    cycles.device = "CPU"
    render.threads_mode = "FIXED"
    render.threads = options.threads
    render.resolution_x = description["width"]
    render.resolution_y = description["height"]
    render.resolution_percentage = 100
    render.use_persistent_data = True
    render.use_compositing = render.use_sequencer = False
    scene.view_settings.view_transform = "Raw"
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    cycles.samples = options.samples
    cycles.seed = options.seed
    cycles.use_adaptive_sampling = False
    # Less time for the same error on scenes of one lamp, and less error of denoised pictures in the same time
    cycles.use_light_tree = False
    cycles.sampling_pattern = "BLUE_NOISE"
    cycles.pixel_filter_type = "BOX"
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = options.bounces - 1  # beyond the first hit
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.blur_glossy = cycles.light_sampling_threshold = 0.0
    cycles.use_denoising = options.denoise is not None
    if options.denoise is not None:
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
        cycles.denoising_prefilter, cycles.denoising_quality = options.denoise.split("/")


def rendered(moving: Moving, frame: int, folder: Path) -> tuple[np.ndarray, list[float]]:
    """Return the radiance [H, W] of a frame, and its wall and processor seconds."""
    wall = time.perf_counter()
    processor = time.process_time()
    for thing, matrices in moving:
        thing.matrix_world = Matrix(matrices[frame].tolist())
    bpy.ops.render.render()
    seconds = [time.perf_counter() - wall, time.process_time() - processor]
    path = folder / f"{frame}.exr"
    bpy.data.images["Render Result"].save_render(str(path))
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    values = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    return values.reshape(height, width, 4)[::-1, :, :3].mean(axis=2), seconds


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="neutral file")
    parser.add_argument("out", help="radiance and seconds, .npz")
    parser.add_argument("--samples", type=int, required=True, help="per pixel")
    parser.add_argument("--bounces", type=int, default=32, help="scatterings along a path (default 32)")
    parser.add_argument("--denoise", metavar="PREFILTER/QUALITY", help="in Cycles' words: ACCURATE/HIGH is its default")
    parser.add_argument("--frames", help="comma-separated (default all)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    if bpy.app.version[:2] != VERSION:
        raise ValueError(f"expected Blender {VERSION[0]}.{VERSION[1]}, found {bpy.app.version_string}")
    description, arrays = read(options.scene)
    frames = range(description["frames"]) if options.frames is None else map(int, options.frames.split(","))
    moving = build(description, arrays)
    configure(description, options)
    with tempfile.TemporaryDirectory() as folder:
        pictures, seconds = zip(*[rendered(moving, frame, Path(folder)) for frame in frames], strict=True)
    np.savez(options.out, radiance=np.stack(pictures), seconds=np.array(seconds))
    return 0


if __name__ == "__main__":
    sys.exit(main())
