"""Compares bit depths on one fast clip: the same photons read as 2^b - 1 binary planes, or once with b bits.

    clip at the plane rate (>= 10 000 fps) -> per bit depth: motion, blur, noise by its causes, PSNR, data rate

A frame of b bits lasts M = 2^b - 1 clip frames. M is odd, so the frames of **all** depths are centred on the same clip
frames. Every depth has the same output rate and is scored against the same sharp image.

* `planes`: M binary planes, each exposed at another instant and drawn with the key of its clip frame. A deeper frame
  contains the planes of a shallower one, and they are the planes of `qsim sense --group`.
* `multibit`: the light of the M clip frames, read once. All depths use the same random number of a pixel.

Every simulated error has its exact expectation beside it: the sum over codes of P(code | light) (estimate - truth)^2.
For planes of different light, the binomial distribution of their mean probability is used. Its variance is multiplied
by sum p (1 - p) / (M mean p (1 - mean p)). That is exact to second order in the differences.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim import keys
from qsim.clip.motion_statistics import CODE_PLANES, SLOWEST, looks, moving_mean, moving_pixels
from qsim.colour import psnr
from qsim.optics import radiometry
from qsim.sensor.sensor import Sensor
from qsim.streams.clip import Clip
from qsim.streams.photons import light_level
from qsim.studies.bit_depth.laws import Structure
from qsim.studies.bit_depth.pixel_light import check_bands, pixel_light
from qsim.studies.bit_depth.readout import GRID, Readout, StudySettings, readouts


@dataclass(frozen=True)
class StudyRow:
    """One bit depth of one model; errors are rms over scored pixels, in photons per pixel and clip frame (plane)."""

    model: str  # "planes" or "multibit"
    bits: int
    fps: float
    motion_px_per_frame: float | None  # clip_motion times the clip frames of this frame; None if the clip has no flow
    blur_error: float  # exposed mean against the sharp instant
    blur_predicted: float  # the same from the clip's structure function (laws.Structure)
    shot_error: float  # of an ideal photon counter behind the same efficiency and dark rate
    quantisation_error: float  # added by few levels and saturation (in squares), without read noise
    read_error: float  # added by read noise (in squares); negative where it dithers coarse levels
    snr_db: float | None  # exposure-referred, at the mean light: 20 log10(photons sqrt(Fisher information)); None: none
    psnr_db: float  # of the maximum-likelihood frame against the sharp instant
    psnr_predicted_db: float  # its exact expectation
    psnr_error_db: float  # standard error of the simulated PSNR: draws only
    sigmas: float  # (simulated - predicted mean square error) / standard error
    data_rate_megabytes_per_second: float


@dataclass(frozen=True)
class Study:
    """The rows of one clip at one light level."""

    clip: str
    rows: tuple[StudyRow, ...]
    ppp: float  # photons per pixel and clip frame, mean of the clip
    lux: float | None
    peak: float  # photons per clip frame that PSNR refers to: 2.5 x the mean light; nothing is clamped to it
    frame_rate: float
    speed: int
    instants: tuple[int, ...]  # clip frames that were scored
    structure: Structure  # of the light, in photons^2 per clip frame
    moving: bool = False  # errors are those of the pixels that move
    share: float = 1.0  # of the pixels that were scored

    @property
    def bits(self) -> tuple[int, ...]:
        """The depths that were tried."""
        return tuple(sorted({row.bits for row in self.rows}))

    def best(self, model: str) -> StudyRow:
        """Return the row of highest PSNR."""
        return max((row for row in self.rows if row.model == model), key=lambda row: row.psnr_db)


@dataclass(frozen=True)
class Exposed:
    """One frame of M clip frames around an instant; arrays are float64, [H, W] or the scored pixels [N]."""

    planes: int
    photons: Array  # sum of the light, photons
    fired: Array  # number of planes that fired (model "planes")
    quiet: Array  # sum of the probabilities 1 - p that a plane does not fire
    spread: Array  # sum of p (1 - p), the variance of `fired`

    def only(self, pixels: Array) -> Exposed:
        """Return the frame of some pixels, given as bool [H, W]."""
        arrays = (self.photons, self.fired, self.quiet, self.spread)
        return Exposed(self.planes, *(values[pixels] for values in arrays))


def check_clip(clip: Clip, settings: StudySettings) -> None:
    """Raise `ValueError` if the clip is too slow or too short for the settings."""
    check_bands(clip, settings.colour)
    if clip.frame_rate < SLOWEST:
        raise ValueError(
            f"{clip.path}: {clip.frame_rate:g} fps; this study needs a clip of at least {SLOWEST:g} fps, as in "
            "`qsim render` with frame_rate=10000"
        )
    if len(clip) < settings.longest:
        raise ValueError(
            f"{clip.path}: {len(clip)} frames; {settings.bits[-1]} bits at speed {settings.speed} need "
            f"{settings.longest}; use fewer bits, or render a longer clip"
        )


def instants(frames: int, settings: StudySettings) -> tuple[int, ...]:
    """Return the centres of frames of the deepest depth, spread over the clip without overlap."""
    span = settings.longest
    count = min(settings.instants, frames // span)
    first = span // 2
    last = frames - 1 - span // 2
    return tuple(int(t) for t in np.linspace(first, last, count).round()) if count > 1 else (frames // 2,)


def expose(
    clip: Clip, centre: int, settings: StudySettings, factor: float, plane: Sensor, structure: Array, scored: Array
) -> Iterator[Exposed]:
    """Yield the frames of all depths around one clip frame, shallow to deep; add squared differences to `structure`.

    `factor` multiplies the light of the clip. `structure` is float64 [K]: entry k grows by the sum over the pixels
    `scored` (bool [H, W]) of (difference of light)^2 at two instants that are k planes apart, symmetric about the
    centre.
    """
    key = keys.Key(seed=settings.seed, clip=keys.hash_name(clip.name))
    wanted = [2**b - 1 for b in settings.bits]
    photons = pixel_light(clip, centre, factor, settings.colour)
    total, fired, quiet, spread = (np.zeros_like(photons) for _ in range(4))
    before = photons
    for reach in range(wanted[-1] // 2 + 1):
        places = [centre] if reach == 0 else [centre - reach * settings.speed, centre + reach * settings.speed]
        pair = [photons] if reach == 0 else [pixel_light(clip, t, factor, settings.colour) for t in places]
        for t, light in zip(places, pair, strict=True):
            p = plane.pmf(light, clip.exposure)
            fired += plane.sample(light, clip.exposure, key=key.at(t), origin=clip.origin)
            total = total + light
            quiet = quiet + p[..., 0]
            spread = spread + p[..., 0] * p[..., 1]
        if reach:
            # Differences at odd and at even distances: each new pair is
            # compared with one plane of the last, and with itself.
            structure[2 * reach - 1] += np.sum((pair[0] - before)[scored] ** 2)
            structure[2 * reach] += np.sum((pair[0] - pair[1])[scored] ** 2)
            before = pair[1]
        if 2 * reach + 1 in wanted:
            yield Exposed(2 * reach + 1, total.copy(), fired.copy(), quiet.copy(), spread.copy())


class _Sums:
    """The running sums of one readout over pixels and instants."""

    def __init__(self) -> None:
        self.pixels = 0
        self.parts = np.zeros(6)  # simulated, predicted, their squared difference, blur, shot, noise
        self.quiet = 0.0  # noise without read noise

    def add(self, readout: Readout, frame: Exposed, codes: Array, sharp: Array) -> None:
        """Add the errors of one frame, in photons per clip frame; `codes` and `sharp` are [N]."""
        m = frame.planes
        light = _equivalent(readout, frame)
        mean, variance = readout.moments(light)
        if readout.model == "planes":
            # A sum of unequal chances varies less than a binomial one: sum
            # p (1 - p) is at most M p (1 - p) of their mean.
            even = frame.quiet * (1 - frame.quiet / m)  # the variance if all planes saw the same light
            variance = variance * np.minimum(frame.spread / np.maximum(even, 1e-300), 1.0)
        # One drawn code, and beside it the expectation of its squared error: bias squared plus variance.
        simulated = (readout.estimates[codes] / m - sharp) ** 2
        predicted = (mean / m - sharp) ** 2 + variance / m**2
        sensor = readout.sensor
        # Of an ideal counter: Poisson variance of the electrons, referred to photons per clip frame.
        arrivals = sensor.efficiency * frame.photons + sensor.dark_rate * _duration(readout)
        blur = (frame.photons / m - sharp) ** 2
        shot = arrivals / (m * sensor.efficiency) ** 2
        noise = ((mean - frame.photons) ** 2 + variance) / m**2
        self.pixels += simulated.size
        for i, part in enumerate((simulated, predicted, (simulated - predicted) ** 2, blur, shot, noise)):
            self.parts[i] += part.sum()
        quiet = readout.noiseless()
        if quiet is readout:
            self.quiet += noise.sum()
        else:
            mean, variance = quiet.moments(light)
            self.quiet += (((mean - frame.photons) ** 2 + variance) / m**2).sum()


def _duration(readout: Readout) -> float:
    return readout.exposure * (readout.planes if readout.model == "planes" else 1)


def _equivalent(readout: Readout, frame: Exposed) -> Array:
    """Return the constant light [photons per frame] that gives the same mean code, of the frame's shape."""
    if readout.model == "multibit":
        return frame.photons
    sensor = readout.sensor
    mean_quiet = np.maximum(frame.quiet / frame.planes, 1e-290)
    if sensor.sums_planes:
        # A plane stays dark with exp(-arrivals): the inverse of its law.
        arrivals = -np.log(mean_quiet) - sensor.dark_rate * readout.exposure
        return frame.planes * np.maximum(arrivals, 0.0) / sensor.efficiency
    # Other planes have no law that can be inverted: P(dark) falls with light, so its negative rises as interp needs.
    grid = np.append(0.0, np.geomspace(1e-5, 1.0, 4 * GRID) * 4 * max(frame.photons.max() / frame.planes, 1e-12))
    return frame.planes * np.interp(-mean_quiet, -sensor.pmf(grid, readout.exposure)[:, 0], grid)


