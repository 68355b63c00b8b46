"""Aligns patches of many pairs of images at once on any device: as quiver/baselines/patch_alignment.py, whose head has
the method.

Patches are [P, N, size, size] of P pairs. All shifts of a search are tried in one operation. Among shifts that are
equally good the first in raster order wins: here the first within TIE of the best, there the first that no later one
improves by TIE.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
import torch.nn.functional as functional
from torch import Tensor

from quiver.baselines import patch_alignment
from quiver.baselines.patch_alignment import ITERATIONS, LEVELS, MULTIPLE, TIE, Level

KERNEL = (1 / 12, -8 / 12, 0.0, 8 / 12, -1 / 12)  # of a derivative


def pad_images(images: Tensor) -> Tensor:
    """Return images [B, K, H, W] with bottom and right replicated until both sides are multiples of 64."""
    height, width = images.shape[-2:]
    return functional.pad(images, (0, -width % MULTIPLE, 0, -height % MULTIPLE), mode="replicate")


def pyramid(images: Tensor) -> list[Tensor]:
    """Return box means of images [..., H, W] with sides that are multiples of 64, finest first."""
    levels = [images]
    for level in LEVELS[1:]:
        step = level.ratio
        height, width = (side // step for side in levels[-1].shape[-2:])
        levels.append(levels[-1].unflatten(-2, (height, step)).unflatten(-1, (width, step)).mean((-3, -1)))
    return levels


@lru_cache(maxsize=64)
def corners(shape: tuple[int, ...], level: Level, device: torch.device) -> Tensor:
    """Return the upper left corners, int64 [2, N], of the patches of an image in raster order."""
    return patch_alignment.grid(shape, level)[0].to(device)


def gather(images: Tensor, corner: Tensor, size: int) -> Tensor:
    """Return squares [P, N, size, size] of images [P, H, W] with these corners, whole numbers [2, P, N] or [2, 1, N];
    outside, the border repeats.
    """
    count, height, width = images.shape
    step = torch.arange(size, dtype=torch.int32, device=images.device)
    corner = corner.to(torch.int32)[..., None]
    y = (corner[0] + step).clamp_(0, height - 1) * width
    x = (corner[1] + step).clamp_(0, width - 1)
    plane = torch.arange(count, dtype=torch.int32, device=images.device)[:, None, None, None] * (height * width)
    place = (y[..., None] + x[:, :, None, :]) + plane
    return images.reshape(-1).index_select(0, place.flatten()).view(place.shape)


def search(patches: Tensor, others: Tensor, corner: Tensor, centre: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Return the best whole shift [2, P, N] within `radius` of each `centre`, and its sum of absolute differences.

    Only shifts that keep the patch inside the image count.
    """
    size = patches.shape[-1]
    side = 2 * radius + 1
    lows = [-one for one in corner]
    highs = [length - size - one for length, one in zip(others.shape[1:], corner, strict=True)]
    bounds = zip(centre, lows, highs, strict=True)
    centre = torch.stack([torch.maximum(torch.minimum(c, high + radius), low - radius) for c, low, high in bounds])
    window = gather(others, corner + centre - radius, size + 2 * radius)
    views = window.unfold(2, size, 1).unfold(3, size, 1)  # [P, N, side, side, size, size]
    cost = (views - patches[:, :, None, None]).abs_().sum((-2, -1))
    step = torch.arange(-radius, radius + 1, device=patches.device)
    moves = [c[..., None] + step for c in centre]
    legal = [(m >= low[..., None]) & (m <= high[..., None]) for m, low, high in zip(moves, lows, highs, strict=True)]
    allowed = legal[0][..., :, None] & legal[1][..., None, :]
    cost = cost.masked_fill_(~allowed, torch.inf).flatten(2)
    near = cost <= cost.amin(2, keepdim=True) + TIE * size**2
    first = (near * torch.arange(side * side, 0, -1, device=patches.device)).argmax(2)
    rows = first.div(side, rounding_mode="floor")
    shift = centre + torch.stack([rows, first - rows * side]) - radius
    return shift, cost.gather(2, first[..., None])[..., 0]


def derivatives(images: Tensor) -> tuple[Tensor, Tensor]:
    """Return (d/dy, d/dx) of images [P, H, W], borders mirrored."""
    return _slope(images), _slope(images.mT).mT


def _slope(images: Tensor) -> Tensor:
    """Return the derivative along the rows' index."""
    height = images.shape[1]
    place = [images[:, i : i + 1] for i in (1, 0, height - 1, height - 2)]
    wide = torch.cat([*place[:2], images, *place[2:]], dim=1)
    parts = [k * wide[:, i : i + height] for i, k in enumerate(KERNEL) if k]
    return sum(parts[1:], parts[0])


def sample_cubic(images: Tensor, position: Tensor, size: int) -> Tensor:
    """Return bicubic patches [P, N, size, size] with upper left corners at real positions [2, P, N]."""
    floor = position.floor()
    square = gather(images, floor.int() - 1, size + 3)
    y, x = (patch_alignment.cubic_weights(part)[..., None, None] for part in (position - floor))
    rows = sum((y[k] * square[:, :, k : k + size] for k in range(1, 4)), y[0] * square[:, :, :size])
    return sum((x[k] * rows[..., k : k + size] for k in range(1, 4)), x[0] * rows[..., :size])


