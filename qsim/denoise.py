"""Open Image Denoise on radiance: optional (`pip install qsim[denoise]`), and its error measured without a reference.

    noisy [H, W] + albedo [H, W] + normal [H, W, 3] -> denoised [H, W]

A denoiser's bias is the same in two halves, so their difference says nothing about it. With independent halves A and B,
whose noise is V = E (A - B)^2 / 2,

    E (D(A) - B)^2 = E (D(A) - truth)^2 + V,    E (D(A) - B)(A - B) = E (D(A) - truth)(A - truth) + V,

so the errors of D(A), of A and what they share are known without the truth, and with them the mixture w D + (1 - w) raw
that errs least. Means are taken around each pixel: where texture or a mirror misleads the denoiser, raw samples speak.
What is stated is the error of the mixture at half of the samples, as a rule more than that of all of them. The share is
chosen from the same pixels, which makes it a little too small (docs/evidence.md has both errors, stated and reached).
"""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
from numpy import ndarray as Array

DENOISE_COST = 15.0  # samples per pixel that the denoiser, its score, albedo and normals cost (about, on two cores)
AROUND = 33  # px, side of the square around a pixel in which errors are compared


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


def mixture(halves: Array, cleaned: Array) -> tuple[Array, float]:
    """The share w [H, W] of D that errs least around each pixel, and the rms error of w D(A) + (1 - w) A.

    From halves [2, H, W] = A, B and `cleaned` = D(A). The estimates are differences and may come out negative for few
    pixels; the error is at least a tenth of B's noise, which keeps it from promising nothing.
    """
    from scipy.ndimage import uniform_filter

    a, b = halves
    raw, clean, both, apart = (
        uniform_filter(product, AROUND)
        for product in ((a - b) ** 2 / 2, (cleaned - b) ** 2, (cleaned - b) * (a - b), (cleaned - a) ** 2)
    )
    share = np.clip((2 * raw - both) / np.maximum(apart, 1e-300), 0, 1)
    square = share**2 * (clean - raw) + 2 * share * (1 - share) * (both - raw) + (1 - share) ** 2 * raw
    return share, float(np.sqrt(max(square.mean(), 0.01 * raw.mean())))
