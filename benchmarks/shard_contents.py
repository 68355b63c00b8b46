"""Measures what clips hold: motion, contrast and the spectrum of their light. `shard_page.py` shows them.

Motion is the length of the stored flow of all frames. Contrast and spectrum are of at most LOOKED_AT frames of a clip.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clamped_error import stated
from qsim.clip.motion_statistics import MOVING
from qsim.streams.clip import Clip

MOTION = (1.0, 7.0)  # px/frame that the paper states
EDGES = (MOVING, *np.arange(0.25, 20.25, 0.25).tolist(), np.inf)  # px/frame, of the histogram
LOOKED_AT = 16  # frames of a clip
RINGS = 2.0 ** (np.arange(19) / 3 - 7)  # cycles/px: three rings of the spectrum per octave, from 1/128 to 1/2
FITTED = (1 / 64, 1 / 4)  # cycles/px between which the power law is fitted


def contents(clip: Clip) -> dict[str, Any]:
    """Return the size, the budget and the stated PSNR of a clip, and its motion, contrast and spectrum."""
    clip.require_one_band("this page")
    reached = stated(clip.info)
    budget = clip.info.render
    looked_at = np.unique(np.linspace(0, len(clip) - 1, LOOKED_AT).round().astype(int))
    images = np.stack([clip.radiance(int(t)) for t in looked_at])
    power = spectrum(images)
    return {
        "shape": list(clip.shape),
        "samples": budget and budget.samples,
        "neighbours": budget and budget.neighbours,
        "psnr": None if reached is None else reached.psnr,
        "motion": motion(clip.flow(t) for t in range(len(clip))),
        "contrast": contrast(images),
        "spectrum": [float(value) if np.isfinite(value) else None for value in power],
        "slope": slope(power),
    }


def motion(flows: Iterable[Array]) -> dict[str, Any]:
    """Return how many pixels of flows [2, H, W] are known, and how many of them move by EDGES px/frame."""
    known = 0
    counts = np.zeros(len(EDGES) - 1, np.int64)
    summed = 0.0
    for flow in flows:
        length = np.hypot(*flow.astype(np.float64))
        length = length[np.isfinite(length)]
        moving = length[length >= MOVING]
        known = known + length.size
        summed = summed + float(moving.sum())
        counts += np.histogram(moving, EDGES)[0]
    return {"known": known, "counts": counts.tolist(), "summed": summed}


def contrast(images: Array) -> dict[str, float]:
    """Return the standard deviation and the 1st and 99th percentile of images [N, H, W], over their mean."""
    relative = images.astype(np.float64) / images.mean(dtype=np.float64)
    low, high = np.percentile(relative, (1, 99))
    return {"rms": float(relative.std()), "low": float(low), "high": float(high)}


def spectrum(images: Array) -> Array:
    """Return the mean power density [px^2] in each of RINGS of images [N, H, W] over their mean; NaN in empty rings.

    A Hann window keeps the edges of the frame out: without it, they add power that falls as f^-2.
    """
    height, width = images.shape[1:]
    window = np.hanning(height + 2)[1:-1, None] * np.hanning(width + 2)[1:-1]
    relative = images.astype(np.float64) / images.mean(dtype=np.float64)
    centred = relative - (relative * window).sum((1, 2), keepdims=True) / window.sum()
    power = np.mean(np.abs(np.fft.fft2(centred * window)) ** 2, axis=0) / np.sum(window**2)
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width))
    total, count = (np.histogram(frequency, RINGS, weights=w)[0] for w in (power, np.ones_like(power)))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def slope(power: Array) -> float | None:
    """Return the exponent of the power law that fits a spectrum between the frequencies FITTED; None without power."""
    middle = np.sqrt(RINGS[1:] * RINGS[:-1])
    used = (middle > FITTED[0]) & (middle < FITTED[1]) & (np.nan_to_num(power) > 0)
    if used.sum() < 2:
        return None
    return float(np.polyfit(np.log(middle[used]), np.log(power[used]), 1)[0])
