"""Describes a scene as frozen records in SI units: camera, lights, and bodies of mesh, material and motion.

    Scene = Camera + lights + bodies (mesh, material, motion)

Lengths are metres, angles radians, y points up. Bodies are described in their own coordinates; `motion.pose(t)` (4x4,
body to world) places them at time t [s]. The camera looks from `origin` to `target`; its optional motion acts in the
camera's own axes (x right, y down, z forward): a spin about y is a pan, a translation along z a dolly. Radiance belongs
to one band around `Camera.wavelength`, or to the three `bands` of a colour scene. Left out: polarisation, spectra,
participating media, lens aberrations but the distortion of `Camera.lens`.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from qsim.checks import require_finite
from qsim.host import own_numbers
from qsim.optics.camera import Camera, Pose
from qsim.scene.bands import Bands, check_bands, has_colour
from qsim.scene.flicker import Flicker
from qsim.scene.lights import ENVIRONMENTS, Light, strength
from qsim.scene.materials import (
    Diffuse,
    Material,
    MetallicRoughness,
    Patches,
    VertexColours,
    emits,
    see_through,
    shows_picture,
)


@runtime_checkable
class Deformation(Pose, Protocol):
    """A motion that also moves the vertices within the body's coordinates."""

    def deform(self, t: float) -> np.ndarray:
        """Return vertices [m] in body coordinates at time t [s], float64 [V, 3]; the faces are those of the mesh."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in body coordinates. Zero-area triangles are allowed: they are never hit."""

    vertices: np.ndarray  # float64 [V, 3], m
    faces: np.ndarray  # int [F, 3], indices into vertices, counter-clockwise seen from outside
    uv: np.ndarray | None = None  # float64 [V, 2]; row 0 of a texture lies at v = 1, its column 0 at u = 0
    smooth: bool = False  # shade with interpolated vertex normals
    # int [V]; vertices of one number share a normal, as the two sides of a seam. None: each has its own
    groups: np.ndarray | None = dataclasses.field(default=None, metadata={"described": "if any"})

    def __post_init__(self) -> None:
        vertices = np.asarray(self.vertices, np.float64)
        faces = np.asarray(self.faces, np.int64)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError(f"Mesh: expected vertices [V, 3] and faces [F, 3], got {vertices.shape} and {faces.shape}")
        if not len(faces):
            raise ValueError("Mesh: no faces; a body needs at least one triangle")
        require_finite("Mesh.vertices", vertices)
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError(f"Mesh.faces: indices 0..{len(vertices) - 1} expected, found {faces.min()}..{faces.max()}")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces.astype(np.int32))
        if self.uv is not None:
            uv = np.asarray(self.uv, np.float64)
            if uv.shape != (len(vertices), 2):
                raise ValueError(f"Mesh.uv: expected [{len(vertices)}, 2], got {uv.shape}")
            require_finite("Mesh.uv", uv)
            object.__setattr__(self, "uv", uv)
        if self.groups is not None:
            groups = np.asarray(self.groups, np.int64)
            if groups.shape != (len(vertices),) or groups.min() < 0 or groups.max() >= len(vertices):
                raise ValueError(f"Mesh.groups: a number below {len(vertices)} per vertex is expected")
            object.__setattr__(self, "groups", groups)


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh with one material and one motion."""

    name: str
    mesh: Mesh
    material: Material = dataclasses.field(default_factory=Diffuse)
    motion: Pose | None = None  # None: stays where its mesh is

    def __post_init__(self) -> None:
        if self.mesh.uv is None and shows_picture(self.material):
            raise ValueError(
                f"body {self.name}: its material shows a picture, and its mesh has no texture coordinates; give Mesh "
                "uv=, or build it with qsim.scene.shapes.box_mapped"
            )
        colours = self.material.reflectance if isinstance(self.material, MetallicRoughness) else None
        if isinstance(colours, VertexColours) and len(colours.colours) != len(self.mesh.vertices):
            raise ValueError(
                f"body {self.name}: its material colours {len(colours.colours)} vertices, its mesh has "
                f"{len(self.mesh.vertices)}"
            )
        if isinstance(self.material, Patches) and sum(self.material.counts) != len(self.mesh.faces):
            raise ValueError(
                f"body {self.name}: its Patches are of {sum(self.material.counts)} faces, its mesh has "
                f"{len(self.mesh.faces)}"
            )

    def pose(self, t: float) -> np.ndarray:
        """Return the body-to-world matrix at time t [s], float64 [4, 4]."""
        return np.eye(4) if self.motion is None else np.asarray(self.motion.pose(t), np.float64)

    def vertices(self, t: float) -> np.ndarray:
        """Return vertices [m] in body coordinates at time t [s], float64 [V, 3]; only deformations change them."""
        if self.deforms:
            assert isinstance(self.motion, Deformation)
            return np.asarray(self.motion.deform(t), np.float64)
        return self.mesh.vertices

    @functools.cached_property
    def deforms(self) -> bool:
        """Whether the motion deforms the mesh; cached, because the check costs as much as a pose."""
        return isinstance(self.motion, Deformation)


@dataclass(frozen=True, eq=False)
class MitsubaFile:
    """An XML scene with shapes, materials and lights, read by Mitsuba; its radiance is in W m^-2 sr^-1."""

    path: str
    sha256: str  # of the file; meshes and pictures that it names are not counted
    flickers: dict[str, Flicker] | None = dataclasses.field(default=None, metadata={"described": "if any"})  # by id


@dataclass(frozen=True, eq=False)
class Part:
    """A shape of a Mitsuba file; its motion starts at its place in the file, in the world's axes."""

    name: str
    motion: Pose | None = None

    def pose(self, t: float) -> np.ndarray:
        """Return the matrix from the shape's place in the file to its place at time t [s], float64 [4, 4]."""
        return np.eye(4) if self.motion is None else np.asarray(self.motion.pose(t), np.float64)


