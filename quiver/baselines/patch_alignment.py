"""Aligns patches of two images, coarse to fine: the shift of each patch of the reference in the other image.

    pyramid (1/1, 1/2, 1/8) -> exhaustive search at 1/8 -> Lucas-Kanade -> three candidates per patch at 1/2, search,
    Lucas-Kanade -> three candidates at 1/1, search -> (v, u) of 16x16 patches at a stride of 8

Source: Ma, Gupta, Ulku, Bruschini, Charbon, Gupta, "Quanta Burst Photography", ACM TOG 39(4), 2020, with the parameters
of its authors; alignment after Hasinoff et al. 2016 and Lucas and Kanade 1981; written from the description. Our
reading: a candidate that would leave the image is moved to the nearest place inside.

All patches are computed at once. Patches lie in the last dimension, [patch height, patch width, N], so that shifted
views of a search window are as fast as complete arrays. Shifts are (v, u) = (down, right), in pixels, from the
reference to the other image: reference(p) is like other(p + shift).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

MULTIPLE = 64  # of the sides of an image, which pyramid and patch sizes divide


@dataclass(frozen=True)
class Level:
    """One level of the pyramid."""

    ratio: int  # pixels of the next finer level per pixel, along one side; 1 at the finest
    patch: int  # pixels, side of a patch
    stride: int  # pixels between patches
    radius: int  # pixels, of the search around each candidate
    refine: bool  # sub-pixel step after the search


# Finest first. The integer search alone reaches 8 * 8 + 4 * 2 + 1 = 73 pixels.
LEVELS = (Level(1, 16, 8, 1, False), Level(2, 16, 16, 4, True), Level(4, 8, 8, 8, True))
ITERATIONS = 3  # of Lucas-Kanade
TIE = 1e-5  # mean absolute difference per pixel, in the unit of the images, below which two shifts are equally good


def pad_image(image: Tensor) -> Tensor:
    """Return the image with bottom and right replicated until both sides are multiples of 64."""
    y, x = (torch.clip(torch.arange(side + -side % MULTIPLE), None, side - 1) for side in image.shape)
    return image[y[:, None], x[None]]


def pyramid(image: Tensor, levels: tuple[Level, ...] = LEVELS) -> list[Tensor]:
    """Return box means of an image [H, W] with sides that are multiples of 64, finest first."""
    images = [image]
    for level in levels[1:]:
        fine = images[-1]
        step = level.ratio
        images.append(sum((fine[y::step, x::step] for y in range(step) for x in range(step)), torch.zeros(1)) / step**2)
    return images


def grid(shape: tuple[int, ...], level: Level) -> tuple[Tensor, int, int]:
    """Return the upper left corners [2, N] (y, x) of the patches in raster order, and their number down and across."""
    down, across = ((side - level.patch) // level.stride + 1 for side in shape)
    y, x = torch.meshgrid(torch.arange(down), torch.arange(across), indexing="ij")
    return torch.stack([y.reshape(-1), x.reshape(-1)]) * level.stride, down, across


def gather(image: Tensor, corner: Tensor, size: int) -> Tensor:
    """Return squares [size, size, N] with these upper left corners [2, N]; outside, the border repeats."""
    height, width = image.shape
    step = torch.arange(size)
    y = torch.clip(corner[0] + step[:, None], 0, height - 1) * width
    x = torch.clip(corner[1] + step[:, None], 0, width - 1)
    return image.reshape(-1)[y[:, None] + x[None]]


def search(patches: Tensor, other: Tensor, corner: Tensor, centre: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Return the best integer shift [2, N] within `radius` of each `centre`, and its sum of absolute differences [N].

    Only shifts that keep the patch inside the image count; among equals the first in raster order. Sums of few-bit
    codes are often equal, and rounding, which differs between machines, must not choose.
    """
    size = patches.shape[0]
    limit = torch.asarray(other.shape)[:, None]
    low = -corner
    high = limit - patches.shape[0] - corner
    centre = torch.maximum(torch.minimum(centre, high + radius), low - radius)
    window = gather(other, corner + centre - radius, size + 2 * radius)
    best = centre
    least = torch.full(corner.shape[1:], torch.inf, dtype=torch.float32)
    for v in range(2 * radius + 1):
        for u in range(2 * radius + 1):
            shift = centre + torch.asarray([[v - radius], [u - radius]])
            cost = torch.abs(window[v : v + size, u : u + size] - patches).sum((0, 1))
            better = (cost < least - TIE * size**2) & ((shift >= low) & (shift <= high)).all(0)
            best = torch.where(better, shift, best)
            least = torch.where(better, cost, least)
    return best, least


