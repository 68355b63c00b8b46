"""Restores by merging frames along smooth paths: each pixel is a mean of the frames that agree, and knows how many.

    codes -> phi of pooled codes at scales 8, 4, 2 -> shake of the camera and paths (paths/motion_paths.py) ->
    moved codes -> weights -> mean code, count

Frames beside the reference are compared with it; farther ones, in pairs, with the mean of the nearest three. Two
statistics compare: the squared mean differences of 6 x 6 and of 2 x 2 pixels over their exact variance, averaged
nearby: 1 where the scene is the same. The first finds large areas at little light, the second edges and textures that
a path misses by a pixel. The worse one decides. A frame that a path leads out of the picture has no weight.

At the ends of a stream the window is moved, not cut: the first frame has ten of its future. Those farther away than
half of the window count where a place rests, and where all around it they have the mean of near frames: motion that
nothing finds shows there. One acceleration does not lead farther.

The count of a pixel is the number of codes whose mean has its noise: (sum of weights)^2 over the sum of squared weights
times the share of the noise that is left where a moved frame is sampled between its pixels.

Light that changes for all of a picture is evened out first (paths/light_factors.py): codes of a frame are scaled to the
light of the reference, and count by the information that they have about it.

A batch of windows is merged at once, on any device; nothing waits for the host. Frames of a group share their weight,
so sums of a group's frames are all that is kept of them.

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

from qsim.sensor.estimation import Response
from qsim.sensor.sensor import Sensor
from quiver.baselines.domain_tables import DomainTables, domain_tables
from quiver.baselines.information_domain import InformationDomain, information_domain
from quiver.baselines.paths.light_factors import light_factors
from quiver.baselines.paths.motion_paths import Moves, moves, none_of, rests
from quiver.baselines.paths.moved_frames import CHUNK, SCALES, box_mean, enlarged, halved, look_sharply
from quiver.baselines.sliding_window import check_window, checked_codes, equal_windows, in_units, moved_window
from quiver.device import is_gpu

# places of frames in the window -> those frames [B, N, H, W] seen where each pixel went, 1 where that lies in the
# picture, else 0, and the share of the noise's variance that is left there
Follow = Callable[[Sequence[int]], tuple[Tensor, Tensor, Tensor]]

# (cells of 2 x 2 px beside the own one whose mean difference is squared, and over which squares are averaged; statistic
# up to which frames agree; excess over it at which a frame has half its weight)
STATISTICS = ((1, 1, 3.0, 1.0), (0, 2, 1.6, 0.25))
GROUPS = ((-1,), (1,), (-2, -3), (2, 3), (-4, -5), (4, 5))  # offsets of the frames that `Merged.groups` averages
PIXEL_BYTES = 3_000  # that a pixel of a window takes on a GPU, where all frames and velocities are tried at a time
LINEAR = 0.5  # of the largest mean code, up to which codes follow light and are scaled with it
FLAT = 0.8  # of it, from which they are left as they are: near saturation they hardly follow light
MOST_SHARE = 2.0  # of a frame in brighter light than the reference; saturated codes would seem to tell everything
LEAST_NOISE = 0.1  # of a group of frames; a cubic leaves a frame half of its noise
NEARBY = 5  # frames from the reference within which motion is found, or half of a longer window
# (cells of 2 x 2 px along the side of a block, blocks beside the own one over which squares are averaged; deviations of
# their mean up to which far frames have the mean of near ones)
UNCHANGED = ((1, 16, 3.0), (4, 4, 2.5))
NEAR = 2  # groups of one frame beside the reference; the other frames are compared with the mean of these three


@dataclass(frozen=True, eq=False)
class Merged:
    """Mean codes and counts of one frame of each window, float32 [B, H, W] each."""

    mean_code: Tensor
    count: Tensor
    weight: Tensor  # sum of the weights of frames, 1 of the reference included
    alone: Tensor  # codes of the frame
    near: Tensor  # mean code of the frame and its two neighbours, moved and weighted
    near_count: Tensor
    still: Tensor  # mean code of the window without motion
    frames: int  # in the window
    groups: Tensor  # [B, 6, H, W], mean codes of GROUPS, moved and not weighted
    group_counts: Tensor  # [B, 6, H, W], codes whose mean has the noise of each; 0 without a frame in the picture


@dataclass(frozen=True, eq=False)
class Groups:
    """Moved frames of each group, where they lie in the picture, float32 [B, G, H, W] each."""

    sums: Tensor  # of their codes
    counts: Tensor  # frames
    noise: Tensor  # variance of the sum over that of one code
    beside: Tensor  # [B, 2, H, W], the frames beside the reference wherever they lie: 0 where there is none


@dataclass(frozen=True, eq=False)
class Prepared:
    """Frames: their codes [..., H, W], and phi of pooled codes at every scale; sides are multiples of the largest."""

    codes: Tensor
    pyramid: dict[int, Tensor]
    size: tuple[int, int]  # of a frame before it was filled
    shares: Tensor | None = None  # [B, K], codes of the reference that tell as much as one of a frame; None: 1


def prepared(codes: Tensor, tables: DomainTables) -> Prepared:
    """Return windows of codes [B, K, H, W] with their pyramids; bottom and right repeat the last pixels."""
    height, width = codes.shape[-2:]
    fill = (0, -width % SCALES[0], 0, -height % SCALES[0])
    frames = codes.to(torch.float32)
    frames = functional.pad(frames, fill, mode="replicate") if any(fill) else frames
    pooled = {SCALES[-1]: halved(frames)}
    for finer, scale in zip(SCALES[:0:-1], SCALES[-2::-1], strict=True):
        pooled[scale] = halved(pooled[finer])  # sums of whole numbers: exact
    pyramid = {}
    for scale, image in pooled.items():
        flat = image.flatten(1, 2)  # [B, K * h, w]
        pyramid[scale] = tables.phi_of_pooled(flat, scale).view(image.shape)
    return Prepared(frames, pyramid, (height, width))


def windows_of(frames: Sequence[Prepared], count: int) -> Prepared:
    """Return all windows of `count` successive frames, of frames that were prepared one by one, [1, 1, H, W] each."""
    pyramid = {scale: _windows([frame.pyramid[scale] for frame in frames], count) for scale in SCALES}
    return Prepared(_windows([frame.codes for frame in frames], count), pyramid, frames[0].size)


def _windows(images: Sequence[Tensor], count: int) -> Tensor:
    """Return windows [B, count, H, W] of successive images [1, 1, H, W]."""
    joined = torch.cat(list(images), dim=1)
    if len(images) == count:
        return joined
    return joined[0].unfold(0, count, 1).movedim(-1, 1)


@torch.no_grad()
def merge(window: Prepared, offsets: Sequence[int], tables: DomainTables) -> Merged:
    """Return the merged reference frames of windows [B, K, H, W]; `offsets` are the frames' places in time, with 0."""
    window = evened(window, offsets, tables)
    return merge_along(window, offsets, tables, _found(window, offsets, tables))


