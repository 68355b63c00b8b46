"""Restores by merging frames along smooth paths: each pixel is a mean of the frames that agree, and knows how many.

    codes -> phi of pooled codes at scales 8, 4, 2 -> paths (paths/motion_paths.py) -> moved codes -> weights ->
    mean code, count

Frames beside the reference are compared with it; farther ones, in pairs, with the mean of the nearest three. Two
statistics compare: the squared mean differences of 6 x 6 and of 2 x 2 pixels over their exact variance, averaged
nearby: 1 where the scene is the same. The first finds large areas at little light, the second edges and textures that
a path misses by a pixel. The worse one decides. A frame that a path leads out of the picture has no weight, so the ends
of a stream need no invented frames.

The count of a pixel is (sum of weights)^2 / sum of squared weights: the codes that, averaged alike, have its noise.

Ours; against QBP (qbp.py) one path per place replaces pairs of frames that are matched alone, and weights per pixel
replace those per patch and frequency.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as functional
from numpy import ndarray as Array
from torch import Tensor

from qsim.sensor.sensor import Sensor
from quiver.baselines.information_domain import FLOOR, InformationDomain, information_domain
from quiver.baselines.paths.motion_paths import paths
from quiver.baselines.paths.moved_frames import SCALES, box_mean, displacement, enlarged, look
from quiver.baselines.sliding_window import check_window, checked_codes, in_units, look_ahead

# (cells of 2 x 2 px beside the own one whose mean difference is squared, and over which squares are averaged; statistic
# up to which frames agree; excess over it at which a frame has half its weight)
STATISTICS = ((1, 1, 3.0, 1.0), (0, 2, 1.6, 0.25))
GROUPS = ((-1,), (1,), (-2, -3), (2, 3), (-4, -5), (4, 5))  # offsets of the frames that `Merged.groups` averages


@dataclass(frozen=True)
class Merged:
    """Mean codes and counts of one frame, float32 [H, W] each."""

    mean_code: Array
    count: Array
    alone: Array  # codes of the frame
    near: Array  # mean code of the frame and its two neighbours, moved and weighted
    near_count: Array
    still: Array  # mean code of the window without motion
    frames: int  # in the window
    groups: Array  # [6, H, W], mean codes of GROUPS, moved and not weighted
    group_counts: Array  # [6, H, W], frames of each that lie in the picture


@dataclass(frozen=True)
class Prepared:
    """One frame: its codes [H, W], and phi of pooled codes at every scale; sides are multiples of the largest."""

    codes: Tensor
    pyramid: dict[int, Tensor]
    size: tuple[int, int]  # of the frame before it was filled


def prepared(codes: Array, domain: InformationDomain) -> Prepared:
    """Return a frame of codes [H, W] with its pyramid; bottom and right repeat the last pixels."""
    height, width = codes.shape
    fill = (0, -width % SCALES[0], 0, -height % SCALES[0])
    frame = functional.pad(torch.from_numpy(codes.astype(np.float32))[None, None], fill, mode="replicate")
    pooled = {scale: functional.avg_pool2d(frame, scale)[0, 0] for scale in SCALES}
    pyramid = {scale: torch.from_numpy(domain.forward(image.numpy())) for scale, image in pooled.items()}
    return Prepared(frame[0, 0], pyramid, (height, width))


def merge(window: Sequence[Prepared], offsets: Sequence[int], domain: InformationDomain) -> Merged:
    """Return the merged reference frame of a window of frames; `offsets` are their places in time, with 0."""
    with torch.no_grad():
        pyramid = {scale: torch.stack([frame.pyramid[scale] for frame in window]) for scale in SCALES}
        codes = torch.stack([functional.avg_pool2d(frame.codes[None], SCALES[-1])[0] for frame in window])
        # The noise that the search for paths expects, from the window without motion: only its size matters there.
        deviation = variance_of(box_mean(codes.mean(0)[None], 2)[0], domain).sqrt()
        velocity, acceleration = paths(pyramid, offsets, codes, deviation)
        moved = torch.empty(len(window), *window[0].codes.shape)
        inside = torch.ones_like(moved)
        for i, (frame, offset) in enumerate(zip(window, offsets, strict=True)):
            if offset:
                moved[i], inside[i] = look(frame.codes, displacement(velocity, acceleration, offset), frame.size)
            else:
                moved[i] = frame.codes
        weight = weights(moved, inside, offsets, domain)
        near = [i for i, offset in enumerate(offsets) if abs(offset) <= 1]
        still = sum((frame.codes for frame in window[1:]), window[0].codes) / len(window)
        alone = window[offsets.index(0)].codes.numpy()
        groups = [[i for i, offset in enumerate(offsets) if offset in group] for group in GROUPS]
        counts = torch.stack([inside[group].sum(0) for group in groups])
        sums = torch.stack([(moved[group] * inside[group]).sum(0) for group in groups])
        return Merged(
            *_weighted(moved, weight),
            alone,
            *_weighted(moved[near], weight[near]),
            still.numpy(),
            frames=len(window),
            groups=(sums / counts.clamp(min=1)).numpy(),
            group_counts=counts.numpy(),
        )


def variance_of(mean_code: Tensor, domain: InformationDomain) -> Tensor:
    """Return the variance of a code [...] at mean codes [...], FLOOR at least."""
    variance = np.interp(mean_code.numpy(), domain.mean_code, domain.variance)
    return torch.from_numpy(np.maximum(variance, FLOOR).astype(np.float32))


def _weighted(moved: Tensor, weight: Tensor) -> tuple[Array, Array]:
    """Return the weighted mean [H, W] of frames, and the number of equal weights with the same noise."""
    total = weight.sum(0)
    return ((moved * weight).sum(0) / total).numpy(), (total.square() / weight.square().sum(0)).numpy()


def weights(moved: Tensor, inside: Tensor, offsets: Sequence[int], domain: InformationDomain) -> Tensor:
    """Return weights [K, H, W] of moved codes [K, H, W], 0 where not `inside`; the reference has the weight 1."""
    centre = offsets.index(0)
    # One picture of the variance serves all frames, or frames that happen to be dim would be trusted more.
    half = functional.avg_pool2d((moved * inside).sum(0)[None] / inside.sum(0)[None], 2)
    variance = variance_of(box_mean(half, 1)[0], domain)
    weight = torch.zeros_like(moved)
    weight[centre] = 1.0
    for i, offset in enumerate(offsets):
        if abs(offset) == 1:
            weight[i] = agreement(moved[i] - moved[centre], 2 * variance) * inside[i]
    near = [i for i, offset in enumerate(offsets) if abs(offset) <= 1]
    total = weight[near].sum(0)
    # Far frames are compared with the mean of the nearest three, which has less noise than the reference alone.
    base = (weight[near] * moved[near]).sum(0) / total
    base_share = functional.avg_pool2d((1 / total)[None], 2)[0]
    for side in (-1, 1):
        for pair in range(1, max(abs(offset) for offset in offsets) // 2 + 1):
            group = [i for i, offset in enumerate(offsets) if offset * side > 0 and abs(offset) // 2 == pair]
            if not group:
                continue
            count = inside[group].sum(0).clamp_(min=1)
            mean = (moved[group] * inside[group]).sum(0) / count
            share = functional.avg_pool2d((1 / count)[None], 2)[0]
            weight[group] = agreement(mean - base, (share + base_share) * variance) * inside[group]
    return weight


def agreement(difference: Tensor, variance: Tensor) -> Tensor:
    """Return weights [H, W] from a difference of moved codes [H, W] and its variance per pixel [H/2, W/2]."""
    cells = functional.avg_pool2d(difference[None], 2)
    excess = torch.zeros_like(variance)
    for beside, around, tolerance, softness in STATISTICS:
        # The mean of n pixels has the variance of one over n: its square times n over that is 1 where nothing changed.
        pixels = 4 * (2 * beside + 1) ** 2
        statistic = box_mean(box_mean(cells, beside).square() * (pixels / variance), around)[0]
        excess = torch.maximum(excess, (statistic - tolerance) / softness)
    return enlarged((1 / (1 + excess))[None], difference.shape)[0]


def stream(
    read: Callable[[int], Array], length: int, domain: InformationDomain, window: int, frames: range
) -> Iterator[Merged]:
    """Yield merged frames of a stream of `length` frames, each after look_ahead(window) more frames were read.

    `read` returns the codes [H, W] of one frame. A frame is read and pooled once; windows end where the stream ends.
    """
    kept: deque[tuple[int, Prepared]] = deque()
    for t in frames:
        first = max(0, t - window // 2)
        last = min(length - 1, t + look_ahead(window))
        while kept and kept[0][0] < first:
            kept.popleft()
        for i in range(kept[-1][0] + 1 if kept else first, last + 1):
            kept.append((i, prepared(read(i), domain)))
        yield merge([frame for _, frame in kept], [i - t for i, _ in kept], domain)


def restore(
    codes: Array,
    sensor: Sensor,
    exposure: float,
    *,
    window: int = 11,
    photons_per_unit: float = 1.0,
    frames: range | None = None,
) -> Array:
    """Restore codes [T, H, W] from up to `window` frames around each: float32 [T, H, W], in units of this many photons.

    `ValueError` for codes that the sensor cannot produce, an empty window and an impossible unit.
    """
    codes = checked_codes(codes, sensor)
    check_window(window)
    domain = information_domain(sensor, exposure)
    table = sensor.response(exposure)
    frames = range(len(codes)) if frames is None else frames
    restored = np.empty((len(frames), *codes.shape[1:]), np.float32)
    height, width = codes.shape[1:]
    for i, merged in enumerate(stream(lambda t: codes[t], len(codes), domain, window, frames)):
        restored[i] = table.invert(merged.mean_code[:height, :width], merged.frames)
    return in_units(restored, photons_per_unit)
