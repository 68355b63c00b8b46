"""Writes a scene as a neutral file, so that another renderer can render the same clip.

    NAME.npz: arrays, and `description`, a JSON text

    description   format, height and width [px], focal_pixels [px], frames, bodies and lights in order
    cameras       float64 [T, 4, 4], camera to world at the times of the frames; axes x right, y down, z forward
    body{i}_...   vertices [V, 3] in m, faces [F, 3], normals [V, 3] of smooth bodies, uv [V, 2] of textured ones,
                  poses [T, 4, 4] (body to world), texture [H, W] (row 0 at v = 1)
    light{i}_...  poses [T, 4, 4] of area lamps (a square -1 .. 1 in x, y that emits towards +z), map [H, W]
                  (surroundings in W m^-2 sr^-1; row 0 at the zenith, +z in the middle, +x left of it)

Radiance and reflectance are grey. Rigid bodies, diffuse surfaces and metals (GGX), constant or pictured surroundings
and area lamps can be written; all else is refused.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.rendering.mitsuba_mesh import vertex_normals
from qsim.rendering.mitsuba_scene import lamp_pose
from qsim.scene import AreaLamp, Body, Conductor, Constant, Diffuse, EnvironmentImage, RoughPlastic, Scene, Texture
from qsim.scene.environment import environment_map

FORMAT = 1
FINER = 8  # samples per texel of surroundings, whose rows and columns renderers place differently


def with_shared_materials(scene: Scene) -> Scene:
    """Return a scene of materials that both renderers have: lacquer becomes diffuse, of the same reflectance."""
    coats = [body.material for body in scene.bodies]
    matt = [Diffuse(coat.reflectance, coat.relief) if isinstance(coat, RoughPlastic) else coat for coat in coats]
    bodies = [replace(body, material=coat) for body, coat in zip(scene.bodies, matt, strict=True)]
    return replace(scene, bodies=tuple(bodies))


def write(scene: Scene, times: Sequence[float], path: Path) -> None:
    """Write the scene at these times [s]; `ValueError` names what a neutral file cannot hold."""
    camera = scene.camera
    if camera.lens is not None or camera.aperture_blur or scene.bands is not None or scene.file is not None:
        raise ValueError(f"scene {scene.name}: a neutral file holds grey scenes of records, seen through a pinhole")
    arrays: dict[str, Array] = {"cameras": np.stack([camera.pose(t) for t in times])}
    description = {
        "format": FORMAT,
        "name": scene.name,
        "height": camera.height,
        "width": camera.width,
        "focal_pixels": camera.focal_pixels,
        "frames": len(times),
        "bodies": [_body(body, times, f"body{i}", arrays) for i, body in enumerate(scene.bodies)],
        "lights": [_light(light, times, f"light{i}", arrays) for i, light in enumerate(scene.lights)],
    }
    np.savez(path, description=np.array(json.dumps(description)), **arrays)


def _body(body: Body, times: Sequence[float], name: str, arrays: dict[str, Array]) -> dict[str, Any]:
    """Return the description of a body, and add its arrays."""
    if body.deforms:
        raise ValueError(f"body {body.name}: it deforms, and a neutral file holds rigid bodies")
    corners = body.mesh.vertices[body.mesh.faces]
    seen = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) > 0
    arrays[f"{name}_vertices"] = body.mesh.vertices
    arrays[f"{name}_faces"] = body.mesh.faces[seen]
    arrays[f"{name}_poses"] = np.stack([body.pose(t) for t in times])
    if body.mesh.smooth:
        arrays[f"{name}_normals"] = vertex_normals(body.mesh.vertices, body.mesh.faces)
    match body.material:
        case Diffuse(Texture(repeat=repeat, nearest=nearest) as texture, None):
            if body.mesh.uv is None:
                raise ValueError(f"body {body.name}: its mesh has no texture coordinates")
            arrays[f"{name}_texture"] = texture.pixels()
            arrays[f"{name}_uv"] = body.mesh.uv * repeat
            return {"material": "textured", "nearest": nearest}
        case Diffuse(float(reflectance), None):
            return {"material": "diffuse", "reflectance": reflectance}
        case Conductor(float(eta), float(k), alpha, None):
            return {"material": "conductor", "eta": eta, "k": k, "alpha": alpha}
    raise ValueError(f"body {body.name}: a neutral file holds grey diffuse surfaces and metals, not {body.material}")


def _light(light: Any, times: Sequence[float], name: str, arrays: dict[str, Array]) -> dict[str, Any]:
    """Return the description of a light, and add its arrays."""
    match light:
        case Constant(float(radiance), None):
            return {"light": "constant", "radiance": radiance}
        case AreaLamp(radiance=float(radiance), flicker=None):
            placed = [np.eye(4) if light.motion is None else light.motion.pose(t) for t in times]
            arrays[f"{name}_poses"] = np.stack(placed) @ lamp_pose(light)
            return {"light": "area", "radiance": radiance}
        case EnvironmentImage(flicker=None):
            arrays[f"{name}_map"] = finer_map(environment_map(light), light.rotation)
            return {"light": "map"}
    raise ValueError(f"{light}: a neutral file holds steady constant, pictured and area lights")


def finer_map(picture: Array, rotation: float = 0.0) -> Array:
    """Return surroundings [H, W], turned by `rotation` [rad], as Mitsuba interpolates them: float32 [FINER H, FINER W].

    Mitsuba's first and last row are the poles. The rows and columns of the result are centres of equal angles.
    """
    from scipy.ndimage import map_coordinates

    height, width = picture.shape
    rows = (np.arange(FINER * height) + 0.5) / (FINER * height) * (height - 1)
    columns = ((np.arange(FINER * width) + 0.5) / FINER + rotation / (2 * np.pi) * width - 0.5) % width
    wrapped = np.concatenate([picture, picture[:, :1]], axis=1)
    grid = np.meshgrid(rows, columns, indexing="ij")
    return map_coordinates(wrapped, grid, order=1, mode="nearest").astype(np.float32)
