"""Denoises radiance with Open Image Denoise (optional) and measures the error without a reference.

    halves [2, H, W] + albedo [H, W] + normal [H, W, 3] -> radiance [H, W], its rms error

`pip install pyoidn` installs it. A denoiser has the same bias in two halves, so their difference does not
contain it. The halves A and B with independent noise are therefore both denoised, and D(A) is compared with the raw
half B, D(B) with the raw half A. Let M = (A + B) / 2 be the raw mean, C = (D(A) + D(B)) / 2 the denoised mean,
Z = A - B and Y = D(A) - D(B). Without the terms of zero mean (the error of D(A) times the noise of B, and the reverse),

    E (M - truth)^2 = E Z^2 / 4,    E (M - truth)(C - truth) = E Y Z / 4,    E (C - M)^2 = E (C - M)^2,

The error of every mixture w C + (1 - w) M then follows without the truth, and with it the best w:

    E (w C + (1 - w) M - truth)^2 = E [Z^2 / 4 - w Z (Z - Y) / 2 + w^2 (C - M)^2].

Means are taken around each pixel: where the denoiser is biased (texture, mirrors), the weight of the raw samples rises.
The stated error is that of the picture that is returned.

The denoiser shifts the mean light (docs/log.md). Raw halves do not, so a frame gets their mean if that shift is smaller
than KEPT times its error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import TypeVar

import numpy as np
from numpy import ndarray as Array

from qsim.backend import gpu_denoises, on_gpu
from qsim.clip.clamped_error import Clamp, clamped_squares
from qsim.lazy_array import Crop
from qsim.rendering import optix_denoiser

QUALITIES = ("high", "balanced", "fast")  # of Open Image Denoise, best first
OPTIX = "optix"  # in place of a quality: the denoiser of a GPU
AROUND = 33  # px, side of the square around a pixel in which errors are compared
Kind = TypeVar("Kind", bound="Mixture")
KEPT = 0.25  # of a frame's error: the largest shift of its mean towards that of the raw halves


def available() -> bool:
    """Return whether the denoiser is installed."""
    return find_spec("pyoidn") is not None


def kinds(variant: str) -> tuple[str, ...]:
    """Return the denoisers that are tried for frames of a Mitsuba variant, as `Budget.quality` names them."""
    return (*QUALITIES, OPTIX) if on_gpu(variant) and gpu_denoises() else QUALITIES


def wording(kind: str) -> str:
    """Return the name of a denoiser in sentences."""
    return "OptiX" if kind == OPTIX else f"{kind} quality"


def denoised(noisy: Array, albedo: Array, normal: Array, quality: str = "high") -> Array:
    """Return a picture [H, W] or [3, H, W] without its pixel noise, float32.

    Albedo has the shape of the picture, in 0..1, `normal` is [H, W, 3]; both are treated as free of noise. `quality` is
    "high", "balanced" or "fast": networks that take about 1, 0.4 and 0.2 of the time. "optix" is OptiX's denoiser on a
    GPU, which sees no normals. `ValueError` if the denoiser is not installed.
    """
    if not available():
        raise ValueError("denoising requires Open Image Denoise, which is missing: pip install pyoidn")
    import pyoidn

    colour = _three(noisy)
    matt = _three(np.clip(albedo, 0, 1))
    normal = normal.astype(np.float32)
    if quality == OPTIX:
        cleaned = optix_denoiser.denoised(colour, matt)
    else:
        cleaned = pyoidn.denoise(colour, albedo=matt, normal=normal, hdr=True, clean_aux=True, quality=quality)
    return np.maximum(cleaned[..., 0] if noisy.ndim == 2 else np.moveaxis(cleaned, -1, 0), 0)


def _three(picture: Array) -> Array:
    """Return a picture [H, W] or [3, H, W] as colours, float32 [H, W, 3]."""
    if picture.ndim == 2:
        return np.repeat(picture[..., None].astype(np.float32), 3, axis=2)
    return np.ascontiguousarray(np.moveaxis(picture, 0, -1), np.float32)


@dataclass(frozen=True, eq=False)
class Mixture:
    """Raw and denoised halves, mixed, with estimates of the squared errors."""

    share: Array  # [H, W], fraction of the denoised mean in the picture, 0 to 1
    picture: Array  # [H, W], with the mean of the raw halves
    lower: Array  # [H, W], the darker of the two halves, both mixed by `share`
    squares: Array  # [H, W], whose mean estimates the picture's squared error; single ones may be negative
    raw: Array  # [H, W], the same of the raw mean
    noise: Array | float = 0.0  # [H, W], the same of the picture's own noise, which its error cannot be below

    @property
    def error(self) -> float:
        """The rms error of the picture, W m^-2 sr^-1."""
        return _root(self.squares, self.raw, 1.0, float(np.mean(self.noise)))

    def error_at(self, white: float, sigmas: float = 1.0) -> float:
        """Return the rms error of picture and truth clamped at white, plus `sigmas` of its standard errors."""
        clamp = Clamp.at(white, self.picture, self.lower)
        squares = clamp.squares(self.squares)
        least = float(np.mean(np.where(clamp.below, self.noise, 0)))
        return _root(squares, np.minimum(self.raw, white**2), sigmas, least)

    def deviation_at(self, white: float) -> float:
        """Return the standard deviation over the pixels of what estimates their squared error, clamped at white."""
        return float(clamped_squares(self.squares, self.picture, self.lower, white).std())

    def cut(self, crop: Crop, thinned: int) -> Mixture:
        """Return every n-th (`thinned`) row and column of a window (y, x, height, width)."""
        y, x, height, width = crop
        arrays = (self.share, self.picture, self.lower, self.squares, self.raw, self.noise * np.ones_like(self.raw))
        return Mixture(*(array[y : y + height : thinned, x : x + width : thinned] for array in arrays))


def cleaned_mean(halves: Array, albedo: Array, normal: Array, white: float, quality: str = "high") -> Mixture:
    """Return the mean of two independent halves, [2, H, W] or [2, 3, H, W], denoised where that lowers the error.

    Its mean is that of the raw halves, unless the shift exceeds KEPT times its error at white.
    """
    cleaned = np.stack([denoised(half, albedo, normal, quality) for half in halves])
    return keeping_mean(mixture(halves, cleaned), float(halves.mean()), white)


def keeping_mean(mixed: Kind, wanted: float, white: float) -> Kind:
    """Return a mixture with this mean radiance, or as near to it as KEPT times its error at white allows."""
    mean = float(mixed.picture.mean())
    most = KEPT * mixed.error_at(white)
    if not mean > 0:
        return mixed
    factor = 1 + float(np.clip(wanted - mean, -most, most)) / mean
    return replace(mixed, picture=factor * mixed.picture, lower=factor * mixed.lower)


def mixture(halves: Array, cleaned: Array) -> Mixture:
    """Return the fraction w [H, W] of C with the smallest error around each pixel, and the picture w C + (1 - w) M.

    `halves` [2, H, W] are A and B, `cleaned` [2, H, W] are D(A) and D(B). The same pixels select w and give the error,
    which lowers it by about one standard error (docs/log.md): one is added. The error is at least a tenth of the raw
    one, so that chance cannot make it zero.
    """
    from scipy.ndimage import uniform_filter

    z = halves[0] - halves[1]
    y = cleaned[0] - cleaned[1]
    # Half differences are noise: z / 2 of the raw mean, (z - y) / 2 of raw less denoised. Their product estimates
    # the covariance of both, and that over the squared difference is the share with the least error.
    gain = z * (z - y) / 4
    apart = (cleaned.mean(axis=0) - halves.mean(axis=0)) ** 2
    share = np.clip(
        uniform_filter(gain, AROUND, axes=(-2, -1)) / np.maximum(uniform_filter(apart, AROUND, axes=(-2, -1)), 1e-300),
        0,
        1,
    )
    mixed = share * cleaned + (1 - share) * halves
    # The error of M + w (C - M): that of M, less twice w times the covariance, plus w^2 times the difference squared.
    squares = z**2 / 4 - 2 * share * gain + share**2 * apart
    return Mixture(share, mixed.mean(axis=0), mixed.min(axis=0), squares, z**2 / 4)


def _root(squares: Array, raw: Array, sigmas: float, least: float) -> float:
    stated = squares.mean() + sigmas * squares.std() / np.sqrt(squares.size)
    return float(np.sqrt(max(stated, 0.01 * np.mean(raw), least)))
