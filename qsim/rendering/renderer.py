"""A scene at given times: radiance with its error, and the ground truth of its motion.

    Scene + frame rate + shutter + budget -> Frame(radiance, sharp, flow, flow_back, valid, depth, body_id, error)

Frame t is exposed around t / frame_rate: K instants, evenly spread over shutter / frame_rate seconds, are averaged
(Mitsuba's wheels have no motion blur). Every pixel integrates its own area (box filter). Samples come in two
independent halves A and B; radiance is their mean, its noise the rms of (A - B) / 2; the error that a frame states
holds its blur and the bounces left out as well. The sampler's seeds are words of qsim.keys, so any frame can be
rendered alone, in any order. With engine.py, the only importer of Mitsuba.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.backend import Engine
from qsim.clip.clamped_error import Errors, frame_errors, rms, white_in
from qsim.keys import Key, hash_name, words
from qsim.rendering import ground_truth
from qsim.rendering.budget import Budget, blur_left, grid_samples, instants
from qsim.rendering.denoiser import cleaned_mean
from qsim.rendering.engine import activate, select
from qsim.rendering.ground_truth import Hits
from qsim.rendering.mitsuba_scene import Stage
from qsim.scene.scene import Scene

Crop = tuple[int, int, int, int]  # y, x, height, width

RENDER_STAGE = 16  # of the random keys: sampler seeds
SHARP_STAGE = 17  # the sharp instant has seeds of its own
SURFACE_SAMPLES = 16  # per pixel, for the denoiser's albedo and normals
MAX_LANES = 2**23  # samples in flight, about; a frame that takes more is rendered in parts
SPEED_STEPS = 64  # of an exposure, over one of which a speed is measured: up to 32 turns are told from rest
SPEED_PARTS = (-0.5, -0.27, 0.0, 0.23, 0.5)  # where in the exposure; uneven, so that no oscillation rests at all
FIREFLY = 10.0  # a pixel counts as a firefly where halves differ by this many rms of the frame's difference


@dataclass(frozen=True, eq=False)
class Frame:
    """One exposure and what is known about it."""

    radiance: Array  # float32 [H, W], W m^-2 sr^-1, mean over the exposure
    error: float  # rms error of `radiance`, W m^-2 sr^-1: noise and blur as measured, and the budget's `left_out`
    errors_at: tuple[tuple[float, float], ...]  # (white, the same clamped there), rising; empty without light
    fireflies: int  # pixels whose halves differ by more than FIREFLY rms, or are not finite (and made 0)
    sharp: Array | None = None  # float32 [H, W], the instant at mid-exposure, only for an open shutter
    flow: Array | None = None  # float32 [2, H, W], px, mid-exposure of t to that of t + 1
    flow_back: Array | None = None  # float32 [2, H, W], px, mid-exposure of t to that of t - 1
    valid: Array | None = None  # bool [H, W], the point is seen in frame t + 1
    depth: Array | None = None  # float32 [H, W], m along the optical axis, inf where nothing is
    body_id: Array | None = None  # int32 [H, W], bodies in order, then lamps; -1 where nothing is

    @property
    def truth(self) -> dict[str, Array]:
        """The ground truth by name, as a clip stores it."""
        names = ("flow", "flow_back", "valid", "depth", "body_id")
        return {name: value for name in names if (value := getattr(self, name)) is not None}


class Renderer:
    """A scene loaded once; `frame(t)` moves it and renders, in any order of t.

    `shutter` is the share of the frame time that the shutter is open (0 is an instant), `crop` = (y, x, height, width)
    renders that window of the camera's frame, `thinned` = n only every n-th row and column of it (pixels of their true
    size, for pilots). `ValueError` for a crop outside the frame or rates that make no sense.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        frame_rate: float = 2000.0,
        shutter: float = 0.0,
        seed: int = 0,
        budget: Budget | None = None,
        crop: Crop | None = None,
        thinned: int = 1,
        engine: Engine | None = None,
    ) -> None:
        if not frame_rate > 0:
            raise ValueError(f"frame_rate: a positive number of frames per second is needed, got {frame_rate!r}")
        if not 0 <= shutter <= 1:
            raise ValueError(f"shutter: a share of the frame time, 0 to 1, got {shutter!r}")
        self.scene, self.frame_rate, self.shutter, self.seed = scene, frame_rate, shutter, seed
        self.budget = budget or Budget()
        self.crop, self.thinned = _checked_crop(scene, crop), thinned
        self.shape = -(-self.crop[2] // thinned), -(-self.crop[3] // thinned)
        self.engine = engine or select()
        activate(self.engine)
        import mitsuba as mi

        self._mi = mi
        self._key = Key(seed=seed, clip=hash_name(f"{scene.name}/{scene.seed}"), stage=RENDER_STAGE)
        self._stage = Stage(mi, scene)
        self._obvious: Stage | None = None
        self._integrators: dict[int | None, Any] = {}
        self._samplers: dict[int, Any] = {}
        self._numbers = self._shape_table()

    def time(self, t: int) -> float:
        """Mid-exposure of frame t [s]."""
        return t / self.frame_rate

    def frame(self, t: int, *, with_truth: bool = True) -> Frame:
        """Render frame t."""
        activate(self.engine)
        radiance, error, errors_at, fireflies = self._exposed(self.instants(t), self.key(t))
        sharp = None
        if self.shutter > 0 and self.budget.sharp:
            sharp = self._exposed([self.time(t)], self.key(t, SHARP_STAGE))[0]
        # Last, because it leaves the scene at t + 1, where the next frame wants it.
        found = self.truth(t) if with_truth else {}
        return Frame(radiance, error, errors_at, fireflies, sharp, **found)

    def window(self, crop: Crop) -> Renderer:
        """The same loaded scene seen through another crop, every pixel of it."""
        other = copy.copy(self)
        other.crop, other.thinned, other.shape = _checked_crop(self.scene, crop), 1, crop[2:]
        return other

    def instants(self, t: int) -> list[float]:
        """The times [s] whose mean is the exposure of frame t."""
        count = self.budget.sub_frames if self.shutter > 0 else 1
        return instants(self.time(t), self.shutter / self.frame_rate, count)

    def halves(self, instants: list[float], budget: Budget, key: Key) -> Array:
        """Two independent estimates A, B of the mean radiance over the instants [s], float64 [2, H, W]."""
        return self._means(instants, budget, key)[0]

    def _means(self, instants: list[float], budget: Budget, key: Key) -> Array:
        """Those estimates, and the same of every third and of the middle instant alone, float64 [3, 2, H, W]."""
        n, samples = len(instants), budget.grid(len(instants))
        parts = self._parts(2 * samples)
        seeds = words(key, (2, n * len(parts))).reshape(2, n, len(parts))
        sums = np.zeros((3, 2, math.prod(self.shape)))
        for i, instant in enumerate(instants):
            drawn = np.empty_like(sums[0])
            self._stage.place(instant)
            pose = self.scene.camera.pose(instant)
            if self.engine.backend == "scalar":
                integrator = self._integrator(budget.bounces)
                images = [self._film_pass(self._stage, pose, int(s), samples, integrator) for s in seeds[:, i, 0]]
                drawn[:] = np.reshape(images, drawn.shape)
            else:
                for part, seed in zip(parts, seeds[0, i], strict=True):
                    drawn[:, part.start : part.stop] = self._pass(pose, int(seed), samples, budget.bounces, part)
            sums[0] += drawn / n
            if i % 3 == 1:
                sums[1] += drawn * 3 / n
            if i == n // 2:
                sums[2] = drawn
        return sums.reshape(3, 2, *self.shape)

    def _parts(self, samples: int) -> list[range]:
        """The window's pixels, row by row, in ranges of about MAX_LANES samples or less, `samples` to a pixel.

        Pixels are shared among the passes, not samples: the error of a whole grid falls faster than that of its parts.
        """
        pixels = math.prod(self.shape)
        count = min(pixels, math.ceil(pixels * samples / MAX_LANES))
        return [range(pixels * i // count, pixels * (i + 1) // count) for i in range(count)]

    def key(self, t: int, stage: int = RENDER_STAGE) -> Key:
        """The random key of frame t: another seed, scene or stage draws other samples."""
        return replace(self._key, frame=t, stage=stage)

    def _exposed(self, instants: list[float], key: Key) -> tuple[Array, float, tuple[tuple[float, float], ...], int]:
        """Mean radiance over the instants, its rms error, the same clamped at some whites, and the fireflies."""
        means = self._means(instants, self.budget, key)
        halves, broken = means[0], ~np.isfinite(means[0]).all(axis=0)
        means[:, :, broken] = 0  # or the denoiser and every mean around would break too
        difference = (halves[0] - halves[1]) / 2
        error, radiance = rms(difference), halves.mean(axis=0)
        fireflies = int(np.count_nonzero(broken | ((np.abs(difference) > FIREFLY * error) & (error > 0))))
        white = self.budget.white or white_in(radiance)
        mixed = None
        if self.budget.denoise:
            mixed = cleaned_mean(halves, *self.surfaces(instants, key), white)
            radiance, error = mixed.picture, mixed.error

        def error_at(white: float) -> float:
            noise = mixed.error_at(white) if mixed else Errors.of_halves(halves, white).at_white
            left_out = self.budget.left_out_at_white if self.budget.white else self.budget.left_out
            blur = blur_left(np.minimum(means, white), len(instants)) if len(instants) > 1 else 0.0
            return math.hypot(noise, blur, left_out)

        whole = math.hypot(error, blur_left(means, len(instants)), self.budget.left_out)
        return radiance.astype(np.float32), whole, frame_errors(error_at, white), fireflies

    def surfaces(self, instants: list[float], key: Key) -> tuple[Array, Array]:
        """Albedo [H, W] (1 where nothing or a mirror is) and normals [H, W, 3] of first surfaces, for the denoiser."""
        if self.engine.backend == "scalar":
            raise ValueError("the scalar engine cannot denoise; leave Budget.denoise off or install LLVM")
        import drjit as dr

        mi = self._mi
        samples = grid_samples(max(2, SURFACE_SAMPLES // len(instants)))
        parts = self._parts(samples)
        seeds = words(key, (len(instants), len(parts)), redraw=1)
        sums = np.zeros((4, math.prod(self.shape)))
        for instant, row in zip(instants, seeds, strict=True):
            self._stage.place(instant)
            for part, seed in zip(parts, row, strict=True):
                sampler, position = self._film_positions(int(seed), samples, part)
                ray = self._camera_ray(self.scene.camera.pose(instant), position, sampler)
                found = self._stage.loaded.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True)
                bsdf = found.bsdf(ray)
                seen = found.is_valid()
                matt = seen & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
                albedo = dr.select(matt, bsdf.eval_diffuse_reflectance(found)[0], 1)
                normal = dr.select(seen, found.sh_frame.n, 0)
                values = (albedo, normal.x, normal.y, normal.z)
                dr.eval(*values)  # together, or each sum would trace the rays again
                means = [np.array(dr.block_sum(value, samples)) / samples for value in values]
                sums[:, part.start : part.stop] += means
        albedo, *normals = sums.reshape(4, *self.shape) / len(instants)
        return albedo, np.stack(normals, axis=-1)

    def _pass(self, pose: Array, seed: int, samples: int, bounces: int, part: range) -> Array:
        """Two independent estimates of the radiance of these pixels, float64 [2, N], `samples` per pixel each.

        Both are one launch: what it costs to start one is that of several samples of a small frame.
        """
        import drjit as dr

        integrator = self._integrator(bounces)  # first: loading amid what follows would change the kernel once
        sampler, position = self._film_positions(seed, samples, part, 2)
        ray = self._camera_ray(pose, position, sampler)
        radiance, _, _ = integrator.sample(self._stage.loaded, sampler, ray)
        mean = dr.block_sum(radiance[0], samples) / samples
        return np.array(mean, np.float64).reshape(2, len(part))

    def _film_positions(self, seed: int, samples: int, part: range, times: int = 1) -> tuple[Any, Any]:
        """A seeded sampler and film positions [px], uniform in each pixel, whose samples are neighbours in memory.

        The pixels of `part` come `times` times over, each time with grids of their own. Size and place of the window
        are data, not code: a pilot and a whole frame share one compiled kernel.
        """
        import drjit as dr

        mi = self._mi
        lanes = times * len(part) * samples
        sampler = self._sampler(samples)
        sampler.seed(seed, lanes)
        numbers = (len(part), part.start, self.shape[1], self.thinned, *self.crop[:2])
        count, first, columns, step, y0, x0 = (dr.opaque(mi.UInt32, n) for n in numbers)
        pixel = dr.arange(mi.UInt32, lanes) // samples % count + first
        row = pixel // columns
        corner = mi.Point2f(mi.Float((pixel - row * columns) * step + x0), mi.Float(row * step + y0))
        return sampler, corner + sampler.next_2d()

    def _integrator(self, bounces: int | None) -> Any:
        """A path tracer without Russian roulette, so that the same seed draws the same paths at every depth.

        None is Mitsuba's default: any depth, Russian roulette from the fifth bounce on.
        """
        if bounces not in self._integrators:
            plugin: dict[str, Any] = {"type": "path"}
            if bounces is not None:
                plugin |= {"max_depth": bounces + 1, "rr_depth": 1000}
            self._integrators[bounces] = self._mi.load_dict(plugin)
        return self._integrators[bounces]

    def _camera_ray(self, pose: Array, position: Any, sampler: Any) -> Any:
        """Rays through film positions [px]; the pose is data, not code, so that moving it compiles nothing."""
        import drjit as dr

        mi, camera = self._mi, self.scene.camera
        axes = [mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in pose[:3, i])) for i in range(4)]
        f = camera.focal_pixels
        across = (position.x - camera.width / 2) / f
        down = (position.y - camera.height / 2) / f
        direction = axes[0] * across + axes[1] * down + axes[2]
        origin = axes[3]
        if camera.aperture_blur:
            focus = camera.focus
            lens = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d()) * (camera.pupil_radius)
            shift = axes[0] * lens.x + axes[1] * lens.y
            origin = origin + shift
            direction = direction * focus - shift
        return mi.RayDifferential3f(o=mi.Point3f(origin), d=dr.normalize(direction))

    def _sampler(self, samples: int) -> Any:
        if samples not in self._samplers:
            sampler = self._mi.load_dict({"type": "multijitter", "sample_count": samples})
            sampler.set_samples_per_wavefront(samples)
            self._samplers[samples] = sampler
        return self._samplers[samples]

    def obvious(self, t: int, samples: int, redraw: int = 0) -> Array:
        """The loop that everybody writes first, float64 [H, W]: only here to be compared with.

        `mi.render` with Mitsuba's camera and film, its default integrator and its default sampler; box filter. Another
        `redraw` draws other samples.
        """
        activate(self.engine)
        if self._obvious is None:
            self._obvious = Stage(self._mi, self.scene, smooth_weight=1.0)
        self._obvious.place(self.time(t))
        pose, seed = self.scene.camera.pose(self.time(t)), int(words(self.key(t), (1, 1), redraw=redraw)[0, 0])
        return self._film_pass(self._obvious, pose, seed, samples, self._integrator(None), "independent")

    def _film_pass(
        self, stage: Stage, pose: Array, seed: int, samples: int, integrator: Any, sampler: str = "multijitter"
    ) -> Array:
        """Mitsuba's own camera and film; the scalar engine, which has no vectors of rays, always renders so."""
        mi, camera = self._mi, self.scene.camera
        y, x, height, width = self.crop
        film: dict[str, Any] = {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "rfilter": {"type": "box"},
            # In Mitsuba's RGB variant a uniform spectrum is reddish (the white of sRGB is not that of equal energy);
            # its luminance is 1.
            "pixel_format": "luminance",
        }
        film |= {"crop_offset_x": x, "crop_offset_y": y, "crop_width": width, "crop_height": height}
        view = pose @ np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba's camera axes: left, up, forward
        sensor: dict[str, Any] = {"type": "perspective", "film": film, "near_clip": 1e-4, "far_clip": 1e5}
        sensor["to_world"] = mi.ScalarTransform4f(view.tolist())
        sensor |= {"fov_axis": "x", "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / camera.focal_pixels)))}
        sensor["sampler"] = {"type": sampler, "sample_count": samples}
        if camera.aperture_blur:
            sensor |= {"type": "thinlens", "aperture_radius": camera.pupil_radius, "focus_distance": camera.focus}
        image = mi.render(stage.loaded, sensor=mi.load_dict(sensor), integrator=integrator, seed=seed, spp=samples)
        return np.array(image, np.float64)[:: self.thinned, :: self.thinned, 0]

    def truth(self, t: int) -> dict[str, Array]:
        """Flow, validity, depth and body of frame t at mid-exposure, as in `Frame`."""
        camera, now, after, shape = self.scene.camera, self.time(t), self.time(t + 1), self.shape
        rays = ground_truth.pixel_rays(camera, self.crop, self.thinned)
        self._stage.place(now)
        hits = self._cast(camera.pose(now), rays)
        flow, inside, then = ground_truth.flow_between(self.scene, rays, hits, now, after)
        back, _, _ = ground_truth.flow_between(self.scene, rays, hits, now, self.time(t - 1))
        self._stage.place(after)
        valid = inside & ground_truth.visible(hits.distance, self._cast(camera.pose(after), then))
        return {
            "flow": flow.reshape(2, *shape).astype(np.float32),
            "flow_back": back.reshape(2, *shape).astype(np.float32),
            "valid": valid.reshape(shape),
            "depth": hits.distance.reshape(shape).astype(np.float32),
            "body_id": hits.number.reshape(shape),
        }

    def travel(self, t: int) -> tuple[Array, Array]:
        """How far what each pixel sees runs in the exposure [px], and the body that it is, both [H, W].

        From its largest speed, not from where it comes to lie: a wheel that turns once has not rested. With the shutter
        at 0, by its speed at the instant, in a whole frame time.
        """
        exposure, parts = (self.shutter or 1.0) / self.frame_rate, SPEED_PARTS if self.shutter > 0 else (0.0,)
        rays, now = ground_truth.pixel_rays(self.scene.camera, self.crop, self.thinned), self.time(t)
        self._stage.place(now)
        hits = self._cast(self.scene.camera.pose(now), rays)
        fastest, step = np.zeros(rays.shape[1]), exposure / SPEED_STEPS
        for part in parts:
            ends = [now + part * exposure + step / 2, now + part * exposure - step / 2]
            late, early = (ground_truth.flow_between(self.scene, rays, hits, now, end)[0] for end in ends)
            fastest = np.maximum(fastest, np.hypot(*(late - early)))
        across = math.hypot(self.scene.camera.height, self.scene.camera.width)  # nothing smears farther
        return np.minimum(fastest * SPEED_STEPS, across).reshape(self.shape), hits.number.reshape(self.shape)

    def _cast(self, pose: Array, rays: Array) -> Hits:
        """First hits along rays [3, N] of a camera with this pose."""
        origin, directions = pose[:3, 3], pose[:3, :3] @ rays
        if self.engine.backend == "scalar":
            return self._cast_one_by_one(origin, directions)
        import drjit as dr

        mi = self._mi
        direction = mi.Vector3f(directions.astype(np.float32))
        length = dr.norm(direction)
        eye = mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in origin))
        ray = mi.Ray3f(eye, direction / length)
        found = self._stage.loaded.ray_intersect_preliminary(ray, coherent=True)
        shape = dr.reinterpret_array(mi.UInt32, found.shape)
        instance: Any = dr.reinterpret_array(mi.UInt32, found.instance)
        hit = found.is_valid()
        # Where nothing was hit, Dr.Jit leaves whatever the memory held.
        index = dr.select(hit, dr.select(instance > 0, instance, shape), 0)
        distance = dr.select(hit, found.t / length, dr.inf)
        triangle, weights = dr.select(hit, found.prim_index, 0), dr.select(hit, found.prim_uv, 0)
        dr.eval(index, distance, triangle, weights)  # rays are cast once, not once for each answer
        number = self._numbers[np.minimum(np.array(index), len(self._numbers) - 1)]
        far = np.where(number >= 0, np.array(distance, np.float64), np.inf)
        return Hits(far, number, np.array(triangle, np.int64), np.array(weights, np.float64).reshape(2, -1).T)

    def _cast_one_by_one(self, origin: Array, directions: Array) -> Hits:
        mi = self._mi
        numbers = self._stage.shape_numbers()
        lengths = np.linalg.norm(directions, axis=0)
        distance, number = np.full(len(lengths), np.inf), np.full(len(lengths), -1, np.int32)
        triangle, weights = np.zeros(len(lengths), np.int64), np.zeros((len(lengths), 2))
        for i, (direction, length) in enumerate(zip(directions.T, lengths, strict=True)):
            ray = mi.Ray3f(origin.tolist(), (direction / length).tolist())
            found = self._stage.loaded.ray_intersect_preliminary(ray)
            if found.is_valid():
                number[i] = numbers.get((found.instance or found.shape).id(), -1)
                triangle[i], weights[i] = found.prim_index, found.prim_uv
                distance[i] = found.t / length if number[i] >= 0 else np.inf
        return Hits(distance, number, triangle, weights)

    def _shape_table(self) -> Array:
        """Body numbers by Dr.Jit's registry index; unknown shapes (the sun) are surroundings, -1."""
        if self.engine.backend == "scalar":
            return np.zeros(0, np.int32)
        import drjit as dr

        mi, numbers = self._mi, self._stage.shape_numbers()
        shapes = self._stage.loaded.shapes()
        pointers: list[Any] = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)) for shape in shapes]
        indices = [int(pointer[0]) for pointer in pointers]
        table = np.full(max([0, *indices]) + 2, -1, np.int32)
        for index, shape in zip(indices, shapes, strict=True):
            table[index] = numbers.get(shape.id(), -1)
        return table


def _checked_crop(scene: Scene, crop: Crop | None) -> Crop:
    height, width = scene.camera.height, scene.camera.width
    if crop is None:
        return 0, 0, height, width
    y, x, rows, columns = crop
    if min(y, x) < 0 or min(rows, columns) < 1 or y + rows > height or x + columns > width:
        raise ValueError(f"crop (y, x, height, width) = {crop} does not lie in the {height} x {width} frame")
    return crop
