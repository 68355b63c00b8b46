"""What is in front of the sensor: frozen records in SI units, and nothing that draws.

    Scene = Camera + lights + bodies (mesh, material, motion)

Lengths are metres, angles radians, y points up. Bodies are described in their own coordinates; `motion.pose(t)` (4x4,
body to world) places them at time t [s]. The camera looks from `origin` to `target`; its optional motion acts in the
camera's own axes (x right, y down, z forward): a spin about y is a pan, a translation along z a dolly. Radiance belongs
to one band around `Camera.wavelength`. Left out: polarisation, spectra, participating media, lens aberrations.
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
from qsim.colour import luminance, to_linear
from qsim.optics.camera import Camera, Pose, Vector


@runtime_checkable
class Deformation(Pose, Protocol):
    """A motion that also moves the vertices within the body's coordinates."""

    def deform(self, t: float) -> np.ndarray:
        """Vertices in body coordinates, float64 [V, 3], same faces as the body's mesh."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in body coordinates. Zero-area triangles are allowed: they are never hit."""

    vertices: np.ndarray  # float64 [V, 3], m
    faces: np.ndarray  # int [F, 3], indices into vertices, counter-clockwise seen from outside
    uv: np.ndarray | None = None  # float64 [V, 2]; row 0 of a texture lies at v = 1, its column 0 at u = 0
    smooth: bool = False  # shade with interpolated vertex normals

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


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture on a surface: an array [H, W] of linear values, or an image file (sRGB grey or colour)."""

    image: np.ndarray | str  # float [H, W] linear, or a path; a path's colours become linear luminance (Rec. 709)
    repeat: tuple[float, float] = (1.0, 1.0)  # how often the picture fits into u, v = 0..1
    nearest: bool = False  # nearest texel instead of bilinear

    def pixels(self) -> np.ndarray:
        """Linear values, float32 [H, W]; raises FileNotFoundError or ValueError naming the file."""
        if not isinstance(self.image, str | Path):
            pixels = np.asarray(self.image, np.float32)
            where = "Texture.image"
        else:
            where = str(self.image)
            pixels = _read_grey(Path(self.image))
        if pixels.ndim != 2 or pixels.size == 0:
            raise ValueError(f"{where}: expected a picture [H, W], got shape {pixels.shape}")
        require_finite(where, pixels)
        return pixels


@dataclass(frozen=True, eq=False)
class Bump:
    """Relief that only tilts normals: a height map (in metres where 1 means `height`)."""

    texture: Texture
    height: float = 1.0  # m


@dataclass(frozen=True, eq=False)
class NormalMap:
    """Tangent-space normals as a picture, float [H, W, 3] in 0..1 (0.5, 0.5, 1 is flat)."""

    image: np.ndarray
    repeat: tuple[float, float] = (1.0, 1.0)


Relief = Bump | NormalMap | None


@dataclass(frozen=True, eq=False)
class Diffuse:
    """Lambertian surface, both sides."""

    reflectance: float | Texture = 0.5  # 0..1
    relief: Relief = None

    def __post_init__(self) -> None:
        _check_reflectance(self)


@dataclass(frozen=True, eq=False)
class RoughPlastic:
    """Diffuse base under a rough dielectric coat (GGX)."""

    reflectance: float | Texture = 0.5  # of the base, 0..1
    roughness: float = 0.1  # GGX alpha
    ior: float = 1.49
    relief: Relief = None

    def __post_init__(self) -> None:
        _check_reflectance(self)


@dataclass(frozen=True, eq=False)
class Conductor:
    """Metal by its complex index at the camera's wavelength; roughness 0 is a mirror. Default: aluminium at 550 nm.

    Aluminium 0.96 + 6.70i, silver 0.055 + 3.32i, gold 0.42 + 2.35i, copper 1.04 + 2.59i, chromium 3.12 + 3.31i
    (rounded from the usual handbooks at 550 nm).
    """

    eta: float = 0.96
    k: float = 6.70
    roughness: float = 0.1  # GGX alpha
    relief: Relief = None


@dataclass(frozen=True, eq=False)
class Dielectric:
    """Glass or water; roughness 0 is clear. `thin` is a pane without thickness."""

    ior: float = 1.5
    roughness: float = 0.0
    thin: bool = False


@dataclass(frozen=True, eq=False)
class Glow:
    """A surface that emits the same radiance in all directions, on its outer side, and reflects nothing."""

    radiance: float  # W m^-2 sr^-1

    def __post_init__(self) -> None:
        _check_light(self, "radiance")


Material = Diffuse | RoughPlastic | Conductor | Dielectric | Glow


@dataclass(frozen=True, eq=False)
class Constant:
    """The same radiance from every direction."""

    radiance: float  # W m^-2 sr^-1

    def __post_init__(self) -> None:
        _check_light(self, "radiance")


@dataclass(frozen=True, eq=False)
class SunSky:
    """A clear sky (CIE standard general sky, type 12), a sun disk, and a ground of constant radiance below the horizon.

    Both irradiances are those in the rendered band. Azimuth 0 is +z, pi/2 is +x.
    """

    elevation: float = 0.8  # rad above the horizon
    azimuth: float = 0.6  # rad
    sun_irradiance: float = 1.0  # W m^-2 on a plane facing the sun
    sky_irradiance: float = 0.25  # W m^-2 on the ground, sky alone
    ground_reflectance: float = 0.2  # 0..1
    sun_radius: float = 4.65e-3  # rad; the real sun's mean angular radius

    def __post_init__(self) -> None:
        _check_light(self, "sun_irradiance", "sky_irradiance")


@dataclass(frozen=True, eq=False)
class AreaLamp:
    """A rectangle that shines from `origin` towards `target`, on that side only."""

    origin: Vector
    target: Vector
    width: float  # m
    height: float  # m
    radiance: float  # W m^-2 sr^-1
    motion: Pose | None = None  # world motion: pose(t) is applied after the placement

    def __post_init__(self) -> None:
        _check_light(self, "radiance")


@dataclass(frozen=True, eq=False)
class PointLight:
    """An isotropic point: irradiance at distance r is intensity / r^2."""

    position: Vector
    intensity: float  # W sr^-1
    motion: Pose | None = None

    def __post_init__(self) -> None:
        _check_light(self, "intensity")


@dataclass(frozen=True, eq=False)
class EnvironmentImage:
    """An equirectangular picture of radiance around the scene: array [H, W] or a file (.hdr, .exr), zenith on top.

    The first and last column meet at azimuth `rotation` + pi; the middle column is azimuth `rotation` (0 is +z).
    """

    image: np.ndarray | str
    scale: float = 1.0  # radiance per unit of the picture, W m^-2 sr^-1
    rotation: float = 0.0  # rad about +y


Light = Constant | SunSky | AreaLamp | PointLight | EnvironmentImage
ENVIRONMENTS = (Constant, SunSky, EnvironmentImage)


@dataclass(frozen=True, eq=False)
class Body:
    """One thing that moves as a whole."""

    name: str
    mesh: Mesh
    material: Material = dataclasses.field(default_factory=Diffuse)
    motion: Pose | None = None  # None: stays where its mesh is

    def pose(self, t: float) -> np.ndarray:
        """Body-to-world matrix at time t [s], float64 [4, 4]."""
        return np.eye(4) if self.motion is None else np.asarray(self.motion.pose(t), np.float64)

    def vertices(self, t: float) -> np.ndarray:
        """Vertices in body coordinates at time t [s], float64 [V, 3]; only deformations change them."""
        if self.deforms:
            assert isinstance(self.motion, Deformation)
            return np.asarray(self.motion.deform(t), np.float64)
        return self.mesh.vertices

    @functools.cached_property
    def deforms(self) -> bool:
        """Asked at every frame; telling a protocol costs as much as posing the body."""
        return isinstance(self.motion, Deformation)


@dataclass(frozen=True, eq=False)
class MitsubaFile:
    """An XML scene that Mitsuba reads itself: shapes, materials and lights, radiance taken as W m^-2 sr^-1."""

    path: str
    sha256: str  # of the file; meshes and pictures that it names are not counted


@dataclass(frozen=True, eq=False)
class Part:
    """A shape of a Mitsuba file; the motion carries it from where the file puts it, in the world's axes."""

    name: str
    motion: Pose | None = None

    def pose(self, t: float) -> np.ndarray:
        """Matrix that takes the shape from its place in the file to its place at time t [s], float64 [4, 4]."""
        return np.eye(4) if self.motion is None else np.asarray(self.motion.pose(t), np.float64)


