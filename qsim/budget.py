"""How much work a scene needs: bounces, instants per exposure and samples, from the error that is asked for.

    choose(scene, ..., psnr=40, ppp=26) -> Budget;  explain(budget) -> what is modelled, left out, and how large it is

A pilot (pilot.py) looks at every n-th pixel in its true size. The allowed rms error E is the stricter of

    target:  peak * 10^(-psnr / 20), peak = 99.9th percentile of the radiance, blurred as it will be
    sensor:  Monte-Carlo variance in electrons^2 at most 1 % of the shot variance: mean * sqrt(0.01 / (QE * PPP))

and is shared: bounces and blur may each take 30 % of it (rms), the samples get all that those leave.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy import ndarray as Array

if TYPE_CHECKING:
    from qsim.scene import Camera, Scene

SHARE = 0.3  # of the allowed rms error, for the bounces left out and for the blur of finitely many instants
SENSOR_SHARE = 0.01  # of the shot variance that Monte-Carlo noise may add
DEPTHS = (2, 4, 6, 9, 12, 16, 24)  # bounces tried, against (each depth is a kernel to compile)
DEEPEST = 32
COUNTS = (8, 32, 128)  # samples of the pilots: 2x2, 4x4 and 8x8 in each half
MOST_SAMPLES = 16384
PEAK_INSTANTS = 25  # whose mean tells how bright the exposure of a frame is
MOST_INSTANTS = 3 + 6 * 85
MOST_TRIED = 15  # instants up to which more are tried against them


@dataclass(frozen=True)
class Finding:
    """One thing that a clip models or leaves out, and how large the rest is."""

    effect: str
    chosen: str
    size: str


@dataclass(frozen=True)
class Budget:
    """What a frame costs, and why; the same record is stored in clip.json."""

    samples: int = 32  # per pixel and frame, all instants and both halves together
    bounces: int = 6  # scatterings along a path
    sub_frames: int = 9  # instants per exposure when the shutter is open; their error is measured if 3, 6, 9 ...
    sharp: bool = True  # also render the instant at mid-exposure when the shutter is open
    denoise: bool = False  # Open Image Denoise; its error is measured against raw halves
    left_out: float = 0.0  # W m^-2 sr^-1, rms of later bounces by the pilot; part of the error that a frame states
    findings: tuple[Finding, ...] = field(default=())

    def __post_init__(self) -> None:
        for name in ("samples", "bounces", "sub_frames"):
            if getattr(self, name) < 1:
                raise ValueError(f"Budget.{name}: at least 1, got {getattr(self, name)!r}")

    def grid(self, instants: int) -> int:
        """Samples per pixel of each half at each of these instants."""
        return grid_samples(math.ceil(self.samples / instants / 2))


def choose(
    scene: Scene,
    *,
    frame_rate: float = 2000.0,
    shutter: float = 0.0,
    frames: int = 21,
    psnr: float = 40.0,
    ppp: float | None = None,
    quantum_efficiency: float = 1.0,
    denoise: bool | None = None,
    seed: int = 0,
) -> Budget:
    """The smallest budget that keeps the error below `psnr` [dB] and, at `ppp` photons, below the sensor's noise.

    `ppp` is the highest light level that the clip will be sensed at (None: only `psnr` counts). `denoise` None means:
    where it is installed and, at the same measured error, cheaper. Depends on nothing but its arguments and on what is
    installed, so that an interrupted clip is continued with the same budget.
    """
    if not 10 <= psnr <= 80:
        raise ValueError(f"psnr: 10 to 80 dB can be asked for, got {psnr!r}")
    from qsim.pilot import Pilot, denoised_samples, rests  # which renders budgets

    pilot = Pilot.of(scene, frame_rate, shutter, frames, seed)
    full = pilot.mean(COUNTS[1], DEEPEST)
    if not full.mean() > 0:
        raise ValueError(
            f"scene {scene.name}: the pilot saw no light in frames {list(pilot.times)}; is a lamp behind a wall?"
        )
    # Noise lifts the percentile of few samples: the peak that counts is that of the pilot with the most. Blur lowers it
    # where what is bright is small: with an open shutter it is that of the blurred pilot.
    blurs = shutter > 0 and not rests(scene)
    exposed = np.stack([pilot.blurred(t, PEAK_INSTANTS, DEEPEST).mean(axis=0) for t in pilot.times]) if blurs else full
    rough, _ = _allowed(exposed, psnr, ppp, quantum_efficiency)
    bounces, dimmed, about_bounces = _bounces(lambda depth: pilot.mean(COUNTS[1], depth), full, SHARE * rough)
    halves = [pilot.halves(count, bounces) for count in COUNTS]
    bright = halves[-1].mean(axis=0)
    allowed, limit = _allowed(exposed if blurs else bright, psnr, ppp, quantum_efficiency)
    contrast = float(np.percentile(bright, 99.9) - np.percentile(bright, 0.1))
    instants, blurred, about_blur, share = 1, 0.0, _motion(pilot.travel, shutter), SHARE * allowed
    if blurs:
        instants, blurred, about_blur = _instants(pilot.travel, share, contrast, lambda k: pilot.changes(k, bounces))
    noise = math.sqrt(allowed**2 - min(dimmed, share) ** 2 - min(blurred, share) ** 2)
    errors = _errors(halves)
    samples, about_samples = _samples(errors, instants, noise, float(np.percentile(bright, 99.9)))
    fewer, about_denoiser = None, Finding("denoiser", "off", "not asked for")
    if denoise is not False:
        fewer, about_denoiser = denoised_samples(
            pilot, instants, bounces, noise, samples, denoise, lambda n: _error(errors, n / instants) / instants**0.5
        )
    if fewer is not None:
        samples = fewer
        about_samples = Finding("samples", f"{samples} per pixel, denoised", f"without: {about_samples.chosen}")
    lens = _left_out(scene.camera, pilot.truths())
    findings = (limit, about_samples, about_denoiser, about_bounces, about_blur, *lens)
    return Budget(samples, bounces, instants, instants > 1, fewer is not None, dimmed, findings)


def explain(budget: Budget) -> str:
    """What was modelled, what was left out, and how large it would have been; one line each."""
    width = max((len(finding.effect) for finding in budget.findings), default=0)
    return "\n".join(f"{f.effect:{width}}  {f.chosen}; {f.size}" for f in budget.findings)


def shortfall(reached: float | None, asked: float) -> str:
    """What to say of a clip whose measured PSNR misses the one asked for by more than chance, 0.5 dB; else nothing."""
    if reached is None or reached >= asked - 0.5:
        return ""
    why = "the pilot foresaw less error or brighter highlights; a higher psnr takes more samples"
    return f"{reached:.1f} dB where {asked:g} were asked for: {why}"


def grid_samples(samples: int) -> int:
    """The next size of an even number of cells, nearly square: 4, 6, 8, 12, 16, 20, 24, 30, 36, 42, 48, 56, 64, ...

    Multijitter does worse on squares of odd numbers: measured under sun and sky, error * samples^0.7 is 0.012 to 0.015
    at 4, 16, ... 144, but 0.018 to 0.028 at 9, 25, ... 121. On all others it is alike: at 4, 6, 8, 12, 16, 20 and 24
    samples it stays within 5 % of its mean (fan, tumble, gears, flag, crowd).
    """
    size = max(4, samples)
    while not _is_grid(size):
        size += 1
    return size


def _is_grid(size: int) -> bool:
    """Whether multijitter, whose grid is isqrt(size) high, holds just that many, evenly and nearly square."""
    high = math.isqrt(size)
    return size % 2 == 0 and size % high == 0 and size // high - high <= 2


def blur_error(travel: float, instants: int) -> float:
    """Largest error of the mean of K instants at a moving edge, as a share of its contrast.

    An edge that travels m px in the exposure steps by d = m / K. While d < 1 px, a pixel's coverage is piecewise linear
    in time and the midpoint rule errs by at most d^2 / (8 m) per kink; coarser steps leave separate ghosts of 1 / K.
    """
    step = travel / instants
    return step**2 / (8 * travel) if 0 < step <= 1 else 1 / instants if step > 1 else 0.0


def _allowed(image: Array, psnr: float, ppp: float | None, efficiency: float) -> tuple[float, Finding]:
    """The stricter of the two limits [W m^-2 sr^-1]."""
    peak, mean = float(np.percentile(image, 99.9)), float(image.mean())
    target = peak * 10 ** (-psnr / 20)
    text = f"target {psnr:g} dB allows {target:.3g}"
    allowed = target
    if ppp is not None:
        sensor = mean * math.sqrt(SENSOR_SHARE / (efficiency * ppp))
        allowed = min(target, sensor)
        text += f", the sensor at {ppp:g} photons per pixel {sensor:.3g}"
    return allowed, Finding("error", f"rms {allowed:.3g} W/m2/sr", f"{text}; peak {peak:.3g}, mean {mean:.3g}")


def _bounces(cut_at: Callable[[int], Array], full: Array, tolerance: float) -> tuple[int, float, Finding]:
    """The smallest depth whose radiance differs from that of DEEPEST by an rms below the tolerance; and that rms.

    `cut_at(depth)` and `full` are the pilot's radiance from the same paths, W m^-2 sr^-1.
    """
    for bounces in DEPTHS:
        cut = cut_at(bounces)
        left_out = float(np.sqrt(np.mean((full - cut) ** 2)))
        if left_out <= tolerance:
            break
    else:
        # What lies beyond is not known; it is less than what the last step added, which takes its place.
        size = f"the last {DEEPEST - bounces} added rms {left_out:.2g}, more than allowed; deeper ones were not tried"
        return DEEPEST, left_out, Finding("bounces", f"{DEEPEST}", size)
    share = 100 * float((full - cut).mean() / full.mean())
    size = f"later bounces up to {DEEPEST} would add rms {left_out:.2g} ({share:.2g} % of the light)"
    return bounces, left_out, Finding("bounces", f"{bounces}", size)


def _motion(travel: Array, shutter: float) -> Finding:
    """What the pilot sees move [frames, H, W], px in the exposure, in words; nothing is blurred."""
    fastest = float(np.percentile(travel, 99.9, axis=(1, 2)).max()) / (shutter or 1.0)
    size = f"motion up to {fastest:.2f} px/frame in 99.9 % of the pilot's pixels, "
    return Finding("motion blur", "none, one instant", size + ("nothing moves" if shutter else "shutter 0"))


def _instants(
    travel: Array, tolerance: float, contrast: float, changes: Callable[[int], float]
) -> tuple[int, float, Finding]:
    """Instants (3, 9, 15 ...), rms error of the blur that they leave [W m^-2 sr^-1] and the finding.

    First from the travel of what is seen, px [frames, H, W], in the frame where most of it moves farthest; then, since
    shadows, lamps and reflections move on surfaces at rest, more until `changes(K)`, the measured rms difference
    between the means of K and of more instants, is below the tolerance.
    """
    fastest = float(np.percentile(travel, 99.9, axis=(1, 2)).max())
    moving = float((travel > 0.1).mean(axis=(1, 2)).max())
    edge = tolerance / max(contrast * math.sqrt(moving), 1e-300)
    count = 3
    while blur_error(fastest, count) > edge and count < MOST_INSTANTS:
        count += 6  # 3, 9, 15 ...: one instant lies at mid-exposure, and every third shows what more would change
    by_motion, tried = count, {}
    while count <= MOST_TRIED:
        tried[count] = changes(count)
        if tried[count] <= tolerance:
            break
        count += 6
    found, power = tried.get(count, 0.0), 1.0
    if tried and count not in tried:  # beyond the last trial the difference falls as it did before, or as ghosts do
        few, most = min(tried), max(tried)
        if few < most:
            power = min(max(math.log(tried[few] / tried[most]) / math.log(most / few), 0.5), 2.0)
        wanted = min(most * (tried[most] / tolerance) ** (1 / power), MOST_INSTANTS)
        count = max(count, 3 + 6 * math.ceil((wanted - 3) / 6))
        found = tried[most] * (most / count) ** power
    blurred = max(blur_error(fastest, count) * math.sqrt(moving) * contrast, found)
    size = f"motion up to {fastest:.2f} px in the exposure in 99.9 % of the pilot's pixels"
    size += f"; an edge so fast errs by {100 * blur_error(fastest, count):.2g} %"
    if count > by_motion:
        size += f"; {by_motion} for what is seen moving, the rest for light and shadow that move on it"
    if tried:
        size += f"; more than {max(tried)} would change rms {tried[max(tried)]:.2g}"
    if count >= MOST_INSTANTS:
        size += f", the limit of {MOST_INSTANTS} instants is reached"
    return count, blurred, Finding("motion blur", f"mean of {count} instants", size)


def _errors(pilots: list[Array]) -> list[float]:
    """The rms errors of pilots, given as halves [2, times, H, W] with COUNTS samples.

    Paths that are rare and bright are missed by small pilots: fewer samples err at least as 1 / sqrt(n) makes it.
    """
    errors = [float(np.sqrt(np.mean((halves[0] - halves[1]) ** 2))) / 2 for halves in pilots]
    for i in (1, 0):
        errors[i] = max(errors[i], errors[i + 1] * math.sqrt(COUNTS[i + 1] / COUNTS[i]))
    return errors


def _samples(errors: list[float], instants: int, target: float, peak: float) -> tuple[int, Finding]:
    """Samples per pixel and frame; the error between the pilots' counts is taken as a power of the samples."""
    each = 2 * grid_samples(COUNTS[0] // 2)
    if min(errors) <= 0:
        return each * instants, Finding("samples", f"{each * instants} per pixel", "the pilot found no noise")
    while _error(errors, each) > target * math.sqrt(instants) and each * instants < MOST_SAMPLES:
        each = 2 * grid_samples(each // 2 + 1)
    expected = _error(errors, each) / math.sqrt(instants)
    size = f"expected rms {expected:.2g} = {20 * math.log10(peak / expected):.1f} dB"
    if expected > target:
        size += f", the limit of {MOST_SAMPLES} samples is reached"
    return each * instants, Finding("samples", f"{each * instants} per pixel", size)


def _error(errors: list[float], samples: float) -> float:
    """Error at a number of samples: a power law through the two nearest pilots, beyond them 0.5 to 0.75."""
    if min(errors) <= 0:
        return 0.0
    i = 0 if samples <= COUNTS[1] else 1
    power = math.log(errors[i] / errors[i + 1]) / math.log(COUNTS[i + 1] / COUNTS[i])
    if samples > COUNTS[-1]:
        power = min(max(power, 0.5), 0.75)
    return float(errors[i + 1] * (samples / COUNTS[i + 1]) ** -power)


def _left_out(camera: Camera, truths: list[dict[str, Array]]) -> tuple[Finding, ...]:
    """Effects that the renderer does not draw, with their size where the pilot knows it."""
    from qsim import optics

    depths = np.concatenate([truth["depth"].ravel() for truth in truths])
    depths = depths[np.isfinite(depths) & (depths > camera.focal_length)]
    focus = camera.focus
    # Circle of confusion of a thin lens: (f^2 / N) / (s - f) * |z - s| / z.
    circle = camera.focal_length**2 / camera.f_number / abs(focus - camera.focal_length)
    blur = float(np.max(circle * np.abs(depths - focus) / depths, initial=0.0)) / camera.pixel_pitch
    how = "thin lens" if camera.aperture_blur else "left out, pinhole"
    return (
        Finding("depth of field", how, f"largest blur circle {blur:.2g} px at f/{camera.f_number:g}"),
        Finding("diffraction", "left out here", optics.diffraction_line(camera)),
        Finding("lens aberrations, polarisation, spectra", "not modelled", "size unknown"),
    )