@own_numbers
@dataclass(frozen=True, eq=False)
class Scene:
    """A camera, lights and bodies, with the family and seed they came from."""

    name: str
    seed: int
    camera: Camera
    lights: tuple[Light, ...]
    bodies: tuple[Body, ...]
    speed: float = 1.0  # the factor that the family applied to its motions
    file: MitsubaFile | None = None  # instead of lights and bodies; see `qsim.read_mitsuba`
    parts: tuple[Part, ...] = ()  # the file's shapes, in its order
    bands: Bands | None = None  # m, wavelengths of R, G and B; None: one band, at the camera's wavelength

    def __post_init__(self) -> None:
        for name in ("lights", "bodies"):
            if not isinstance(getattr(self, name), list | tuple):
                kind = type(getattr(self, name)).__name__
                raise ValueError(f"Scene.{name}: a tuple is expected, got a {kind}; one alone is ({kind}(...),)")
        check_bands(self.bands, f"scene {self.name}")
        coloured = [
            type(each).__name__ for each in (*self.lights, *(b.material for b in self.bodies)) if has_colour(each)
        ]
        if self.bands is None and coloured:
            raise ValueError(f"scene {self.name}: a {coloured[0]} has a colour; give the scene bands=qsim.optics.RGB")
        environments = [light for light in self.lights if isinstance(light, ENVIRONMENTS)]
        if len(environments) > 1:
            kinds = " and ".join(type(light).__name__ for light in environments)
            raise ValueError(f"scene {self.name}: only one light may surround the scene, found {kinds}")
        if not self.emits():
            raise ValueError(
                f"scene {self.name}: no light and no glowing body, every pixel would be black; add a light"
            )
        names = [body.name for body in self.bodies]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"scene {self.name}: body names must differ, found {twice[0]!r} more than once")
        if (self.file is None and self.parts) or (self.file is not None and (self.bodies or self.lights)):
            raise ValueError(f"scene {self.name}: bodies and lights are either records or those of a Mitsuba file")
        movable: tuple[Body | Part, ...] = (*self.bodies, *self.parts)
        for body in movable:
            _check_motion(self.name, body)

    def __repr__(self) -> str:
        camera = self.camera
        lights = ", ".join(type(light).__name__ for light in self.lights) or "glowing bodies only"
        lights = f"of {self.file.path}" if self.file is not None else lights
        things = len(self.bodies) + len(self.parts)
        return (
            f"<Scene {self.name}, seed {self.seed}, speed {self.speed:g}: {things} bodies, "
            f"light: {lights}; "
            f"camera {camera.height} x {camera.width} px of {camera.pixel_pitch * 1e6:g} um, "
            f"{camera.focal_length * 1e3:.3g} mm f/{camera.f_number:g}>"
        )

    def emits(self) -> bool:
        """Return whether anything emits light."""
        if self.file is not None:
            return True  # checked when the file was read
        return any(strength(light) > 0 for light in self.lights) or any(emits(body.material) for body in self.bodies)

    @functools.cached_property
    def see_through(self) -> bool:
        """Whether a body lets light pass straight on."""
        return any(see_through(body.material) for body in self.bodies)

    @functools.cached_property
    def flickers(self) -> dict[str, Flicker]:
        """The flicker of each light that has one: `light0` by its place in `lights`, `body3` for a glowing body.

        Lights of a Mitsuba file have the id of their emitter, or of the shape that glows.
        """
        if self.file is not None:
            return dict(self.file.flickers or {})
        lights = {f"light{i}": getattr(light, "flicker", None) for i, light in enumerate(self.lights)}
        glowing = {f"body{i}": getattr(body.material, "flicker", None) for i, body in enumerate(self.bodies)}
        return {name: flicker for name, flicker in (lights | glowing).items() if flicker is not None}

    def resized(self, height: int, width: int) -> Scene:
        """Return the same scene with another number of pixels."""
        return replace(self, camera=self.camera.resized(height, width))

    def to_dict(self) -> dict[str, object]:
        """Return the scene as JSON-ready values; arrays become their shape, type and SHA-256."""
        described = describe(self)
        assert isinstance(described, dict)
        return described


