"""Carries the samples of neighbouring frames into a frame: with their bodies, into the pixels where they fall.

    samples of frames t - k ... t + k -> pictures of frame t from 1, 3, 5 ... frames, each in two independent halves

A sample is a path with its first surface: film position, depth, body, radiance. The body's poses carry that surface to
another frame, and its radiance is dropped into the pixel where it lands; nothing is interpolated. Light on the surface
is assumed to stay; choice.py measures by how much it does not.

Each pixel has two layers: what lies near the surface behind its centre (the same body, depth within NEAR), and the
rest. A layer's radiance is the mean of the samples that fell into it. The share of the layers is that of COVERAGE rays
of the frame itself. Surfaces that a neighbour hides or shows in excess therefore do not change the mixture of an edge.

Points at infinity move with the camera's rotation. Bodies that deform are not carried: they keep their own samples.
Sums are of integers, because sums of floats would depend on the order of threads; one integer holds sum and number.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key, words
from qsim.rendering.camera_rays import Film
from qsim.rendering.engine import in_own_variant
from qsim.rendering.ground_truth import body_pose
from qsim.rendering.mitsuba_scene import Stage
from qsim.rendering.ray_casting import Hits, RayCaster, pixel_rays
from qsim.scene import Scene

NEAR = 0.03  # relative difference of depth within one layer
COVERAGE = 16  # rays per pixel that measure the share of its layers
REACH = (1, 2, 3, 5)  # neighbours on each side from which pictures are made
FINE = 2.0**17  # steps of the integers within the mean radiance; a sum can hold 2^26 times the mean
COUNTED = 2**20  # samples that a sum can count; their number is in its lowest bits


def unshared(scene: Scene, shutter: float, backend: str) -> str:
    """Return what keeps the frames of a scene from sharing samples, or an empty text."""
    lens = scene.camera.lens
    reasons = {
        "an open shutter": shutter > 0,
        "three bands": scene.bands is not None,
        "lights that flicker": bool(scene.flickers),
        "a thin lens": scene.camera.aperture_blur,
        "a lens that zooms": scene.camera.zoom is not None,
        "a lens that distorts": lens is not None and lens.distorts,
        "the scalar engine": backend == "scalar",
    }
    return next((what for what, holds in reasons.items() if holds), "")


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of some pixels in one frame, half A, then half B; Dr.Jit arrays [2 * pixels * each]."""

    pixels: range  # of the film, row by row
    each: int  # samples per pixel and half
    seed: int  # of their film positions
    inverse: Any  # 1 / depth [1/m], 0 at infinity
    body: Any  # number of the body plus 1; 0 for the surroundings
    radiance: Any  # W m^-2 sr^-1


@dataclass(frozen=True, eq=False)
class Traced:
    """The samples of one frame, and where its camera and bodies are."""

    view: Array  # camera-to-world [4, 4]
    bodies: Array  # body-to-world [n, 4, 4] by number + 1; the first is the identity of the surroundings
    parts: list[Samples]