def sample_linear(images: Tensor, position: Tensor, size: int) -> Tensor:
    """Return bilinear patches [P, N, size, size] with upper left corners at real positions [2, P, N]."""
    floor = position.floor()
    square = gather(images, floor.int(), size + 1)
    y, x = (position - floor)[..., None, None]
    rows = torch.lerp(square[:, :, :-1], square[:, :, 1:], y)
    return torch.lerp(rows[..., :-1], rows[..., 1:], x)


def inside(shape: Sequence[int], position: Tensor, size: int) -> Tensor:
    """Return 1 where pixels of patches at real positions [2, P, N] lie in the image, else 0: [P, N, size, size]."""
    step = torch.arange(size, device=position.device)
    y, x = (at[..., None] + step for at in position)
    legal = [(at >= 0) & (at <= side - 1) for at, side in zip((y, x), shape, strict=True)]
    return (legal[0][..., :, None] & legal[1][..., None, :]).to(position.dtype)


def lucas_kanade(references: Tensor, others: Tensor, corner: Tensor, shift: Tensor, size: int) -> Tensor:
    """Return shifts [2, P, N] refined to fractions of a pixel: template Lucas-Kanade, translation only."""
    template = gather(references, corner, size)
    flats = derivatives(others)
    slopes = [gather(images, corner, size) for images in derivatives(references)]
    shift = shift.to(references.dtype)
    moving = torch.ones_like(shift[0], dtype=torch.bool)
    for _ in range(ITERATIONS):
        position = corner + shift
        valid = inside(others.shape[1:], position, size)
        error = (template - sample_cubic(others, position, size)) * valid
        gy, gx = ((s + sample_cubic(f, position, size)) / 2 * valid for s, f in zip(slopes, flats, strict=True))
        pairs = ((gy, gy), (gy, gx), (gx, gx), (gy, error), (gx, error))
        yy, xy, xx, ye, xe = ((a * b).sum((-2, -1)) for a, b in pairs)
        det = yy * xx - xy**2
        # A patch with one edge only tells the motion across it: its structure tensor is singular.
        moving = moving & (det > 1e-6 * (yy + xx) ** 2) & (det > 1e-12)
        step = torch.stack([xx * ye - xy * xe, yy * xe - xy * ye]) / torch.where(moving, det, 1.0)
        # A step beyond a pixel leaves the range in which the picture is linear.
        step = step / step.square().sum(0).sqrt().clamp(min=1.0)
        shift = torch.where(moving, shift + step, shift)
    return shift


@lru_cache(maxsize=64)
def _parents(count: int, limit: int, fine: Level, coarse: Level, device: torch.device) -> Tensor:
    """Return for `count` patches along one axis their parent, and its neighbour on their side, int64 [2, count]."""
    place = torch.arange(count) * fine.stride / (coarse.ratio * coarse.patch)
    first = place.floor().long().clamp(max=limit - 1)
    onward = ((place - first >= 0.5) & (first + 1 < limit)) | (first == 0)
    return torch.stack([first, torch.where(onward, first + 1, first - 1).clamp(0, limit - 1)]).to(device)


def candidates(parent: Tensor, size: tuple[int, int], fine: Level, coarse: Level) -> list[Tensor]:
    """Return whole shifts [2, P, N] for the patches of the finer level, `size` down and across, from their parent and
    two of its neighbours; `parent` is [2, P, down, across].
    """
    scaled = (parent * coarse.ratio).round().long()
    rows, columns = (
        _parents(count, limit, fine, coarse, parent.device) for count, limit in zip(size, parent.shape[2:], strict=True)
    )
    choices = ((0, 0), (1, 0), (0, 1))
    return [scaled.index_select(2, rows[y]).index_select(3, columns[x]).flatten(2) for y, x in choices]


def align(references: Sequence[Tensor], others: Sequence[Tensor], *, refine_finest: bool = False) -> Tensor:
    """Return shifts [2, P, N] of the finest level's patches between pairs of pyramids of P images each."""
    shifts = references[0].new_zeros(2, len(references[0]), 1, 1)
    for depth in range(len(LEVELS) - 1, -1, -1):
        level = LEVELS[depth]
        images = references[depth]
        corner = corners(tuple(images.shape[1:]), level, images.device)[:, None]
        down, across = patch_alignment.grid(images.shape[1:], level)[1:]
        patches = gather(images, corner, level.patch)
        if depth == len(LEVELS) - 1:
            starts = [torch.zeros_like(corner).expand(-1, len(images), -1)]
        else:
            starts = candidates(shifts, (down, across), level, LEVELS[depth + 1])
        found, least = search(patches, others[depth], corner, starts[0], level.radius)
        for start in starts[1:]:
            shift, cost = search(patches, others[depth], corner, start, level.radius)
            better = cost < least - TIE * level.patch**2
            found = torch.where(better, shift, found)
            least = torch.where(better, cost, least)
        fine = found.to(images.dtype)
        if level.refine or (depth == 0 and refine_finest):
            fine = lucas_kanade(images, others[depth], corner, fine, level.patch)
        shifts = fine.unflatten(2, (down, across))
    return shifts.flatten(2)