def _found(window: Prepared, offsets: Sequence[int], tables: DomainTables) -> Moves:
    """Return how every place of windows [B, K, H, W] moves, by the frames that are near.

    Frames beyond count where near frames and all frames find no motion: at little light, a few do not see all.
    """
    codes = halved(window.codes)
    near = [i for i, offset in enumerate(offsets) if abs(offset) <= _reach(offsets)]
    found = _moves_of(window, offsets, codes, near, tables)
    if len(near) == len(offsets):
        return found
    shake = found.shake.new_zeros(len(codes), len(offsets), 2, 3)
    shake[:, near] = found.shake
    if window.shares is None:
        of_all = _moves_of(window, offsets, codes, range(len(offsets)), tables)
        far = rests(found) * rests(of_all) * unchanged(codes, near, tables)
    else:
        far = torch.zeros_like(window.codes[:, 0])  # light that changes hides what moves
    return Moves(found.path, shake, far)


def _moves_of(
    window: Prepared, offsets: Sequence[int], codes: Tensor, places: Sequence[int], tables: DomainTables
) -> Moves:
    """Return how every place moves, by the frames at some places of the windows; `codes` as of `moves`, of all."""
    # The noise that the search for paths expects, from the frames without motion: only its size matters there.
    seen = codes[:, places]
    variance = tables.variance(box_mean(seen.mean(1), 2))[:, None]
    if window.shares is not None:
        variance = variance * _about_mean(window.shares[:, places])
    pyramid = {scale: frames[:, places] for scale, frames in window.pyramid.items()}
    return moves(pyramid, [offsets[i] for i in places], seen, variance.sqrt())


