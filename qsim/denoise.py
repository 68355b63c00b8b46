"""Open Image Denoise on radiance: optional (`pip install qsim[denoise]`), and its error measured without a reference.

    noisy [H, W] + albedo [H, W] + normal [H, W, 3] -> denoised [H, W]

A denoiser's bias is the same in two halves, so their difference says nothing about it. With independent halves A and B,

    E (D(A) - B)^2 = E (D(A) - truth)^2 + Var(B),    Var(B) = E (A - B)^2 / 2,

hence error^2 = mean((D(A) - B)^2) - mean((A - B)^2) / 2: D's error at half of the samples, an upper estimate for all.
"""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
from numpy import ndarray as Array

DENOISE_COST = 10.0  # samples per pixel that two passes of the denoiser and its albedo and normals cost (2-core CPU)


def available() -> bool:
    """Whether the denoiser is installed."""
    return find_spec("pyoidn") is not None


def denoised(noisy: Array, albedo: Array, normal: Array) -> Array:
    """A grey picture without its pixel noise, float32 [H, W]; albedo (0..1) and normals are taken as free of noise.

    `ValueError` if the denoiser is not installed.
    """
    if not available():
        raise ValueError("denoising asked for, but Open Image Denoise is missing: pip install 'qsim[denoise]'")
    import pyoidn

    colour = np.repeat(noisy[..., None].astype(np.float32), 3, axis=2)
    grey = np.repeat(np.clip(albedo, 0, 1)[..., None].astype(np.float32), 3, axis=2)
    cleaned = pyoidn.denoise(colour, albedo=grey, normal=normal.astype(np.float32), hdr=True, clean_aux=True)
    return np.maximum(cleaned[..., 0], 0)


def denoised_error(halves: Array, cleaned: Array) -> float:
    """Root of the mean square error of `cleaned` = D(A), from halves [2, H, W] = A, B; at least a tenth of B's noise.

    The estimate is a difference and may come out negative for few pixels; the floor keeps it from promising nothing.
    """
    variance = float(np.mean((halves[0] - halves[1]) ** 2)) / 2
    square = float(np.mean((cleaned - halves[1]) ** 2)) - variance
    return float(np.sqrt(max(square, 0.01 * variance)))