def study(clip: Clip, settings: StudySettings, *, progress: Callable[[int, int], None] | None = None) -> Study:
    """Draw and score every bit depth of a clip.

    Raise `ValueError` if the clip is too slow or too short, or if its light is unknown.
    """
    check_clip(clip, settings)
    level = light_level(clip, ppp=settings.ppp)
    forms = readouts(settings, level.ppp, clip.exposure)
    centres = instants(len(clip), settings)
    sums = {(form.model, form.planes): _Sums() for form in forms}
    by_planes = {m: [form for form in forms if form.planes == m] for m in (2**b - 1 for b in settings.bits)}
    structure = np.zeros(2 ** settings.bits[-1] - 1)
    pixels = 0
    for done, centre in enumerate(centres):
        scored = scored_pixels(clip, centre, settings)
        pixels += int(scored.sum())
        sharp = pixel_light(clip, centre, level.factor, settings.colour, sharp=True)
        for frame in expose(clip, centre, settings, level.factor, forms[0].sensor, structure, scored):
            for form in by_planes[frame.planes]:
                codes = (
                    frame.fired.astype(np.intp)
                    if form.model == "planes"
                    else _read(clip, form, frame, centre, settings)
                )
                if scored.any():
                    sums[form.model, form.planes].add(form, frame.only(scored), codes[scored], sharp[scored])
        if progress is not None:
            progress(done + 1, len(centres))
    if not pixels:
        raise ValueError(
            f"{clip.path}: no pixel moves at its frames {', '.join(map(str, centres))}, which would be scored; give "
            "more instants=, or speed= instead of px= to score all pixels"
        )
    law = Structure(structure / pixels)
    motion = mean_motion(clip, settings.speed)
    peak = radiometry.WHITE_PER_MEAN * level.ppp
    rows = tuple(_row(clip, form, sums[form.model, form.planes], law, motion, peak, level.ppp) for form in forms)
    share = pixels / (len(centres) * math.prod(clip.shape[1:]))
    light = (level.ppp, level.lux, peak)
    return Study(clip.name, rows, *light, clip.frame_rate, settings.speed, centres, law, settings.moving, share)


