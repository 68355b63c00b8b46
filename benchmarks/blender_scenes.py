"""Builds twenty scenes in Blender, exports them as glTF, and renders them with Cycles.

    python blender_scenes.py FOLDER --samples 256

It runs in an environment of its own (`pip install bpy==5.0.1`) and imports nothing of this project. Blender is under
the GPL, so nothing of this project imports this file either. FOLDER gets NAME.glb by Blender's own exporter, and
NAME_T.exr for every frame T: radiance, and Blender's vector pass. Cycles gets a pixel's own area as filter, no clamp
and no other approximation that changes the mean.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

FPS = 100
FRAMES = 3
LAST = 20  # the key at the end of every motion
WIDTH = 160
HEIGHT = 120


def surface(name: str, **inputs: Any) -> Any:
    """Return a principled material; underscores in names of inputs stand for blanks."""
    made = bpy.data.materials.new(name)
    node = made.node_tree.nodes["Principled BSDF"]
    for key, value in inputs.items():
        node.inputs[key.replace("_", " ")].default_value = value
    return made


def picture(name: str, values: np.ndarray) -> Any:
    """Return an sRGB image of values [H, W, 4], row 0 below."""
    height, width = values.shape[:2]
    image = bpy.data.images.new(name, width, height, alpha=True)
    image.pixels.foreach_set(np.ascontiguousarray(values, np.float32).ravel())
    image.pack()
    return image


def chequered(cells: int = 8, texels: int = 64) -> np.ndarray:
    """Return a chequered picture [texels, texels, 4] with a ramp across, so that no two places look alike."""
    i = np.arange(texels)
    odd = (i[:, None] * cells // texels + i[None, :] * cells // texels) % 2
    ramp = i / (texels - 1)
    values = np.ones((texels, texels, 4), np.float32)
    values[..., 0] = 0.2 + 0.6 * odd
    values[..., 1] = 0.2 + 0.3 * odd + 0.3 * ramp[None, :]
    values[..., 2] = 0.2 + 0.6 * ramp[:, None]
    return values


def textured(made: Any, image: Any, with_alpha: bool = False) -> Any:
    """Return a material whose base colour, and opacity, are those of an image."""
    tree = made.node_tree
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    tree.links.new(texture.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    if with_alpha:
        clip = tree.nodes.new("ShaderNodeMath")
        clip.operation = "GREATER_THAN"
        clip.inputs[1].default_value = 0.5
        tree.links.new(texture.outputs["Alpha"], clip.inputs[0])
        tree.links.new(clip.outputs["Value"], tree.nodes["Principled BSDF"].inputs["Alpha"])
    return made


def here() -> Any:
    """Return the object that was added last."""
    return bpy.context.object


def painted(made: Any, smooth: bool = False) -> Any:
    """Give the last object a material and return it."""
    here().data.materials.append(made)
    if smooth:
        bpy.ops.object.shade_smooth()
    return here()


def floor() -> None:
    """Add a floor and a wall."""
    stone = surface("stone", Base_Color=(0.5, 0.5, 0.5, 1), Roughness=1.0, Specular_IOR_Level=0.0)
    bpy.ops.mesh.primitive_plane_add(size=8)
    painted(stone)
    bpy.ops.mesh.primitive_plane_add(size=8, location=(0, 3, 2), rotation=(math.pi / 2, 0, 0))
    painted(stone)


def aimed(thing: Any, at: tuple[float, float, float]) -> None:
    """Turn a camera or lamp towards a point."""
    thing.rotation_euler = (Vector(at) - thing.location).to_track_quat("-Z", "Y").to_euler()


def sun(energy: float = 3.0) -> None:
    """Add a sun, a point at infinity."""
    bpy.ops.object.light_add(type="SUN", rotation=(0.7, 0.3, 0.0))
    here().data.energy = energy
    here().data.angle = 0.0


def lamp(kind: str, place: tuple[float, float, float], watts: float) -> Any:
    """Add a lamp that is a point."""
    bpy.ops.object.light_add(type=kind, location=place)
    here().data.energy = watts
    here().data.shadow_soft_size = 0.0
    return here()


def keyed(thing: Any, path: str, start: Any, end: Any) -> None:
    """Move a property from the first frame to the last key."""
    for frame, value in ((0, start), (LAST, end)):
        setattr(thing, path, value)
        thing.keyframe_insert(path, frame=frame)


def camera() -> Any:
    """Add the camera."""
    bpy.ops.object.camera_add(location=(0.0, -5.0, 2.5))
    aimed(here(), (0.0, 0.0, 0.6))
    here().data.lens = 45
    bpy.context.scene.camera = here()
    return here()


def ball(place: tuple[float, float, float], made: Any) -> Any:
    """Add a smooth ball."""
    bpy.ops.mesh.primitive_uv_sphere_add(segments=48, ring_count=24, radius=0.5, location=place)
    return painted(made, smooth=True)


def plain() -> None:
    """A matt ball slides under a sun."""
    sun()
    thing = ball((0, 0, 0.6), surface("clay", Base_Color=(0.7, 0.3, 0.2, 1), Roughness=0.9))
    keyed(thing, "location", (-0.4, 0, 0.6), (0.8, 0.2, 0.7))


def parented() -> None:
    """A stretched box hangs on a ball that slides, and turns."""
    sun()
    thing = ball((0, 0, 0.6), surface("clay", Base_Color=(0.3, 0.5, 0.7, 1), Roughness=0.7))
    bpy.ops.mesh.primitive_cube_add(size=0.5, location=(0.9, 0, 0.3))
    box = painted(surface("box", Base_Color=(0.6, 0.6, 0.2, 1), Roughness=0.6))
    box.parent = thing
    box.scale = (1.0, 0.6, 1.4)
    keyed(thing, "location", (-0.4, 0, 0.6), (0.6, 0.2, 0.7))
    keyed(box, "rotation_euler", (0.1, 0.0, 0.0), (0.1, 0.4, 1.5))


def armature() -> None:
    """A tube bends by two bones."""
    sun()
    bpy.ops.mesh.primitive_cylinder_add(vertices=32, radius=0.25, depth=2.0, location=(0, 0, 1.2))
    tube = painted(surface("rubber", Base_Color=(0.2, 0.6, 0.3, 1), Roughness=0.8))
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.subdivide(number_cuts=5)
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.object.armature_add(location=(0, 0, 0.2))
    bones = here()
    bpy.ops.object.mode_set(mode="EDIT")
    first = bones.data.edit_bones[0]
    first.tail = (0, 0, 1.0)
    second = bones.data.edit_bones.new("second")
    second.head = (0, 0, 1.0)
    second.tail = (0, 0, 2.0)
    second.parent = first
    bpy.ops.object.mode_set(mode="OBJECT")
    tube.select_set(True)
    bones.select_set(True)
    bpy.context.view_layer.objects.active = bones
    bpy.ops.object.parent_set(type="ARMATURE_AUTO")
    bone = bones.pose.bones["second"]
    bone.rotation_mode = "XYZ"
    keyed(bone, "rotation_euler", (0, 0, 0.2), (0, 0, 1.2))


def shape_keys() -> None:
    """A ball swells to a pear."""
    sun()
    thing = ball((0, 0, 0.7), surface("clay", Base_Color=(0.6, 0.3, 0.6, 1), Roughness=0.8))
    thing.shape_key_add(name="rest")
    pear = thing.shape_key_add(name="pear")
    for vertex, moved in zip(thing.data.vertices, pear.data, strict=True):
        x, y, z = vertex.co
        moved.co = (x * (1 + 0.5 * z), y * (1 + 0.5 * z), z * 1.6)
    keyed(pear, "value", 0.1, 1.0)


def camera_path() -> None:
    """The camera flies and turns."""
    sun()
    ball((0, 0, 0.6), surface("clay", Base_Color=(0.7, 0.6, 0.3, 1), Roughness=0.9))
    bpy.ops.mesh.primitive_cube_add(size=0.6, location=(1.0, 0.8, 0.4))
    painted(surface("box", Base_Color=(0.3, 0.3, 0.7, 1), Roughness=0.9))
    view = bpy.context.scene.camera
    turned = tuple(view.rotation_euler)
    keyed(view, "location", (0.0, -5.0, 2.5), (0.6, -4.6, 2.4))
    keyed(view, "rotation_euler", turned, (turned[0] - 0.03, turned[1] + 0.05, turned[2] + 0.1))


def pictures() -> None:
    """A ball and a box with pictures."""
    sun()
    made = textured(surface("painted", Roughness=0.9), picture("chequers", chequered()))
    thing = ball((-0.5, 0, 0.6), made)
    keyed(thing, "rotation_euler", (0, 0, 0), (0.3, 0.2, 1.5))
    bpy.ops.mesh.primitive_cube_add(size=0.8, location=(0.9, 0.3, 0.5))
    painted(made)


def emissive() -> None:
    """A glowing box lights a room while it slides."""
    bpy.ops.mesh.primitive_cube_add(size=0.5, location=(0.2, -0.2, 1.6))
    glow = surface("glow", Base_Color=(0, 0, 0, 1), Emission_Color=(1.0, 0.8, 0.6, 1), Emission_Strength=8.0)
    thing = painted(glow)
    keyed(thing, "location", (-0.2, 0, 1.6), (0.8, 0.2, 1.7))
    ball((-0.8, 0.4, 0.6), surface("clay", Base_Color=(0.7, 0.7, 0.7, 1), Roughness=0.9))


def sun_and_spot() -> None:
    """A spot swings across a ball in weak sun."""
    sun(0.6)
    ball((0, 0, 0.6), surface("clay", Base_Color=(0.7, 0.7, 0.6, 1), Roughness=0.9))
    spot = lamp("SPOT", (-1.5, -2.0, 3.0), 400.0)
    aimed(spot, (0, 0, 0.5))
    spot.data.spot_size = 0.7
    spot.data.spot_blend = 0.4
    turned = tuple(spot.rotation_euler)
    keyed(spot, "rotation_euler", turned, (turned[0], turned[1], turned[2] + 0.3))


def metal() -> None:
    """A rough metal ball and a varnished one under a point lamp."""
    lamp("POINT", (1.5, -2.0, 3.0), 300.0)
    thing = ball((-0.6, 0, 0.6), surface("metal", Base_Color=(0.9, 0.7, 0.4, 1), Metallic=1.0, Roughness=0.5))
    keyed(thing, "location", (-0.6, 0, 0.6), (-0.2, 0.3, 0.7))
    ball((0.7, 0.2, 0.6), surface("varnish", Base_Color=(0.2, 0.4, 0.6, 1), Roughness=0.3))


def cut_out() -> None:
    """A moving plate with holes throws a shadow."""
    sun()
    values = chequered()
    values[..., 3] = (np.hypot(*np.meshgrid(*[np.linspace(-1, 1, 64)] * 2)) > 0.5).astype(np.float32)
    made = textured(surface("plate", Roughness=0.9), picture("holes", values), with_alpha=True)
    bpy.ops.mesh.primitive_plane_add(size=1.6, location=(0, 0, 1.2), rotation=(0.9, 0.2, 0.0))
    thing = painted(made)
    keyed(thing, "location", (-0.2, 0, 1.2), (0.6, 0, 1.3))


def two_materials() -> None:
    """A ball of two materials turns."""
    sun()
    thing = ball((0, 0, 0.8), surface("red", Base_Color=(0.8, 0.2, 0.2, 1)))
    thing.data.materials.append(surface("green", Base_Color=(0.2, 0.8, 0.2, 1), Roughness=0.8))
    for polygon in thing.data.polygons:
        polygon.material_index = int(polygon.center.x > 0)
    keyed(thing, "rotation_euler", (0, 0, 0), (0, 0, 1.2))


def copies() -> None:
    """Boxes share a mesh; one is mirrored, others are stretched."""
    sun()
    bpy.ops.mesh.primitive_cube_add(size=0.4, location=(-1, 0, 0.4))
    first = painted(surface("blue", Base_Color=(0.5, 0.5, 0.8, 1), Roughness=0.9))
    for i in range(5):
        copy = first.copy()
        bpy.context.collection.objects.link(copy)
        copy.location = (-0.5 + 0.5 * i, 0.4 * i - 0.5, 0.4)
        copy.rotation_euler = (0, 0, 0.3 * i)
        copy.scale = (1, 1 + 0.2 * i, -1 if i == 2 else 1)


def mapped() -> None:
    """A picture is shifted, turned and scaled by a mapping node."""
    sun()
    made = textured(surface("painted", Roughness=0.9), picture("chequers", chequered()))
    tree = made.node_tree
    texture = next(node for node in tree.nodes if node.type == "TEX_IMAGE")
    mapping = tree.nodes.new("ShaderNodeMapping")
    places = tree.nodes.new("ShaderNodeUVMap")
    tree.links.new(places.outputs[0], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs[0], texture.inputs["Vector"])
    mapping.inputs["Scale"].default_value = (2, 3, 1)
    mapping.inputs["Location"].default_value = (0.2, 0.1, 0)
    mapping.inputs["Rotation"].default_value = (0, 0, 0.5)
    bpy.ops.mesh.primitive_plane_add(size=2, location=(0, 0.5, 1), rotation=(1.2, 0, 0.2))
    keyed(painted(made), "location", (0, 0.5, 1), (0.5, 0.5, 1))


def vertex_colours() -> None:
    """A plate shows the colours of its vertices."""
    sun()
    made = surface("colours", Roughness=0.9)
    colours = made.node_tree.nodes.new("ShaderNodeVertexColor")
    colours.layer_name = "Col"
    base = made.node_tree.nodes["Principled BSDF"].inputs["Base Color"]
    made.node_tree.links.new(colours.outputs["Color"], base)
    bpy.ops.mesh.primitive_grid_add(
        x_subdivisions=12, y_subdivisions=12, size=2, location=(0, 0.3, 1), rotation=(1.0, 0, 0)
    )
    thing = painted(made)
    layer = thing.data.color_attributes.new("Col", "FLOAT_COLOR", "POINT")
    for i, vertex in enumerate(thing.data.vertices):
        layer.data[i].color = (0.2 + 0.3 * (vertex.co.x + 1), 0.5, 0.2 + 0.3 * (vertex.co.y + 1), 1)
    keyed(thing, "location", (0, 0.3, 1), (0.4, 0.3, 1))


def on_a_bone() -> None:
    """A box is parented to a bone of a scaled armature."""
    sun()
    bpy.ops.object.armature_add(location=(0, 0, 0.2))
    bones = here()
    bones.scale = (1.5, 1.5, 1.5)
    bone = bones.pose.bones[0]
    bone.rotation_mode = "XYZ"
    bpy.ops.mesh.primitive_cube_add(size=0.5, location=(0, 0, 1.7))
    thing = painted(surface("box", Base_Color=(0.7, 0.4, 0.2, 1), Roughness=0.9))
    thing.parent = bones
    thing.parent_type = "BONE"
    thing.parent_bone = bones.data.bones[0].name
    keyed(bone, "rotation_euler", (0, 0, 0), (0, 0, 1.0))


def skin_and_shape() -> None:
    """The tube of `armature` swells while it bends."""
    armature()
    tube = next(thing for thing in bpy.data.objects if thing.type == "MESH" and thing.vertex_groups)
    tube.shape_key_add(name="rest")
    fat = tube.shape_key_add(name="fat")
    for vertex, moved in zip(tube.data.vertices, fat.data, strict=True):
        moved.co = (vertex.co.x * 1.6, vertex.co.y * 1.6, vertex.co.z)
    keyed(fat, "value", 0.0, 1.0)


def camera_rig() -> None:
    """The camera hangs on a scaled empty that turns."""
    sun()
    ball((0, 0, 0.6), surface("clay", Base_Color=(0.7, 0.6, 0.3, 1), Roughness=0.9))
    bpy.ops.object.empty_add(location=(0, 0, 0))
    rig = here()
    rig.scale = (2, 2, 2)
    view = bpy.context.scene.camera
    view.parent = rig
    view.matrix_parent_inverse = rig.matrix_world.inverted()
    keyed(rig, "rotation_euler", (0, 0, 0), (0, 0, 0.2))


def glass() -> None:
    """A frosted glass ball stands before a box."""
    sun()
    clear = {"Base_Color": (1, 1, 1, 1), "Transmission_Weight": 1.0, "Roughness": 0.05, "IOR": 1.45}
    ball((0, 0, 0.7), surface("glass", **clear))
    bpy.ops.mesh.primitive_cube_add(size=0.6, location=(1, 0.8, 0.4))
    painted(surface("box", Base_Color=(0.3, 0.3, 0.7, 1), Roughness=0.9))


def see_through() -> None:
    """A plate of 60 % opacity slides before a ball."""
    sun()
    bpy.ops.mesh.primitive_plane_add(size=1.6, location=(0, 0, 1.0), rotation=(0.9, 0.2, 0))
    thing = painted(surface("veil", Base_Color=(0.8, 0.3, 0.3, 1), Roughness=0.9, Alpha=0.6))
    keyed(thing, "location", (0, 0, 1), (0.6, 0, 1.1))
    ball((0.4, 0.9, 0.6), surface("clay", Base_Color=(0.2, 0.6, 0.3, 1), Roughness=0.9))


def edges() -> None:
    """A cylinder is smooth around and sharp at its ends; Blender's monkey is smooth."""
    sun()
    bpy.ops.mesh.primitive_cylinder_add(vertices=24, radius=0.6, depth=1, location=(0, 0, 0.8))
    thing = painted(surface("clay", Base_Color=(0.7, 0.6, 0.5, 1), Roughness=0.7))
    bpy.ops.object.shade_smooth_by_angle(angle=0.6)
    keyed(thing, "rotation_euler", (0, 0, 0), (0.5, 0.3, 0))
    bpy.ops.mesh.primitive_monkey_add(size=0.8, location=(1.1, 0.4, 0.6))
    painted(surface("monkey", Base_Color=(0.4, 0.5, 0.7, 1), Roughness=0.5), smooth=True)


