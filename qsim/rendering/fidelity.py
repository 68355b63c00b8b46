"""Chooses bounces, instants per exposure and samples of a scene for a requested error.

    choose_budget(scene, ..., psnr=40, ppp=26) -> Budget; its findings list effects modelled or left out, with sizes

A pilot (pilot.py) renders every n-th pixel at full resolution. The stricter of two limits holds:

    target:  white * 10^(-psnr / 20), rms of picture and truth clamped at white (clip/clamped_error.py), after blur
    sensor:  Monte-Carlo variance in electrons^2 at most 1 % of the shot variance: mean * sqrt(0.01 / (QE * PPP)), rms

Bounces and blur may each take 30 % of the allowed error (rms); the samples use the remainder.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clamped_error import Errors, Stated, white_in
from qsim.clip.motion_statistics import MOVING
from qsim.colour import bright_end, psnr
from qsim.host import own_numbers
from qsim.optics.camera import Camera
from qsim.optics.diffraction import diffraction_line
from qsim.optics.radiometry import WHITE_PER_MEAN
from qsim.rendering.budget import LIMIT, Allowed, Budget, Finding, blur_error, grid_samples, plane_grid
from qsim.rendering.denoiser import wording
from qsim.rendering.pilot import COUNTS, OF_PLANES, Pilot, Trials, denoised_samples, rests
from qsim.rendering.planes import most_planes
from qsim.rendering.reuse.sharing import Need, Sharing, shared_samples
from qsim.scene import Scene
from qsim.scene.bands import Bands

SHARE = 0.3  # of the allowed rms error, for the bounces left out and for the blur of finitely many instants
SENSOR_SHARE = 0.01  # of the shot variance that Monte-Carlo noise may add
DEPTHS = (2, 4, 6, 9, 12, 16, 24)  # bounces that are tried; each depth is a kernel to compile
DEEPEST = 32  # bounces of the reference for them
MOST_SAMPLES = 16384
PEAK_INSTANTS = 25  # whose mean gives the white of a blurred frame
MOST_INSTANTS = 3 + 6 * 85
BIAS = 0.01  # of the light, by which the noise of planes may lower the counts of binary planes
PLANES = "planes"  # the finding about frames that share noise
MOST_TRIED = 15  # instants up to which a larger number is rendered for comparison


@dataclass(frozen=True)
class Noise:
    """Errors of pilots with COUNTS samples [W m^-2 sr^-1], inter- and extrapolated by power laws."""

    at_white: tuple[float, ...]
    plain: tuple[float, ...]

    @classmethod
    def of(cls, pilots: list[Array], white: float) -> Noise:
        """Return the noise of pilots given as halves [2, times, H, W], one array per count."""
        errors = [Errors.of_halves(halves, white) for halves in pilots]
        return cls(_falling([e.at_white for e in errors]), _falling([e.plain for e in errors]))

    def times(self, factor: float) -> Noise:
        """Return the noise times a factor."""
        return Noise(*(tuple(factor * error for error in errors) for errors in (self.at_white, self.plain)))

    def at(self, samples: float, instants: int = 1) -> Errors:
        """Return the errors of the mean of `instants` instants with `samples` samples each."""
        return Errors(*(_error(errors, samples) / math.sqrt(instants) for errors in (self.at_white, self.plain)))


@own_numbers
def choose_budget(  # noqa: PLR0913 (settings of a public function)
    scene: Scene,
    *,
    frame_rate: float = 2000.0,
    shutter: float = 0.0,
    frames: int = 21,
    psnr: float = 40.0,
    ppp: float | None = None,
    quantum_efficiency: float = 1.0,
    planes: float = 1.0,
    codes: Sequence[int] = (),
    denoise: bool | None = None,
    reuse: bool | None = None,
    seed: int = 0,
) -> Budget:
    """Return the smallest budget with an error below `psnr` [dB] and, at `ppp` photons, below the sensor's noise.

    `ppp` is the highest light level at which the clip will be sensed; with None, only `psnr` counts. A code that sums
    `planes` frames of `ppp` photons each averages their noise. What repeats from frame to frame has a stricter limit,
    that of a code: left-out bounces, and all errors of frames that are denoised or share samples. `codes` are the
    frames in a code of each stream that will be sensed from frame 0 on. Sharp frames then share the noise of the code
    with the fewest (planes.py): `psnr` and `ppp` are asked of its mean light, and the middle of each code gets a sharp
    frame of the same `psnr`. `denoise` None denoises if Open Image Denoise is installed and cheaper at the same
    measured error.
    `reuse` None lets neighbouring frames share samples where that is predicted to cost less and the trial costs little
    against the clip; True tries it at any length, False renders each frame alone. The result depends only on the
    arguments and the installed software: an interrupted clip resumes with the same budget. `ValueError` for a `psnr`
    outside 10 to 80 dB, for other values out of range, and for a scene without light.
    """
    _check_wishes(psnr=psnr, frames=frames, denoise=denoise, reuse=reuse, ppp=ppp, planes=planes)
    if not 0 < quantum_efficiency <= 1:
        raise ValueError(f"quantum_efficiency: expected a number above 0, at most 1, got {quantum_efficiency!r}")
    summed, why_alone = planes_together(scene, codes, shutter, frames)
    if summed > 1:  # a code is the picture that has the errors asked for
        ppp = None if ppp is None else ppp * summed
        planes = max(1.0, planes / summed)
    pilot = Pilot.of(scene, frame_rate, shutter, frames, seed)
    full = pilot.mean(COUNTS[1], DEEPEST)
    if not full.mean() > 0:
        raise ValueError(
            f"scene {scene.name}: the pilot saw no light in frames {list(pilot.times)}; is a lamp behind a wall?"
        )
    # Noise raises the percentile of few samples, so white comes from the pilot with the most samples. Blur lowers the
    # white of small bright things, so with an open shutter it comes from the blurred pilot.
    blurs = shutter > 0 and not rests(scene)
    exposed = pilot.exposures(PEAK_INSTANTS, DEEPEST) if blurs else full
    rough, _ = allowed_in(exposed, psnr, ppp, quantum_efficiency, planes)
    bounces, cut, about_bounces = fewest_bounces(lambda depth: pilot.mean(COUNTS[1], depth), full, rough.repeated)
    left_out = Errors.between(cut, full, rough.white)
    halves = [pilot.halves(count, bounces) for count in COUNTS]
    bright = halves[-1].mean(axis=0)
    allowed, limit = allowed_in(exposed if blurs else bright, psnr, ppp, quantum_efficiency, planes)
    why = "nothing moves" if shutter else "the shutter is 0"
    instants = 1
    blurred = 0.0
    about_blur = Finding("motion blur", "none, one instant", why)
    if blurs:
        instants, blurred, about_blur = _blur(pilot, bright, allowed, bounces)
    strict = allowed.repeated
    # Independent errors add in squares: what bounces and blur leave of the allowed error is for the noise of samples.
    share = math.sqrt(1 - min(strict.fraction(left_out), SHARE) ** 2 - min(blurred, SHARE) ** 2)
    noise = Noise.of(halves, allowed.white).times(pilot.unevenness(instants))
    needed = _Work(bounces, instants, frames, share, allowed, noise)
    found = _shared_or_alone(pilot, needed, denoise, reuse if summed == 1 and not scene.see_through else False)
    chosen = found.chosen
    dimmed = dimming(full, cut)
    pixels = scene.camera.height * scene.camera.width
    # The error of the mean of all pixels, as a share of the light: that of one pixel over the root of their number.
    noisy = noise.at(chosen.samples / instants, instants).plain / math.sqrt(pixels) / float(full.mean())
    findings = (
        limit,
        deciding_limit(noise, chosen.samples, instants, allowed, psnr, ppp),
        *found.findings,
        about_bounces,
        _light(dimmed, noisy, bool(chosen.denoise)),
        moving(pilot.extent, shutter),
        about_blur,
        *flickering(pilot.renderer.strengths(frames), pilot.extent, instants),
        *_lens(scene.camera),
        *effects_left_out(scene.camera, pilot.truths(), scene.bands),
    )
    work = (chosen.samples, bounces, instants, instants > 1, bool(chosen.denoise))
    errors = (left_out.plain, left_out.at_white, allowed.white, *dimmed)
    budget = Budget(*work, *errors, findings, chosen.neighbours, chosen.denoise or "high")
    if summed == 1:
        return _with_finding(budget, Finding(PLANES, "each frame alone", why_alone)) if why_alone else budget
    shared = _planes(pilot, budget, replace(needed, instants=summed), denoise)
    if shared is not None:
        return replace(shared, codes=tuple(sorted(set(codes))))
    why_alone = f"{summed} sharp frames cost no more than a code of as many planes with its sharp frame"
    return _with_finding(budget, Finding(PLANES, "each frame alone", why_alone))


def _check_wishes(
    *, psnr: float, frames: int, denoise: bool | None, reuse: bool | None, ppp: float | None, planes: float
) -> None:
    """Raise `ValueError` for a wish outside its range."""
    if not 10 <= psnr <= 80:
        raise ValueError(f"psnr: expected 10 to 80 dB, got {psnr!r}")
    if frames < 1:
        raise ValueError(f"frames: expected a whole number from 1 up, got {frames!r}")
    for name, wish in (("denoise", denoise), ("reuse", reuse)):
        if not isinstance(wish, bool | None):
            raise ValueError(f"{name}: expected True, False or None, got {wish!r}")
    if ppp is not None and not 0 < ppp < math.inf:
        raise ValueError(f"ppp: expected photons per pixel above 0, or None, got {ppp!r}")
    if not 1 <= planes < math.inf:
        raise ValueError(f"planes: expected frames in a code from 1 up, got {planes!r}")


def planes_together(scene: Scene, codes: Sequence[int], shutter: float, frames: int) -> tuple[int, str]:
    """Return how many frames share the noise of a code, 1 if each has its own, and why although codes sum several."""
    fewest = min(codes, default=1)
    if fewest < 1:
        raise ValueError(f"codes: expected frames in a code from 1 up, got {fewest!r}")
    if max(codes, default=1) == 1:
        return 1, ""
    most = most_planes(scene.camera.height * scene.camera.width, 1 if scene.bands is None else 3)
    reasons = {
        "the shutter is open": shutter > 0,
        "a stream has one frame in a code, or codes whose rows or exposures differ": fewest == 1,
        f"the clip has fewer than {fewest} frames": frames < fewest,
        f"frames of this size leave memory for {most}, and a code has {fewest}": fewest > most,
    }
    why = next((reason for reason, holds in reasons.items() if holds), "")
    return (1, why) if why else (fewest, "")


def _planes(pilot: Pilot, sharp: Budget, work: _Work, denoise: bool | None) -> Budget | None:
    """Return the budget of `work.instants` planes with the noise of a code; None if it costs as much as sharp ones.

    `sharp` is the budget of a sharp frame with the error asked of a code.
    """
    count = work.instants
    raw = 2 * plane_grid(1)
    while work.allowed.fraction(_of_code(work.noise, count, raw, sharp.samples)) > work.share and raw < sharp.samples:
        raw = 2 * plane_grid(raw // 2 + 1)
    chosen = Sharing(raw * (count - 1) + sharp.samples, 0, "")
    how = "raw"
    if denoise is not False:
        trial = Trials(count, OF_PLANES, partial(_beside_sharp, count, sharp.samples))
        expected = partial(_of_each, work.noise, count)
        strict = work.allowed.repeated
        fewer, _ = denoised_samples(pilot, trial, work.bounces, strict, work.share, chosen.samples, denoise, expected)
        if fewer is not None:
            chosen = Sharing(fewer[0], 0, fewer[1])
            how = f"their mean denoised, {wording(fewer[1])}; {raw} without"
    each = (chosen.samples - sharp.samples) // (count - 1)
    # The mean of a code may be right while its planes are not: a binary
    # plane bends, and noise between planes lowers its counts.
    unbiased = each
    while planes_bias(work, unbiased, sharp.samples) > BIAS and unbiased < sharp.samples:
        unbiased = 2 * plane_grid(unbiased // 2 + 1)
    if unbiased > each:
        how += f"; {each} would lower the counts of binary planes by more than {100 * BIAS:g} %"
        each = unbiased
        chosen = replace(chosen, samples=each * (count - 1) + sharp.samples)
    pixels = pilot.renderer.scene.camera.height * pilot.renderer.scene.camera.width
    alone = Sharing.of(sharp).cost(pixels)
    # A code needs a sharp frame in its middle anyway, so planes have to be cheaper together with it.
    if chosen.cost(pixels) + alone - sharp.samples >= count * alone:
        return None
    size = f"{each} samples per pixel each, {how}; that in the middle has {sharp.samples}"
    if math.isfinite(work.allowed.sensor):
        bias = planes_bias(work, each, sharp.samples)
        size += f"; their noise lowers the counts of binary planes by {100 * bias:.2g} % of the light"
    else:
        size += "; without a light level, how far their noise lowers the counts of binary planes is not bounded"
    budget = replace(
        sharp,
        samples=each,
        denoise=bool(chosen.denoise),
        quality=chosen.denoise or "high",
        planes=count,
        sharp_samples=sharp.samples,
        sharp_quality=sharp.quality if sharp.denoise else "",
    )
    return _with_finding(budget, Finding(PLANES, f"{count} share the noise of a code", size))


def planes_bias(work: _Work, each: int, in_middle: int) -> float:
    """Return by which share of the light the noise of planes lowers the counts of a code of binary planes.

    A plane fires with 1 - exp(-photons): noise of s photons lowers its mean as s^2 / 2 photons less light would, to
    second order. Over a code that is half of the planes' variance over the shot variance, of which `allowed.sensor` is
    SENSOR_SHARE. A denoised mean leaves the noise of planes against each other. 0 without a light level.
    """
    raw = _of_code(work.noise, work.instants, each, in_middle).plain
    return (raw / work.allowed.sensor) ** 2 * SENSOR_SHARE / 2


def _with_finding(budget: Budget, finding: Finding) -> Budget:
    """Return a budget with a finding after those about errors."""
    limit = [each.effect for each in budget.findings].index(LIMIT) + 1
    return replace(budget, findings=(*budget.findings[:limit], finding, *budget.findings[limit:]))


def _of_code(noise: Noise, count: int, each: int, in_middle: int) -> Errors:
    """Return the errors of the mean of `count` planes with so many samples each, and more in the middle one."""
    others = noise.at(each)
    middle = noise.at(in_middle)
    return Errors(
        math.sqrt((count - 1) * others.at_white**2 + middle.at_white**2) / count,
        math.sqrt((count - 1) * others.plain**2 + middle.plain**2) / count,
    )


def _beside_sharp(count: int, in_middle: int, each: float) -> int:
    """Return the samples of a code whose planes have the noise of `each` samples each, if the middle one has more."""
    # Variances: (count - 1) / others + 1 / in_middle = count / each, solved for the samples of the others.
    left = count / each - 1 / in_middle
    others = (count - 1) / left if left > 0 else 2.0
    return (count - 1) * 2 * plane_grid(math.ceil(min(others, in_middle) / 2)) + in_middle


def _of_each(noise: Noise, count: int, samples: int) -> Errors:
    """Return the errors of the mean of `count` instants that have so many samples together."""
    return noise.at(samples / count, count)


def deciding_limit(
    noise: Noise, samples: int, instants: int, allowed: Allowed, psnr_asked: float, ppp: float | None
) -> Finding:
    """Return the finding about the stricter limit, of which the number of samples follows."""
    found = noise.at(samples / instants, instants)
    if ppp is None or found.at_white <= 0 or found.at_white / allowed.target >= found.plain / allowed.sensor:
        size = "the sensor sets no limit" if ppp is None else f"the noise at {ppp:g} photons per pixel allows more"
        return Finding(LIMIT, f"{psnr_asked:g} dB", size)
    needed = psnr(allowed.white, allowed.sensor * found.at_white / found.plain)
    return Finding(
        LIMIT, f"{ppp:g} PPP", f"1 % of the shot variance needs {needed:.1f} dB, {psnr_asked:g} were asked for"
    )


def _blur(pilot: Pilot, bright: Array, allowed: Allowed, bounces: int) -> tuple[int, float, Finding]:
    """Return `fewest_instants` of a scene that moves within its exposures; `bright` is its radiance, any shape."""
    low, high = (float(np.percentile(bright, share)) for share in (0.1, 99.9))
    contrast = allowed.fraction(Errors(min(high, allowed.white) - low, high - low))
    return fewest_instants(pilot.extent, contrast, lambda k: allowed.fraction(pilot.changes(k, bounces, allowed.white)))


@dataclass(frozen=True)
class _Work:
    """What is chosen before the samples, and the error that is left to them."""

    bounces: int
    instants: int
    frames: int
    share: float  # of the allowed error
    allowed: Allowed
    noise: Noise


@dataclass(frozen=True)
class _Chosen:
    """Samples, denoiser and neighbours, and the findings about them."""

    chosen: Sharing
    findings: tuple[Finding, Finding, Finding]


def _shared_or_alone(pilot: Pilot, work: _Work, denoise: bool | None, reuse: bool | None) -> _Chosen:
    """Return the cheapest of raw samples, denoised ones, and those that neighbouring frames share."""
    instants = work.instants
    strict = work.allowed.repeated
    noise = work.noise
    samples, about_samples = fewest_samples(noise, instants, work.allowed, work.share)
    fewer = None
    about_denoiser = Finding("denoiser", "off", "not requested")
    if denoise is not False:
        fewer, about_denoiser = denoised_samples(
            pilot,
            Trials(instants),
            work.bounces,
            strict,
            work.share,
            samples,
            denoise,
            lambda n: noise.at(n / instants, instants),
        )
    alone = Sharing(samples, 0, "")
    if fewer is not None:
        alone = Sharing(fewer[0], 0, fewer[1])
        about_samples = Finding("samples", f"{fewer[0]} per pixel, denoised", f"without: {about_samples.chosen}")
    need = Need(strict, work.share, work.bounces, work.frames, alone, noise.at)
    chosen, about_reuse = shared_samples(pilot, need, denoise, reuse)
    if chosen is not alone:
        size = f"frames alone: {about_samples.chosen}"
        about_samples = Finding("samples", f"{chosen.samples} per pixel{', denoised' if chosen.denoise else ''}", size)
        about_denoiser = Finding("denoiser", chosen.about_denoiser, "tried on shared samples")
    return _Chosen(chosen, (about_samples, about_denoiser, about_reuse))


def shortfall(reached: Stated | None, asked: float) -> str:
    """Return a message if the measured PSNR of a clip misses `asked` [dB] by more than chance (0.5 dB), else ""."""
    if reached is None or reached.psnr >= asked - 0.5:
        return ""
    why = "the pilot estimated less error or more light; request a higher psnr for more samples"
    return f"{reached.line}, where {asked:g} were requested: {why}"


def allowed_in(
    image: Array, psnr: float, ppp: float | None, efficiency: float, planes: float
) -> tuple[Allowed, Finding]:
    """Return the limits for a clip with the radiance of `image` (any shape, W m^-2 sr^-1), and the finding."""
    mean = float(image.mean())
    white = white_in(image)
    target = white * 10 ** (-psnr / 20)
    rule = f"{WHITE_PER_MEAN:g} x the mean" if white == WHITE_PER_MEAN * mean else "the 99.9th percentile"
    brighter = float((image > white).mean())
    text = f"{psnr:g} dB below white, {white:.3g} ({rule}): rms {target:.3g} = {100 * target / white:.2g} % of white"
    text += f"; {_percent(brighter)} of the pixels are brighter, picture and truth are clamped there, as in scores"
    sensor = math.inf
    if ppp is not None:
        # The relative shot noise of n electrons is 1 / root(n); the renderer may take SENSOR_SHARE of its variance.
        sensor = mean * math.sqrt(SENSOR_SHARE / (efficiency * ppp))
        text += f"; the sensor at {ppp:g} photons per pixel allows {sensor:.3g} without a clamp"
        text += f", {sensor / math.sqrt(planes):.3g} of errors that repeat within a code" if planes > 1 else ""
    allowed = Allowed(white, target, sensor, planes)
    return allowed, Finding("error", f"rms {min(target, sensor):.3g} W/m2/sr", text)


def fewest_bounces(cut_at: Callable[[int], Array], full: Array, allowed: Allowed) -> tuple[int, Array, Finding]:
    """Return the smallest depth within SHARE of the allowed error of DEEPEST, its radiance, and the finding.

    `cut_at(depth)` and `full` are the pilot's radiance from the same paths, [times, H, W], W m^-2 sr^-1.
    """
    for bounces in DEPTHS:
        cut = cut_at(bounces)
        left_out = Errors.between(cut, full, allowed.white)
        if allowed.fraction(left_out) <= SHARE:
            break
    else:
        # Deeper bounces add less than the last step did; that step is stated in their place.
        size = f"the last {DEEPEST - bounces} added rms {left_out.plain:.2g}, more than allowed; "
        return DEEPEST, cut, Finding("bounces", f"{DEEPEST}", size + "deeper ones were not tried")
    size = f"later bounces up to {DEEPEST} would add rms {left_out.at_white:.2g}, {left_out.plain:.2g} without a clamp"
    return bounces, cut, Finding("bounces", f"{bounces}", size)


def dimming(full: Array, cut: Array) -> tuple[float, float]:
    """Return the fraction of the mean light missing in `cut` against `full` (same paths), and its standard error."""
    missing = full - cut
    return float(missing.mean() / full.mean()), float(missing.std() / math.sqrt(missing.size) / full.mean())


def _light(dimmed: tuple[float, float], noisy: float, denoises: bool) -> Finding:
    """Return the expected deviation of a frame's mean light; `noisy` is its random part, as a fraction."""
    low, error = (100 * share for share in dimmed)
    size = (
        f"the bounces left out, known to +- {error:.2g} %; beside that the noise of a frame's mean, {100 * noisy:.2g} %"
    )
    kept = ", that of its raw samples, which denoising keeps" if denoises else ""
    return Finding("mean light", f"{low:.2g} % too low" if low else "all of it", size + kept)