def scored_pixels(clip: Clip, centre: int, settings: StudySettings) -> Array:
    """Return the pixels whose errors count at a clip frame, bool [H, W]: all, or those that move then.

    Raise `ValueError` where the motion is wanted and the clip has no ground truth.
    """
    if not settings.moving:
        return np.ones(clip.shape[1:], bool)
    if not clip.has_truth:
        raise ValueError(f"{clip.path}: has no ground truth, so it is unknown which of its pixels move")
    return moving_pixels(settings.speed * np.hypot(*clip.flow(centre)), CODE_PLANES)


def _read(clip: Clip, form: Readout, frame: Exposed, centre: int, settings: StudySettings) -> Array:
    """Return the codes of one multi-bit read of the summed light, [H, W]; stage 1 of the key (planes: stage 0)."""
    key = keys.Key(seed=settings.seed, clip=keys.hash_name(clip.name), frame=centre, stage=1)
    return form.sensor.sample(frame.photons, form.exposure, key=key, origin=clip.origin)


def clip_motion(clip: Clip, t: int, speed: int = 1) -> float | None:
    """Return the mean motion [px per plane] of the pixels that move more than 0.1 px per 3-bit frame, at frame t.

    `speed` is a whole factor on the motion. 0 if no pixel moves so far, None if the clip has no ground truth.
    """
    if not clip.has_truth:
        return None
    u, v = clip.flow(t)
    return (moving_mean(speed * np.hypot(u, v), CODE_PLANES) or 0.0) / CODE_PLANES