@dataclass(frozen=True, eq=False)
class Scene:
    """A camera, lights and bodies, with the family and seed they came from."""

    name: str
    seed: int
    camera: Camera
    lights: tuple[Light, ...]
    bodies: tuple[Body, ...]
    speed: float = 1.0  # the factor that the family applied to its motions
    file: MitsubaFile | None = None  # instead of lights and bodies of our own; see `qsim.read_mitsuba`
    parts: tuple[Part, ...] = ()  # the file's shapes, in its order

    def __post_init__(self) -> None:
        for name in ("lights", "bodies"):
            if not isinstance(getattr(self, name), list | tuple):
                kind = type(getattr(self, name)).__name__
                raise ValueError(f"Scene.{name}: a tuple is expected, got a {kind}; one alone is ({kind}(...),)")
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
        """Whether anything gives light."""
        if self.file is not None:
            return True  # checked when the file was read
        return any(_strength(light) > 0 for light in self.lights) or any(
            isinstance(body.material, Glow) and body.material.radiance > 0 for body in self.bodies
        )

    def resized(self, height: int, width: int) -> Scene:
        """The same scene on another number of pixels."""
        return replace(self, camera=self.camera.resized(height, width))

    def to_dict(self) -> dict[str, Any]:
        """Provenance as JSON-ready values; arrays become their shape, type and SHA-256."""
        described = describe(self)
        assert isinstance(described, dict)
        return described


