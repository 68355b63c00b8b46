"""Builds the page on which the sensor of a clip is explored with sliders; its codes are drawn in the browser.

The page holds the light of a few frames and the laws of qsim/sensor as a script (templates/sensor_law.js). The script
draws every code pixel by pixel from the exact law of its light. Left out of the page: defects of pixels, full well,
offset, paralyzable counters, and light that changes within the exposure of a SPAD.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np
from numpy.typing import NDArray

from qsim.report.clip_section import motion
from qsim.report.html import environment, script
from qsim.sensor import devices
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons, light_level

FRAMES = 16  # largest number on a page, and of frames per code
PIXELS = 1 << 15  # largest number in a frame; larger pictures are reduced by a whole factor
BRIGHTEST = 200.0  # photons per pixel and frame at the right end of the slider
BITS = 8  # the largest number of bits on the page
_STEPS = 65_535  # of the stored light


@dataclass(frozen=True)
class StoredLight:
    """Light of frames, relative to the mean of the clip, in 16 bits on a square-root scale.

    Rounding errs by at most sqrt(light brightest) / 65535: a fixed share of the photon noise at every light.
    """

    steps: NDArray[np.uint16]  # [T, h, w]
    brightest: float  # relative light of step 65535
    rows: int  # of the clip in one row of the page
    columns: int  # of the clip in one column of the page

    def noise_share(self, ppp: float) -> float:
        """Return the largest rounding error over the photon noise, at `ppp` mean photons per pixel and frame."""
        return sqrt(self.brightest * ppp) / _STEPS

    def light(self) -> NDArray[np.float64]:
        """Return the relative light [T, h, w] that the page reads."""
        return self.brightest * (self.steps / _STEPS) ** 2


def stored_light(clip: Clip) -> StoredLight:
    """Return the light of the first frames of a clip; `ValueError` for a black clip."""
    clip.require_one_band("the page of sliders")
    factor = light_level(clip, ppp=1.0).factor
    _, height, width = clip.shape
    step = ceil(sqrt(height * width / PIXELS))
    rows = min(step, height)
    columns = min(step, width)
    frames = np.stack([_reduced(clip_photons(clip, t, factor), rows, columns) for t in range(min(len(clip), FRAMES))])
    brightest = float(frames.max()) or 1.0
    return StoredLight(np.rint(_STEPS * np.sqrt(frames / brightest)).astype(np.uint16), brightest, rows, columns)


def _reduced(frame: NDArray[np.floating], rows: int, columns: int) -> NDArray[np.float64]:
    """Return the means [H // rows, W // columns] of blocks of a frame [H, W]; incomplete blocks are cut off."""
    height = frame.shape[0] // rows
    width = frame.shape[1] // columns
    blocks = frame[: height * rows, : width * columns].reshape(height, rows, width, columns)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float64))


def explore_page(clip: Clip) -> str:
    """Return the page of a clip as HTML; it loads nothing from elsewhere. `ValueError` for a black clip."""
    stored = stored_light(clip)
    frames, height, width = stored.steps.shape
    mean = motion(clip, range(frames))[0] if clip.has_truth else None
    shutter = clip.info.shutter
    data = {
        "frames": frames,
        "height": height,
        "width": width,
        "light": base64.b64encode(stored.steps.astype("<u2").tobytes()).decode(),
        "brightest": stored.brightest,
        "steps": _STEPS,
        "exposure": clip.exposure,
        "frameRate": clip.frame_rate,
        "shutter": min(clip.exposure * clip.frame_rate, 1.0) if shutter is None else shutter,  # share of a frame
        "motion": mean,
        "devices": named_sensors(clip.exposure),
    }
    template = environment().get_template("explore.html")
    return template.render(
        name=clip.name,
        data=data,
        frames=frames,
        devices=data["devices"],
        lines=_about(clip, stored),
        brightest=BRIGHTEST,
        bits=BITS,
        scripts=[script("sensor_law.js"), script("explore.js")],
    )


def named_sensors(exposure: float, ppp: float = 3.25) -> list[dict[str, object]]:
    """Return the devices that the sliders can state, at this exposure [s] and light: {name, what, settings, follows}.

    `follows` holds light and frames per code of the settings where these follow them, else None.
    """
    found: list[dict[str, object]] = []
    for device in devices.DEVICES.values():
        if device.bits > BITS:
            continue
        own = device.make(ppp, device.bits, exposure).to_dict()
        settings = {
            "model": own["model"],
            "bits": own["bits"],
            "efficiency": own.get("quantum_efficiency", own.get("pde")),
            "dark": own.get("dark_current", own.get("dark_count_rate")),
            "noise": own.get("read_noise", 0.0),
            "gain": own.get("gain", 1.0),
            "dead": own.get("dead_time", 0.0),
        }
        follows = {"light": ppp, "frames": 1} if device.follows_light else None
        found.append({"name": device.name, "what": device.what, "settings": settings, "follows": follows})
    return found


def _about(clip: Clip, stored: StoredLight) -> list[str]:
    """Return what the page shows of the clip, and what it leaves out."""
    frames, height, width = stored.steps.shape
    first = f"The first {frames} of {len(clip)} frames" if frames < len(clip) else f"All {frames} frames"
    block = stored.rows * stored.columns
    size = f"{height} × {width} pixels"
    if block > 1:
        size += f", each the mean of {stored.rows} × {stored.columns} pixels of the clip"
    share = 100 * stored.noise_share(BRIGHTEST)
    return [
        f"{first} of {clip.name}: {size}, {clip.frame_rate:g} frames/s, exposure {clip.exposure * 1e6:.4g} µs. "
        "Photons per pixel and frame are the mean over the whole clip.",
        f"The light is stored in 16 bits on a square-root scale. At {BRIGHTEST:g} photons its rounding is at most "
        f"{share:.2g} % of the photon noise of a pixel.",
        "A code collects the light of its frames: it is the mean of moving frames, so motion blurs it. Every pixel is "
        "drawn from the exact law of its light, which is taken as constant within a code.",
        "Left out here, and modelled by qsim sense: hot and dead pixels, crosstalk, afterpulses, full well, offset, "
        "paralyzable counters.",
    ]
