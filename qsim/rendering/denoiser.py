"""Open Image Denoise on radiance: optional (`pip install qsim[denoise]`), and its error measured without a reference.

    halves [2, H, W] + albedo [H, W] + normal [H, W, 3] -> radiance [H, W], its rms error

A denoiser's bias is the same in two halves, so their difference says nothing about it. Both halves A and B, whose noise
is independent, are denoised, and D(A) meets the raw half B, D(B) the raw half A. With the raw mean M = (A + B) / 2, the
denoised mean C = (D(A) + D(B)) / 2, Z = A - B and Y = D(A) - D(B), multiplying out and dropping what is zero on average
(the error of D(A) times the noise of B, and the reverse) leaves

    E (M - truth)^2 = E Z^2 / 4,    E (M - truth)(C - truth) = E Y Z / 4,    E (C - M)^2 = E (C - M)^2,

so that the error of every mixture w C + (1 - w) M is known without the truth, and with it the w that errs least:

    E (w C + (1 - w) M - truth)^2 = E [Z^2 / 4 - w Z (Z - Y) / 2 + w^2 (C - M)^2].

Means are taken around each pixel: where texture or a mirror misleads the denoiser, raw samples speak. Denoising the
halves instead of their mean takes as many calls (two), errs about as much once mixed (from 0.2 dB more to 0.4 dB less;
tried once, seven scenes at 8 to 72 samples), and what is stated is the error of the very picture that is returned.

The denoiser shifts the mean light, by -0.25 to +0.65 % of it in nine scenes. Raw halves do not: a frame gets their
mean, as long as that moves it by less than KEPT of its own error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.util import find_spec

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clamped_error import clamped_squares

DENOISE_COST = 15.0  # samples per pixel that two denoised halves, albedo and normals cost (about, on two cores)
AROUND = 33  # px, side of the square around a pixel in which errors are compared
KEPT = 0.25  # of a frame's error: the most by which its mean is moved to that of the raw halves


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


@dataclass(frozen=True, eq=False)
class Mixture:
    """Raw and denoised halves mixed, and what is known of the errors."""

    share: Array  # [H, W], of the denoised mean in the picture, 0 to 1
    picture: Array  # [H, W], with the mean of the raw halves
    lower: Array  # [H, W], the darker of the two halves, each mixed alike
    squares: Array  # [H, W], whose mean estimates the picture's squared error; single ones may be negative
    raw: Array  # [H, W], the same of the raw mean

    @property
    def error(self) -> float:
        """The rms error of the picture."""
        return _root(self.squares, self.raw)

    def error_at(self, white: float, sigmas: float = 1.0) -> float:
        """The rms error of picture and truth clamped at white, with so many standard errors of its own added."""
        squares = clamped_squares(self.squares, self.picture, self.lower, white)
        return _root(squares, np.minimum(self.raw, white**2), sigmas)


def cleaned_mean(halves: Array, albedo: Array, normal: Array, white: float) -> Mixture:
    """The mean of two independent halves [2, H, W], denoised where that helps.

    Its mean is that of the raw halves, unless that moves it by more than KEPT of its error at white.
    """
    cleaned = np.stack([denoised(half, albedo, normal) for half in halves])
    mixed = mixture(halves, cleaned)
    mean, most = float(mixed.picture.mean()), KEPT * mixed.error_at(white)
    if not mean > 0:
        return mixed
    factor = 1 + float(np.clip(halves.mean() - mean, -most, most)) / mean
    return replace(mixed, picture=factor * mixed.picture, lower=factor * mixed.lower)


def mixture(halves: Array, cleaned: Array) -> Mixture:
    """The share w [H, W] of C that errs least around each pixel, and the picture w C + (1 - w) M.

    From halves [2, H, W] = A, B and `cleaned` [2, H, W] = D(A), D(B). The share is chosen from the pixels that also
    give the error, which makes that too small by about one standard error of its own (0 to 1.8 of them, six scenes at
    8, 16 and 32 samples): one is added. The error is at least a tenth of the raw one, lest chance promise nothing.
    """
    from scipy.ndimage import uniform_filter

    z, y = halves[0] - halves[1], cleaned[0] - cleaned[1]
    gain, apart = z * (z - y) / 4, (cleaned.mean(axis=0) - halves.mean(axis=0)) ** 2
    share = np.clip(uniform_filter(gain, AROUND) / np.maximum(uniform_filter(apart, AROUND), 1e-300), 0, 1)
    mixed = share * cleaned + (1 - share) * halves
    squares = z**2 / 4 - 2 * share * gain + share**2 * apart
    return Mixture(share, mixed.mean(axis=0), mixed.min(axis=0), squares, z**2 / 4)


def _root(squares: Array, raw: Array, sigmas: float = 1.0) -> float:
    stated = squares.mean() + sigmas * squares.std() / np.sqrt(squares.size)
    return float(np.sqrt(max(stated, 0.01 * np.mean(raw))))