def describe(value: Any) -> Any:
    """A record as JSON-ready values; dataclasses name their kind, arrays give shape, type and SHA-256."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: describe(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"kind": type(value).__name__} | fields
    if isinstance(value, np.ndarray):
        if value.size <= 16:
            return value.tolist()
        digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return {"shape": list(value.shape), "dtype": str(value.dtype), "sha256": digest}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple | list):
        return [describe(item) for item in value]
    if isinstance(value, dict):
        return {str(key): describe(item) for key, item in value.items()}
    if value is None or isinstance(value, str | int | float | bool):
        return value
    if isinstance(value, Path):
        return str(value)
    return f"{type(value).__module__}.{type(value).__qualname__}"


def _check_motion(scene: str, body: Body | Part) -> None:
    pose = body.pose(0.0)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"scene {scene}, body {body.name}: motion.pose(0) must be a finite 4x4 matrix, got {pose!r}")
    if isinstance(body, Part):
        if isinstance(body.motion, Deformation):
            raise ValueError(f"scene {scene}, shape {body.name}: shapes of a Mitsuba file move rigidly, none deforms")
    elif body.deforms and body.vertices(0.0).shape != body.mesh.vertices.shape:
        expected, found = body.mesh.vertices.shape, body.vertices(0.0).shape
        raise ValueError(f"scene {scene}, body {body.name}: deform must keep the mesh's {expected}, got {found}")


def _strength(light: Light) -> float:
    """Some measure that is 0 only for a light that is off."""
    match light:
        case Constant(radiance) | AreaLamp(radiance=radiance):
            return radiance
        case SunSky(sun_irradiance=sun, sky_irradiance=sky):
            return sun + sky
        case PointLight(intensity=intensity):
            return intensity
        case EnvironmentImage(image, scale):
            return scale * (1.0 if isinstance(image, str) else float(np.max(image)))
    raise ValueError(f"{light!r} is not one of the lights of qsim.scene")


def _read_grey(path: Path) -> np.ndarray:
    """An image file as linear luminance, float32 [H, W]."""
    from PIL import Image

    if not path.is_file():
        raise FileNotFoundError(f"texture {path}: no such file")
    try:
        with Image.open(path) as opened:
            colour = np.asarray(opened.convert("RGB"), np.float32) / 255
    except OSError as error:
        raise ValueError(f"texture {path}: not a readable image ({error})") from error
    return luminance(to_linear(colour, "srgb", 1.0).astype(np.float64)).astype(np.float32)


def _check_reflectance(material: Diffuse | RoughPlastic) -> None:
    found, kind = material.reflectance, type(material).__name__
    if not isinstance(found, Texture) and not (isinstance(found, int | float | np.number) and 0 <= found <= 1):
        raise ValueError(f"{kind}.reflectance: a number from 0 to 1 or a Texture is expected, got {found!r}")


def _check_light(light: Any, *names: str) -> None:
    for name in names:
        found = getattr(light, name)
        if not (isinstance(found, int | float | np.number) and np.isfinite(found) and found >= 0):
            raise ValueError(f"{type(light).__name__}.{name}: a finite number from 0 up is expected, got {found!r}")
