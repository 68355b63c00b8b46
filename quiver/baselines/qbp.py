"""Restores by Quanta Burst Photography, with or without BM3D: aligns frames, merges them, inverts the response.

    codes -> matching images -> shifts per 16x16 patch -> Wiener merge of patch spectra -> mean code -> mu^-1 -> photons
    with BM3D: mean code -> f -> BM3D with sigma = excess / sqrt(frames) -> D^-1 -> photons

Source: Ma, Gupta, Ulku, Bruschini, Charbon, Gupta, "Quanta Burst Photography", ACM TOG 39(4), 2020; written from the
description. Our reading for few-bit streams: every frame is one block, and the response is inverted by its exact table.
1-bit streams take blocks of several frames (`Settings.block`), as the article does. AS_PUBLISHED keeps the article's
choices, above all its noise estimate (the variance of the reference patch, which contains the picture). CALIBRATED, the
default, takes the sensor's exact variance, refines shifts at full resolution and averages three frames before matching.
Its c0 was chosen on clips made for that: a photograph in motion, a filmed ball and two rendered scenes at 3.25 and 26
photons per pixel.

The window slides over the clip, so its frames are aligned again for each restored frame.

Near the ends of a clip a window holds fewer frames. None is invented: a moving scene does not come back.

The denoising step uses the stabiliser and the unbiased inverse of vst.py in place of the binomial Anscombe transform.
Where the Wiener merge gives a frame a low weight, fewer codes are averaged than the window holds: `excess` is the
deviation of the noise over that of a full average.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from numpy import ndarray as Array
from torch import Tensor

from qsim.sensor.estimation import Response
from qsim.sensor.sensor import Sensor
from quiver.baselines import bm3d, patch_alignment
from quiver.baselines.sliding_window import check_window, checked_codes, in_units, look_ahead
from quiver.baselines.vst import stabiliser


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
EPSILON = float(np.finfo(np.float32).eps)  # least variance, in the squared unit of codes, `_unit`
EXCESS = 1.0  # best of 0.8, 1, 1.25, 1.5, 2 on the clips on which CALIBRATED was chosen
WIDE = 255  # the top code up to which it is the unit of codes
BRIGHT = 8.0  # unit of codes of more bits, in mean codes


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
    codes = checked_codes(codes, sensor)
    check_window(window)
    table = sensor.response(exposure)
    frames = range(len(codes)) if frames is None else frames
    restored = np.empty((len(frames), *codes.shape[1:]), np.float32)
    for i, frame in enumerate(frames):
        merged = merge(codes, frame, table, window, settings)
        count = len(_present(frame, window, len(codes)))
        if excess is None:
            restored[i] = table.invert(merged, count)
        else:
            transform = stabiliser(sensor, exposure, (1,) * count)
            stable = transform.forward(merged)
            restored[i] = transform.inverse(bm3d.denoise(stable, excess * transform.deviation, peak=transform.peak))
    return in_units(restored, photons_per_unit)


restore_denoised = partial(restore, excess=EXCESS)
restore_as_published = partial(restore, settings=AS_PUBLISHED)


def merge(codes: Array, frame: int, table: Response, window: int, settings: Settings = CALIBRATED) -> Array:
    """Return the mean code [H, W], float32, of the window around one frame after alignment and Wiener merging."""
    check_window(window)
    if window % settings.block:
        raise ValueError(f"window is {window} frames, which blocks of {settings.block} do not divide")
    here = _present(frame, window, len(codes))
    start = frame - window // 2
    present = codes[here.start : here.stop]
    unit = _unit(present, table)
    stack = present.astype(np.float32) / unit
    frames = torch.stack([patch_alignment.pad_image(image) for image in torch.from_numpy(stack)])
    places = range(start - here.start, start - here.start + window)
    shifts = frame_shifts(frames, places, settings)
    blocks = [slice(block.start, block.stop) for block in _blocks(len(frames), places, settings.block)]
    middle = next(i for i, block in enumerate(blocks) if block.stop > frame - here.start)
    merged = _merge_patches([(frames[block], shifts[block]) for block in blocks], middle, table, unit, settings)
    height, width = codes.shape[1:]
    return np.asarray(unit * merged[:height, :width])


def _unit(codes: Array, table: Response) -> float:
    """Return the code that frames are divided by: the top code, or less where many bits see little light.

    What counts as equal in alignment and the least variance are fixed in this unit. In units of the top code of 16
    bits a few photons would be nothing. The mean code decides: a hot pixel does not change it.
    """
    if table.top <= WIDE:
        return table.top
    return float(np.clip(BRIGHT * codes.mean(), WIDE, table.top))


def _present(frame: int, window: int, length: int) -> range:
    """Return the frames of a clip of `length` frames that lie in the window around one of them."""
    return range(max(0, frame - window // 2), min(length, frame + look_ahead(window) + 1))


def _blocks(count: int, window: range, size: int) -> list[range]:
    """Return the blocks of `size` frames of a window, cut to the `count` frames that are present."""
    ends = sorted({max(0, min(count, end)) for end in range(window.start, window.stop + 1, size)})
    return [range(*pair) for pair in itertools.pairwise(ends)]


def frame_shifts(frames: Tensor, window: range, settings: Settings = CALIBRATED) -> Tensor:
    """Return shifts [K, 2, N] of the patches of the middle frame of a window in each of K frames [K, H, W].

    `window` holds the places of its frames; those below 0 and from K on lie beyond the ends of the clip. Means of
    blocks are matched (`matched`). Shifts follow linearly in time between them, and at constant speed beyond.
    """
    found = matched(len(frames), window, settings)
    middle = window[len(window) // 2]
    pyramids = [patch_alignment.pyramid(frames[span.start : span.stop].mean(0)) for span in found]
    own = next(i for i, span in enumerate(found) if middle in span)
    still = torch.zeros(*patch_alignment.grid(frames.shape[1:], patch_alignment.LEVELS[0])[0].shape)
    moves = [
        still if i == own else patch_alignment.align(pyramids[own], other, refine_finest=settings.refine_finest)
        for i, other in enumerate(pyramids)
    ]
    times = torch.tensor([(span.start + span.stop - 1) / 2 for span in found])
    # Matched blocks are fewer than frames: between their middles a patch moves evenly.
    shifts = interpolate(torch.arange(len(frames)).float() - times[own], times - times[own], torch.stack(moves))
    return shifts - shifts[middle]


def matched(count: int, window: range, settings: Settings) -> list[range]:
    """Return which of `count` frames are averaged for matching, in rising order; one range holds the middle frame.

    A range has `prefilter` blocks and shares no frame with that of the middle: shared noise would pull shifts to zero.
    In a window that is not complete, ranges are cut at its ends, since few are left. Short windows, and those in which
    nothing else could be matched, take single blocks.
    """
    blocks = _blocks(count, window, settings.block)
    middle = next(i for i, block in enumerate(blocks) if window[len(window) // 2] in block)
    complete = count == len(window)

    def spans(half: int) -> list[range]:
        cut = {i: range(max(0, i - half), min(len(blocks), i + half + 1)) for i in range(len(blocks))}
        whole = [span for span in cut.values() if len(span) > 2 * half or not complete]
        others = [span for span in whole if span.stop <= cut[middle].start or span.start >= cut[middle].stop]
        return sorted([cut[middle], *others], key=lambda span: (span.start, span.stop))

    found = spans(settings.prefilter // 2 if len(window) >= 3 * settings.prefilter * settings.block else 0)
    return [range(blocks[span[0]].start, blocks[span[-1]].stop) for span in (found if len(found) > 1 else spans(0))]


def interpolate(place: Tensor, known: Tensor, values: Tensor) -> Tensor:
    """Return shifts at other times from shifts [K, ...] at rising times [K], one of them 0: linear, in proportion
    beyond, and at the speed of the other side where one side has none.
    """
    if len(known) == 1:
        return torch.broadcast_to(values, (len(place), *values.shape[1:]))
    if known[0] == 0:
        known = torch.concat([-known[1:2], known])
        values = torch.concat([-values[1:2], values])
    elif known[-1] == 0:
        known = torch.concat([known, -known[-2:-1]])
        values = torch.concat([values, -values[-2:-1]])
    within = torch.clip(place, float(known[0]), float(known[-1]))
    right = torch.clip(torch.searchsorted(known, within), 1, len(known) - 1)
    share = (within - known[right - 1]) / (known[right] - known[right - 1])
    beyond = place / torch.where(within == 0, 1.0, within)
    between = torch.lerp(values[right - 1], values[right], share[:, None, None])
    return between * torch.where(within == 0, 1.0, beyond)[:, None, None]


def _warp_block(frames: Tensor, shifts: Tensor, corner: Tensor, smooth: bool) -> Tensor:
    """Return the mean of the frames [F, H, W] of a block, moved patch by patch [F, 2, N]: [patch, patch, N].

    Pixels from outside the image are left out; where no frame has any, the border repeats.
    """
    size = patch_alignment.LEVELS[0].patch
    total, count, edge = torch.zeros(3, size, size, corner.shape[1])
    for image, shift in zip(frames, shifts, strict=True):
        position = (corner + (shift if smooth else torch.round(shift))).float()
        patch = (
            patch_alignment.sample_linear(image, position, size)
            if smooth
            else patch_alignment.gather(image, position.long(), size)
        )
        valid = patch_alignment.inside(image.shape, position, size)
        total = total + patch * valid
        count = count + valid
        edge = edge + patch
    return torch.where(count > 0, total / torch.clip(count, 1, None), edge / len(frames))


def _merge_patches(
    blocks: list[tuple[Tensor, Tensor]], middle: int, table: Response, unit: float, settings: Settings
) -> Tensor:
    """Return the merged image from blocks of frames [F, H, W] in a unit of codes, and shifts [F, 2, N]: aligned
    patches, spectra, Wiener weights, overlap-add. Blocks count by their frames.
    """
    shape = blocks[0][0].shape[1:]
    counts = [len(frames) for frames, _ in blocks]
    corner = patch_alignment.grid(shape, patch_alignment.LEVELS[0])[0]
    size = patch_alignment.LEVELS[0].patch
    own = counts[middle]
    smooth = settings.refine_finest
    reference = _warp_block(*blocks[middle], corner, smooth)
    # The variance of a coefficient of an unnormalised transform of size^2 pixels of white noise is size^2 times theirs.
    noise = size * size * settings.wiener * _noise(reference, own, table, unit, settings)
    spectrum = torch.fft.rfft2(reference, None, (0, 1))
    total = own * spectrum
    for i, (count, block) in enumerate(zip(counts, blocks, strict=True)):
        if i == middle:
            continue
        other = torch.fft.rfft2(_warp_block(*block, corner, smooth), None, (0, 1))
        other -= spectrum
        power = torch.square(other.real) + torch.square(other.imag)
        # Noise of the reference, plus that of the other block, whose mean
        # of `count` frames has own / count of its variance.
        both = noise * (1 + own / count)  # of the difference
        total += count * (spectrum + other * (both / (power + both)))  # A F0 + (1 - A) Fz, A = power / (power + both)
    patches = torch.fft.irfft2(total / sum(counts), (size, size), (0, 1))
    return torch.clip(overlap_add(patches, corner, shape), 0, None)


def _noise(reference: Tensor, frames: int, table: Response, unit: float, settings: Settings) -> Tensor:
    """Return the variance of a pixel of each reference patch [N], in the squared unit of codes of the patches; a patch
    is the mean of this many frames.
    """
    size = len(reference)
    if settings.wiener_variance == "patch":
        spread = reference - reference.mean((0, 1))
        return torch.clip(torch.square(spread).sum((0, 1)) / (size**2 - 1), EPSILON, None)
    mean_code = np.asarray(unit * reference.mean((0, 1)))
    # The sensor's law gives the noise at the patch's mean, however much the patch varies by its picture.
    variance = np.interp(mean_code, table.mean, table.variance) / (frames * unit**2)
    return torch.asarray(np.maximum(variance, EPSILON), dtype=torch.float32)


def overlap_add(patches: Tensor, corner: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return an image of this shape: the mean of overlapping patches [size, size, N], weighted by a raised cosine."""
    size = patches.shape[0]
    width = shape[1]
    step = torch.arange(size)
    # Raised cosines at half their width apart add up to 1; the division below is for patches at the border alone.
    one = 0.5 - 0.5 * torch.cos(2 * torch.pi * (step.float() + 0.5) / size)
    weight = torch.outer(one, one)[..., None]
    index = ((corner[0] + step[:, None]) * width)[:, None] + (corner[1] + step[:, None])[None]
    above, below = torch.zeros(2, shape[0] * width)
    above.index_add_(0, index.reshape(-1), (patches * weight).reshape(-1))
    below.index_add_(0, index.reshape(-1), torch.broadcast_to(weight, patches.shape).reshape(-1))
    return (above / below).reshape(tuple(shape))
