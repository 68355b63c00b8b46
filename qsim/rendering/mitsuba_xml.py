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
from xml.etree import ElementTree

import numpy as np

from qsim import files, limits
from qsim.checks import file_path, suggest
from qsim.device_lock import one_thread_at_a_time
from qsim.host import own_numbers
from qsim.optics.camera import Camera, Pose, Vector
from qsim.optics.lens import Lens
from qsim.optics.radiometry import RGB
from qsim.rendering import mitsuba_files
from qsim.rendering.engine import activate, errors_only, in_colour, select
from qsim.rendering.mitsuba_mesh import POSITIONS
from qsim.scene import MitsubaFile, Part, Scene
from qsim.scene.flicker import Flicker

# of the camera made from the file's sensor, which has no pixels in metres
F_NUMBER = 2.8
PITCH = 1.1e-6
MOVABLE = ("to_world", POSITIONS)
REJECTIONS = (  # what Mitsuba raises for files that it cannot load
    *(RuntimeError, ValueError, TypeError, LookupError, AttributeError, UnicodeError, RecursionError, OSError),
)
EMISSION = (  # what scales a light: lamp or glow, even, point or spot, parallel, image
    *("emitter.radiance.value", "radiance.value", "intensity.value", "irradiance.value", "scale"),
)


@own_numbers
@one_thread_at_a_time
def read_mitsuba(
    xml: str | Path,
    motions: Mapping[str, Pose] | None = None,
    *,
    camera: Camera | None = None,
    flickers: Mapping[str, Flicker] | None = None,
    bands: str | None = None,
) -> Scene:
    """Return the scene of a Mitsuba XML file; shapes named by their `id` follow `motions`, all others rest.

    `flickers` are the strengths over time of emitters by their `id`, of glowing shapes by that of the shape.
    Without `camera` the file's first sensor is taken: a pinhole of its field of view, its film's size or crop window
    and its principal point, behind an f/2.8 lens on pixels of 1.1 um. A pixel is the mean over its area, whatever the
    film's reconstruction filter; integrator, samples and shutter times do not count. With `bands="rgb"` the scene is in
    colour, which emitters of some kinds need. `FileNotFoundError` for a missing file; `ValueError` for a file that
    Mitsuba refuses to load or to render, without light, with participating media, with a camera that is not a plain
    `perspective` or whose clipping planes cut away what it sees, for motions of unknown shapes or of shapes that cannot
    be moved rigidly, and for flickers of lights that are unknown or whose strength is not one number. Shapes with holes
    by opacity warn: their truth is that of the whole shape.
    """
    if bands not in (None, "rgb"):
        raise ValueError(f"bands {bands!r}: expected 'rgb', or None for one band")
    engine = select()
    if bands is not None:
        activate(in_colour(engine))
    import mitsuba as mi

    path = file_path(xml)
    motions = motions or {}
    loaded = load(mi, str(path))
    if not loaded.emitters():
        raise ValueError(f"{path}: no emitter, every pixel would be black; add one")
    for shape in loaded.shapes():
        if shape.interior_medium() is not None or shape.exterior_medium() is not None:
            raise ValueError(f"{path}: shape {shape.id()!r} holds a participating medium, which is not rendered here")
        if _has_holes(mi, shape):
            warnings.warn(
                f"{path}: shape {shape.id()!r} has holes by its opacity; truth (flow, depth, bodies) ignores them",
                stacklevel=4,
            )
    reason = _rejected(mi, loaded)
    if reason is not None:
        del loaded  # what Mitsuba rejects must not outlive this call: it traces every light that exists
        raise ValueError(f"{path}: Mitsuba cannot render it: {reason}{_cure(mi, reason)}")
    names = [shape.id() for shape in loaded.shapes()]
    parameters = mi.traverse(loaded)
    for name in motions:
        _check_movable(path, name, names, parameters)
    for name, flicker in (flickers or {}).items():
        _check_flicker(path, name, flicker, loaded, parameters)
    parts = tuple(Part(name, motions.get(name)) for name in names)
    camera = camera or _camera(mi, loaded, path)
    file = MitsubaFile(str(path), files.sha256(path, limits.TEXT), dict(flickers) if flickers else None)
    return Scene(path.stem, 0, camera, (), (), file=file, parts=parts, bands=None if bands is None else RGB)