@dataclass(frozen=True, eq=False)
class Carrier:
    """Traces the frames of one film and carries their samples; keeps the frames that the last picture needed."""

    stage: Stage
    film: Film
    caster: RayCaster
    integrator: Any
    each: int  # samples per pixel and half
    neighbours: int  # frames on each side
    frames: range  # of the clip
    time: Callable[[int], float]  # of a frame [s]
    key: Callable[[int], Key]
    _kept: dict[int, Traced] = field(default_factory=dict)

    @property
    def variant(self) -> str:
        """The Mitsuba variant that loaded the scene."""
        return self.stage.variant

    @in_own_variant
    def pictures(self, t: int, centres: Hits | None = None) -> Array:
        """Return pictures of frame t from 1, 3, 5 ... frames, float64 [n, 2 halves, H, W]; the first is its own.

        The number of frames follows REACH up to `neighbours`, which is the last; frames outside the clip are missing.
        `centres` are the first hits [H W] behind the pixels' centres, if they are known. Places the stage at frame t
        first, and then where samples are missing. `ValueError` for a frame outside the clip.
        """
        if t not in self.frames:
            raise ValueError(f"frame {t}: the frames that share samples are {self.frames[0]} to {self.frames[-1]}")
        wanted = [s for s in range(t - self.neighbours, t + self.neighbours + 1) if s in self.frames]
        # Frames are asked for in order: each is traced once, and forgotten when no later picture needs it.
        for s in set(self._kept) - set(wanted):
            del self._kept[s]
        self.stage.place(self.time(t))
        if t not in self._kept:
            self._kept[t] = self._traced(t)
        own = self._own(self._kept[t])
        if centres is None:
            centres = self.caster.cast(self._kept[t].view, pixel_rays(self.film.camera, self.film.crop))
        layers = _Layers(self, t, self._kept[t], centres, float(np.mean(own, where=np.isfinite(own))))
        layers.add(self._kept[t])
        for s in wanted:
            if s not in self._kept:
                self._kept[s] = self._traced(s)
        found = [own]
        done = 0
        for reach in (*(k for k in REACH if k < self.neighbours), self.neighbours):
            for s in wanted:
                if done < abs(s - t) <= reach:
                    layers.add(self._kept[s])
            done = reach
            found.append(layers.picture(own))
        return np.stack(found)

    def _traced(self, s: int) -> Traced:
        import drjit as dr

        now = self.time(s)
        scene = self.stage.scene
        self.stage.place(now)
        view = scene.camera.pose(now)
        count = len(scene.bodies) + len(scene.lights) + len(scene.parts)
        bodies = np.stack([np.eye(4), *(body_pose(scene, number, now) for number in range(count))])
        parts = self.film.parts(2 * self.each)
        traced = Traced(view, bodies, [])
        for part, seed in zip(parts, words(self.key(s), (2, len(parts)))[0].tolist(), strict=True):
            sampler, place = self.film.positions(seed, self.each, part, 2)
            ray = self.film.rays.through(view, place, sampler)
            radiance, _, _ = self.integrator.sample(self.stage.loaded, sampler, ray)
            inverse, body = self.caster.first(view, ray)
            light = radiance[0]
            dr.eval(light, inverse, body)  # together: separate evaluations would trace the rays again
            traced.parts.append(Samples(part, self.each, seed, inverse, body, light))
        return traced

    def _own(self, traced: Traced) -> Array:
        """Return the halves [2, H, W] of a frame's own samples, to the bit those of the frame alone."""
        import drjit as dr

        own = np.empty((2, math.prod(self.film.shape)))
        for part in traced.parts:
            mean = np.array(dr.block_sum(part.radiance, part.each) / part.each, np.float64)
            own[:, part.pixels.start : part.pixels.stop] = mean.reshape(2, -1)
        return own.reshape(2, *self.film.shape)


