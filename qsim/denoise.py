"""Open Image Denoise on radiance: optional (`pip install qsim[denoise]`), and its error measured without a reference.

    noisy [H, W] + albedo [H, W] + normal [H, W, 3] -> denoised [H, W]

A denoiser's bias is the same in two halves, so their difference says nothing about it. With independent halves A and B,
whose noise is V = E (A - B)^2 / 2,

    E (D(A) - B)^2 = E (D(A) - truth)^2 + V,    E (D(A) - B)(A - B) = E (D(A) - truth)(A - truth) + V,

so the errors of D(A), of A and what they share are known without the truth, and with them the mixture w D + (1 - w) raw
that errs least. Its error at half of the samples is an upper estimate for all of them (by 1 to 2 dB). It is measured on
the quarter of the frame whose noise is most like that of the whole, and in proportion to the noise, because a second
pass of the denoiser over everything would cost as much as the picture itself.
"""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
from numpy import ndarray as Array

DENOISE_COST = 15.0  # samples per pixel that the denoiser, its score, albedo and normals cost (10 to 23 on two cores)
SMALLEST_PART = 64  # px, sides of a quarter that the error is measured on


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


def typical_part(halves: Array) -> tuple[slice, slice]:
    """Rows and columns of the quarter of [2, H, W] whose noise is most like the whole's; all of a small frame."""
    height, width = halves.shape[1:]
    if min(height, width) < 2 * SMALLEST_PART:
        return slice(0, height), slice(0, width)
    rows = [slice(0, height // 2), slice(height // 2, height)]
    columns = [slice(0, width // 2), slice(width // 2, width)]
    square = (halves[0] - halves[1]) ** 2
    whole = square.mean()
    return min(((y, x) for y in rows for x in columns), key=lambda part: float(abs(square[part].mean() - whole)))


def mixture(halves: Array, cleaned: Array) -> tuple[float, float]:
    """The share w of the denoised picture that errs least, and the rms error of w D(A) + (1 - w) A.

    From halves [2, H, W] = A, B and `cleaned` = D(A). The estimates are differences and may come out negative for few
    pixels; the error is at least a tenth of B's noise, which keeps it from promising nothing.
    """
    a, b = halves
    raw = float(np.mean((a - b) ** 2)) / 2
    clean = float(np.mean((cleaned - b) ** 2)) - raw
    both = float(np.mean((cleaned - b) * (a - b))) - raw
    apart = clean + raw - 2 * both  # E (D(A) - A)^2
    share = min(max((raw - both) / apart, 0.0), 1.0) if apart > 0 else 1.0
    square = share**2 * clean + 2 * share * (1 - share) * both + (1 - share) ** 2 * raw
    return share, float(np.sqrt(max(square, 0.01 * raw)))