SCENES: dict[str, Callable[[], None]] = {
    scene.__name__: scene
    for scene in (
        plain,
        parented,
        armature,
        shape_keys,
        camera_path,
        pictures,
        emissive,
        sun_and_spot,
        metal,
        cut_out,
        two_materials,
        copies,
        mapped,
        vertex_colours,
        on_a_bone,
        skin_and_shape,
        camera_rig,
        glass,
        see_through,
        edges,
    )
}


def straight() -> None:
    """Let every motion run evenly between its keys."""
    for action in bpy.data.actions:
        for layer in action.layers:
            for strip in layer.strips:
                for bag in strip.channelbags:
                    for curve in bag.fcurves:
                        for point in curve.keyframe_points:
                            point.interpolation = "LINEAR"


def configure(samples: int, threads: int) -> None:
    """Set film, samples, depth and passes; nothing is clamped, filtered, cut, adapted or denoised."""
    scene = bpy.context.scene
    render = scene.render
    cycles = scene.cycles
    render.engine = "CYCLES"
    cycles.device = "CPU"
    render.threads_mode = "FIXED"
    render.threads = threads
    render.resolution_x = WIDTH
    render.resolution_y = HEIGHT
    render.resolution_percentage = 100
    render.fps = FPS
    scene.view_settings.view_transform = "Raw"
    cycles.samples = samples
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.pixel_filter_type = "BOX"
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = 16
    cycles.transparent_max_bounces = 16
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.blur_glossy = cycles.light_sampling_threshold = 0.0
    scene.view_layers[0].use_pass_vector = True
    render.image_settings.media_type = "MULTI_LAYER_IMAGE"
    render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    render.image_settings.color_depth = "32"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the scenes and pictures go")
    parser.add_argument("--samples", type=int, default=256, help="per pixel (default 256)")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only", help="names with commas between them (default all)")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    for name in options.only.split(",") if options.only else SCENES:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        scene.frame_start = 0
        scene.frame_end = LAST
        camera()
        floor()
        SCENES[name]()
        straight()
        configure(options.samples, options.threads)
        for thing in scene.objects:
            thing.cycles.shadow_terminator_geometry_offset = 0.0
        glb = str((options.folder / f"{name}.glb").resolve())
        bpy.ops.export_scene.gltf(filepath=glb, export_cameras=True, export_lights=True)
        for t in range(FRAMES):
            scene.frame_set(t)
            render = scene.render
            render.filepath = str((options.folder / f"{name}_{t}.exr").resolve())
            bpy.ops.render.render(write_still=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
