"""Converts a `Scene` to a Mitsuba scene once, and updates only the parameters that move.

    Scene -> mi.Scene (loaded once) + `place(t)`, which moves bodies, lamps and points to their poses at time t
                                    + `light(start, stop)`, which sets flickering lights to their mean strength

The motion of a body decides its form in Mitsuba. A resting mesh lies in world coordinates. A large rigid body is an
instance whose `to_world` changes; the acceleration structure of its mesh stays. The vertices of small, deforming or
glowing bodies are rewritten, because Mitsuba traces every instance into the kernel of every pass (docs/log.md).
`mi` is the Mitsuba module, passed in by the renderer.
"""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.colour import luminance
from qsim.device_lock import one_thread_at_a_time
from qsim.rendering import metallic_roughness, mitsuba_xml
from qsim.rendering.engine import errors_only, opaque
from qsim.rendering.mitsuba_mesh import COLOURS, NORMALS, POSITIONS, mesh_shape, vertex_normals, vertices_of
from qsim.scene import Body, Mesh, Part, Scene, lights, materials
from qsim.scene.bands import Colour, largest, numbers
from qsim.scene.environment import environment_map, sky_map, sun_direction, sun_radiance

LARGE = 20_000  # triangles from which a rigid body becomes an instance
# Sampling weight of smooth surroundings (constant, clear sky) as an emitter, against 1 for any other light. Scattered
# rays find them anyway, and sampling them takes samples from the sun or the lamp. test_mitsuba_scene.py requires 1.25
# times less error than with 1; docs/log.md has the measurement.
SMOOTH_WEIGHT = 1 / 1024
EDGE = 512  # texels across the picture of a spot's edge
SUN_DISTANCE = 1000.0  # in units of the scene's reach from the camera: parallax of the sun under 1 mrad


