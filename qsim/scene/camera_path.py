"""Reads and writes camera paths in the transforms.json of nerfstudio, instant-ngp and Blender's NeRF scenes.

    transforms.json -> Camera whose motion passes every pose        Camera + times -> transforms.json

A file holds a lens, or one per picture, and a list of camera-to-world matrices. Its camera axes are x right, y up and z
back (OpenGL), and the z of its world points up. Here the camera's axes are x right, y down, z forward, and the world's
y points up: (x, y, z) of the file is (x, z, -y), exactly. Between poses the position follows a cubic Hermite path and
the rotation is uniform (slerp, `Keyframes`); before the first and after the last the camera rests. Poses are equally
spaced in time. Where lenses differ, focal length, principal point and distortion follow such paths, too (`Zoom`).
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Required, TypedDict, get_type_hints

import numpy as np
from msgspec import Meta
from numpy import ndarray as Array

from qsim import files, limits
from qsim.file_order import natural
from qsim.kinds import Number, Positive
from qsim.optics.camera import Camera
from qsim.optics.lens import Lens
from qsim.optics.zoom import Zoom
from qsim.records import convert
from qsim.scene.motion import Keyframes
from qsim.scene.rotation import logarithm, vector

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # camera axes: y up, z back <-> y down, z forward
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # world: z up -> y up
SKEW = 1e-3  # by which the axes of a pose may fail to be orthonormal; the nearest rotation is taken
SQUARE = 1e-6  # relative difference of fl_x and fl_y up to which pixels are square
SQUARE_BY_ANGLE = 1e-3  # the same of focal lengths from angles of view, which files state rounded
MODELS = ("OPENCV", "PINHOLE", "RADIAL", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "PERSPECTIVE")
PLAIN = Camera(focal_length=1e-3, f_number=2.8, pixel_pitch=1.1e-6, height=1, width=1)  # its size does not count
TERMS = ("k1", "k2", "k3", "k4", "p1", "p2")
ZERO = ("k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2", "skew")  # terms of lenses that are not modelled
OTHER_LENSES = ("is_fisheye", "latlong", "equirectangular", "orthographic")  # flags of other projections

Pixels = Annotated[float, Meta(ge=1, le=limits.PIXELS, multiple_of=1)]  # programs also write 800.0
Angle = Annotated[float, Meta(ge=1e-6, le=3.14)]  # of view, rad


class LensTable(TypedDict, total=False):
    """What a file, or a frame of it, states of the lens."""

    w: Pixels
    h: Pixels
    fl_x: Positive
    fl_y: Positive
    cx: Number
    cy: Number
    k1: Number
    k2: Number
    k3: Number
    k4: Number
    p1: Number
    p2: Number
    k5: Number
    k6: Number
    s1: Number
    s2: Number
    s3: Number
    s4: Number
    b1: Number
    b2: Number
    skew: Number
    camera_angle_x: Angle
    camera_angle_y: Angle
    camera_model: str
    is_fisheye: bool
    latlong: bool
    equirectangular: bool
    orthographic: bool


Row = tuple[Number, Number, Number, Number]


class FrameTable(LensTable, total=False):
    """A frame of a file."""

    transform_matrix: Required[Annotated[tuple[Row, ...], Meta(min_length=3, max_length=4)]]
    file_path: str


class FileTable(LensTable, total=False):
    """A transforms.json."""

    frames: Required[list[dict[str, Any]]]
    frame_rate: Positive


_KEYS = tuple(get_type_hints(LensTable))
_FOCAL = frozenset({"fl_x", "fl_y", "camera_angle_x", "camera_angle_y"})
_MAY_CHANGE = _FOCAL | {"cx", "cy", *TERMS}


def read_camera_path(
    path: str | os.PathLike[str],
    like: Camera | None = None,
    *,
    frame_rate: float | None = None,
    speed: float = 1.0,
    scale: float = 1.0,
    size: tuple[int, int] | None = None,
) -> Camera:
    """Return the camera of a transforms.json: its view, distortion, principal point, and all poses as its motion.

    The rest is as in `like` (without it f/2.8 and pixels of 1.1 um), also the size [px] if the file states none; with
    `size` (height, width) [px] the pictures of a file without a size have this one, and its view is an angle. Poses
    are in the order of their `file_path`, the first at time 0, as many per second as the file states, else
    `frame_rate`; `speed` is a factor on that. `scale` is the length of the file's unit [m]. `motion` starts at the
    first pose, in the camera's own axes: another camera that takes it moves alike.

    Where fl_x and fl_y differ, pixels are as high as in `like`, and fl_x / fl_y times narrower.

    Lenses that differ from frame to frame become the camera's `zoom`; what a frame does not state, the file does.

    `FileNotFoundError`, or `ValueError` for less than two poses, a pose that is no rotation, pictures of several sizes
    or models, fisheye lenses and other models, all of them named at once.
    """
    where = str(path)
    if not Path(path).is_file():
        raise FileNotFoundError(f"{where}: no such file")
    for name, value in (("scale", scale), ("speed", speed)):
        if not 0 < value < math.inf:
            raise ValueError(f"{where}: {name} must be a number above 0, got {value!r}")
    content: dict[str, Any] = {**convert(_without_nulls(files.read_json(Path(path))), FileTable, where)}
    frames = _in_order(content["frames"], where)
    rate = content.get("frame_rate") or frame_rate
    if rate is None:
        raise ValueError(f"{where}: states no frame_rate; give the poses per second, as in frame_rate=30")
    poses = [_pose(frame, scale) for frame in frames]
    views = [_view(content, frame) for frame in frames]
    found = views[0]
    differing = [key for key in _KEYS if any(view.get(key) != found.get(key) for view in views)]
    _check_lens(found, [key for key in differing if key not in _MAY_CHANGE], where)
    if size is not None and not all(found.get(key) for key in ("w", "h")):
        pixels = [key for key in ("fl_x", "fl_y", "cx", "cy") if found.get(key) is not None]
        if pixels:
            raise ValueError(
                f"{where}: {pixels[0]} is in pixels, and w and h are missing; add the size of its pictures"
            )
        like = (like or PLAIN).resized(*size)
    placed = _seen_from(found, where, like or PLAIN, poses[0], like is not None)
    inside = [np.linalg.inv(placed.pose()) @ pose for pose in poses]
    times = tuple(i / (rate * speed) for i in range(len(poses)))
    motion = Keyframes(
        times,
        tuple(vector(pose[:3, 3]) for pose in inside),
        tuple(vector(logarithm(pose[:3, :3])) for pose in inside),
    )
    if not differing:
        return replace(placed, motion=motion)
    cameras = [
        _seen_from(view, frame["where"], like or PLAIN, pose, like is not None)
        for view, frame, pose in zip(views, frames, poses, strict=True)
    ]
    zoom = Zoom(
        times,
        tuple(camera.focal_pixels / camera.height for camera in cameras),
        tuple(camera.lens or Lens() for camera in cameras),
    )
    try:
        return replace(placed, motion=motion, zoom=zoom)
    except ValueError as error:
        raise ValueError(f"{where}: between two poses: {error}") from None


def camera_path(
    camera: Camera, poses: Sequence[Array], names: Sequence[str], frame_rate: float, origin: tuple[int, int] = (0, 0)
) -> dict[str, Any]:
    """Return the content of a transforms.json: a lens, or one per picture, and a pose per picture of `names`.

    `poses` are camera-to-world matrices [4, 4] in the camera's axes of this program, `frame_rate` of them per second;
    `origin` is the (y, x) of the pictures' first pixel in the frame of the camera, and their size is `camera`'s.
    """
    views = [_intrinsics(camera.at(i / frame_rate), origin) for i in range(len(poses))]
    common = views[0] if camera.zoom is None else {}
    placed = [UPRIGHT.T @ np.asarray(pose, np.float64) @ FLIP for pose in poses]
    return {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        **common,
        "frame_rate": float(frame_rate),
        "frames": [
            {"file_path": name, "transform_matrix": (pose + 0.0).tolist()} | ({} if common else view)
            for name, pose, view in zip(names, placed, views, strict=True)
        ],
    }


def _intrinsics(camera: Camera, origin: tuple[int, int]) -> dict[str, float]:
    """Return focal lengths, principal point and distortion of a camera without zoom, as a file states them."""
    lens = camera.lens or Lens()
    x, y = camera.axis
    return {
        "fl_x": camera.focal_pixels * lens.aspect,
        "fl_y": camera.focal_pixels,
        "cx": x - origin[1],
        "cy": y - origin[0],
        "k1": float(lens.k1),
        "k2": float(lens.k2),
        **{key: float(term) for key, term in (("k3", lens.k3), ("k4", lens.k4)) if term},
        "p1": float(lens.p1),
        "p2": float(lens.p2),
    }


def write_camera_path(
    path: str | os.PathLike[str], camera: Camera, *, frames: int, frame_rate: float, force: bool = False
) -> None:
    """Write the poses of a camera at the times 0, 1 / frame_rate, ... [s] as transforms.json.

    Pictures are named 000000.png and so on. `FileExistsError` if the file exists and `force` is off; `ValueError` for
    less than two frames and a frame rate that is not above 0.
    """
    if frames < 2 or not 0 < frame_rate < math.inf:
        raise ValueError(f"{path}: a path needs two or more frames at a rate above 0, got {frames} at {frame_rate!r}")
    if Path(path).exists() and not force:
        raise FileExistsError(f"{path}: exists; name another file, or replace it with force=True")
    poses = [camera.pose(t / frame_rate) for t in range(frames)]
    content = camera_path(camera, poses, [f"{t:06d}.png" for t in range(frames)], frame_rate)
    files.write_json(Path(path), content)


def _without_nulls(table: dict[str, Any]) -> dict[str, Any]:
    """Return a table without keys of the value null, which count as missing."""
    return {key: value for key, value in table.items() if value is not None}


def _in_order(frames: list[dict[str, Any]], where: str) -> list[dict[str, Any]]:
    """Return the checked frames in the order of their pictures, as listed if not all have one."""
    if len(frames) < 2:
        raise ValueError(f"{where}: a path needs two or more frames, found {len(frames)}")
    found = [
        {**convert(_without_nulls(frame), FrameTable, f"{where}, frame {i}"), "where": f"{where}, frame {i}"}
        for i, frame in enumerate(frames)
    ]
    if all(frame.get("file_path") is not None for frame in found):
        found.sort(key=lambda frame: natural(str(frame["file_path"])))
    return found


def _pose(frame: dict[str, Any], scale: float) -> Array:
    """Return a frame's pose [4, 4] in the axes of this program, its rotation made exact."""
    matrix = np.eye(4)
    given = np.array(frame["transform_matrix"], np.float64)
    matrix[: len(given)] = given
    turn = matrix[:3, :3]
    if (
        not np.abs(turn.T @ turn - np.eye(3)).max() <= SKEW
        or np.linalg.det(turn) < 0
        or (matrix[3] != (0, 0, 0, 1)).any()
    ):
        raise ValueError(
            f"{frame['where']}: transform_matrix is no rotation with a position; its axes must be orthonormal and "
            "right-handed, and its last row 0, 0, 0, 1"
        )
    # The nearest rotation: files round their numbers, and products of poses would let the error grow.
    left, _, right = np.linalg.svd(turn)
    matrix[:3, :3] = left @ right
    matrix[:3, 3] *= scale
    # Files have z up, and cameras that look along -z with y up; here a camera looks along z with y down.
    return UPRIGHT @ matrix @ FLIP


