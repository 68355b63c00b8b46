"""Draws film positions, and builds the camera's rays through them in Dr.Jit: pinhole or thin lens, with distortion."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.lazy_array import Crop
from qsim.optics.camera import Camera
from qsim.optics.lens import Lens

MAX_SAMPLES_IN_FLIGHT = 2**23  # samples in flight, about; a frame with more is rendered in parts
GRID = 129  # columns and lines of slopes known to a lens with tangential terms; the same test measures the rest
KNOWN = 1024  # radii of the picture whose rays are known; tests/qsim/rendering/test_camera_rays.py measures the rest


class Film:
    """The pixels of a window (y, x, height, width) of a camera's frame, or every n-th row and column (`thinned`).

    `rays` is None for the scalar engine, whose camera is Mitsuba's.
    """

    def __init__(self, mi: Any, camera: Camera, crop: Crop, thinned: int, rays: CameraRays | None) -> None:
        self._mi = mi
        self.camera = camera
        self.crop = crop
        self.thinned = thinned
        self.shape = -(-crop[2] // thinned), -(-crop[3] // thinned)
        self._samplers: dict[int, Any] = {}
        self.rays: Any = rays

    def window(self, crop: Crop) -> Film:
        """Return the film of every pixel of another crop; it shares the samplers."""
        other = copy.copy(self)
        other.crop = crop
        other.thinned = 1
        other.shape = crop[2:]
        return other

    def parts(self, samples: int) -> list[range]:
        """Return the window's pixels, row by row, in ranges of at most about MAX_SAMPLES_IN_FLIGHT samples.

        Passes divide the pixels, not the samples: the error of a complete grid falls faster than that of its parts.
        """
        pixels = math.prod(self.shape)
        count = min(pixels, math.ceil(pixels * samples / MAX_SAMPLES_IN_FLIGHT))
        return [range(pixels * i // count, pixels * (i + 1) // count) for i in range(count)]

    def positions(self, seed: int, samples: int, part: range, times: int = 1) -> tuple[Any, Any]:
        """Return a seeded sampler and film positions [px], uniform in each pixel; its samples are neighbours in memory.

        The pixels of `part` come `times` times over, each time with separate grids. Size and place of the window
        are data, not code: a pilot and a whole frame share one compiled kernel.
        """
        import drjit as dr

        mi = self._mi
        in_flight = times * len(part) * samples
        sampler = self._sampler(samples)
        sampler.seed(seed, in_flight)
        numbers = (len(part), part.start, self.shape[1], self.thinned, *self.crop[:2])
        count, first, columns, step, y0, x0 = (dr.opaque(mi.UInt32, n) for n in numbers)
        pixel = dr.arange(mi.UInt32, in_flight) // samples % count + first
        row = pixel // columns
        corner = mi.Point2f(mi.Float((pixel - row * columns) * step + x0), mi.Float(row * step + y0))
        return sampler, corner + sampler.next_2d()

    def _sampler(self, samples: int) -> Any:
        if samples not in self._samplers:
            sampler = self._mi.load_dict({"type": "multijitter", "sample_count": samples})
            sampler.set_samples_per_wavefront(samples)
            self._samplers[samples] = sampler
        return self._samplers[samples]


class CameraRays:
    """Rays of a camera on a parallel engine. Numbers that change with time are data, so that they compile no kernel."""

    def __init__(self, mi: Any, camera: Camera, *, changes: bool = False) -> None:
        self._mi = mi
        self._camera = camera
        self._changes = changes
        lens = camera.lens
        self._bends: _Bends | _Warp | None = None
        if lens is not None and lens.bends:
            self._bends = _Warp(mi, camera, lens) if lens.tangential else _Bends(mi, camera, lens)

    def at(self, t: float) -> CameraRays:
        """Return the rays of time t [s]: the same ones unless the camera has a `zoom`."""
        if self._camera.zoom is None:
            return self
        return CameraRays(self._mi, self._camera.at(t), changes=True)

    def through(self, pose: Array, position: Any, sampler: Any) -> Any:
        """Return rays through film positions [px]; the pose is data, not code, so that motion compiles no kernel."""
        import drjit as dr

        mi = self._mi
        camera = self._camera
        axes = [mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in pose[:3, i])) for i in range(4)]
        numbers = (camera.focal_pixels * camera.aspect, camera.focal_pixels, *camera.axis, camera.pupil_radius)
        f_x, f_y, x, y, pupil = (dr.opaque(mi.Float, n) for n in numbers) if self._changes else numbers
        across = (position.x - x) / f_x
        down = (position.y - y) / f_y
        if self._bends is not None:
            across, down = self._bends.traced(across, down)
        direction = axes[0] * across + axes[1] * down + axes[2]
        origin = axes[3]
        if camera.aperture_blur:
            focus = camera.focus
            lens = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d()) * pupil
            shift = axes[0] * lens.x + axes[1] * lens.y
            origin = origin + shift
            # All rays of a thin lens through a point of the plane in focus meet there, wherever they pass the pupil.
            direction = direction * focus - shift
        return mi.RayDifferential3f(o=mi.Point3f(origin), d=dr.normalize(direction))


class _Bends:
    """`Lens.traced` of radial terms for Dr.Jit: a start between two known radii, and one step of Newton's method."""

    def __init__(self, mi: Any, camera: Camera, lens: Lens) -> None:
        import drjit as dr

        far = 1.0001 * camera.corner  # rounding of film positions
        stretch = lens.traced_radius(np.linspace(0.0, far, KNOWN)[1:]) / np.linspace(0.0, far, KNOWN)[1:]
        self._stretch = mi.Float(np.concatenate([[1.0], stretch]).astype(np.float32))
        self._terms = _radial_terms(mi, lens)
        self._step = dr.opaque(mi.Float, far / (KNOWN - 1))
        self._mi = mi

    def traced(self, across: Any, down: Any) -> tuple[Any, Any]:
        """Return the slopes of the rays that are seen at these slopes."""
        import drjit as dr

        seen = dr.sqrt(across * across + down * down)
        place = seen / self._step
        left = dr.minimum(self._mi.UInt32(place), KNOWN - 2)
        start = dr.gather(self._mi.Float, self._stretch, left)
        end = dr.gather(self._mi.Float, self._stretch, left + 1)
        stretch = start + (end - start) * (place - self._mi.Float(left))
        square = dr.square(seen * stretch)
        # The stretch s of the slope seen: s (1 + k1 (s seen)^2 + k2 (s seen)^4 + ...) = 1
        off = stretch * (1 + square * _sum_of_powers(self._terms, square)) - 1
        rise = [(2 * i + 3) * term for i, term in enumerate(self._terms)]
        # Newton's step in s: the derivative of s (1 + k1 s^2 seen^2 + ...) is 1 + 3 k1 ... + 5 k2 ...
        stretch -= off / (1 + square * _sum_of_powers(rise, square))
        return across * stretch, down * stretch