def mean_motion(clip: Clip, speed: int = 1) -> float | None:
    """Return the mean of `clip_motion` over a few frames of the clip [px per plane]: the motion of the whole clip."""
    found = [clip_motion(clip, t, speed) for t in looks(len(clip))]
    known = [motion for motion in found if motion is not None]
    return float(np.mean(known)) if known else None


def _row(
    clip: Clip, form: Readout, sums: _Sums, law: Structure, motion: float | None, peak: float, ppp: float
) -> StudyRow:
    simulated, predicted, squares, blur, shot, noise = sums.parts / sums.pixels
    quiet = sums.quiet / sums.pixels
    error = math.sqrt(squares / sums.pixels)
    _, height, width = clip.shape
    fps = clip.frame_rate / form.planes
    snr = form.snr_db(form.planes * ppp)
    return StudyRow(
        model=form.model,
        bits=form.bits,
        fps=fps,
        motion_px_per_frame=None if motion is None else motion * form.planes,
        blur_error=math.sqrt(blur),
        blur_predicted=math.sqrt(law.blur(form.planes)),
        shot_error=math.sqrt(shot),
        quantisation_error=signed_root(quiet - shot),
        read_error=signed_root(noise - quiet),
        snr_db=snr if math.isfinite(snr) else None,
        psnr_db=psnr(peak, math.sqrt(simulated)),
        psnr_predicted_db=psnr(peak, math.sqrt(predicted)),
        psnr_error_db=10 / math.log(10) * error / simulated,
        sigmas=(simulated - predicted) / error if error > 0 else 0.0,
        data_rate_megabytes_per_second=height * width * form.bits * fps / 8e6,
    )


def signed_root(square: float) -> float:
    """Return sqrt(|x|) with the sign of x."""
    return math.copysign(math.sqrt(abs(square)), square)