def _has_holes(mi: Any, shape: Any) -> bool:
    """Return whether light passes through a shape by its opacity."""
    bsdf = shape.bsdf()
    if bsdf is None or "ThinDielectric" in str(bsdf):
        return False
    return bool(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null))


def _check_movable(path: Path, name: str, names: list[str], parameters: Any) -> None:
    """Raise `ValueError` if no shape has this id, or if it cannot be moved."""
    if name not in names:
        meant = suggest(name, names) or f"; there are {', '.join(map(repr, names)) or 'none'}"
        raise ValueError(f"{path}: no shape has the id {name!r}{meant}")
    if not any(f"{name}.{key}" in parameters for key in MOVABLE):
        raise ValueError(f"{path}: shape {name!r} has neither vertices nor a placement to move; use a mesh")


def _rejected(mi: Any, loaded: Any) -> str | None:
    """Return why Mitsuba rejects while it renders what it has loaded, as a spectrum of another variant; None if not.

    The paths are only recorded, which asks every material and light of the scene, and not traced.
    """
    film = {"type": "hdrfilm", "width": 2, "height": 2}
    try:
        with errors_only(mi):  # it warns that a colour film becomes grey
            sensor = mi.load_dict({"type": "perspective", "film": film})
            mi.render(loaded, sensor=sensor, integrator=mi.load_dict({"type": "path", "max_depth": 3}), spp=1)
    except RuntimeError as error:
        return _reason(error)
    return None


def _reason(error: BaseException) -> str:
    """Return the text of an error's first cause, in one line."""
    while (cause := error.__cause__ or error.__context__) is not None:
        error = cause
    return " ".join(str(error).split())[:400]


def _cure(mi: Any, reason: str) -> str:
    """Return what helps against a spectrum that grey rendering lacks, or that no rendering here has."""
    if "non-spectral" in reason:
        return "; wavelengths are not rendered here: give the colour of this spectrum as <rgb> or <float>"
    return "" if mi.variant().endswith("_rgb") else "; if it needs colour, render with bands='rgb'"


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
    _refuse_hidden_lights(Path(path))
    mitsuba_files.check(Path(path))
    try:
        with errors_only(mi):  # it warns that a colour film becomes grey; no film is used
            # Optimising would merge shapes and lose their names.
            loaded = mi.load_file(files.native(path), optimize=False)
    except REJECTIONS as error:
        reason = _reason(error)
        needs = _cure(mi, reason) if "RGB" in str(error) or "non-spectral" in reason else ""
        raise ValueError(f"{path}: Mitsuba cannot load it: {reason}{needs}") from None
    if not isinstance(loaded, mi.Scene):
        raise ValueError(f"{path}: its root element is not <scene>; only scene files can be read")
    for i, shape in enumerate(loaded.shapes()):
        if not shape.id():
            shape.set_id(f"shape {i}")
    return loaded


def _refuse_hidden_lights(path: Path) -> None:
    """Raise `ValueError` for an integrator that hides light sources: it changes the picture, and does not count."""
    try:
        flags = ElementTree.parse(path).iter("boolean")
        hidden = any(e.get("name") == "hide_emitters" and e.get("value", "").lower() == "true" for e in flags)
    except (ElementTree.ParseError, OSError, ValueError, RecursionError):
        return  # Mitsuba reports the error
    if hidden:
        raise ValueError(f"{path}: hide_emitters is true, and light sources are seen here; leave it out")