def _view(content: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """Return the lens of a frame: what it states, else what the file states; all focal lengths are of one of them."""
    own = {key: frame[key] for key in _KEYS if frame.get(key) is not None}
    below = {key: value for key, value in content.items() if not (_FOCAL & own.keys() and key in _FOCAL)}
    return below | own


def _seen_from(found: dict[str, Any], where: str, like: Camera, pose: Array, sized: bool) -> Camera:
    """Return `like` at a pose [4, 4], with the size, view and lens that a file states."""
    stated = {key: found[key] for key in _KEYS if found.get(key) is not None}
    if not sized and not {"w", "h"} <= stated.keys():
        raise ValueError(f"{where}: states no w and h; give a camera of the size of its pictures, like=Camera(...)")
    height = int(stated.get("h", like.height))
    width = int(stated.get("w", like.width))
    if "fl_x" not in stated and "camera_angle_x" not in stated:
        raise ValueError(f"{where}: states neither fl_x nor camera_angle_x; one of them gives the view")
    focal, aspect = _focal(stated, width)
    shift = ((stated.get("cx", width / 2) - width / 2) / height, (stated.get("cy", height / 2) - height / 2) / height)
    falloff = () if like.lens is None else like.lens.falloff
    # Files state the distance from lens to sensor. The thin lens 1 / f = 1 / distance + 1 / ahead
    # gives the focal length that focuses there; a pinhole has no such difference.
    distance = focal * like.pixel_pitch
    ahead = like.focus
    try:
        bent = Lens(falloff=falloff, shift=shift, aspect=aspect, **{key: stated.get(key, 0.0) for key in TERMS})
        return replace(
            like,
            height=height,
            width=width,
            focal_length=distance * ahead / (distance + ahead) if like.aperture_blur else distance,
            origin=vector(pose[:3, 3]),
            target=vector(pose[:3, 3] + ahead * pose[:3, 2]),
            up=vector(-pose[:3, 1]),
            focus_distance=ahead,
            motion=None,
            zoom=None,
            lens=bent,
        )
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _check_lens(found: dict[str, Any], differing: list[str], where: str) -> None:
    """Raise one `ValueError` that names everything of a file that no camera here can follow, and what to do."""
    stated = {key: found[key] for key in _KEYS if found.get(key) is not None}
    blocking = []
    model = stated.get("camera_model", "OPENCV")
    if model not in MODELS:
        blocking.append(f"camera_model is {model!r:.40} (read are {', '.join(MODELS)})")
    blocking += [f"{key} is true (only perspective lenses are read)" for key in OTHER_LENSES if stated.get(key)]
    blocking += [f"{key} is {stated[key]:g} (modelled are {', '.join(TERMS)})" for key in ZERO if stated.get(key)]
    if differing:
        blocking.append(f"frames differ in {', '.join(differing)} (a path has one sensor and one model)")
    if blocking:
        cures = {
            "frames differ": "split the file by cameras, or calibrate with one shared camera",
            "": "calibrate with COLMAP's model OPENCV, or undistort the pictures (COLMAP's image_undistorter)",
        }
        cure = cures["frames differ" if len(blocking) == bool(differing) else ""]
        raise ValueError(f"{where}: {'; '.join(blocking)}: {cure}")


def _focal(stated: dict[str, Any], width: int) -> tuple[float, float]:
    """Return the focal length [heights of a pixel] of a picture of this width [px], and fl_x over fl_y."""
    across = stated.get("fl_x") or width / 2 / math.tan(stated["camera_angle_x"] / 2)
    if {"fl_x", "fl_y"} <= stated.keys():
        down = stated["fl_y"]
        allowed = SQUARE
    elif {"w", "h", "camera_angle_y"} <= stated.keys():
        down = stated["h"] / 2 / math.tan(stated["camera_angle_y"] / 2)
        allowed = SQUARE_BY_ANGLE
    else:
        return across, 1.0
    # Calibrations never find two equal lengths; those that agree this well are of square pixels.
    return (across, 1.0) if abs(down / across - 1) <= allowed else (down, across / down)
