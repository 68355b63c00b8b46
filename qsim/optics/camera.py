"""Describes the camera (lens, pixel grid, pose) and projects between world and pixels."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np

from qsim.host import own_numbers
from qsim.kinds import Number, Positive, Whole
from qsim.optics.lens import Lens
from qsim.optics.zoom import Zoom

Vector = tuple[Number, Number, Number]


@runtime_checkable
class Pose(Protocol):
    """A rigid motion: the position and the velocity of a body at any time [s]."""

    def pose(self, t: float) -> np.ndarray:
        """Return the body-to-world matrix, float64 [4, 4]."""

    def velocity(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the world velocity of the body's origin [m/s] and angular velocity [rad/s], float64 [3] each."""


def checked_pitch(pitch: float, where: str) -> float:
    """Return a pixel pitch [m]; `ValueError` that names its place for one that no sensor has."""
    if not 0 < pitch < 1e-3:
        raise ValueError(f"{where} is in metres, got {pitch!r}; a 1.1 um pixel is 1.1e-6")
    return pitch


@own_numbers
@dataclass(frozen=True, eq=False)
class Camera:
    """Lens, pixels, position and orientation of the camera. With a `zoom`, `at` gives the camera of any time."""

    focal_length: Positive  # m
    f_number: Positive  # focal length / entrance pupil diameter
    pixel_pitch: Positive  # m; the height of a pixel, and its width unless `lens` has an aspect
    height: Whole  # pixels
    width: Whole  # pixels
    transmission: float = 1.0  # of lens and filters, above 0, at most 1
    fill_factor: float = 1.0  # photosensitive share of the pixel, above 0, at most 1
    wavelength: float = 550e-9  # m, effective wavelength of the rendered band
    vignetting: bool = True  # natural vignetting, cos^4; radiometry.py applies it
    origin: Vector = (0.0, 0.0, 5.0)  # m
    target: Vector = (0.0, 0.0, 0.0)  # m
    up: Vector = (0.0, 1.0, 0.0)
    motion: Pose | None = None  # in the camera's own axes: x right, y down, z forward
    aperture_blur: bool = False  # thin lens of diameter focal_length / f_number instead of a pinhole
    focus_distance: Positive | None = None  # m; None: distance from origin to target
    lens: Lens | None = field(default=None, metadata={"described": "if any"})  # distortion, fall-off; None: ideal
    zoom: Zoom | None = field(default=None, metadata={"described": "if any"})  # replaces focal_length, lens over time

    def __post_init__(self) -> None:
        self._check_lens()
        self._check_pixels()
        self._check_pose()
        if self.lens == Lens():
            object.__setattr__(self, "lens", None)
        if self.lens is not None:
            _check(self.lens, self.corner)
        if self.zoom is not None:
            for t in self.zoom.moments():
                self._zoomed(t)

    def _check_lens(self) -> None:
        """Raise `ValueError` for a lens that cannot be, or that cannot focus where it should."""
        if not 0 < self.focal_length < 3:
            raise ValueError(f"Camera.focal_length is in metres, got {self.focal_length!r}; 8 mm is 8e-3")
        if not 100e-9 <= self.wavelength <= 20e-6:
            raise ValueError(f"Camera.wavelength is in metres, got {self.wavelength!r}; 550 nm is 550e-9")
        if not self.f_number >= 0.5:
            raise ValueError(f"Camera.f_number must be at least 0.5, the limit of a lens in air, got {self.f_number!r}")
        if self.focus_distance is not None and not 0 < self.focus_distance < math.inf:
            raise ValueError(f"Camera.focus_distance is in metres before the camera, got {self.focus_distance!r}")

    def _check_pixels(self) -> None:
        """Raise `ValueError` for pixels that no sensor has."""
        checked_pitch(self.pixel_pitch, "Camera.pixel_pitch")
        for name in ("transmission", "fill_factor"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"Camera.{name} must be in (0, 1], got {getattr(self, name)!r}")
        for name in ("height", "width"):
            if getattr(self, name) < 1 or int(getattr(self, name)) != getattr(self, name):
                raise ValueError(
                    f"Camera.{name} must be a positive whole number of pixels, got {getattr(self, name)!r}"
                )

    def _check_pose(self) -> None:
        """Raise `ValueError` for a view without an orientation, and for a focus nearer than the lens reaches."""
        # An `up` along the view leaves the picture free to turn around it.
        forward = np.subtract(self.target, self.origin)
        if not np.linalg.norm(np.cross(forward, self.up)) > 1e-9 * np.linalg.norm(forward):
            raise ValueError(
                f"Camera: origin {self.origin}, target {self.target} and up {self.up} give no orientation; choose a "
                "target other than the origin, and an up that is not along the view"
            )
        if self.aperture_blur and not self.focus > self.focal_length:
            raise ValueError(
                f"Camera: a lens of {self.focal_length:g} m cannot focus on a distance of {self.focus:g} m; give a "
                "focus_distance above its focal_length, or leave aperture_blur off"
            )

    def at(self, t: float) -> Camera:
        """Return the camera as it is at time t [s]: the same one unless it has a `zoom`. Its motion stays."""
        return self if self.zoom is None else _at(self, float(t))

    def resting(self) -> None:
        """Raise `ValueError` for a camera whose lens changes: what asks for its view needs `at` of a time."""
        if self.zoom is not None:
            raise ValueError("Camera.zoom: the lens changes with time; pass camera.at(t), the camera at the time t [s]")

    def _zoomed(self, t: float) -> Camera:
        assert self.zoom is not None
        share, lens = self.zoom.at(t)
        distance = share * self.height * self.pixel_pitch
        # The lens equation 1/f = 1/distance + 1/focus: a lens that focuses near stands farther from its pixels than f.
        focal_length = distance * self.focus / (distance + self.focus) if self.aperture_blur else distance
        return replace(self, zoom=None, focal_length=focal_length, lens=lens)

    @property
    def image_distance(self) -> float:
        """Distance from the lens to the pixels [m]: `focal_length`, or with `aperture_blur` that of a focused lens."""
        if not self.aperture_blur:
            return self.focal_length
        return self.focal_length * self.focus / (self.focus - self.focal_length)

    @property
    def focal_pixels(self) -> float:
        """`image_distance` in heights of a pixel, f: (x, y, z) in camera axes is seen at (W/2 + f x/z, H/2 + f y/z).

        Where the lens has an aspect, pixels are not square, and f x/z is times the aspect.
        """
        return self.image_distance / self.pixel_pitch

    @property
    def working_f_number(self) -> float:
        """`image_distance` over the diameter of the entrance pupil: f_number, or more where the focus is near."""
        return self.f_number * (self.image_distance / self.focal_length)

    @property
    def axis(self) -> tuple[float, float]:
        """Pixel (x, y) that the optical axis meets: the middle, unless `lens` is shifted."""
        x, y = (0.0, 0.0) if self.lens is None else self.lens.shift
        return self.width / 2 + x * self.height, self.height / 2 + y * self.height

    @property
    def corner(self) -> float:
        """Length of the slope at which the farthest corner of the picture is seen, before its aspect widens it."""
        across, down = (max(at, size - at) for at, size in zip(self.axis, (self.width, self.height), strict=True))
        return math.hypot(across / self.aspect, down) / self.focal_pixels

    @property
    def aspect(self) -> float:
        """A pixel's height over its width: fl_x over fl_y."""
        return 1.0 if self.lens is None else self.lens.aspect

    @property
    def pixel_area(self) -> float:
        """Photosensitive area of a pixel [m^2]; `pixel_pitch` is its height."""
        return self.fill_factor * self.pixel_pitch**2 / self.aspect

    def circle_of_confusion(self, depth: np.ndarray) -> np.ndarray:
        """Return the diameter [px] of the blur of points at `depth` [m] along the axis, [...], with `aperture_blur`.

        It is A f |z - s| / (z |s - f|) for the focal length f, the pupil's diameter A and the focus s, counted in
        heights of a pixel.
        """
        depth = np.asarray(depth, np.float64)
        scale = self.focal_length / abs(self.focus - self.focal_length) / self.pixel_pitch
        return 2 * self.pupil_radius * scale * np.abs(depth - self.focus) / depth

    @property
    def focus(self) -> float:
        """Distance of sharp focus [m] along the optical axis."""
        return self.focus_distance or float(np.linalg.norm(np.subtract(self.target, self.origin)))

    @property
    def pupil_radius(self) -> float:
        """Radius of the entrance pupil [m]."""
        return self.focal_length / (2 * self.f_number)

    def resized(self, height: int, width: int) -> Camera:
        """Return a camera of this vertical field of view and f-number with another number of pixels.

        The pitch stays and the focal length changes. With `aperture_blur` the focal length stays and the pitch changes,
        so that blur keeps its share of the picture.
        """
        if self.aperture_blur:
            return replace(self, height=height, width=width, pixel_pitch=self.pixel_pitch * self.height / height)
        return replace(self, height=height, width=width, focal_length=self.focal_length * height / self.height)

    def pose(self, t: float = 0.0) -> np.ndarray:
        """Return the camera-to-world matrix at time t [s], float64 [4, 4]; camera axes x right, y down, z forward."""
        forward = _unit(np.subtract(self.target, self.origin))
        right = _unit(np.cross(forward, self.up))
        down = np.cross(forward, right)
        placed = np.eye(4)
        placed[:3, :4] = np.column_stack([right, down, forward, self.origin])
        return placed if self.motion is None else placed @ np.asarray(self.motion.pose(t), np.float64)

    def directions(self) -> np.ndarray:
        """Return rays through pixel centres in camera axes with z = 1, float64 [H, W, 3]; no `zoom` (`resting`)."""
        self.resting()
        slopes = _pixel_slopes(self.height, self.width, self.axis, self.focal_pixels)
        if self.lens is not None:
            slopes = _traced(self.lens, self.height, self.width, self.axis, self.focal_pixels)
        return np.concatenate([slopes, np.ones_like(slopes[..., :1])], axis=-1)

    def seen(self, slopes: np.ndarray) -> np.ndarray:
        """Return where the lens shows slopes (x / z, y / z) [2, N], in the same unit: pixels are `focal_pixels` long.

        Slopes so steep that the distortion would fold them back stay outside the picture.
        """
        return slopes if self.lens is None else self.lens.seen(slopes.T).T

    def cosines(self) -> np.ndarray:
        """Return the cosine of the off-axis angle at the pixel centres, float64 [H, W]."""
        return 1.0 / np.linalg.norm(self.directions(), axis=-1)

    def project(self, points: np.ndarray, t: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Project world points [..., 3] [m] to pixels [..., 2] (x, y; first pixel centre 0.5) and depth z [...] [m]."""
        if self.zoom is not None:
            return self.at(t).project(points, t)
        pose = self.pose(t)
        # The transpose of a rotation is its inverse: row vectors times the pose's axes are camera coordinates.
        local = (np.asarray(points, np.float64) - pose[:3, 3]) @ pose[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            slopes = local[..., :2] / local[..., 2:]
            shown = slopes if self.lens is None else self.lens.seen(slopes)
            pixels = shown * self.focal_pixels + self.axis
        return pixels, local[..., 2]


@functools.lru_cache(maxsize=64)
def _at(camera: Camera, t: float) -> Camera:
    return camera._zoomed(t)


@functools.lru_cache(maxsize=4096)
def _check(lens: Lens, corner: float) -> None:
    lens.check(corner)


def _pixel_slopes(height: int, width: int, axis: tuple[float, float], focal_pixels: float) -> np.ndarray:
    """Return the slopes at which the pixel centres are seen, float64 [H, W, 2]."""
    y, x = np.mgrid[:height, :width] + 0.5
    return np.stack([(x - axis[0]) / focal_pixels, (y - axis[1]) / focal_pixels], axis=-1)


@functools.lru_cache(maxsize=4)
def _traced(lens: Lens, height: int, width: int, axis: tuple[float, float], focal_pixels: float) -> np.ndarray:
    """Return the slopes of the rays through the pixel centres, float64 [H, W, 2], read-only."""
    slopes = lens.traced(_pixel_slopes(height, width, axis, focal_pixels))
    slopes.setflags(write=False)
    return slopes


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