def describe(value: Any) -> Any:
    """Return a record as JSON-ready values: dataclasses with their kind, arrays with shape, type and SHA-256."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        values = {
            field.name: getattr(value, field.name) for field in dataclasses.fields(value) if _is_told(value, field)
        }
        return {"kind": type(value).__name__} | {name: describe(each) for name, each in values.items()}
    if isinstance(value, np.ndarray):
        if value.size <= 16 or value.dtype.kind == "O":
            return describe(value.tolist())
        digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return {"shape": list(value.shape), "dtype": str(value.dtype), "sha256": digest}
    if isinstance(value, np.generic):
        return describe(value.item())
    if isinstance(value, complex):
        return [value.real, value.imag]
    if isinstance(value, tuple | list):
        return [describe(item) for item in value]
    if isinstance(value, dict):
        return {str(key): describe(item) for key, item in value.items()}
    if value is None or isinstance(value, str | int | float | bool):
        return value
    if isinstance(value, Path):
        return str(value)
    return f"{type(value).__module__}.{type(value).__qualname__}"


def _is_told(record: Any, field: dataclasses.Field[Any]) -> bool:
    """Return whether a description holds a field: not where it is marked "if any" and has its default."""
    value = getattr(record, field.name)
    default = value is field.default or (not isinstance(value, np.ndarray) and value == field.default)
    return "described" not in field.metadata or not default


def _check_motion(scene: str, body: Body | Part) -> None:
    pose = body.pose(0.0)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"scene {scene}, body {body.name}: motion.pose(0) must be a finite 4x4 matrix, got {pose!r}")
    if isinstance(body, Part):
        if isinstance(body.motion, Deformation):
            raise ValueError(f"scene {scene}, shape {body.name}: shapes of a Mitsuba file move rigidly, none deforms")
    elif body.deforms and body.vertices(0.0).shape != body.mesh.vertices.shape:
        expected = body.mesh.vertices.shape
        found = body.vertices(0.0).shape
        raise ValueError(f"scene {scene}, body {body.name}: deform must keep the mesh's {expected}, got {found}")