def unchanged(codes: Tensor, near: Sequence[int], tables: DomainTables) -> Tensor:
    """Return 1 where the other frames have the mean of those `near`, all around, else 0: [B, H, W] of mean codes of
    2 x 2 px [B, K, H/2, W/2].

    Motion that is too dim to be found is seen here, as an area is larger than the blocks that vote on a path.
    """
    frames = codes.shape[1]
    total = codes.sum(1)
    nearer = codes[:, near].sum(1)
    others = frames - len(near)
    variance = tables.variance(box_mean(total / frames, 1)) * (1 / others + 1 / len(near)) / 4
    difference = (total - nearer) / others - nearer / len(near)
    same = torch.ones_like(difference)
    for side, beside, most in UNCHANGED:
        blocks = functional.avg_pool2d(difference, side)
        squares = blocks.square_().mul_(side**2 / functional.avg_pool2d(variance, side))
        around = 2 * beside + 1
        counted = functional.avg_pool2d(torch.ones_like(squares), around, 1, beside).mul_(around**2)
        mean = functional.avg_pool2d(squares, around, 1, beside, count_include_pad=False)
        # A square of noise has the mean 1 and the variance 2.
        fits = (mean < 1 + most * (2 / counted).sqrt()).to(same.dtype)
        same *= functional.interpolate(fits[:, None], size=same.shape[-2:])[:, 0]
    return functional.interpolate(same[:, None], scale_factor=2.0)[:, 0]