class Stage:
    """A loaded scene that can be moved to any time; the only mutable state of the renderer."""

    def __init__(self, mi: Any, scene: Scene, smooth_weight: float = SMOOTH_WEIGHT) -> None:
        """Load the scene; a `smooth_weight` of 1 is Mitsuba's default."""
        self.mi = mi
        self.scene = scene
        self.variant: str = mi.variant()
        self.loaded = (
            mi.load_dict(_scene_dict(mi, scene, smooth_weight))
            if scene.file is None
            else mitsuba_xml.load(mi, scene.file.path)
        )
        self._parameters = mi.traverse(self.loaded)
        self._rest = {part.name: self._rest_of(part) for part in scene.parts if part.motion is not None}
        self._placed: dict[str, bytes] = {}
        self._normals: dict[str, Array] = {}  # of smooth bodies that moved; replace those of Mitsuba
        self._rest_normals: dict[str, Array] = {}
        self._used: dict[str, Any] = {}  # the vertices of each shape of a body
        self._time: float | None = None  # of the last placement [s]
        self._steady = {name: self._emission(name) for name in scene.flickers}

    @one_thread_at_a_time
    def __del__(self) -> None:
        """Free the scene under the lock: another thread may be rendering."""
        vars(self).clear()

    def place(self, t: float) -> None:
        """Move everything to time t [s]; parameters equal to those of the last call are not set again."""
        if t == self._time:  # an update costs as much as a sample per pixel of a small frame, also if nothing changed
            return
        self._time = None  # until all is placed
        for i, body in enumerate(self.scene.bodies):
            if body.motion is not None:
                self._place_body(i, body, t)
        for i, light in enumerate(self.scene.lights):
            motion = getattr(light, "motion", None)
            if motion is not None:
                self._place_light(f"light{i}", light, motion.pose(t))
        for part in self.scene.parts:
            if part.motion is not None:
                self._place_part(part.name, part.pose(t), self._rest[part.name])
        with errors_only(self.mi):  # the scalar engine warns of normals that it cannot compute; ours replace them
            self._parameters.update()
        # Mitsuba computes normals anew when vertices change, and would
        # smooth over creases: ours are set after its update.
        if self._normals:
            for key, normals in self._normals.items():
                self._parameters[key] = normals.ravel()
            self._normals.clear()
            self._parameters.update()
        self._time = t

    def light(self, start: float, stop: float) -> None:
        """Set every flickering light to its mean strength over the times from `start` to `stop` [s]."""
        for name, flicker in self.scene.flickers.items():
            key, steady = self._steady[name]
            strength = flicker.mean(np.array(start), np.array(stop))
            self._set(key, strength, lambda steady=steady, by=float(strength): self._opaque(steady * by))
        self._parameters.update()

    def _emission(self, name: str) -> tuple[str, Any]:
        """Return the parameter that scales a light, and its value without flicker."""
        key = next(key for suffix in mitsuba_xml.EMISSION if (key := f"{name}.{suffix}") in self._parameters)
        value = self._parameters[key]
        return key, type(value)(value)

    def shape_numbers(self) -> dict[str, int]:
        """Return shape id -> body number; lamps follow the bodies; the sun's disk is -1 (surroundings)."""
        numbers = {"sun": -1}
        for i, body in enumerate(self.scene.bodies):
            numbers |= {name: i for name, _, _ in _shapes(i, body)}
        numbers |= {f"light{i}": len(self.scene.bodies) + i for i in range(len(self.scene.lights))}
        return numbers | {part.name: i for i, part in enumerate(self.scene.parts)}

    def first_faces(self) -> dict[str, int]:
        """Return shape id -> number of its first face in the mesh of its body; 0 where a body is one shape."""
        shapes = [shape for i, body in enumerate(self.scene.bodies) for shape in _shapes(i, body)]
        return {name: 0 if faces is None else faces.start for name, _, faces in shapes}

    def _place_body(self, number: int, body: Body, t: float) -> None:
        pose = body.pose(t)
        if _is_instance(body):
            self._set(f"body{number}.to_world", pose, lambda: self._transform(pose))
            return
        world = _to_world(pose, body.vertices(t)).astype(np.float32)
        for name, _, faces in _shapes(number, body):
            if name not in self._used:
                self._used[name] = vertices_of(body.mesh, faces)
            own = world[self._used[name]]
            moved = self._set(f"{name}.{POSITIONS}", own, lambda own=own: own.ravel())
            if moved and body.mesh.smooth:
                normals = self._normals_of(f"body{number}", body, pose, world)
                self._normals[f"{name}.{NORMALS}"] = normals[self._used[name]]

    def _normals_of(self, name: str, body: Body, pose: Array, world: Array) -> Array:
        """Return unit normals of a smooth body, float32 [V, 3]; a rigid body's are computed once and rotated."""
        if body.deforms:
            return vertex_normals(world, body.mesh.faces, body.mesh.groups)
        if name not in self._rest_normals:
            self._rest_normals[name] = vertex_normals(body.mesh.vertices, body.mesh.faces, body.mesh.groups)
        return (self._rest_normals[name] @ pose[:3, :3].T).astype(np.float32)

    def _place_light(self, name: str, light: lights.Light, pose: Array) -> None:
        if isinstance(light, lights.AreaLamp):
            placed = pose @ lamp_pose(light)
            self._set(f"{name}.to_world", placed, lambda: self._transform(placed))
        elif isinstance(light, lights.PointLight):
            position = _to_world(pose, np.array([light.position]))[0]
            self._set(f"{name}.position", position, lambda: self._opaque(self.mi.Point3f(position.tolist())))
        elif isinstance(light, lights.SpotLight | lights.DirectionalLight):
            placed = pose @ beam_pose(light)
            self._set(f"{name}.to_world", placed, lambda: self._transform(placed))

    def _rest_of(self, part: Part) -> tuple[Array, ...]:
        """Return a file shape's rest state: its 4x4 placement, or its vertices [V, 3] and normals [V, 3] or [0, 3]."""
        if f"{part.name}.to_world" in self._parameters:
            return (np.array(self._parameters[f"{part.name}.to_world"].matrix, np.float64).reshape(4, 4),)
        arrays = (f"{part.name}.{POSITIONS}", f"{part.name}.{NORMALS}")
        return tuple(
            np.array(self._parameters[key], np.float64).reshape(-1, 3) if key in self._parameters else np.zeros((0, 3))
            for key in arrays
        )

    def _place_part(self, name: str, pose: Array, rest: tuple[Array, ...]) -> None:
        if len(rest) == 1:
            placed = pose @ rest[0]
            self._set(f"{name}.to_world", placed, lambda: self._transform(placed))
            return
        world = _to_world(pose, rest[0]).astype(np.float32)
        if self._set(f"{name}.{POSITIONS}", world, lambda: world.ravel()) and len(rest[1]):
            self._normals[f"{name}.{NORMALS}"] = (rest[1] @ pose[:3, :3].T).astype(np.float32)

    def _set(self, key: str, value: Array, make: Any) -> bool:
        # Setting a parameter makes Mitsuba rebuild what depends on it, also if its value is the same.
        stamp = value.tobytes()
        if self._placed.get(key) == stamp:
            return False
        self._parameters[key] = make()
        self._placed[key] = stamp
        return True

    def _transform(self, matrix: Array) -> Any:
        kind = self.mi.ScalarTransform4f if self.mi.variant().startswith("scalar") else self.mi.Transform4f
        return self._opaque(kind(matrix.tolist()))

    def _opaque(self, value: Any) -> Any:
        return value if self.mi.variant().startswith("scalar") else opaque(value)


