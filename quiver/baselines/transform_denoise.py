"""Restores by Transform Denoise: sums the codes of a window, stabilises the variance, denoises, inverts.

    mean code -> f -> BM3D with sigma = 1/sqrt(window) -> D^-1 -> photons

Source: Chan, Elgendy, Wang, "Images from Bits: Non-Iterative Image Reconstruction for Quanta Image Sensors", Sensors
16(11):1961, 2016; written from the description. Our reading for few-bit pixels: stabiliser and inverse are tables from
the sensor's exact distribution (vst.py). The article's binary form is `kind="binomial"`. A window longer than one frame
blurs motion: short windows suit motion, long ones static scenes. Near the ends of a clip reflected frames count several
times: the deviation and the inverse are those of such a mean.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.sensor import Sensor
from quiver.baselines import bm3d
from quiver.baselines.sliding_window import check_window, checked_codes, frame_times, in_units, window_sums
from quiver.baselines.vst import Kind, stabiliser


def restore(
    codes: Array,
    sensor: Sensor,
    exposure: float,
    *,
    window: int = 3,
    photons_per_unit: float = 1.0,
    kind: Kind = "table",
    frames: range | None = None,
) -> Array:
    """Restore codes [T, H, W] from `window` frames around each: float32 [T, H, W], in units of this many photons.

    `ValueError` for codes that the sensor cannot produce, an empty window and an impossible unit.
    """
    codes = checked_codes(codes, sensor)
    check_window(window)
    top = sensor.levels - 1
    frames = range(len(codes)) if frames is None else frames
    table: Array | None = None
    restored = np.empty((len(frames), *codes.shape[1:]), np.float32)
    for frame, total in enumerate(window_sums(codes, window, top)):
        if frame in frames:
            transform = stabiliser(sensor, exposure, frame_times(frame, window, len(codes)), kind)
            if table is None:  # f is the same for all frames
                table = transform.forward(np.arange(window * top + 1) / window)
            clean = bm3d.denoise(table[total], transform.deviation, peak=transform.peak)
            restored[frame - frames.start] = transform.inverse(clean)
    return in_units(restored, photons_per_unit)


restore_as_published = partial(restore, kind="binomial")
