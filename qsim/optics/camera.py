"""Describes the camera (lens, pixel grid, pose) and projects between world and pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

Vector = tuple[float, float, float]


@runtime_checkable
class Pose(Protocol):
    """A rigid motion: the position and the velocity of a body at any time [s]."""

    def pose(self, t: float) -> np.ndarray:
        """Return the body-to-world matrix, float64 [4, 4]."""

    def velocity(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the world velocity of the body's origin [m/s] and angular velocity [rad/s], float64 [3] each."""


@dataclass(frozen=True, eq=False)
class Camera:
    """Lens, pixels, position and orientation of the camera."""

    focal_length: float  # m
    f_number: float  # focal length / entrance pupil diameter
    pixel_pitch: float  # m
    height: int  # pixels
    width: int  # pixels
    transmission: float = 1.0  # of lens and filters, above 0, at most 1
    fill_factor: float = 1.0  # photosensitive share of the pixel, above 0, at most 1
    wavelength: float = 550e-9  # m, effective wavelength of the rendered band
    vignetting: bool = True  # natural vignetting, cos^4; radiometry.py applies it
    origin: Vector = (0.0, 0.0, 5.0)  # m
    target: Vector = (0.0, 0.0, 0.0)  # m
    up: Vector = (0.0, 1.0, 0.0)
    motion: Pose | None = None  # in the camera's own axes: x right, y down, z forward
    aperture_blur: bool = False  # thin lens of diameter focal_length / f_number instead of a pinhole
    focus_distance: float | None = None  # m; None: distance from origin to target

    def __post_init__(self) -> None:
        if not 0 < self.pixel_pitch < 1e-3:
            raise ValueError(f"Camera.pixel_pitch is in metres, got {self.pixel_pitch!r}; a 1.1 um pixel is 1.1e-6")
        if not 0 < self.focal_length < 3:
            raise ValueError(f"Camera.focal_length is in metres, got {self.focal_length!r}; 8 mm is 8e-3")
        if not 100e-9 <= self.wavelength <= 20e-6:
            raise ValueError(f"Camera.wavelength is in metres, got {self.wavelength!r}; 550 nm is 550e-9")
        if not self.f_number >= 0.5:
            raise ValueError(f"Camera.f_number must be at least 0.5, the limit of a lens in air, got {self.f_number!r}")
        for name in ("transmission", "fill_factor"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"Camera.{name} must be in (0, 1], got {getattr(self, name)!r}")
        for name in ("height", "width"):
            if getattr(self, name) < 1 or int(getattr(self, name)) != getattr(self, name):
                raise ValueError(
                    f"Camera.{name} must be a positive whole number of pixels, got {getattr(self, name)!r}"
                )
        forward = np.subtract(self.target, self.origin)
        if not np.linalg.norm(np.cross(forward, self.up)) > 1e-9 * np.linalg.norm(forward):
            raise ValueError(
                f"Camera: origin {self.origin}, target {self.target} and up {self.up} give no orientation; choose a "
                "target other than the origin, and an up that is not along the view"
            )

    @property
    def focal_pixels(self) -> float:
        """Focal length in pixels: a point at (x, y, z) in camera axes falls on (W/2 + f x/z, H/2 + f y/z)."""
        return self.focal_length / self.pixel_pitch

    @property
    def focus(self) -> float:
        """Distance of sharp focus [m] along the optical axis."""
        return self.focus_distance or float(np.linalg.norm(np.subtract(self.target, self.origin)))

    @property
    def pupil_radius(self) -> float:
        """Radius of the entrance pupil [m]."""
        return self.focal_length / (2 * self.f_number)

    def resized(self, height: int, width: int) -> Camera:
        """Return a camera of this vertical field of view, pixel pitch and f-number with another number of pixels."""
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
        """Return rays through the pixel centres in camera axes with z = 1, float64 [H, W, 3]."""
        y, x = np.mgrid[: self.height, : self.width] + 0.5
        return np.stack(
            [(x - self.width / 2) / self.focal_pixels, (y - self.height / 2) / self.focal_pixels, np.ones_like(x)], -1
        )

    def cosines(self) -> np.ndarray:
        """Return the cosine of the off-axis angle at the pixel centres, float64 [H, W]."""
        return 1.0 / np.linalg.norm(self.directions(), axis=-1)

    def project(self, points: np.ndarray, t: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Project world points [..., 3] [m] to pixels [..., 2] (x, y; first pixel centre 0.5) and depth z [...] [m]."""
        pose = self.pose(t)
        local = (np.asarray(points, np.float64) - pose[:3, 3]) @ pose[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = local[..., :2] / local[..., 2:] * self.focal_pixels + (self.width / 2, self.height / 2)
        return pixels, local[..., 2]


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