def moving(extent: Array, shutter: float) -> Finding:
    """Return the fraction of moving pixels, with mean and largest motion; `extent` as in `Pilot`."""
    speed = extent / (shutter or 1.0)
    fast = speed[speed > MOVING]
    size = f"more than {MOVING:g} px/frame"
    if fast.size:
        fastest = max(map(bright_end, speed))
        size += f"; those by {fast.mean():.3g} on average, 99.9 % of all pixels by at most {fastest:.3g}"
    return Finding("motion", f"{_percent(fast.size / speed.size)} of the pixels move", size)


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def fewest_instants(extent: Array, contrast: float, changes: Callable[[int], float]) -> tuple[int, float, Finding]:
    """Return the number of instants (3, 9, 15 ...), the part of the allowed error that their blur takes, and a finding.

    The first estimate comes from the motion `extent` [frames, H, W] in px, in the frame with the most motion. Shadows,
    lamps and reflections also move on surfaces at rest. The number therefore grows until `changes(K)`, the difference
    between the means of K and of more instants, is at most SHARE. `changes` and `contrast` (of the picture) are
    fractions of the allowed error.
    """
    fastest = max(map(bright_end, extent))
    runs = float((extent > 0.1).mean(axis=(1, 2)).max())
    # Only the pixels of edges that move are wrong: their share of the frame thins out the rms error.
    edge = SHARE / max(contrast * math.sqrt(runs), 1e-300)
    count = 3
    while blur_error(fastest, count) > edge and count < MOST_INSTANTS:
        count += 6  # 3, 9, 15 ...: one instant lies at mid-exposure, and every third shows what more would change
    by_motion = count
    tried = {}
    while count <= MOST_TRIED:
        tried[count] = changes(count)
        if tried[count] <= SHARE:
            break
        count += 6
    found = tried.get(count, 0.0)
    power = 1.0
    if tried and count not in tried:  # extrapolate by the power of the trials
        few = min(tried)
        most = max(tried)
        if few < most:
            power = min(max(math.log(tried[few] / tried[most]) / math.log(most / few), 0.5), 2.0)
        wanted = min(most * (tried[most] / SHARE) ** (1 / power), MOST_INSTANTS)
        count = max(count, 3 + 6 * math.ceil((wanted - 3) / 6))
        found = tried[most] * (most / count) ** power
    blurred = max(blur_error(fastest, count) * math.sqrt(runs) * contrast, found)
    size = f"motion up to {fastest:.2f} px in the exposure in 99.9 % of the pilot's pixels"
    size += f"; an edge so fast errs by {100 * blur_error(fastest, count):.2g} %"
    if count > by_motion:
        size += f"; {by_motion} for what is seen moving, the rest for light and shadow that move on it"
    if tried:
        size += f"; more than {max(tried)} would change {_percent(tried[max(tried)])} of the error allowed"
    if count >= MOST_INSTANTS:
        size += f", the limit of {MOST_INSTANTS} instants is reached"
    return count, blurred, Finding("motion blur", f"mean of {count} instants", size)


