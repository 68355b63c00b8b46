"""Builds the camera's rays through film positions in Dr.Jit: pinhole or thin lens, with the distortion of the lens."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.optics.camera import Camera
from qsim.optics.lens import Lens

KNOWN = 1024  # radii of the picture whose rays are known; tests/qsim/rendering/test_camera_rays.py measures the rest


class CameraRays:
    """Rays of a camera on a parallel engine."""

    def __init__(self, mi: Any, camera: Camera) -> None:
        self._mi, self._camera = mi, camera
        lens = camera.lens
        self._bends = _Bends(mi, camera, lens) if lens is not None and lens.distorts else None

    def through(self, pose: Array, position: Any, sampler: Any) -> Any:
        """Return rays through film positions [px]; the pose is data, not code, so that motion compiles no kernel."""
        import drjit as dr

        mi, camera = self._mi, self._camera
        axes = [mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in pose[:3, i])) for i in range(4)]
        f, (x, y) = camera.focal_pixels, camera.axis
        across = (position.x - x) / f
        down = (position.y - y) / f
        if self._bends is not None:
            across, down = self._bends.traced(across, down)
        direction = axes[0] * across + axes[1] * down + axes[2]
        origin = axes[3]
        if camera.aperture_blur:
            focus = camera.focus
            lens = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d()) * (camera.pupil_radius)
            shift = axes[0] * lens.x + axes[1] * lens.y
            origin = origin + shift
            direction = direction * focus - shift
        return mi.RayDifferential3f(o=mi.Point3f(origin), d=dr.normalize(direction))


class _Bends:
    """`Lens.traced` for Dr.Jit: a start between two known radii, and one step of Newton's method."""

    def __init__(self, mi: Any, camera: Camera, lens: Lens) -> None:
        import drjit as dr

        far = 1.0001 * camera.corner  # rounding of film positions
        stretch = lens.traced_radius(np.linspace(0.0, far, KNOWN)[1:]) / np.linspace(0.0, far, KNOWN)[1:]
        self._stretch = mi.Float(np.concatenate([[1.0], stretch]).astype(np.float32))
        self._k1, self._k2, self._step = (dr.opaque(mi.Float, v) for v in (lens.k1, lens.k2, far / (KNOWN - 1)))
        self._mi = mi

    def traced(self, across: Any, down: Any) -> tuple[Any, Any]:
        """Return the slopes of the rays that are seen at these slopes."""
        import drjit as dr

        seen = dr.sqrt(across * across + down * down)
        place = seen / self._step
        left = dr.minimum(self._mi.UInt32(place), KNOWN - 2)
        start, end = dr.gather(self._mi.Float, self._stretch, left), dr.gather(self._mi.Float, self._stretch, left + 1)
        stretch = start + (end - start) * (place - self._mi.Float(left))
        square = dr.square(seen * stretch)
        # The stretch s of the slope seen: s (1 + k1 (s seen)^2 + k2 (s seen)^4) = 1
        off = stretch * (1 + square * (self._k1 + square * self._k2)) - 1
        stretch -= off / (1 + square * (3 * self._k1 + 5 * self._k2 * square))
        return across * stretch, down * stretch
