"""Aligns and merges windows by Quanta Burst Photography, a batch of them at once on any device.

    codes [B, K, H, W] -> alignment of all windows and frames together -> patches, spectra, Wiener weights -> mean code

It computes what quiver/baselines/qbp.py does, for blocks of one frame; its head has the method.
"""

from __future__ import annotations

from functools import lru_cache

import torch
import torch.nn.functional as functional
from torch import Tensor

from qsim.sensor.estimation import Response
from qsim.sensor.sensor import Sensor
from quiver.baselines import patch_alignment as level_table
from quiver.baselines import qbp
from quiver.baselines.batched import patch_alignment, tables
from quiver.baselines.qbp import BRIGHT, EPSILON, WIDE, Settings

FINEST = level_table.LEVELS[0]
PIXEL_BYTES = 5000  # that a pixel of a window of 11 frames takes: patches, their spectra, and what a search compares


def merge(codes: Tensor, window: range, sensor: Sensor, exposure: float, settings: Settings = qbp.CALIBRATED) -> Tensor:
    """Return the mean codes [B, H, W], float32, of the middle frames of windows of codes [B, K, H, W] that were merged.

    `window` holds the places of its frames; those below 0 and from K on lie beyond the ends of the clip. `ValueError`
    for blocks of several frames.
    """
    if settings.block != 1:
        raise ValueError(f"blocks of {settings.block} frames are merged on the CPU alone; take block=1")
    unit = _unit(codes, sensor.response(exposure))
    frames = patch_alignment.pad_images(codes.to(torch.float32)) / unit[:, None]
    shifts = frame_shifts(frames, window, settings)
    middle = window[len(window) // 2]
    merged = _merge_patches(frames, shifts, middle, sensor, exposure, unit, settings)
    height, width = codes.shape[2:]
    return unit * merged[:, :height, :width]


def _unit(codes: Tensor, response: Response) -> Tensor:
    """Return the code that frames are divided by, float32 [B, 1, 1]; see qbp.py."""
    if response.top <= WIDE:
        return torch.full((len(codes), 1, 1), float(response.top), device=codes.device)
    mean = codes.flatten(1).mean(1, dtype=torch.float64)[:, None, None]
    return (BRIGHT * mean).clamp(WIDE, response.top).to(torch.float32)


def frame_shifts(frames: Tensor, window: range, settings: Settings) -> Tensor:
    """Return shifts [B, K, 2, N] of the patches of the middle frame of windows in each of their frames [B, K, H, W]."""
    batch, count = frames.shape[:2]
    spans = qbp.matched(count, window, settings)
    middle = window[len(window) // 2]
    own = next(i for i, span in enumerate(spans) if middle in span)
    images = torch.stack([frames[:, span.start : span.stop].mean(1) for span in spans], dim=1)
    pyramids = patch_alignment.pyramid(images)
    others = [i for i in range(len(spans)) if i != own]
    if not others:
        number = patch_alignment.corners(tuple(frames.shape[2:]), FINEST, frames.device).shape[1]
        return frames.new_zeros(batch, count, 2, number)
    references = [level[:, own : own + 1].expand(-1, len(others), -1, -1).flatten(0, 1) for level in pyramids]
    seen = [torch.cat([level[:, :own], level[:, own + 1 :]], dim=1).flatten(0, 1) for level in pyramids]
    moves = patch_alignment.align(references, seen, refine_finest=settings.refine_finest)
    moves = moves.unflatten(1, (batch, len(others))).permute(1, 2, 0, 3)  # [B, M - 1, 2, N]
    # Matched blocks are fewer than frames: between their middles a patch moves evenly.
    weights = _between(count, window, settings, frames.device)
    return (weights @ moves.flatten(2)).unflatten(2, moves.shape[2:])


@lru_cache(maxsize=64)
def _between(count: int, window: range, settings: Settings, device: torch.device) -> Tensor:
    """Return the share of each matched shift but that of the middle, in the shift of each frame: [K, M - 1]."""
    spans = qbp.matched(count, window, settings)
    middle = window[len(window) // 2]
    own = next(i for i, span in enumerate(spans) if middle in span)
    times = torch.tensor([(span.start + span.stop - 1) / 2 for span in spans])
    one_each = torch.eye(len(spans))[:, :, None]
    found = qbp.interpolate(torch.arange(count).float() - times[own], times - times[own], one_each)[..., 0]
    found = found - found[middle]
    return torch.cat([found[:, :own], found[:, own + 1 :]], dim=1).to(device)


def _merge_patches(
    frames: Tensor,
    shifts: Tensor,
    middle: int,
    sensor: Sensor,
    exposure: float,
    unit: Tensor,
    settings: Settings,
) -> Tensor:
    """Return merged images [B, H, W] from frames [B, K, H, W] in a unit of codes, and shifts [B, K, 2, N]."""
    batch, count, height, width = frames.shape
    corner = patch_alignment.corners((height, width), FINEST, frames.device)
    size = FINEST.patch
    position = (corner + shifts).permute(2, 0, 1, 3).flatten(1, 2)  # [2, B * K, N]
    images = frames.flatten(0, 1)
    if settings.refine_finest:
        patches = patch_alignment.sample_linear(images, position, size)
    else:
        patches = patch_alignment.gather(images, position.round(), size)
    patches = patches.unflatten(0, (batch, count))
    reference = patches[:, middle]
    spectra = torch.fft.rfft2(patches)
    own = spectra[:, middle]
    spectra = spectra - own[:, None]
    power = spectra.real.square() + spectra.imag.square()
    # Noise of the reference and of the other frame; a coefficient of an unnormalised transform has size^2 times theirs.
    noise = _noise(reference, sensor, exposure, unit, settings)[:, None, :, None, None]
    both = noise * (2 * size * size * settings.wiener)
    total = (spectra * (both / (power + both))).sum(1) / count + own  # (1 - A) Fz + A F0, A = power / (power + both)
    merged = overlap_add(torch.fft.irfft2(total, (size, size)), (height, width))
    return merged.clamp(min=0)


def _noise(reference: Tensor, sensor: Sensor, exposure: float, unit: Tensor, settings: Settings) -> Tensor:
    """Return the variance of a pixel of reference patches [B, N, size, size], [B, N], in the unit of codes squared."""
    mean = reference.mean((-2, -1))
    if settings.wiener_variance == "patch":
        spread = (reference - mean[..., None, None]).square().sum((-2, -1))
        return (spread / (reference.shape[-1] ** 2 - 1)).clamp(min=EPSILON)
    unit = unit[:, :, 0]
    # The sensor's law gives the noise at the patch's mean, however much the patch varies by its picture.
    variance = tables.variance_of_code(sensor, exposure, reference.device)(unit * mean)
    return (variance / unit.square()).clamp(min=EPSILON)


@lru_cache(maxsize=16)
def _cosine(size: int, device: torch.device) -> Tensor:
    """Return the raised cosine that weighs the pixels of a patch, [size, size]."""
    one = 0.5 - 0.5 * torch.cos(2 * torch.pi * (torch.arange(size).float() + 0.5) / size)
    return torch.outer(one, one).to(device)


def overlap_add(patches: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return images [B, *shape]: means of overlapping patches [B, N, size, size], weighted by a raised cosine."""
    size = patches.shape[-1]
    weight = _cosine(size, patches.device)
    above = functional.fold((patches * weight).flatten(2).mT, shape, size, stride=FINEST.stride)
    ones = weight.flatten()[None, :, None].expand(1, -1, patches.shape[1])
    below = functional.fold(ones, shape, size, stride=FINEST.stride)
    return (above / below)[:, 0]
