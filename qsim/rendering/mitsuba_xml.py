"""Reads scenes in Mitsuba's XML; our camera and motions replace those of the file.

    scene.xml + {shape id: motion} + {light id: flicker} -> Scene(file, parts)

Mitsuba keeps shapes, materials and lights. The `Scene` holds the names of the shapes, their motions, flickers of lights
and the camera.
`mi` is the Mitsuba module.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from qsim import files
from qsim.checks import suggest
from qsim.optics.camera import Camera, Pose, Vector
from qsim.rendering.engine import errors_only, select
from qsim.rendering.mitsuba_mesh import POSITIONS
from qsim.scene import MitsubaFile, Part, Scene
from qsim.scene.flicker import Flicker

F_NUMBER, PITCH = 2.8, 1.1e-6  # of the camera made from the file's sensor, which has no pixels in metres
MOVABLE = ("to_world", POSITIONS)
EMISSION = (  # what scales a light: lamp or glow, even, point or spot, parallel, image
    *("emitter.radiance.value", "radiance.value", "intensity.value", "irradiance.value", "scale"),
)


def read_mitsuba(
    xml: str | Path,
    motions: Mapping[str, Pose] | None = None,
    *,
    camera: Camera | None = None,
    flickers: Mapping[str, Flicker] | None = None,
) -> Scene:
    """Return the scene of a Mitsuba XML file; shapes named by their `id` follow `motions`, all others rest.

    `flickers` are the strengths over time of emitters by their `id`, of glowing shapes by that of the shape.
    Without `camera` the file's first sensor is taken, a pinhole of its field of view and size behind an f/2.8 lens on
    pixels of 1.1 um. The file's integrator and samples do not count. `FileNotFoundError` for a missing file;
    `ValueError` for a file that Mitsuba refuses, without light, with participating media, with a camera that is not a
    plain `perspective`, for motions of unknown shapes or of shapes that cannot be moved rigidly, and for flickers of
    lights that are unknown or whose strength is not one number. Shapes with holes by opacity warn: their truth is that
    of the whole shape.
    """
    select()
    import mitsuba as mi

    path, motions = Path(xml), motions or {}
    loaded = load(mi, str(path))
    if not loaded.emitters():
        raise ValueError(f"{path}: no emitter, every pixel would be black; add one")
    for shape in loaded.shapes():
        if shape.interior_medium() is not None or shape.exterior_medium() is not None:
            raise ValueError(f"{path}: shape {shape.id()!r} holds a participating medium, which is not rendered here")
        bsdf = shape.bsdf()
        if bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) and "ThinDielectric" not in str(bsdf):
            warnings.warn(
                f"{path}: shape {shape.id()!r} has holes by its opacity; truth (flow, depth, bodies) ignores them",
                stacklevel=2,
            )
    names = [shape.id() for shape in loaded.shapes()]
    parameters = mi.traverse(loaded)
    for name in motions:
        if name not in names:
            meant = suggest(name, names) or f"; there are {', '.join(map(repr, names)) or 'none'}"
            raise ValueError(f"{path}: no shape has the id {name!r}{meant}")
        if not any(f"{name}.{key}" in parameters for key in MOVABLE):
            raise ValueError(f"{path}: shape {name!r} has neither vertices nor a placement to move; use a mesh")
    for name, flicker in (flickers or {}).items():
        _check_flicker(path, name, flicker, loaded, parameters)
    parts = tuple(Part(name, motions.get(name)) for name in names)
    camera = camera or _camera(mi, loaded, path)
    file = MitsubaFile(str(path), files.sha256(path), dict(flickers) if flickers else None)
    return Scene(path.stem, 0, camera, (), (), file=file, parts=parts)


def _check_flicker(path: Path, name: str, flicker: Flicker, loaded: Any, parameters: Any) -> None:
    """Raise `ValueError` unless the flicker is one of ours and one number scales the light of this name."""
    if not isinstance(flicker, Flicker):
        kinds = "Mains, RectifiedSine or PulseWidth"
        raise ValueError(f"{path}: flicker of {name!r}: {kinds} is expected, got {flicker!r}")
    known = {(light if light.get_shape() is None else light.get_shape()).id() for light in loaded.emitters()}
    lights = {light for light in known if any(f"{light}.{end}" in parameters for end in EMISSION)}
    if name not in lights:
        meant = suggest(name, lights) or f"; there are {', '.join(map(repr, sorted(lights))) or 'none'}"
        raise ValueError(f"{path}: no light whose strength is one number has the id {name!r}{meant}")


def load(mi: Any, path: str) -> Any:
    """Return Mitsuba's scene object with an id for every shape; unnamed shapes are numbered."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with errors_only(mi):  # it warns that a colour film becomes grey; no film is used
            loaded = mi.load_file(path, optimize=False)  # optimising would merge shapes and lose their names
    except RuntimeError as error:
        raise ValueError(f"{path}: Mitsuba cannot load it: {' '.join(str(error).split())}") from None
    if not isinstance(loaded, mi.Scene):
        raise ValueError(f"{path}: its root element is not <scene>; only scene files can be read")
    for i, shape in enumerate(loaded.shapes()):
        if not shape.id():
            shape.set_id(f"shape {i}")
    return loaded


def _camera(mi: Any, loaded: Any, path: Path) -> Camera:
    """Return the file's first sensor as a pinhole behind an f/2.8 lens."""
    ask = "give a camera of your own: read_mitsuba(..., camera=Camera(...))"
    if not loaded.sensors():
        raise ValueError(f"{path}: no sensor; {ask}")
    sensor = loaded.sensors()[0]
    values = mi.traverse(sensor)
    if sensor.class_name() != "PerspectiveCamera":
        raise ValueError(f"{path}: its sensor is a {sensor.class_name()}, only 'perspective' is taken over; {ask}")
    if any(abs(float(np.ravel(values[f"principal_point_offset_{axis}"])[0])) > 1e-9 for axis in "xy"):
        raise ValueError(f"{path}: its sensor's principal point is off the middle; {ask}")
    pose = np.array(values["to_world"].matrix, np.float64).reshape(4, 4)
    _, up, forward = pose[:3, :3].T  # Mitsuba's camera axes: left, up, forward
    if np.linalg.det(pose[:3, :3]) <= 0:
        raise ValueError(f"{path}: its sensor's to_world mirrors the picture; {ask}")
    width, height = (int(n) for n in sensor.film().size())
    field = math.radians(float(np.ravel(values["x_fov"])[0]))
    focal_length = PITCH * width / 2 / math.tan(field / 2)
    return Camera(
        focal_length=focal_length,
        f_number=F_NUMBER,
        pixel_pitch=PITCH,
        height=height,
        width=width,
        origin=_vector(pose[:3, 3]),
        target=_vector(pose[:3, 3] + forward),
        up=_vector(up),
    )


def _vector(values: np.ndarray) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])