class _Layers:
    """Sums of samples in the two layers of each pixel of frame t, by halves."""

    def __init__(self, carrier: Carrier, t: int, target: Traced, hits: Hits, mean: float) -> None:
        import drjit as dr

        self.carrier = carrier
        self.t = t
        self.target = target
        self.mi = carrier.stage.mi
        self.pixels = math.prod(carrier.film.shape)
        self.inverse = self.mi.Float((1 / hits.distance).astype(np.float32))
        self.body = self.mi.UInt32((hits.number + 1).astype(np.uint32))
        self.step = (mean if mean > 0 else 1.0) / FINE
        self.sums = dr.zeros(self.mi.Int64, 4 * self.pixels)
        self.share = self._coverage()

    def add(self, traced: Traced) -> None:
        """Add the samples of a frame, carried to frame t."""
        import drjit as dr

        mi = self.mi
        moves = mi.Float(self._moves(traced).astype(np.float32).ravel())
        for part in traced.parts:
            pixel, inverse, seen = self._landed(part, moves)
            # Halves stay apart when samples are carried: their difference remains a measure of the noise.
            half = dr.arange(mi.UInt32, dr.width(part.body)) // dr.opaque(mi.UInt32, part.each * len(part.pixels))
            layer = dr.select(self._near(pixel, inverse, part.body), mi.UInt32(0), mi.UInt32(2))
            at = pixel + dr.opaque(mi.UInt32, self.pixels) * (half + layer)
            seen &= dr.isfinite(part.radiance)
            # Sum and number in one integer: one atomic addition instead of two, and the same result in any order.
            steps = mi.Int64(dr.round(part.radiance / dr.opaque(mi.Float, self.step)))
            dr.scatter_add(self.sums, steps * COUNTED + 1, at, seen)
        dr.eval(self.sums)

    def picture(self, own: Array) -> Array:
        """Return the mixture of the layers, float64 [2, H, W]; `own` where a layer has no sample."""
        sums, counts = np.divmod(np.array(self.sums).reshape(2, 2, *self.carrier.film.shape), COUNTED)
        means = sums * self.step / np.maximum(counts, 1)
        # A layer that covers a part of the pixel but got no sample would be black.
        empty = ((counts[0] == 0) & (self.share > 0)) | ((counts[1] == 0) & (self.share < 1))
        return np.where(empty, own, self.share * means[0] + (1 - self.share) * means[1])

    def _moves(self, traced: Traced) -> Array:
        """Return the rigid motions from camera axes of a frame to those of t, by body number + 1, [n, 3, 4]."""
        # Camera then -> world -> body -> world -> camera of frame t: the body's own axes are what a surface keeps.
        moves = np.linalg.inv(self.target.view) @ self.target.bodies @ np.linalg.inv(traced.bodies) @ traced.view
        if traced is not self.target:
            deforming = [n for n, body in enumerate(self.carrier.stage.scene.bodies, 1) if body.deforms]
            moves[deforming] = 0  # never before the camera
        return moves[:, :3]

    def _landed(self, part: Samples, moves: Any) -> tuple[Any, Any, Any]:
        """Return the pixel in which each sample lands, its 1 / depth there, and whether it is in the window.

        View and window are data, not code: all windows share one compiled kernel.
        """
        import drjit as dr

        mi = self.mi
        film = self.carrier.film
        f, middle, level = (dr.opaque(mi.Float, n) for n in (film.camera.focal_pixels, *film.camera.axis))
        y, x, height, width = (dr.opaque(mi.Float, n) for n in film.crop)
        _, place = film.positions(part.seed, part.each, part.pixels, 2)
        across = (place.x - middle) / f
        down = (place.y - level) / f
        row = [dr.gather(mi.Float, moves, part.body * 12 + i) for i in range(12)]
        # Of (x/z, y/z, 1) and 1/z a motion needs no division by a distance that
        # may be infinite: at infinity the translation counts nothing.
        x1, y1, z1 = (row[i] * across + row[i + 1] * down + row[i + 2] + row[i + 3] * part.inverse for i in (0, 4, 8))
        column = dr.floor(x1 / z1 * f + middle) - x
        line = dr.floor(y1 / z1 * f + level) - y
        seen = (z1 > 0) & (column >= 0) & (column < width) & (line >= 0) & (line < height)
        return dr.select(seen, mi.UInt32(line) * mi.UInt32(width) + mi.UInt32(column), 0), part.inverse / z1, seen

    def _near(self, pixel: Any, inverse: Any, body: Any) -> Any:
        """Return whether a surface belongs to the layer of the pixel's centre."""
        import drjit as dr

        centre = dr.gather(self.mi.Float, self.inverse, pixel)
        return (dr.gather(self.mi.UInt32, self.body, pixel) == body) & (dr.abs(centre - inverse) <= NEAR * centre)

    def _coverage(self) -> Array:
        """Return the share of the first layer in each pixel, float64 [H, W]."""
        import drjit as dr

        film = self.carrier.film
        mi = self.mi
        view = self.target.view
        share = np.empty(self.pixels)
        parts = film.parts(COVERAGE)
        seeds = words(self.carrier.key(self.t), (1, len(parts)), redraw=2)[0].tolist()
        for part, seed in zip(parts, seeds, strict=True):
            sampler, place = film.positions(seed, COVERAGE, part)
            inverse, body = self.carrier.caster.first(view, film.rays.through(view, place, sampler))
            pixel = dr.arange(mi.UInt32, COVERAGE * len(part)) // COVERAGE + part.start
            near = dr.select(self._near(pixel, inverse, body), mi.Float(1), mi.Float(0))
            share[part.start : part.stop] = np.array(dr.block_sum(near, COVERAGE)) / COVERAGE
        return share.reshape(film.shape)