def _check_film(sensor: Any, path: Path, ask: str) -> None:
    """Raise `ValueError` for a film or a sensor whose response is not taken over; warn of a filter that is left out."""
    film = sensor.film()
    if film.class_name() != "HDRFilm":
        raise ValueError(f"{path}: its film is a {film.class_name()}, only 'hdrfilm' is taken over; {ask}")
    if sensor.needs_aperture_sample() or sensor.get_medium() is not None:
        raise ValueError(f"{path}: its sensor has an aperture or lies in a medium, which is not taken over; {ask}")
    filter_name = str(film.rfilter()).split("[")[0].strip()
    if not filter_name.startswith(("Box", "Gaussian")):
        warnings.warn(
            f"{path}: the film's rfilter {filter_name} is left out: a pixel collects the light of its own area",
            stacklevel=4,
        )


def _camera(mi: Any, loaded: Any, path: Path) -> Camera:
    """Return the file's first sensor as a pinhole behind an f/2.8 lens."""
    ask = "give a camera of your own: read_mitsuba(..., camera=Camera(...))"
    if not loaded.sensors():
        raise ValueError(f"{path}: no sensor; {ask}")
    sensor = loaded.sensors()[0]
    values = mi.traverse(sensor)

    def number(name: str) -> float:
        return float(np.ravel(values[name])[0])

    if sensor.class_name() != "PerspectiveCamera":
        raise ValueError(f"{path}: its sensor is a {sensor.class_name()}, only 'perspective' is taken over; {ask}")
    _check_film(sensor, path, ask)
    if any("srf" in key for key in values.keys()):  # noqa: SIM118 (no mapping)
        raise ValueError(f"{path}: its sensor has a spectral response (srf), which is not taken over; {ask}")
    pose = np.array(values["to_world"].matrix, np.float64).reshape(4, 4)
    _, up, forward = pose[:3, :3].T  # Mitsuba's camera axes: left, up, forward
    if np.linalg.det(pose[:3, :3]) <= 0:
        raise ValueError(f"{path}: its sensor's to_world mirrors the picture; {ask}")
    film_width, film_height = (int(n) for n in sensor.film().size())
    width, height = (int(n) for n in sensor.film().crop_size())
    left, top = (int(n) for n in sensor.film().crop_offset())
    field = math.radians(number("x_fov"))  # of the complete film
    # The pixel that the optical axis meets; offsets are shares of the complete film.
    x = film_width / 2 - left - number("principal_point_offset_x") * film_width
    y = film_height / 2 - top - number("principal_point_offset_y") * film_height
    shift = ((x - width / 2) / height, (y - height / 2) / height)
    camera = Camera(
        focal_length=PITCH * film_width / 2 / math.tan(field / 2),
        f_number=F_NUMBER,
        pixel_pitch=PITCH,
        height=height,
        width=width,
        origin=_vector(pose[:3, 3]),
        target=_vector(pose[:3, 3] + forward),
        up=_vector(up),
        lens=Lens(shift=shift),
    )
    _check_clipping(mi, loaded, camera, (number("near_clip"), number("far_clip")), path)
    return camera


def _check_clipping(mi: Any, loaded: Any, camera: Camera, planes: tuple[float, float], path: Path) -> None:
    """Raise `ValueError` if the planes near and far of the file's sensor hide what its pixels' middles see."""
    pose = camera.pose()
    slopes = camera.directions().reshape(-1, 3)  # of z = 1, so that a distance along them is a depth
    origin = mi.Point3f(*map(float, pose[:3, 3]))
    hidden = 0
    for slope in slopes[:, None] if mi.variant().startswith("scalar") else [slopes]:
        directions = (slope @ pose[:3, :3].T).T
        ray = mi.Ray3f(origin, mi.Vector3f(*(directions if len(slope) > 1 else map(float, directions[:, 0]))))
        depth = np.array(loaded.ray_intersect_preliminary(ray).t, np.float64)
        hidden += int(np.sum(np.isfinite(depth) & ((depth < planes[0]) | (depth > planes[1]))))
    if hidden:
        raise ValueError(
            f"{path}: its sensor's near_clip {planes[0]:g} and far_clip {planes[1]:g} hide what {hidden} of "
            f"{len(slopes)} pixels see; this program has no clipping planes: remove those shapes, or widen the planes"
        )


def _vector(values: np.ndarray) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])