def _falling(errors: list[float]) -> tuple[float, ...]:
    """Return the rms errors of pilots with COUNTS samples, raised to those that follow from larger pilots.

    Small pilots miss rare bright paths: fewer samples have an error of at least 1 / sqrt(n) times that of more.
    """
    for i in (1, 0):
        errors[i] = max(errors[i], errors[i + 1] * math.sqrt(COUNTS[i + 1] / COUNTS[i]))
    return tuple(errors)


def fewest_samples(noise: Noise, instants: int, allowed: Allowed, share: float) -> tuple[int, Finding]:
    """Return the samples per pixel and frame whose noise takes at most `share` of the allowed error, and a finding."""
    each = 2 * grid_samples(1)
    if min(noise.plain) <= 0:
        return each * instants, Finding("samples", f"{each * instants} per pixel", "the pilot found no noise")
    while allowed.fraction(noise.at(each, instants)) > share and each * instants < MOST_SAMPLES:
        each = 2 * grid_samples(each // 2 + 1)
    expected = noise.at(each, instants)
    size = f"expected rms {expected.at_white:.2g} = {psnr(allowed.white, expected.at_white):.1f} dB"
    size += f", without a clamp {psnr(allowed.white, expected.plain):.1f} dB"
    if allowed.fraction(expected) > share:
        size += f", the limit of {MOST_SAMPLES} samples is reached"
    return each * instants, Finding("samples", f"{each * instants} per pixel", size)


def _error(errors: tuple[float, ...], samples: float) -> float:
    """Return the error by a power law through the two nearest pilots; beyond them, with a power of 0.5 to 0.75."""
    if min(errors) <= 0:
        return 0.0
    i = 0 if samples <= COUNTS[1] else 1
    # Errors of independent samples fall with the power 1/2. Stratified
    # samples fall faster at first, and rare bright paths slower.
    power = math.log(errors[i] / errors[i + 1]) / math.log(COUNTS[i + 1] / COUNTS[i])
    if samples > COUNTS[-1]:
        power = min(max(power, 0.5), 0.75)
    return float(errors[i + 1] * (samples / COUNTS[i + 1]) ** -power)


def flickering(strengths: dict[str, Array], extent: Array, instants: int) -> tuple[Finding, ...]:
    """Return findings for lights that flicker: their strengths [frames] over the exposures, and what these blur.

    Three instants share their mean light: the motion within them (`extent` as in `Pilot`) is in no stated error.
    """
    if not strengths:
        return ()
    sizes = [f"{name} {found.min():.3g} to {found.max():.3g} of its mean" for name, found in strengths.items()]
    exact = Finding("flicker", "exact mean over each exposure", ", ".join(sizes))
    if instants == 1:
        return (exact,)
    within = 3 / instants * max(map(bright_end, extent))
    size = f"the fastest pixels move {within:.2g} px within them, not counted in the stated error"
    return exact, Finding("flicker and motion", f"light averaged over 3 of {instants} instants", size)


def _lens(camera: Camera) -> tuple[Finding, ...]:
    """Return a finding for a lens that is not ideal: how far it moves the corner, and the light left there."""
    if camera.zoom is not None:
        views = [camera.at(t) for t in camera.zoom.times]
        shown = sorted(view.focal_pixels for view in views)
        size = f"focal length {shown[0]:.4g} to {shown[-1]:.4g} px, with a distortion that changes alike"
        return (Finding("lens", "exact rays", size),)
    if camera.lens is None:
        return ()
    away = [max((at, at - size), key=abs) for at, size in zip(camera.axis, (camera.width, camera.height), strict=True)]
    corner = -np.array(away) / camera.focal_pixels
    ideal = camera.lens.traced(corner) * (camera.aspect, 1.0)
    moved = float(np.hypot(*corner) - np.hypot(*ideal)) * camera.focal_pixels
    share = float(camera.lens.illumination(corner, natural=camera.vignetting))
    return (Finding("lens", "exact rays", f"corner moved by {moved:+.3g} px, with {100 * share:.3g} % of the light"),)


def effects_left_out(camera: Camera, truths: list[dict[str, Array]], bands: Bands | None = None) -> tuple[Finding, ...]:
    """Return findings for effects that the renderer leaves out, with their size where it can be computed."""
    depths = np.concatenate([truth["depth"].ravel() for truth in truths])
    depths = np.where(np.isinf(depths), 1e9, depths)  # the surroundings
    depths = depths[depths > camera.focal_length]
    views = [camera] if camera.zoom is None else [camera.at(t) for t in camera.zoom.times]
    blur = max(float(np.max(view.circle_of_confusion(depths), initial=0.0)) for view in views)
    how = "thin lens" if camera.aperture_blur else "left out, pinhole"
    return (
        Finding("depth of field", how, f"largest blur circle {blur:.2g} px at f/{camera.f_number:g}"),
        Finding("diffraction", "left out here", diffraction_line(camera, bands)),
        Finding("lens aberrations, polarisation, spectra", "not modelled", "size unknown"),
    )