def film_pass(
    stage: Stage,
    pose: Array,
    crop: tuple[int, int, int, int],
    seed: int,
    samples: int,
    integrator: Any,
    sampler: str = "multijitter",
) -> Array:
    """Render a window (y, x, height, width) with Mitsuba's own camera and film: radiance, float64 [H, W].

    `ValueError` for a lens that distorts, zooms, or whose axis is off the middle: that camera has none.
    """
    mi = stage.mi
    camera = stage.scene.camera
    shifted = camera.lens is not None and (camera.lens.distorts or camera.lens.shift != (0.0, 0.0))
    if shifted or camera.zoom is not None:
        raise ValueError(
            f"Camera.{'lens' if shifted else 'zoom'}: Mitsuba's own camera, which the scalar engine and `qsim validate "
            f"render` use, has no distortion {'and no shift' if shifted else 'and no zoom'}; install LLVM for the "
            "engine, or choose another scene"
        )
    y, x, height, width = crop
    film: dict[str, Any] = {
        "type": "hdrfilm",
        "width": camera.width,
        "height": camera.height,
        "rfilter": {"type": "box"},
        # In Mitsuba's RGB variant a uniform spectrum is reddish: sRGB white is not equal-energy white. Its luminance
        # is 1.
        "pixel_format": "luminance",
    }
    film |= {"crop_offset_x": x, "crop_offset_y": y, "crop_width": width, "crop_height": height}
    view = pose @ np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba's camera axes: left, up, forward
    sensor: dict[str, Any] = {"type": "perspective", "film": film, "near_clip": 1e-4, "far_clip": 1e5}
    sensor["to_world"] = mi.ScalarTransform4f(view.tolist())
    sensor |= {"fov_axis": "x", "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / camera.focal_pixels)))}
    sensor["sampler"] = {"type": sampler, "sample_count": samples}
    if camera.aperture_blur:
        sensor |= {"type": "thinlens", "aperture_radius": camera.pupil_radius, "focus_distance": camera.focus}
    image = mi.render(stage.loaded, sensor=mi.load_dict(sensor), integrator=integrator, seed=seed, spp=samples)
    return np.array(image, np.float64)[..., 0]


def lamp_pose(lamp: lights.AreaLamp) -> Array:
    """Return the matrix from the square -1..1 in x, y (facing +z) to the lamp in the world, float64 [4, 4]."""
    side, up, forward = _facing(np.subtract(lamp.target, lamp.origin))
    pose = np.eye(4)
    pose[:3, :4] = np.column_stack([side * lamp.width / 2, up * lamp.height / 2, forward, lamp.origin])
    return pose


def _facing(direction: Array) -> tuple[Array, Array, Array]:
    """Return unit vectors to the side, upwards and along a direction [3]."""
    forward = direction / np.linalg.norm(direction)
    helper = (0.0, 1.0, 0.0) if abs(forward[1]) < 0.99 else (1.0, 0.0, 0.0)
    side = np.cross(helper, forward)
    side /= np.linalg.norm(side)
    return side, np.cross(forward, side), forward


def beam_pose(light: lights.SpotLight | lights.DirectionalLight) -> Array:
    """Return the matrix from a beam along +z to the light in the world, float64 [4, 4]."""
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack(_facing(np.asarray(light.direction, np.float64)))
    if isinstance(light, lights.SpotLight):
        pose[:3, 3] = light.position
    return pose


def _is_instance(body: Body) -> bool:
    """Return whether a body is an instance of a mesh in body coordinates."""
    rigid = body.motion is not None and not body.deforms
    return rigid and len(body.mesh.faces) >= LARGE and not materials.emits(body.material)


def _scene_dict(mi: Any, scene: Scene, smooth_weight: float) -> dict[str, Any]:
    parts: dict[str, Any] = {"type": "scene"}
    surfaces: dict[int, Any] = {}
    for i, light in enumerate(scene.lights):
        parts |= _light(mi, scene, light, f"light{i}", smooth_weight)
    for i, body in enumerate(scene.bodies):
        name = f"body{i}"
        # An instance moves by one matrix; a mesh of its own has each vertex rewritten and its tree rebuilt.
        if _is_instance(body):
            group: dict[str, Any] = {"type": "shapegroup"}
            for k, (_, material, faces) in enumerate(_shapes(i, body)):
                inner = f"mesh{k or ''}"
                group[inner] = _mesh(mi, body.mesh, inner, body.mesh.vertices, material, faces, surfaces)
            parts[f"group{i}"] = group
            first = mi.ScalarTransform4f(body.pose(0.0).tolist())
            parts[name] = {"type": "instance", "to_world": first, "group": {"type": "ref", "id": f"group{i}"}}
        else:
            world = _to_world(body.pose(0.0), body.vertices(0.0))
            for shape, material, faces in _shapes(i, body):
                parts[shape] = _mesh(mi, body.mesh, shape, world, material, faces, surfaces)
    return parts


def _shapes(number: int, body: Body) -> list[tuple[str, materials.Material, range | None]]:
    """Return name, material and faces of the shapes of a body: one of all faces (None), or one for each patch."""
    if not isinstance(body.material, materials.Patches):
        return [(f"body{number}", body.material, None)]
    ends = np.cumsum(body.material.counts).tolist()
    names = [f"body{number}", *(f"body{number}_{k}" for k in range(1, len(ends)))]
    faces = [range(start, end) for start, end in zip([0, *ends], ends, strict=False)]
    return list(zip(names, body.material.materials, faces, strict=True))


def _mesh(
    mi: Any,
    mesh: Mesh,
    name: str,
    vertices: Array,
    material: materials.Material,
    faces: range | None,
    surfaces: dict[int, Any],
) -> Any:
    """Return a shape; `surfaces` has what was loaded of each material of a file, which many shapes may share."""
    properties = mi.Properties()
    if isinstance(material, materials.Glow):
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": _value(mi, material.radiance)})
        properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": _value(mi, 0.0)})
    else:
        # Materials of files bring large textures; shapes of one material share what was loaded.
        shared = surfaces.get(id(material))
        properties["bsdf"] = mi.load_dict(_bsdf(mi, material)) if shared is None else shared
    colours = None
    if isinstance(material, materials.MetallicRoughness):
        surfaces[id(material)] = properties["bsdf"]
        if material.glows:
            emitter = {"type": "area", "radiance": _emission(mi, material.emission)}
            properties["emitter"] = mi.load_dict(emitter)
        if isinstance(material.reflectance, materials.VertexColours):
            colours = _vertex_colours(mi, material.reflectance)
    return mesh_shape(mi, mesh, name, vertices, properties, faces, colours)


def _vertex_colours(mi: Any, given: materials.VertexColours) -> Array:
    """Return the colours of vertices, [V, 3], or their luminance, [V, 1]."""
    colours = given.colours.astype(np.float64)
    return colours if mi.variant().endswith("_rgb") else luminance(colours)[:, None]


def _emission(mi: Any, value: float | Colour | materials.Texture) -> Any:
    if not isinstance(value, materials.Texture):
        return _value(mi, value)
    return _texture(mi, value, _pixels_of(mi, value))


def _light(mi: Any, scene: Scene, light: lights.Light, name: str, smooth_weight: float) -> dict[str, Any]:
    match light:
        case lights.Constant(radiance):
            return {name: {"type": "constant", "radiance": _value(mi, radiance), "sampling_weight": smooth_weight}}
        case lights.SunSky():
            sky = {"type": "envmap", "bitmap": _rgb_bitmap(mi, sky_map(light)), "sampling_weight": smooth_weight}
            return {name: sky} | ({"sun": _sun(mi, scene, light)} if largest(light.sun_irradiance) > 0 else {})
        case lights.EnvironmentImage(rotation=rotation):
            turn = mi.ScalarTransform4f().rotate([0, 1, 0], math.degrees(rotation))
            bitmap = _rgb_bitmap(mi, environment_map(light, colours=scene.bands is not None))
            return {name: {"type": "envmap", "bitmap": bitmap, "to_world": turn}}
        case lights.AreaLamp(radiance=radiance):
            place = mi.ScalarTransform4f(lamp_pose(light).tolist())
            black = {"type": "diffuse", "reflectance": _value(mi, 0.0)}
            emitter = {"type": "area", "radiance": _value(mi, radiance)}
            return {name: {"type": "rectangle", "to_world": place, "bsdf": black, "emitter": emitter}}
        case lights.PointLight(position, intensity):
            return {name: {"type": "point", "position": list(position), "intensity": _value(mi, intensity)}}
        case lights.SpotLight():
            return {name: _spot(mi, light)}
        case lights.DirectionalLight(irradiance=irradiance):
            place = mi.ScalarTransform4f(beam_pose(light).tolist())
            return {name: {"type": "directional", "to_world": place, "irradiance": _value(mi, irradiance)}}
    raise ValueError(f"{light!r} is not one of the lights of qsim.scene")


def _spot(mi: Any, light: lights.SpotLight) -> dict[str, Any]:
    """Return Mitsuba's spot, whose own edge is hard, with a picture of the edge that glTF defines."""
    along = (np.arange(EDGE) + 0.5) / EDGE * 2 - 1
    across = np.hypot(*np.meshgrid(along, along)) * math.tan(light.outer)
    least = math.cos(light.outer)
    share = np.clip((np.cos(np.arctan(across)) - least) / (math.cos(light.inner) - least), 0, 1)
    falling = share**2 * (3 - 2 * share) if light.smooth else share**2
    edge = {"type": "bitmap", "data": mi.TensorXf(falling[..., None].astype(np.float32))}
    return {
        "type": "spot",
        "to_world": mi.ScalarTransform4f(beam_pose(light).tolist()),
        "intensity": _value(mi, light.intensity),
        "cutoff_angle": math.degrees(light.outer),
        "beam_width": math.degrees(light.outer) * (1 - 1e-4),
        "texture": edge | {"raw": True, "wrap_mode": "clamp"},
    }


def _sun(mi: Any, scene: Scene, light: lights.SunSky) -> dict[str, Any]:
    """Return a distant disk with the angular radius and irradiance of the record."""
    centre = np.asarray(scene.camera.origin)
    points = [_to_world(body.pose(0.0), body.vertices(0.0)) for body in scene.bodies] or [centre[None]]
    reach = max(1.0, *(float(np.max(np.linalg.norm(p - centre, axis=1))) for p in points))
    # Far enough that its rays are parallel within the scene; its size keeps the angular radius.
    distance = SUN_DISTANCE * reach
    towards = sun_direction(light)
    origin = (centre + distance * towards).tolist()
    up = [0, 1, 0] if abs(towards[1]) < 0.99 else [1, 0, 0]
    place = mi.ScalarTransform4f().look_at(origin=origin, target=centre.tolist(), up=up)
    place = place @ mi.ScalarTransform4f().scale(distance * math.tan(light.sun_radius))
    emitter = {"type": "area", "radiance": _value(mi, sun_radiance(light))}
    return {"type": "disk", "to_world": place, "emitter": emitter}


def _bsdf(mi: Any, material: materials.Material) -> dict[str, Any]:
    match material:
        case materials.Diffuse(reflectance, relief):
            inner = {"type": "diffuse", "reflectance": _reflectance(mi, reflectance)}
        case materials.RoughPlastic(reflectance, roughness, ior, relief):
            inner = {"type": "roughplastic", "diffuse_reflectance": _reflectance(mi, reflectance), "alpha": roughness}
            inner |= {"int_ior": ior, "distribution": "ggx", "nonlinear": True}
        case materials.Conductor(eta, k, roughness, relief):
            inner = {"type": "conductor", "eta": _value(mi, eta), "k": _value(mi, k)}
            if roughness > 0:
                inner |= {"type": "roughconductor", "alpha": roughness, "distribution": "ggx"}
        case materials.Dielectric(ior, roughness, thin):
            if roughness > 0 and not thin:
                return {"type": "roughdielectric", "int_ior": ior, "alpha": roughness, "distribution": "ggx"}
            return {"type": "thindielectric" if thin else "dielectric", "int_ior": ior}
        case materials.MetallicRoughness():
            return _metallic_roughness(mi, material)
        case _:
            raise ValueError(f"{material!r} is not one of the materials of qsim.scene")
    return {"type": "twosided", "inner": _tilted(mi, inner, relief)}


def _tilted(mi: Any, inner: dict[str, Any], relief: materials.Relief) -> dict[str, Any]:
    """Return a surface whose normals follow a relief."""
    match relief:
        case materials.Bump(texture, height):
            return {
                "type": "bumpmap",
                "relief": _texture(mi, texture, texture.pixels()[..., None]),
                "scale": height,
                "inner": inner,
            }
        case materials.NormalMap(image, repeat, wrap):
            picture = _bitmap(mi, np.asarray(image, np.float32), repeat, wrap=wrap)
            return {"type": "normalmap", "normalmap": picture, "inner": inner}
    return inner


def _metallic_roughness(mi: Any, material: materials.MetallicRoughness) -> dict[str, Any]:
    glass = isinstance(material.transmission, materials.Texture) or material.transmission > 0
    base = _reflectance(mi, material.reflectance)
    # The scalar engine would call a plugin in Python for every ray.
    if glass or mi.variant().startswith("scalar"):
        inner: dict[str, Any] = {
            "type": "principled",
            "base_color": base,
            "metallic": _share(mi, material.metallic),
            "roughness": _share(mi, material.roughness),
            "eta": material.ior,
        }
        if glass:
            inner["spec_trans"] = _share(mi, material.transmission)
        else:
            warnings.warn(
                "the scalar engine draws surfaces of glTF by Mitsuba's principled, brighter and without a clearcoat; "
                "install LLVM for the engine",
                stacklevel=2,
            )
        surface = _tilted(mi, inner, material.relief)
        surface = surface if glass else {"type": "twosided", "inner": surface}
    else:
        metallic_roughness.register(mi)
        inner = {
            "type": metallic_roughness.NAME,
            "base_color": _as_texture(mi, base),
            "metallic": _as_texture(mi, _share(mi, material.metallic)),
            "roughness": _as_texture(mi, _share(mi, material.roughness)),
            "reflection": ((material.ior - 1) / (material.ior + 1)) ** 2,
            "clearcoat": material.clearcoat,
            "clearcoat_alpha": material.clearcoat_roughness**2,
        }
        surface = {"type": "twosided", "inner": _tilted(mi, inner, material.relief)}
    if isinstance(material.opacity, materials.Texture) or material.opacity < 1:
        surface = {"type": "mask", "opacity": _share(mi, material.opacity), "nested": surface}
    return surface


def _as_texture(mi: Any, value: Any) -> Any:
    """Return a loaded texture: a plugin in Python gets numbers and colours as they are, and not as textures."""
    return mi.load_dict(value if isinstance(value, dict) else {"type": "uniform", "value": value})


def _share(mi: Any, value: float | materials.Texture) -> Any:
    """Return a number from 0 to 1, or a texture of such numbers, which has one channel in all variants."""
    if not isinstance(value, materials.Texture):
        return float(value)
    pixels = value.pixels()[..., None]
    if pixels.min() < 0 or pixels.max() > 1:
        raise ValueError(f"Texture of shares: 0..1 expected, found {pixels.min()}..{pixels.max()}")
    return _texture(mi, value, pixels)


def _pixels_of(mi: Any, texture: materials.Texture) -> Array:
    """Return the values of a texture in the bands of the variant, [H, W, 3] or [H, W, 1]."""
    return texture.colours() if mi.variant().endswith("_ad_rgb") else texture.pixels()[..., None]


def _reflectance(mi: Any, value: float | Colour | materials.Texture | materials.VertexColours) -> Any:
    if isinstance(value, materials.VertexColours):
        return {"type": "mesh_attribute", "name": COLOURS}
    if isinstance(value, materials.Texture):
        pixels = _pixels_of(mi, value)
        if pixels.min() < 0 or pixels.max() > 1:
            raise ValueError(f"Texture of a reflectance: 0..1 expected, found {pixels.min()}..{pixels.max()}")
        return _texture(mi, value, pixels)
    if not 0 <= min(numbers(value), default=-1) <= max(numbers(value)) <= 1:
        raise ValueError(f"reflectance: 0..1 expected, got {value!r}")
    return _value(mi, value)


def _texture(mi: Any, texture: materials.Texture, pixels: Array) -> dict[str, Any]:
    return _bitmap(mi, pixels, texture.repeat, "nearest" if texture.nearest else "bilinear", texture.wrap)


def _bitmap(
    mi: Any, pixels: Array, repeat: tuple[float, float], kind: str = "bilinear", wrap: str = "repeat"
) -> dict[str, Any]:
    """Return a bitmap texture: row 0 lies at v = 0 in Mitsuba and at v = 1 in our textures."""
    data = mi.TensorXf(np.ascontiguousarray(pixels[::-1], np.float32))
    scale = mi.ScalarTransform4f().scale([repeat[0], repeat[1], 1])
    return {"type": "bitmap", "data": data, "raw": True, "filter_type": kind, "to_uv": scale, "wrap_mode": wrap}


def _rgb_bitmap(mi: Any, picture: Array) -> Any:
    """Return Mitsuba's bitmap of a picture [H, W] or [H, W, 3]."""
    return mi.Bitmap(np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture)


def _value(mi: Any, value: float | Colour) -> Any:
    """Return a colour, or a value equal for all bands: the RGB variant then computes the same as the mono variant."""
    if isinstance(value, tuple):
        return {"type": "rgb", "value": list(value)}
    if mi.variant().startswith("scalar_rgb"):
        return {"type": "rgb", "value": [value] * 3} if 0 <= value <= 1 else {"type": "spectrum", "value": float(value)}
    return float(value)


def _to_world(pose: Array, points: Array) -> Array:
    return points @ pose[:3, :3].T + pose[:3, 3]
