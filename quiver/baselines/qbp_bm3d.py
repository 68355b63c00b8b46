"""QBP + BM3D: the merged mean code of Quanta Burst Photography, stabilised, denoised and inverted.

    merged mean code -> f -> BM3D with sigma = excess / sqrt(window) -> D^-1 -> photons

Source: Ma et al., ACM TOG 39(4), 2020, section on denoising; written from the description. Our reading for few-bit
pixels: stabiliser and unbiased inverse of vst.py in place of the binomial Anscombe transform. Where the Wiener merge
distrusts a frame, fewer than `window` codes are averaged: `excess` is the noise deviation over that of a full average.
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.sensor import Sensor
from quiver.baselines import bm3d, qbp
from quiver.baselines.response_table import response_table
from quiver.baselines.sliding_window import check_codes, check_window, in_units
from quiver.baselines.vst import stabiliser

EXCESS = 1.0  # best of 0.8, 1, 1.25, 1.5, 2 on the clips on which qbp.py was calibrated


def restore(
    codes: Array,
    sensor: Sensor,
    exposure: float,
    *,
    window: int = 11,
    photons_per_unit: float = 1.0,
    settings: qbp.Settings = qbp.CALIBRATED,
    excess: float = EXCESS,
    frames: range | None = None,
) -> Array:
    """Codes [T, H, W] -> restored [T, H, W], float32, from `window` frames around each, in units of so many photons.

    Raises ValueError for codes the sensor cannot produce, an impossible unit, and a window that blocks do not divide.
    """
    check_codes(codes, sensor)
    check_window(window)
    table, transform = response_table(sensor, exposure), stabiliser(sensor, exposure, window)
    frames = range(len(codes)) if frames is None else frames
    restored = np.empty((len(frames), *codes.shape[1:]), np.float32)
    for i, frame in enumerate(frames):
        stable = transform.forward(qbp.merge(codes, frame, table, window, settings))
        clean = bm3d.denoise(stable, excess * transform.deviation, peak=transform.peak)
        restored[i] = transform.inverse(clean)
    return in_units(restored, photons_per_unit)