class _Warp:
    """`Lens.traced` of all terms for Dr.Jit: a start between four known slopes, and two steps of Newton's method."""

    def __init__(self, mi: Any, camera: Camera, lens: Lens) -> None:
        import drjit as dr

        x, y = camera.axis
        f = camera.focal_pixels
        columns, lines = (np.linspace(0.0, size, GRID) for size in (camera.width, camera.height))
        places = np.stack(np.meshgrid((columns - x) / f, (lines - y) / f), axis=-1)
        known = lens.traced(places).astype(np.float32)
        self._across, self._down = (mi.Float(np.ascontiguousarray(known[..., i]).ravel()) for i in range(2))
        first = places[0, 0] / (lens.aspect, 1)
        step = (places[1, 1] - places[0, 0]) / (lens.aspect, 1)
        self._first, self._step = ([dr.opaque(mi.Float, float(n)) for n in pair] for pair in (first, step))
        self._terms = _radial_terms(mi, lens)
        self._p1, self._p2 = (dr.opaque(mi.Float, float(term)) for term in (lens.p1, lens.p2))
        self._mi = mi

    def traced(self, across: Any, down: Any) -> tuple[Any, Any]:
        """Return the slopes of the rays that are seen at these slopes, before the aspect widens them."""
        return self._nearer(*self._nearer(*self._start(across, down), across, down), across, down)

    def _nearer(self, x: Any, y: Any, across: Any, down: Any) -> tuple[Any, Any]:
        """Return slopes after a step of Newton's method from (x, y) to those that are seen at (across, down)."""
        import drjit as dr

        square = x * x + y * y
        stretch = 1 + square * _sum_of_powers(self._terms, square)
        along = 2 * (self._p2 * x + self._p1 * y)
        off_x = x * (stretch + along) + square * self._p2 - across
        off_y = y * (stretch + along) + square * self._p1 - down
        # The Jacobian of this distortion is symmetric, so that three numbers are enough.
        slope = 2 * _sum_of_powers([(i + 1) * term for i, term in enumerate(self._terms)], square)
        xx = stretch + x * x * slope + along + 4 * self._p2 * x
        yy = stretch + y * y * slope + along + 4 * self._p1 * y
        xy = x * y * slope + 2 * (self._p1 * x + self._p2 * y)
        area = xx * yy - dr.square(xy)
        return x - (yy * off_x - xy * off_y) / area, y - (xx * off_y - xy * off_x) / area

    def _start(self, across: Any, down: Any) -> tuple[Any, Any]:
        """Return slopes between those of the four nearest known places."""
        import drjit as dr

        mi = self._mi
        at_x = (across - self._first[0]) / self._step[0]
        at_y = (down - self._first[1]) / self._step[1]
        column, line = (dr.minimum(mi.UInt32(dr.maximum(at, 0)), GRID - 2) for at in (at_x, at_y))
        right = at_x - mi.Float(column)
        below = at_y - mi.Float(line)
        found = []
        for known in (self._across, self._down):
            corner = [dr.gather(mi.Float, known, line * GRID + column + more) for more in (0, 1, GRID, GRID + 1)]
            top, bottom = (corner[i] + (corner[i + 1] - corner[i]) * right for i in (0, 2))
            found.append(top + (bottom - top) * below)
        return found[0], found[1]


def _radial_terms(mi: Any, lens: Lens) -> list[Any]:
    """Return k1 and k2 as data, and k3 and k4 if one of them counts: a lens without them compiles as it always did."""
    import drjit as dr

    more = (lens.k3, lens.k4) if lens.k3 or lens.k4 else ()
    return [dr.opaque(mi.Float, float(term)) for term in (lens.k1, lens.k2, *more)]


def _sum_of_powers(terms: list[Any], square: Any) -> Any:
    """Return terms[0] + terms[1] square + terms[2] square^2 + ..."""
    found = terms[-1]
    for term in reversed(terms[:-1]):
        found = term + square * found
    return found
