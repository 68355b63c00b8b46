"""Draws the first two figures of the QUIVER paper (ECCV 2024) from our scenes, as pictures and numbers.

Figure 1: one motion and light level, seen by CMOS pixels of 5.1 e- at 60, 240 and 2000 fps and by a 3-bit QIS at
2000 fps. Figure 2: binary planes at 10 000 fps averaged to 3, 5, 7 and 9 bits, at two light levels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray as Array

from qsim import colour, keys
from qsim.clip.clamped_error import rms
from qsim.figures import figure_png, new_figure
from qsim.sensor import devices
from qsim.sensor.spad import BinarySPAD
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons, light_level
from qsim.studies.bit_depth.clip_study import check_clip, clip_motion, expose
from qsim.studies.bit_depth.readout import Readout, StudySettings

RATE_1 = 12_000.0  # fps of the clip of figure 1: 200, 50 and 6 of its frames are one at 60, 240 and 2000 fps
CAMERAS = (("cmos-5.1e", 60.0), ("cmos-5.1e", 240.0), ("cmos-5.1e", 2000.0), ("quiver-paper", 2000.0))
BITS_2 = (1, 3, 5, 7, 9)


@dataclass(frozen=True, eq=False)
class Panel:
    """One picture: an estimate of the light [photons per pixel and clip frame], with its scores."""

    label: str
    image: Array  # [H, W]
    numbers: Mapping[str, float | int | str | None]


def figure_1(clip: Clip, *, lux: float = 1.0, seed: int = 0) -> list[Panel]:
    """Return frames of four cameras around the middle of a clip of 12 000 fps (at least 200 frames, with a camera)."""
    for _, fps in CAMERAS:
        if not math.isclose(clip.frame_rate / fps, round(clip.frame_rate / fps)):
            raise ValueError(
                f"{clip.path}: {clip.frame_rate:g} fps is not a whole multiple of {fps:g} fps; "
                f"render the clip at {RATE_1:g} fps"
            )
    longest = round(clip.frame_rate / min(fps for _, fps in CAMERAS))
    if len(clip) < longest:
        raise ValueError(f"{clip.path}: {len(clip)} frames; one frame at 60 fps needs {longest}; render a longer clip")
    level = light_level(clip, lux=lux)
    middle = len(clip) // 2
    sharp = clip_photons(clip, middle, level.factor, sharp=True)
    peak = colour.peak(sharp)
    speed = clip_motion(clip, middle)
    panels = [Panel("sharp instant", sharp, {"ppp": level.ppp, "lux": lux, "peak": peak})]
    key = keys.Key(seed=seed, clip=keys.hash_name(clip.name), frame=middle)
    for name, fps in CAMERAS:
        n = round(clip.frame_rate / fps)
        first = middle - n // 2
        light = np.sum([clip_photons(clip, t, level.factor) for t in range(first, first + n)], axis=0)
        sensor = devices.load(name, exposure=n * clip.exposure)
        codes = sensor.sample(light, n * clip.exposure, key=key, origin=clip.origin)
        found, where = np.unique(codes, return_inverse=True)  # few of the 1024 codes of a deep pixel occur
        estimates = sensor.maximum_likelihood(found[:, None] == np.arange(sensor.levels), n * clip.exposure).photons
        image = estimates[where].reshape(codes.shape) / n
        numbers: dict[str, float | int | str | None] = {
            "sensor": name,
            "bits": sensor.bits,
            "fps": fps,
            "motion_px_per_frame": None if speed is None else n * speed,
            "photons_per_frame": float(light.mean()),
            "electrons_per_frame": float(sensor.efficiency * light.mean()),
            "blur_over_peak": rms(light / n - sharp) / peak,
            "psnr_db": colour.psnr(peak, rms(image - sharp)),
        }
        panels.append(Panel(f"{name}, {fps:g} fps", image, numbers))
    return panels


def figure_2(clip: Clip, ppp: float, *, seed: int = 0, bits: Sequence[int] = BITS_2) -> list[Panel]:
    """Return sums of 2^b - 1 binary planes around the middle of a clip; `ppp` counts detections per pixel and plane."""
    settings = StudySettings(bits=tuple(bits), sensor="spad-320x240", ppp=ppp, seed=seed)
    check_clip(clip, settings)
    level = light_level(clip, ppp=ppp)
    middle = len(clip) // 2
    sharp = clip_photons(clip, middle, level.factor, sharp=True)
    peak = colour.peak(sharp)
    speed = clip_motion(clip, middle)
    panels = [Panel("sharp instant", sharp, {"ppp": ppp, "peak": peak})]
    plane = BinarySPAD(1.0, 0.0)
    nothing = np.zeros(2 ** settings.bits[-1] - 1)
    everywhere = np.ones(sharp.shape, bool)
    exposed = expose(clip, middle, settings, level.factor, plane, nothing, everywhere)
    for b, frame in zip(settings.bits, exposed, strict=True):
        m = frame.planes
        image = Readout("planes", b, plane, clip.exposure).estimates[frame.fired.astype(np.intp)] / m
        numbers = {
            "bits": b,
            "fps": clip.frame_rate / m,
            "motion_px_per_frame": None if speed is None else m * speed,
            "detections_per_pixel": float(frame.fired.mean()),
            "blur_over_peak": rms(frame.photons / m - sharp) / peak,
            "psnr_db": colour.psnr(peak, rms(image - sharp)),
        }
        shown = replace(plane, bits=b)
        panels.append(
            Panel(f"{b} bit, {clip.frame_rate / m:.4g} fps", image, numbers | {"white": shown.white(1.0) / m})
        )
    return panels


def draw(rows: Sequence[Sequence[Panel]]) -> bytes:
    """Return the panels as PNG, one clip per line; the sharp instant of a line gives its white."""
    columns = max(len(row) for row in rows)
    _, width = rows[0][0].image.shape
    shape = rows[0][0].image.shape[0] / width
    drawing = new_figure(2.6 * columns, (2.6 * shape + 0.55) * len(rows))
    for line, row in zip(drawing.subplots(len(rows), columns, squeeze=False), rows, strict=True):
        for axes, panel in zip(line, row, strict=True):
            peak = float(row[0].numbers["peak"])  # type: ignore[arg-type]  # of the sharp instant, always a number
            axes.imshow(colour.tone(panel.image, peak), cmap="gray", vmin=0, vmax=255)
            axes.set_axis_off()
            score = panel.numbers.get("psnr_db")
            motion = panel.numbers.get("motion_px_per_frame")
            title = panel.label
            if score is not None:
                title += f"\n{score:.1f} dB"
                title += "" if motion is None else f", {motion:.2g} px"
            axes.set_title(title, fontsize=8)
    return figure_png(drawing)
