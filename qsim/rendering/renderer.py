"""Renders frames of a scene: radiance with its error, and the ground truth of its motion.

    Scene + frame rate + shutter + budget -> Frame(radiance, sharp, flow, flow_back, valid, depth, body_id, error)

Frame t is exposed around t / frame_rate: the mean of K instants, spread evenly over shutter / frame_rate seconds
(Mitsuba's wheels have no motion blur). Lights that flicker have their exact mean strength over the exposure, also where
the shutter is 0 and in the sharp frame: motion is frozen there, light is not. Every pixel integrates its own area (box
filter). Samples come in two independent halves A and B: radiance is their mean, and its noise the rms of (A - B) / 2.
The stated error also contains blur and omitted bounces. The sampler's seeds are words of qsim.keys: frames can be
rendered alone and in any order. Mitsuba's RGB variant renders scenes of three bands: their images are [3, H, W].
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.backend import RenderEngine, on_gpu
from qsim.clip.clamped_error import HalvesNoise, StatedError, error_at, frame_errors, rms, white_in
from qsim.device_lock import one_thread_at_a_time
from qsim.host import own_numbers
from qsim.keys import Key, hash_name, words
from qsim.lazy_array import Crop
from qsim.optics.radiometry import check_crop
from qsim.rendering import ground_truth
from qsim.rendering.budget import Budget, as_bright, blur_left, grid_samples, instants, light_windows
from qsim.rendering.camera_rays import CameraRays, Film
from qsim.rendering.denoiser import OPTIX, Mixture, cleaned_mean
from qsim.rendering.engine import activate, in_colour, in_own_variant, select
from qsim.rendering.mitsuba_scene import Stage, film_pass
from qsim.rendering.planes import Planes, together
from qsim.rendering.ray_casting import Hits, RayCaster, pixel_rays
from qsim.rendering.reuse.carrying import Carrier, unshared
from qsim.rendering.reuse.choice import best_of, reused_mean
from qsim.scene import Scene

RENDER_STAGE = 16  # of the random keys: sampler seeds
SHARP_STAGE = 17  # the sharp instant has separate seeds
SURFACE_SAMPLES = 16  # per pixel, for the denoiser's albedo and normals
FIREFLY = 10.0  # a pixel counts as a firefly where halves differ by this many rms of the frame's difference

Exposed = tuple[Array, float, tuple[tuple[float, float], ...], int]  # radiance, its error, that at whites, fireflies


@dataclass(frozen=True, eq=False)
class Frame:
    """One exposure with its error and ground truth."""

    radiance: Array  # float32 [H, W], or [3, H, W] of a colour scene, W m^-2 sr^-1, mean over the exposure
    error: float  # rms error of `radiance` or `sharp`, the larger, W m^-2 sr^-1: noise, blur, the budget's `left_out`
    errors_at: tuple[tuple[float, float], ...]  # (white, the same clamped there), rising; empty without light
    fireflies: int  # pixels whose halves differ by more than FIREFLY rms, or are not finite; those of `sharp` are added
    # as radiance, the instant at mid-exposure, for an open shutter, or with more samples in the middle of a code
    sharp: Array | None = None
    flow: Array | None = None  # float32 [2, H, W], px, mid-exposure of t to that of t + 1
    flow_back: Array | None = None  # float32 [2, H, W], px, mid-exposure of t to that of t - 1
    valid: Array | None = None  # bool [H, W], the point is seen in frame t + 1
    depth: Array | None = None  # float32 [H, W], m along the optical axis, inf where nothing is
    body_id: Array | None = None  # int32 [H, W], bodies in order, then lamps; -1 where nothing is
    code: StatedError | None = None  # of a frame in the middle of a code: that of the code or of `sharp`, the larger

    @property
    def truth(self) -> dict[str, Array]:
        """The ground truth by name, as a clip stores it."""
        names = ("flow", "flow_back", "valid", "depth", "body_id")
        return {name: value for name in names if (value := getattr(self, name)) is not None}


@dataclass(frozen=True, eq=False)
class Seen:
    """What is seen through the pixel centres of a frame, and where it is in the next frame and in the one before."""

    hits: Hits
    forth: Future[tuple[Array, Array, Array]]  # as of `ground_truth.flow_between`
    back: Callable[[], tuple[Array, Array, Array]]


@own_numbers
class Renderer:
    """A scene loaded once; `frame(t)` moves it and renders, in any order of t.

    `shutter` is the fraction of the frame time during which the shutter is open; 0 is an instant. `crop` = (y, x,
    height, width) selects a window of the camera's frame, and `thinned` = n every n-th row and column of it (for
    pilots). `frames` is their number in the clip: samples of frames beyond it are not carried (None: no end). Where
    frames share samples, a crop is cut from the complete frame, so that it agrees with it to the bit. `ValueError` for
    a crop outside the frame, for a frame rate or shutter outside its range, and for a budget with neighbours where
    frames cannot share samples.
    """

    @one_thread_at_a_time
    def __init__(  # noqa: PLR0913 (settings of a public function)
        self,
        scene: Scene,
        *,
        frame_rate: float = 2000.0,
        shutter: float = 0.0,
        seed: int = 0,
        budget: Budget | None = None,
        crop: Crop | None = None,
        thinned: int = 1,
        frames: int | None = None,
        engine: RenderEngine | None = None,
    ) -> None:
        if not frame_rate > 0:
            raise ValueError(f"frame_rate: a positive number of frames per second is needed, got {frame_rate!r}")
        if not 0 <= shutter <= 1:
            raise ValueError(f"shutter: a share of the frame time, 0 to 1, got {shutter!r}")
        self.scene = scene
        self.frame_rate = frame_rate
        self.shutter = shutter
        self.seed = seed
        self.budget = budget or Budget()
        self.engine = (engine or select()) if scene.bands is None else in_colour(engine or select())
        asked = (self.budget.quality if self.budget.denoise else "", self.budget.sharp_quality)
        if OPTIX in asked and not on_gpu(self.engine.backend):
            raise ValueError(
                f"Budget.quality: {OPTIX} is the denoiser of a GPU, and the renderer is {self.engine.backend}; "
                "choose high, balanced or fast"
            )
        activate(self.engine)
        import mitsuba as mi

        self.mi = mi
        rays = None if self.engine.backend == "scalar" else CameraRays(mi, scene.camera)
        self.film = Film(mi, scene.camera, _checked_crop(scene, crop), thinned, rays)
        self._key = Key(seed=seed, clip=hash_name(f"{scene.name}/{scene.seed}"), stage=RENDER_STAGE)
        self.stage = Stage(mi, scene)
        self._integrators: dict[int, Any] = {}
        self._caster = RayCaster(self.stage, self.engine.backend)
        self.frames = frames
        self._planes: Planes | None = None  # those of the code that was rendered last
        if self.budget.planes > 1 and shutter > 0:
            raise ValueError("Budget.planes: frames with an open shutter have their own noise; set it to 1")
        self._whole: Renderer | None = None
        if self.budget.neighbours:
            if reason := unshared(scene, shutter, self.engine.backend):
                raise ValueError(f"Budget.neighbours: frames with {reason} cannot share samples; set it to 0")
            self._whole = self.window((0, 0, scene.camera.height, scene.camera.width))
            self._carrier = self._whole.carrier(self.budget, frames)

    def __copy__(self) -> Renderer:
        """Return another renderer of the same loaded scene."""
        other = object.__new__(Renderer)
        vars(other).update(vars(self))
        return other

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to make it again, for pickles and deep copies: Mitsuba's objects cannot be copied."""
        given: dict[str, Any] = {
            "frame_rate": self.frame_rate,
            "shutter": self.shutter,
            "seed": self.seed,
            "budget": self.budget,
        }
        given |= {"crop": self.crop, "thinned": self.film.thinned, "frames": self.frames}
        return partial(Renderer, self.scene, **given), ()

    @property
    def variant(self) -> str:
        """The Mitsuba variant that loaded the scene."""
        return self.engine.variant

    @property
    def crop(self) -> Crop:
        """The window (y, x, height, width) in the camera's frame."""
        return self.film.crop

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the frames [px]."""
        return self.film.shape

    def time(self, t: int) -> float:
        """Return the mid-exposure time of frame t [s]."""
        return t / self.frame_rate

    @property
    def exposure(self) -> float:
        """The time in which a frame collects light [s]: a frame time if the shutter is 0."""
        return (self.shutter or 1.0) / self.frame_rate

    def strengths(self, frames: int) -> dict[str, Array]:
        """Return the mean strength of each flickering light (`Scene.flickers`) in frames 0 ... frames - 1, [frames]."""
        middle = np.arange(frames) / self.frame_rate
        half = self.exposure / 2
        return {name: flicker.mean(middle - half, middle + half) for name, flicker in self.scene.flickers.items()}

    def frame(self, t: int, *, with_truth: bool = True) -> Frame:
        """Render frame t: arrays of the window's height and width [H, W]."""
        return self.begun(t, with_truth=with_truth)()

    @in_own_variant
    def begun(self, t: int, *, with_truth: bool = True) -> Callable[[], Frame]:
        """Do the part of frame t that needs the engine; the result does the rest once, in any thread.

        So the engine can render the next frame meanwhile.
        """
        if self.budget.planes > 1:
            plane = self._plane(t, with_truth)
            return lambda: plane
        # Of an instant the truth's rays go first, so that the host follows their points while paths are traced.
        early = self._seen(t) if with_truth and self.shutter == 0 else None
        exposed = self._shared(t, self._whole, early) if self._whole else self._exposed(self.instants(t), self.key(t))
        of_sharp = None
        if self.shutter > 0 and self.budget.sharp:  # the truth of scores: the larger error of both is stated
            of_sharp = self._exposed([self.time(t)], self.key(t, SHARP_STAGE))
        # Last: it leaves the scene at t + 1, where the next frame starts.
        truth: Callable[[], dict[str, Any]] = self._truth(t, early or self._seen(t)) if with_truth else dict

        def finished() -> Frame:
            radiance, error, errors_at, fireflies = exposed()
            sharp = None
            if of_sharp is not None:
                sharp, other, others_at, more = of_sharp()
                error = max(error, other)
                fireflies = fireflies + more
                errors_at = tuple((white, max(at, error_at(white, others_at or errors_at))) for white, at in errors_at)
            return Frame(radiance, error, errors_at, fireflies, sharp, **truth())

        return finished

    def _plane(self, t: int, with_truth: bool) -> Frame:
        """Render a frame that shares the noise of its code with the others."""
        planes = self._planes_of(t)
        number = t - planes.first
        error = planes.errors[number]
        fireflies = planes.fireflies[number]
        sharp = None
        code = None
        if t in planes.middles:
            instant = [self.time(t)]
            surfaces = self.surfaces(instant, self.key(t)) if self.budget.denoise else None
            found = self._finished(planes.middles[t], surfaces, 1, self.budget.of_middles)
            sharp, plain, at_whites, fireflies = found
            of_sharp = StatedError(plain, at_whites)
            if number == self.budget.planes // 2 and len(planes.errors) == self.budget.planes:
                code = planes.error.or_larger(of_sharp)
            error = error.or_larger(of_sharp)
        truth: dict[str, Any] = self.truth(t) if with_truth else {}
        return Frame(planes.light[number], error.plain, error.at_whites, fireflies, sharp, code=code, **truth)

    def _planes_of(self, t: int) -> Planes:
        """Return the planes of the code that frame t belongs to; the last one is kept."""
        first = t // self.budget.planes * self.budget.planes
        if self._planes is None or self._planes.first != first:
            self._planes = None  # frees its memory
            stop = first + self.budget.planes
            self._planes = self._drawn_planes(range(first, stop if self.frames is None else min(stop, self.frames)))
        return self._planes

    def _drawn_planes(self, frames: range) -> Planes:
        """Render the planes of a code; those in the middle of codes have more samples."""
        middles = {}
        halves = np.empty((len(frames), 2, *(() if self.scene.bands is None else (3,)), *self.shape), np.float32)
        for plane, s in zip(halves, frames, strict=True):
            middle = self.budget.is_middle(s)
            means = self.means([self.time(s)], self.budget.of_middles if middle else self.budget, self.key(s))
            plane[:] = means[0]
            if middle:
                middles[s] = means
        # A sample without a finite value would spread over the whole code through its mean and its denoiser.
        broken = np.logical_not(np.isfinite(halves).all(axis=1))
        halves.swapaxes(0, 1)[:, broken] = 0
        counts = [np.count_nonzero(fireflies_in(halves[i], broken[i])) for i in range(len(frames))]
        times = [self.time(s) for s in frames]
        surfaces = self.surfaces(times, self.key(frames.start)) if self.budget.denoise else None
        light, errors = together(halves, surfaces, self.budget)
        return Planes(frames.start, light, tuple(errors[:-1]), tuple(map(int, counts)), errors[-1], middles)

    def window(self, crop: Crop) -> Renderer:
        """Return a renderer of the same loaded scene for every pixel of another crop."""
        other = copy.copy(self)
        other.film = self.film.window(_checked_crop(self.scene, crop))
        other._planes = None
        return other

    def instants(self, t: int) -> list[float]:
        """Return the times [s] whose mean is the exposure of frame t."""
        count = self.budget.sub_frames if self.shutter > 0 else 1
        return instants(self.time(t), self.shutter / self.frame_rate, count)

    @in_own_variant
    def halves(self, instants: list[float], budget: Budget, key: Key) -> Array:
        """Return independent estimates A, B of the mean radiance over the instants [s], float64 [2, H, W].

        Those of a colour scene are [2, 3, H, W]; so are the radiances of all other functions here. A pixel that is not
        finite in one of them is 0 in both, as in frames.
        """
        found = self.means(instants, budget, key)[0]
        found[:, ~np.isfinite(found).all(axis=0)] = 0
        return found

    @in_own_variant
    def means(self, instants: list[float], budget: Budget, key: Key) -> Array:
        """Return means of all instants, of every third one, and of the middle one, in halves, float64 [3, 2, H, W].

        The instants [s] are the middles of equal parts of an exposure; lights have their mean over `light_windows`.
        """
        n = len(instants)
        samples = budget.grid(len(instants))
        parts = self.film.parts(2 * samples)
        # One seed for each half, instant and part of the film: equal keys
        # render equal frames, in any order and on any part.
        seeds = words(key, (2, n * len(parts))).reshape(2, n, len(parts))
        sums = np.zeros((3, 2, *(() if self.scene.bands is None else (3,)), math.prod(self.shape)))
        windows = light_windows(instants, self.exposure)
        for i, instant in enumerate(instants):
            drawn = np.empty_like(sums[0])
            self.stage.place(instant)
            if self.scene.flickers:
                self.stage.light(*windows[i])
            if self.engine.backend == "scalar":
                pose = self.scene.camera.pose(instant)
                integrator = self._integrator(budget.bounces)
                images = [film_pass(self.stage, pose, self.crop, int(s), samples, integrator) for s in seeds[:, i, 0]]
                thin = [image[:: self.film.thinned, :: self.film.thinned] for image in images]
                drawn[:] = np.reshape(thin, drawn.shape)
            else:
                for part, seed in zip(parts, seeds[0, i], strict=True):
                    drawn[..., part.start : part.stop] = self._pass(instant, int(seed), samples, budget.bounces, part)
            sums[0] += drawn / n
            # Every third instant is the middle of three: their mean shows
            # what fewer instants would change (`blur_left`).
            if i % 3 == 1:
                sums[1] += drawn * 3 / n
            if i == n // 2:
                sums[2] = drawn
        means = sums.reshape(*sums.shape[:-1], *self.shape)
        return as_bright(means) if self.scene.flickers and n > 3 else means

    def key(self, t: int, stage: int = RENDER_STAGE) -> Key:
        """Return the random key of frame t; seed, scene and stage select the samples."""
        return replace(self._key, frame=t, stage=stage)

    @in_own_variant
    def carrier(self, budget: Budget, frames: int | None, stage: int = RENDER_STAGE) -> Carrier:
        """Return what carries samples between the frames 0 .. frames - 1 (None: all) of this window.

        Seed, scene and `stage` select the samples.
        """
        every = range(2**32) if frames is None else range(frames)
        integrator = self._integrator(budget.bounces)
        each = budget.grid(1)
        key = partial(self.key, stage=stage)
        return Carrier(self.stage, self.film, self._caster, integrator, each, budget.neighbours, every, self.time, key)

    def _shared(self, t: int, whole: Renderer, seen: Seen | None) -> Callable[[], Exposed]:
        """Return the same as `_exposed` of a frame that shares samples, cut from the complete frame.

        `seen` is what is seen through the pixel centres of this renderer, if that is known.
        """
        # The denoiser sees the complete frame, as windows of it would have other edges. Surfaces come first: the scene
        # is at frame t already, and pictures move it to later frames.
        surfaces = whole.surfaces([self.time(t)], self.key(t)) if self.budget.denoise else None
        complete = self.crop == whole.crop and self.film.thinned == 1
        pictures = self._carrier.pictures(t, seen.hits if seen is not None and complete else None)
        return partial(self._cut, pictures, surfaces)

    def _cut(self, pictures: Array, surfaces: tuple[Array, Array] | None) -> Exposed:
        """Return radiance and errors of a frame from pictures of the complete one, which more and more frames share."""
        own = pictures[0]
        broken = ~np.isfinite(pictures[0]).all(axis=0)
        pictures[:, :, broken] = 0
        white = self.budget.white or white_in(own.mean(axis=0))
        best, _ = best_of(pictures, white, self.budget.denoise)
        cut = reused_mean(own, best, surfaces, white, self.budget.quality).cut(self.crop, self.film.thinned)
        errors_at = frame_errors(lambda white: math.hypot(cut.error_at(white), self.budget.left_out_clamped), white)
        y, x, height, width = self.crop
        fireflies = int(np.count_nonzero(fireflies_in(own, broken)[y : y + height, x : x + width]))
        return cut.picture.astype(np.float32), math.hypot(cut.error, self.budget.left_out), errors_at, fireflies

    def _exposed(self, instants: list[float], key: Key) -> Callable[[], Exposed]:
        """Render an exposure; the result returns radiance [H, W], its rms error, that at some whites, and fireflies."""
        means = self.means(instants, self.budget, key)
        surfaces = self.surfaces(instants, key) if self.budget.denoise else None
        return partial(self._finished, means, surfaces, len(instants), self.budget)

    def _finished(self, means: Array, surfaces: tuple[Array, Array] | None, instants: int, budget: Budget) -> Exposed:
        """Return the same from the means of so many instants and what the denoiser needs; None: not denoised."""
        halves = means[0]
        broken = ~np.isfinite(means[0]).all(axis=0)
        means[:, :, broken] = 0  # they would break the denoiser and every mean around them
        error = rms((halves[0] - halves[1]) / 2)
        radiance = halves.mean(axis=0)
        fireflies = int(np.count_nonzero(fireflies_in(halves, broken)))
        # The picture is clamped at white before it is scored, so its error there counts, beside that without a clamp.
        white = budget.white or white_in(radiance)
        noise: HalvesNoise | Mixture
        if surfaces is None:
            noise = HalvesNoise.of(halves)
        else:
            noise = mixed = cleaned_mean(halves, *surfaces, white, budget.quality)
            radiance = mixed.picture
            error = mixed.error

        def clamped(white: float) -> float:
            blur = blur_left(np.minimum(means, white), instants) if instants > 1 else 0.0
            return math.hypot(noise.error_at(white), blur, budget.left_out_clamped)

        whole = math.hypot(error, blur_left(means, instants), budget.left_out)
        return radiance.astype(np.float32), whole, frame_errors(clamped, white), fireflies

    @in_own_variant
    def surfaces(self, instants: list[float], key: Key) -> tuple[Array, Array]:
        """Return albedo [H, W] or [3, H, W] (1 for mirrors and misses) and normals [H, W, 3], for the denoiser."""
        if self.engine.backend == "scalar":
            raise ValueError("the scalar engine cannot denoise; leave Budget.denoise off or install LLVM")
        import drjit as dr

        mi = self.mi
        samples = grid_samples(max(4, SURFACE_SAMPLES // len(instants)))
        parts = self.film.parts(samples)
        seeds = words(key, (len(instants), len(parts)), redraw=1)
        colours = 1 if self.scene.bands is None else 3
        sums = np.zeros((colours + 3, math.prod(self.shape)))
        for instant, row in zip(instants, seeds, strict=True):
            self.stage.place(instant)
            for part, seed in zip(parts, row, strict=True):
                sampler, position = self.film.positions(int(seed), samples, part)
                ray = self.film.rays.at(instant).through(self.scene.camera.pose(instant), position, sampler)
                found = self.stage.loaded.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True)
                bsdf = found.bsdf(ray)
                seen = found.is_valid()
                # The denoiser divides by the albedo what it calls texture; a mirror shows other things, and has none.
                matt = seen & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
                reflectance = bsdf.eval_diffuse_reflectance(found)
                albedo = [dr.select(matt, reflectance[i], 1) for i in range(colours)]
                normal = dr.select(seen, found.sh_frame.n, 0)
                values = (*albedo, normal.x, normal.y, normal.z)
                dr.eval(*values)  # together: separate sums would each trace the rays again
                means = [np.array(dr.block_sum(value, samples)) / samples for value in values]
                sums[:, part.start : part.stop] += means
        means_of = sums.reshape(-1, *self.shape) / len(instants)
        return means_of[0] if colours == 1 else means_of[:3], np.stack(list(means_of[colours:]), axis=-1)

    def _pass(self, instant: float, seed: int, samples: int, bounces: int, part: range) -> Array:
        """Return two independent estimates of these pixels' radiance, float64 [2, (3,) N], `samples` per pixel each.

        They are those of the instant [s] at which the stage is placed.

        One launch computes both: a launch costs as much as several samples of a small frame.
        """
        import drjit as dr

        integrator = self._integrator(bounces)  # first: loading it later would change the kernel once
        sampler, position = self.film.positions(seed, samples, part, 2)
        ray = self.film.rays.at(instant).through(self.scene.camera.pose(instant), position, sampler)
        radiance, _, _ = integrator.sample(self.stage.loaded, sampler, ray)
        means = [dr.block_sum(radiance[band], samples) / samples for band in range(len(radiance))]
        dr.eval(*means)  # together: each alone would trace the rays again
        found = np.array([np.array(mean, np.float64).reshape(2, len(part)) for mean in means])
        return found[0] if self.scene.bands is None else found.swapaxes(0, 1)

    def _integrator(self, bounces: int) -> Any:
        """Return a path tracer without Russian roulette: equal seeds give equal paths at every depth."""
        if bounces not in self._integrators:
            # Only the second one lets light through holes on its way from a lamp; it takes a little longer.
            kind = "volpath" if self.scene.see_through else "path"
            plugin = {"type": kind, "max_depth": bounces + 1, "rr_depth": 1000}
            self._integrators[bounces] = self.mi.load_dict(plugin)
        return self._integrators[bounces]

    @in_own_variant
    def truth(self, t: int) -> dict[str, Array]:
        """Return flow, validity, depth and body of frame t at mid-exposure, as in `Frame`."""
        return self._truth(t, self._seen(t))()

    def _seen(self, t: int) -> Seen:
        """Cast rays through the pixel centres of frame t, and follow what they hit in a thread."""
        camera = self.scene.camera
        now = self.time(t)
        rays = pixel_rays(camera.at(now), self.crop, self.film.thinned)
        self.stage.place(now)
        hits = self._caster.cast(camera.pose(now), rays)
        follow = partial(ground_truth.flow_between, self.scene, rays, hits, now)
        thread = ThreadPoolExecutor(1, "following points")
        moved = thread.submit(follow, self.time(t + 1))
        thread.shutdown(wait=False)  # it ends with its work
        return Seen(hits, moved, partial(follow, self.time(t - 1)))

    def _truth(self, t: int, seen: Seen) -> Callable[[], dict[str, Array]]:
        """Cast rays to the points of frame t in frame t + 1; the result returns the truth of frame t."""
        after = self.time(t + 1)
        shape = self.shape
        hits = seen.hits
        flow, inside, then = seen.forth.result()
        self.stage.place(after)
        later = self._caster.cast(self.scene.camera.pose(after), then)

        def found() -> dict[str, Array]:
            back, _, _ = seen.back()
            # A point is seen again if the later ray to it meets nothing nearer.
            valid = inside & ground_truth.visible(hits.distance, later)
            return {
                "flow": flow.reshape(2, *shape).astype(np.float32),
                "flow_back": back.reshape(2, *shape).astype(np.float32),
                "valid": valid.reshape(shape),
                "depth": hits.distance.reshape(shape).astype(np.float32),
                "body_id": hits.number.reshape(shape),
            }

        return found

    @in_own_variant
    def motion_extent(self, t: int) -> tuple[Array, Array]:
        """Return the image-space motion per exposure [px] and the body index of the first hit, both [H, W].

        With the shutter at 0, it is the motion per frame time at the speed of that instant.
        """
        now = self.time(t)
        exposure = self.exposure
        rays = pixel_rays(self.scene.camera.at(now), self.crop, self.film.thinned)
        self.stage.place(now)
        hits = self._caster.cast(self.scene.camera.pose(now), rays)
        extent = ground_truth.motion_extent(self.scene, rays, hits, now, exposure, sharp=self.shutter == 0)
        return extent.reshape(self.shape), hits.number.reshape(self.shape)


def fireflies_in(halves: Array, broken: Array) -> Array:
    """Return which pixels [H, W] are broken, or differ between the halves [2, (3,) H, W] by more than FIREFLY rms."""
    difference = (halves[0] - halves[1]) / 2
    error = rms(difference)
    found = broken | ((np.abs(difference) > FIREFLY * error) & (error > 0))
    return found.reshape(-1, *found.shape[-2:]).any(axis=0)


def _checked_crop(scene: Scene, crop: Crop | None) -> Crop:
    return check_crop(crop, scene.camera.height, scene.camera.width)