def derivatives(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return (d/dy, d/dx) by (f(x-2) - 8 f(x-1) + 8 f(x+1) - f(x+2)) / 12, borders mirrored."""
    return _slope(image), _slope(image.T).T


def _slope(image: Tensor) -> Tensor:
    """Return the derivative along the rows' index."""
    height = len(image)
    wide = image[torch.asarray([1, 0, *range(height), height - 1, height - 2])]
    kernel = (1 / 12, -8 / 12, 0.0, 8 / 12, -1 / 12)
    return sum((k * wide[i : i + height] for i, k in enumerate(kernel) if k), torch.zeros(1))


def cubic_weights(fraction: Tensor) -> Tensor:
    """Return weights [4, N] of the pixels -1, 0, 1, 2 for a position between 0 and 1 (Catmull-Rom)."""
    t = fraction
    return torch.stack([((2 - t) * t - 1) * t, (3 * t - 5) * t**2 + 2, ((4 - 3 * t) * t + 1) * t, (t - 1) * t**2]) / 2


def sample_cubic(image: Tensor, position: Tensor, size: int) -> Tensor:
    """Return bicubic patches [size, size, N] with upper left corners at real positions [2, N]."""
    floor = torch.floor(position)
    square = gather(image, floor.long() - 1, size + 3)
    y = cubic_weights(position[0] - floor[0])
    x = cubic_weights(position[1] - floor[1])
    zero = torch.zeros(1)
    rows = sum((y[k] * square[k : k + size] for k in range(4)), zero)
    return sum((x[k] * rows[:, k : k + size] for k in range(4)), zero)


def sample_linear(image: Tensor, position: Tensor, size: int) -> Tensor:
    """Return bilinear patches [size, size, N] with upper left corners at real positions [2, N]."""
    floor = torch.floor(position)
    square = gather(image, floor.long(), size + 1)
    y, x = position - floor
    rows = torch.lerp(square[:-1], square[1:], y)
    return torch.lerp(rows[:, :-1], rows[:, 1:], x)


def inside(shape: tuple[int, ...], position: Tensor, size: int) -> Tensor:
    """Return which pixels of patches at real positions [2, N] lie in the image: bool [size, size, N]."""
    at = position[:, None] + torch.arange(size)[:, None]
    y, x = ((at[k] >= 0) & (at[k] <= shape[k] - 1) for k in (0, 1))
    return y[:, None] & x[None]


def lucas_kanade(reference: Tensor, other: Tensor, corner: Tensor, shift: Tensor, size: int) -> Tensor:
    """Return shifts [2, N] refined to fractions of a pixel: template Lucas-Kanade, translation only.

    The gradient is the mean of both images'. Steps are at most one pixel long; a patch without structure in two
    directions is not moved.
    """
    template = gather(reference, corner, size)
    flats = derivatives(other)
    slopes = [gather(image, corner, size) for image in derivatives(reference)]
    shift = shift.float()
    moving = torch.ones(corner.shape[1:], dtype=torch.bool)
    for _ in range(ITERATIONS):
        position = (corner + shift).float()
        valid = inside(other.shape, position, size)
        error = (template - sample_cubic(other, position, size)) * valid
        gy, gx = ((s + sample_cubic(f, position, size)) / 2 * valid for s, f in zip(slopes, flats, strict=True))
        yy, xy, xx, ye, xe = ((a * b).sum((0, 1)) for a, b in ((gy, gy), (gy, gx), (gx, gx), (gy, error), (gx, error)))
        # The normal equations of least squares for a shift: the
        # structure tensor times the step is gradient times error.
        det = yy * xx - xy**2
        # A patch with one edge only tells the motion across it: its structure tensor is singular.
        moving = moving & (det > 1e-6 * (yy + xx) ** 2) & (det > 1e-12)
        step = torch.stack([xx * ye - xy * xe, yy * xe - xy * ye]) / torch.where(moving, det, 1.0)
        # A step beyond a pixel leaves the range in which the picture is linear.
        step = step / torch.clip(torch.sqrt(torch.square(step).sum(0)), 1.0, None)
        shift = torch.where(moving, shift + step, shift)
    return shift


def candidates(parent: Tensor, down: int, across: int, fine: Level, coarse: Level) -> list[Tensor]:
    """Return integer shifts [2, N] for the patches of the finer level from their parent and two of its neighbours."""
    scaled = torch.round(parent * coarse.ratio).long()

    def parents(count: int, limit: int) -> tuple[Tensor, Tensor]:
        place = torch.arange(count) * fine.stride / (coarse.ratio * coarse.patch)
        first = torch.clip(torch.floor(place).long(), None, limit - 1)
        # The neighbour on the side on which the patch lies: a motion boundary may run between parent and patch.
        onward = ((place - first >= 0.5) & (first + 1 < limit)) | (first == 0)
        return first, torch.clip(torch.where(onward, first + 1, first - 1), 0, limit - 1)

    y, other_y = parents(down, parent.shape[1])
    x, other_x = parents(across, parent.shape[2])
    return [scaled[:, rows][:, :, columns].reshape(2, -1) for rows, columns in ((y, x), (other_y, x), (y, other_x))]


def align(reference: list[Tensor], other: list[Tensor], *, refine_finest: bool = False) -> Tensor:
    """Return shifts [2, N] of the finest level's patches between two pyramids; integers (as floats) unless refined."""
    shifts = torch.zeros(2, 1, 1)
    for depth in range(len(LEVELS) - 1, -1, -1):
        level = LEVELS[depth]
        image = reference[depth]
        corner, down, across = grid(image.shape, level)
        patches = gather(image, corner, level.patch)
        if depth == len(LEVELS) - 1:
            starts = [torch.zeros_like(corner)]
        else:
            starts = candidates(shifts, down, across, level, LEVELS[depth + 1])
        found, least = search(patches, other[depth], corner, starts[0], level.radius)
        for start in starts[1:]:
            shift, cost = search(patches, other[depth], corner, start, level.radius)
            better = cost < least - TIE * level.patch**2
            found = torch.where(better, shift, found)
            least = torch.where(better, cost, least)
        fine = found.float()
        if level.refine or (depth == 0 and refine_finest):
            fine = lucas_kanade(image, other[depth], corner, fine, level.patch)
        shifts = fine.reshape(2, down, across)
    return shifts.reshape(2, -1)
