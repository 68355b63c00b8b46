"""Restores by Quanta Burst Photography, with or without BM3D: aligns frames, merges them, inverts the response.

    codes -> matching images -> shifts per 16x16 patch -> Wiener merge of patch spectra -> mean code -> mu^-1 -> photons
    with BM3D: mean code -> f -> BM3D with sigma = excess / sqrt(window) -> D^-1 -> photons

Source: Ma, Gupta, Ulku, Bruschini, Charbon, Gupta, "Quanta Burst Photography", ACM TOG 39(4), 2020; written from the
description. Our reading for few-bit streams: every frame is one block, and the response is inverted by its exact table.
1-bit streams take blocks of several frames (`Settings.block`), as the article does. AS_PUBLISHED keeps the article's
choices, above all its noise estimate (the variance of the reference patch, which contains the picture). CALIBRATED, the
default, takes the sensor's exact variance, refines shifts at full resolution and averages three frames before matching.
Its c0 was chosen on clips made for that: a photograph in motion, a filmed ball and two rendered scenes at 3.25 and 26
photons per pixel.

The window slides over the clip, so its frames are aligned again for each restored frame.

The denoising step uses the stabiliser and the unbiased inverse of vst.py in place of the binomial Anscombe transform.
Where the Wiener merge gives a frame a low weight, fewer than `window` codes are averaged: `excess` is the deviation of
the noise over that of a full average. Near the ends of a clip reflected frames count several times: the deviation and
the inverse are those of such a mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.estimation import Response
from qsim.sensor.sensor import Sensor
from quiver.baselines import bm3d, patch_alignment
from quiver.baselines.arrays import add_at, mixed, single, whole, xp, zeros
from quiver.baselines.sliding_window import check_codes, check_window, frame_times, in_units, window_frames
from quiver.baselines.vst import stabiliser

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class Settings:
    """The settings beside the window."""

    block: int = 1  # frames averaged before alignment; the window is a whole number of blocks
    prefilter: int = 3  # neighbouring blocks averaged for matching only; 1 or 3
    wiener: float = 16.0  # c0: a larger one gives the other frames more weight
    wiener_variance: Literal["sensor", "patch"] = "sensor"  # noise of a reference pixel: exact, or its patch's variance
    refine_finest: bool = True  # sub-pixel shifts at full resolution too

    def __post_init__(self) -> None:
        if self.block < 1 or self.prefilter not in (1, 3) or not self.wiener > 0:
            raise ValueError(f"block is 1 or more, prefilter 1 or 3, wiener positive; got {self}")
        if self.wiener_variance not in ("sensor", "patch"):
            raise ValueError(f"wiener_variance is sensor or patch, got {self.wiener_variance!r}")


CALIBRATED = Settings()
AS_PUBLISHED = Settings(prefilter=1, wiener=8.0, wiener_variance="patch", refine_finest=False)
EPSILON = float(np.finfo(np.float32).eps)  # least variance, in units of the top code squared
EXCESS = 1.0  # best of 0.8, 1, 1.25, 1.5, 2 on the clips on which CALIBRATED was chosen


def restore(
    codes: Array,
    sensor: Sensor,
    exposure: float,
    *,
    window: int = 11,
    photons_per_unit: float = 1.0,
    settings: Settings = CALIBRATED,
    excess: float | None = None,
    frames: range | None = None,
) -> Array:
    """Restore codes [T, H, W] from `window` frames around each: float32 [T, H, W], in units of this many photons.

    With `excess`, merged frames are denoised by BM3D. `ValueError` for codes that the sensor cannot produce, an
    impossible unit, and a window that is not a multiple of the block.
    """
    check_codes(codes, sensor)
    check_window(window)
    table = sensor.response(exposure)
    frames = range(len(codes)) if frames is None else frames
    restored = np.empty((len(frames), *codes.shape[1:]), np.float32)
    for i, frame in enumerate(frames):
        merged = merge(codes, frame, table, window, settings)
        if excess is None:
            restored[i] = table.invert(merged, window)
        else:
            transform = stabiliser(sensor, exposure, frame_times(frame, window, len(codes)))
            stable = transform.forward(merged)
            restored[i] = transform.inverse(bm3d.denoise(stable, excess * transform.deviation, peak=transform.peak))
    return in_units(restored, photons_per_unit)


def merge(codes: Array, frame: int, table: Response, window: int, settings: Settings = CALIBRATED) -> Array:
    """Return the mean code [H, W], float32, of the window around one frame after alignment and Wiener merging."""
    check_window(window)
    if window % settings.block:
        raise ValueError(f"window is {window} frames, which blocks of {settings.block} do not divide")
    height, width = codes.shape[1:]
    stack = codes[window_frames(frame, window, len(codes))].astype(np.float32) / table.top
    frames = xp.stack([patch_alignment.pad_image(image) for image in single(stack)])
    frames = frames.reshape(-1, settings.block, *frames.shape[1:])  # [blocks, frames of a block, H, W]
    merged = _merge_patches(frames, frame_shifts(frames, settings), table, settings)
    return np.asarray(table.top * merged[:height, :width])


def frame_shifts(frames: Tensor, settings: Settings = CALIBRATED) -> Tensor:
    """Return shifts [D, F, 2, N] of the patches of the middle block in every frame of D blocks [D, F, H, W].

    Means of `prefilter` blocks are matched where they share no frame with the middle block: shared noise would pull
    shifts to zero. Other frames follow linearly in time between matched ones, and at constant speed beyond the last.
    """
    blocks, middle = frames.mean(1), len(frames) // 2
    width = settings.prefilter if len(frames) >= 3 * settings.prefilter else 1
    half = width // 2
    matched = [i for i in range(half, len(frames) - half) if i == middle or abs(i - middle) >= width]
    pyramids = {i: patch_alignment.pyramid(blocks[i - half : i + half + 1].mean(0)) for i in matched}
    still = zeros(*patch_alignment.grid(blocks.shape[1:], patch_alignment.LEVELS[0])[0].shape)
    found = [
        still
        if i == middle
        else patch_alignment.align(pyramids[middle], pyramids[i], refine_finest=settings.refine_finest)
        for i in matched
    ]
    count, block = frames.shape[:2]
    place = (single(xp.arange(count * block)) + 0.5) / block - 0.5  # of a frame, in blocks
    shifts = _interpolate(place - middle, single(matched) - middle, xp.stack(found))
    return shifts.reshape(count, block, *still.shape)


def _interpolate(place: Tensor, known: Tensor, values: Tensor) -> Tensor:
    """Return shifts at other times from shifts [K, ...] at rising times [K], one of them 0: linear, in proportion
    beyond.
    """
    if len(known) == 1:
        return xp.broadcast_to(values, (len(place), *values.shape[1:]))
    within = xp.clip(place, float(known[0]), float(known[-1]))
    right = xp.clip(xp.searchsorted(known, within), 1, len(known) - 1)
    share = (within - known[right - 1]) / (known[right] - known[right - 1])
    beyond = place / xp.where(within == 0, 1.0, within)
    between = mixed(values[right - 1], values[right], share[:, None, None])
    return between * xp.where(within == 0, 1.0, beyond)[:, None, None]


def _warp_block(frames: Tensor, shifts: Tensor, corner: Tensor, smooth: bool) -> Tensor:
    """Return the mean of the frames [F, H, W] of a block, moved patch by patch [F, 2, N]: [patch, patch, N].

    Pixels from outside the image are left out; where no frame has any, the border repeats.
    """
    size = patch_alignment.LEVELS[0].patch
    total, count, edge = zeros(3, size, size, corner.shape[1])
    for image, shift in zip(frames, shifts, strict=True):
        position = single(corner + (shift if smooth else xp.round(shift)))
        patch = (
            patch_alignment.sample_linear(image, position, size)
            if smooth
            else patch_alignment.gather(image, whole(position), size)
        )
        valid = patch_alignment.inside(image.shape, position, size)
        total, count, edge = total + patch * valid, count + valid, edge + patch
    return xp.where(count > 0, total / xp.clip(count, 1, None), edge / len(frames))


def _merge_patches(frames: Tensor, shifts: Tensor, table: Response, settings: Settings) -> Tensor:
    """Return the merged image from aligned patches: spectra, Wiener weights, overlap-add."""
    corner = patch_alignment.grid(frames.shape[2:], patch_alignment.LEVELS[0])[0]
    size, count = patch_alignment.LEVELS[0].patch, len(frames)
    smooth = settings.refine_finest
    reference = _warp_block(frames[count // 2], shifts[count // 2], corner, smooth)
    noise = 2 * size * size * settings.wiener * _noise(reference, table, settings)
    spectrum = xp.fft.rfft2(reference, None, (0, 1))
    total = spectrum + 0
    for i in range(count):
        if i == count // 2:
            continue
        other = xp.fft.rfft2(_warp_block(frames[i], shifts[i], corner, smooth), None, (0, 1))
        other -= spectrum
        power = xp.square(other.real) + xp.square(other.imag)
        total += spectrum + other * (noise / (power + noise))  # A F0 + (1 - A) Fz, A = power / (power + noise)
    patches = xp.fft.irfft2(total / count, (size, size), (0, 1))
    return xp.clip(overlap_add(patches, corner, frames.shape[2:]), 0, None)


def _noise(reference: Tensor, table: Response, settings: Settings) -> Tensor:
    """Return the variance of a pixel of each reference patch [N], in units of the top code squared."""
    size = len(reference)
    if settings.wiener_variance == "patch":
        spread = reference - reference.mean((0, 1))
        return xp.clip(xp.square(spread).sum((0, 1)) / (size**2 - 1), EPSILON, None)
    mean_code = np.asarray(table.top * reference.mean((0, 1)))
    variance = np.interp(mean_code, table.mean, table.variance) / (settings.block * table.top**2)
    return single(np.maximum(variance, EPSILON))


def overlap_add(patches: Tensor, corner: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return an image of this shape: the mean of overlapping patches [size, size, N], weighted by a raised cosine."""
    size, width = patches.shape[0], shape[1]
    step = xp.arange(size)
    one = 0.5 - 0.5 * xp.cos(2 * xp.pi * (single(step) + 0.5) / size)
    weight = xp.outer(one, one)[..., None]
    index = ((corner[0] + step[:, None]) * width)[:, None] + (corner[1] + step[:, None])[None]
    above, below = zeros(2, shape[0] * width)
    add_at(above, index.reshape(-1), (patches * weight).reshape(-1))
    add_at(below, index.reshape(-1), xp.broadcast_to(weight, patches.shape).reshape(-1))
    return (above / below).reshape(tuple(shape))
