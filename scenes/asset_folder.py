"""Makes scenes of a user's folder of meshes, pictures and environments, one per seed.

    folder/**  *.obj *.ply *.stl *.off *.glb *.gltf   meshes, each thrown into the air, scaled to 8 to 16 cm
               *.png *.jpg *.tif *.bmp ...            textures of the floor, the wall, and meshes without colours
               *.hdr *.exr                            surroundings, equirectangular, zenith on top; 1 is 1 W m^-2 sr^-1

Missing kinds are replaced by solids, procedural textures, or sun and sky. The bodies fill the view, and in two of three
seeds the camera flies by: at least 30 % of the pixels move.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from qsim import files
from qsim.scene import Body, Diffuse, EnvironmentImage, Light, Material, Mesh, RoughPlastic, Scene, Texture, Translation
from qsim.scene.animated.gltf_body import GLTF_SUFFIXES
from qsim.scene.animated.gltf_scene import gltf_parts
from qsim.scene.rotation import pose_matrix, vector
from qsim.scene.shapes import MESH_SUFFIXES, mesh_file, mesh_material, moved
from qsim.scene.textures import PICTURE_SUFFIXES
from qsim.scenes import common, tumble
from qsim.scenes.colours import with_parts
from qsim.scenes.common import any_angle, between, pick

ENVIRONMENT_SUFFIXES = frozenset({".hdr", ".exr"})
SUFFIXES = MESH_SUFFIXES | PICTURE_SUFFIXES | ENVIRONMENT_SUFFIXES


def scene(seed: int = 0, *, speed: float = 1.0, folder: str | Path, bands: Literal["rgb"] | None = None) -> Scene:
    """Return six to nine bodies of the folder's meshes and textures in free flight, as in `tumble`.

    The camera flies by at 1 to 3 m/s at speed 1, but is at rest where the seed is a multiple of 3.
    A glTF file keeps its materials, as a body for each. Other meshes keep their colours in a matt or glossy finish.
    With `bands="rgb"` a scene with glTF files is read in colour; others are coloured afterwards.
    `FileNotFoundError` if the folder has none of these files; `ValueError` names a file that cannot be read.
    """
    meshes, pictures, environments = assets(folder)
    rng = np.random.default_rng([seed, 17])
    bodies = [
        common.floor(_material(rng, pictures), 2.4, y=-0.18, z=-0.2),
        common.wall(_material(rng, pictures), 2.4, 1.2, z=-0.6, y=0.35),
    ]
    kept: list[Body] = []  # with the materials of their files
    for i, place in enumerate(tumble.spread(rng, int(rng.integers(6, 10)))):
        motion = tumble.thrown(rng, place, speed)
        shape = (pick(rng, meshes), between(rng, 0.08, 0.16)) if meshes else _solid(rng)
        drawn = _material(rng, pictures)
        parts = () if isinstance(shape, Mesh) else _parts(*shape, bands)
        kept += [replace(part, name=f"body {i}, part {k}", motion=motion) for k, part in enumerate(parts)]
        if not parts:
            bodies.append(Body(f"body {i}", *_surfaced(shape, drawn), motion))
    flight = None if seed % 3 == 0 else _flight(rng, speed)
    view = common.camera((0.0, between(rng, 0.02, 0.14), 0.65), (0, 0, 0), 0.5, flight)
    made = Scene(Path(folder).resolve().name, seed, view, (_light(rng, environments),), tuple(bodies), speed)
    return with_parts(made, kept, bands)


def assets(folder: str | Path) -> tuple[list[Path], list[Path], list[Path]]:
    """Return the meshes, pictures and environments in a folder and below, each sorted by path."""
    found = sorted(path for path in Path(folder).rglob("*") if path.is_file())
    kinds = (MESH_SUFFIXES, PICTURE_SUFFIXES, ENVIRONMENT_SUFFIXES)
    meshes, pictures, environments = ([p for p in found if p.suffix.lower() in kind] for kind in kinds)
    if not (meshes or pictures or environments):
        known = ", ".join(sorted(SUFFIXES))
        raise FileNotFoundError(f"{folder}: no mesh, picture or environment in this folder ({known})")
    return meshes, pictures, environments


def _solid(rng: np.random.Generator) -> Mesh:
    """Return a solid, 8 to 16 cm across."""
    return moved(tumble.shape(rng), pose_matrix(2.5 * np.eye(3)))


def _parts(path: Path, size: float, bands: Literal["rgb"] | None) -> tuple[Body, ...]:
    """Return a mesh of the folder with its own materials; none unless it is a glTF file that states some."""
    return gltf_parts(path, size, bands=bands) if path.suffix.lower() in GLTF_SUFFIXES else ()


def _surfaced(shape: Mesh | tuple[Path, float], drawn: Material) -> tuple[Mesh, Material]:
    """Return a solid, or a mesh of the folder and its length, with its own colours, if any, in the drawn finish."""
    if isinstance(shape, Mesh):
        return shape, drawn
    path, size = shape
    own = mesh_material(path)
    return mesh_file(path, size=size), drawn if own is None else common.finished(own, drawn)


def _flight(rng: np.random.Generator, speed: float) -> Translation:
    """Return the motion of a camera that flies by and passes its place in the middle of a clip."""
    angle = any_angle(rng)
    rate = between(rng, 1.0, 3.0) * speed
    velocity = rate * np.array([np.cos(angle), 0.4 * np.sin(angle), 0.3 * rng.normal()])
    return Translation(vector(velocity), vector(-velocity * common.CLIP / 2))


def _material(rng: np.random.Generator, pictures: list[Path]) -> Material:
    """Return a matt or slightly glossy material; a picture keeps its colours, with white at a reflectance of 0.9."""
    if not pictures:
        return common.paint(rng, common.surface(rng))
    picture = pick(rng, pictures)
    texture = Texture(str(picture), source=files.sha256(picture), scale=0.9)
    texture.pixels()  # a picture that cannot be read is named here
    return Diffuse(texture) if rng.random() < 0.5 else RoughPlastic(texture, roughness=between(rng, 0.15, 0.4))


def _light(rng: np.random.Generator, environments: list[Path]) -> Light:
    if not environments:
        return common.sun(rng)
    return EnvironmentImage(str(pick(rng, environments)), rotation=any_angle(rng))