def _reach(offsets: Sequence[int]) -> int:
    """Return how many frames from the reference motion is looked for and followed."""
    return max(NEARBY, len(offsets) // 2)


def _about_mean(shares: Tensor) -> Tensor:
    """Return the variance of frames about the mean of all, over that of the reference's codes, [B, K, 1, 1].

    A frame has 1 / share of that variance; the part 1 - 1/K of it is taken off elsewhere. Brighter frames count as the
    reference: near saturation they have more noise than their mean light tells.
    """
    frames = shares.shape[1]
    own = shares.clamp(max=1).reciprocal()
    about = own * (1 - 2 / frames) + own.mean(1, keepdim=True) / frames
    return (about / (1 - 1 / frames))[..., None, None]


def evened(window: Prepared, offsets: Sequence[int], tables: DomainTables) -> Prepared:
    """Return windows [B, K, H, W] whose frames have the light of the reference, and the shares of their codes."""
    centre = offsets.index(0)
    coarse = functional.avg_pool2d(window.codes, SCALES[0])
    of_phi, of_codes = light_factors(window.pyramid[SCALES[0]], coarse, centre)
    if none_of(of_codes != 1):
        return window
    # Of codes that are scaled by 1 / f, the variance is that of codes in f times the light, over f^2.
    level = coarse[:, centre].mean((1, 2))[:, None, None]
    variance = tables.variance(of_codes[:, None] * level) / of_codes[:, None].square()
    shares = (tables.variance(level) / variance)[:, 0].clamp(max=MOST_SHARE)
    pyramid = {scale: phi / of_phi[..., None, None] for scale, phi in window.pyramid.items()}
    highest = torch.maximum(coarse, coarse[:, centre, None]) / tables.last[:, None]
    followed = (FLAT - highest).div_(FLAT - LINEAR).clamp_(0, 1)
    factors = enlarged((of_codes - 1)[..., None, None] * followed, window.codes.shape[-2:]).add_(1)
    return Prepared(window.codes / factors, pyramid, window.size, shares)


def merge_along(window: Prepared, offsets: Sequence[int], tables: DomainTables, found: Moves) -> Merged:
    """Return the reference frames of windows [B, K, H, W], merged along motions that are known."""

    reach = _reach(offsets)

    def follow(places: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
        frames = torch.stack([window.codes[:, i] for i in places], dim=1)
        times = [offsets[i] for i in places]
        seen, inside, kept = look_sharply(frames, found.path, times, window.size, found.shake[:, places])
        for n, offset in enumerate(times):
            if found.far is not None and abs(offset) > reach:
                inside[:, n] *= found.far
        return seen, inside, kept

    return merge_followed(window, offsets, tables, follow)


@torch.no_grad()
def merge_followed(window: Prepared, offsets: Sequence[int], tables: DomainTables, follow: Follow) -> Merged:
    """Return the reference frames of windows [B, K, H, W], merged with the others as they are seen by `follow`."""
    codes = window.codes
    alone = codes[:, offsets.index(0)]
    groups = _groups(window, offsets, follow)
    weights, means, near_total, near_mean = group_weights(alone, groups.sums, groups.counts, groups.beside, tables)
    total, mean_code = _weighted(alone, weights, groups.sums, groups.counts)
    shown = slice(len(GROUPS))
    return Merged(
        mean_code,
        _count(total, weights, groups.noise),
        total,
        alone,
        near_mean,
        _count(near_total, weights[:, :NEAR], groups.noise[:, :NEAR]),
        _still(window),
        frames=len(offsets),
        groups=means[:, shown],
        group_counts=groups.counts[:, shown].square().div_(groups.noise[:, shown].clamp(min=LEAST_NOISE)),
    )


def groups_of(offsets: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """Return the offsets that share a weight: those of GROUPS, and pairs of farther frames, of a longer window."""
    last = max(abs(offset) for offset in offsets) // 2
    return GROUPS + tuple((2 * side * n, side * (2 * n + 1)) for n in range(3, last + 1) for side in (-1, 1))


def _still(window: Prepared) -> Tensor:
    """Return the mean codes [B, H, W] of windows without motion."""
    if window.shares is None:
        return window.codes.sum(1).div_(window.codes.shape[1])
    shares = window.shares / window.shares.sum(1, keepdim=True)
    return (window.codes * shares[..., None, None]).sum(1)


def _groups(window: Prepared, offsets: Sequence[int], follow: Follow) -> Groups:
    """Return the sums of the frames of windows [B, K, H, W], moved."""
    codes = window.codes
    batch, _, height, width = codes.shape
    groups = groups_of(offsets)
    sums = codes.new_zeros(batch, len(groups), height, width)
    counts = torch.zeros_like(sums)
    noise = torch.zeros_like(sums)
    beside = codes.new_zeros(batch, NEAR, height, width)
    place = {offset: g for g, group in enumerate(groups) for offset in group}
    moving = [i for i, offset in enumerate(offsets) if offset]
    step = len(offsets) if is_gpu(codes.device) else max(1, CHUNK // (batch * height * width))
    for first in range(0, len(moving), step):
        chosen = moving[first : first + step]
        seen, inside, kept = follow(chosen)
        if window.shares is not None:
            # A frame that counts c times has c times the codes in a sum, and c times the noise of one code.
            inside = inside * window.shares[:, chosen, None, None]
        for n, i in enumerate(chosen):
            g = place[offsets[i]]
            counts[:, g] += inside[:, n]
            if g < NEAR:
                beside[:, g] = seen[:, n]
            sums[:, g].addcmul_(seen[:, n], inside[:, n])
            noise[:, g].addcmul_(kept[:, n], inside[:, n])
    return Groups(sums, counts, noise, beside)


def group_weights(
    alone: Tensor, sums: Tensor, counts: Tensor, beside: Tensor, tables: DomainTables
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the weights of groups [B, G, H, W], of which a frame has its own where it lies in the picture; the mean
    codes of groups; and the sum of weights and the mean code [B, H, W] of the nearest three frames.

    The reference frame `alone` has the weight 1. The others are those of `Groups`.
    """
    # One picture of the variance serves all frames, or frames that happen to be dim would be trusted more.
    mean = (sums.sum(1) + alone) / (counts.sum(1) + 1)
    variance = tables.variance(box_mean(halved(mean), 1))[:, None]
    most = torch.where(counts > 0, counts, 1.0)
    near = agreement(beside - alone[:, None], variance * halved(1 + most[:, :NEAR].reciprocal()))
    # Far frames are compared with the mean of the nearest three, which has less noise than the reference alone.
    total, base = _weighted(alone, near, sums[:, :NEAR], counts[:, :NEAR])
    means = sums / most
    share = halved(most[:, NEAR:].reciprocal()).add_(halved(total.reciprocal())[:, None])
    far = agreement(means[:, NEAR:] - base[:, None], share.mul_(variance))
    return torch.cat([near, far], dim=1), means, total, base


def _weighted(alone: Tensor, weights: Tensor, sums: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return the sum of the weights of all frames, 1 of the reference included, and their mean code [B, H, W]."""
    total = (weights * counts).sum(1).add_(1)
    return total, (weights * sums).sum(1).add_(alone).div_(total)


def _count(total: Tensor, weights: Tensor, noise: Tensor) -> Tensor:
    """Return the number of codes whose mean has the noise of the merged frame, [B, H, W]."""
    return total.square().div_((weights.square() * noise).sum(1).add_(1))


def agreement(difference: Tensor, variance: Tensor) -> Tensor:
    """Return weights [B, G, H, W] from differences of moved codes and their variance per pixel [B, G, H/2, W/2]."""
    cells = halved(difference)
    excess: Tensor | None = None
    for beside, around, tolerance, softness in STATISTICS:
        # The mean of n pixels has the variance of one over n: its square times n over that is 1 where nothing changed.
        pixels = 4 * (2 * beside + 1) ** 2
        mean = box_mean(cells, beside) if beside else cells
        statistic = box_mean(mean.square() * (pixels / variance), around)
        part = statistic.sub_(tolerance).div_(softness)
        excess = part.clamp_(min=0) if excess is None else torch.maximum(excess, part)
    assert excess is not None
    return enlarged(excess.add_(1).reciprocal_(), difference.shape[-2:])


def stream(
    read: Callable[[int], Array | Tensor],
    length: int,
    domain: InformationDomain,
    window: int,
    frames: range,
    device: torch.device | str = "cpu",
    *,
    together: int = 1,
) -> Iterator[Merged]:
    """Yield merged frames [B, H, W] of a stream of `length` frames, each as soon as its window was read.

    `read` returns the codes [H, W] of one frame. A frame is read and pooled once. The windows of the first frames reach
    farther ahead, those of the last ones farther back, so that all have as many frames. Up to `together` successive
    frames are merged at a time, those near the ends of the stream alone.
    """
    device = torch.device(device)
    tables = domain_tables(domain, device)
    kept: deque[tuple[int, Prepared]] = deque()
    for part, before, count in equal_windows(frames, window, length, together, moved_window):
        first = part.start - before
        while kept and kept[0][0] < first:
            kept.popleft()
        for i in range(kept[-1][0] + 1 if kept else first, part.stop - 1 - before + count):
            kept.append((i, prepared(as_codes(read(i)[None, None], device), tables)))
        yield merge(windows_of([frame for _, frame in kept], count), range(-before, count - before), tables)


def as_codes(codes: Array | Tensor, device: torch.device) -> Tensor:
    """Return codes on a device; those of NumPy in few bytes until they are there."""
    if isinstance(codes, Tensor):
        return codes.to(device)
    small = codes if codes.dtype == np.uint8 else codes.astype(np.float32)
    return torch.from_numpy(np.ascontiguousarray(small)).to(device, non_blocking=True)


def frames_of_light(merged: Merged, response: Response) -> Tensor:
    """Return how many frames tell the light of a pixel, float64 [B, H, W]: their weight, at most all of the window.

    `ValueError` if all of them do not resolve the response; fewer are raised to what does.
    """
    response.cap(merged.frames)
    return merged.weight.to(torch.float64).clamp(response.fewest, max(merged.frames, response.fewest))


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
        pixels = (merged.mean_code, frames_of_light(merged, table))
        mean_code, count = (x[0, :height, :width].numpy() for x in pixels)
        restored[i] = table.invert(mean_code, count)
    return in_units(restored, photons_per_unit)
