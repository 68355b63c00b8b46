"""Sees frames along paths p + k v + k^2/2 a, and means of squares of pixels.

Fields are [2, H, W] = (down, right), in pixels of the full frame per frame, at cells of one scale.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

SCALES = (8, 4, 2)  # px of the full frame per cell, along one side

Path = tuple[Tensor, Tensor]  # velocity and acceleration [2, h, w]


def box_mean(image: Tensor, radius: int) -> Tensor:
    """Return means of squares of 2 radius + 1 pixels of [N, H, W]; beyond the border the last pixel repeats."""
    side = 2 * radius + 1
    grown = functional.pad(image[:, None], (radius,) * 4, mode="replicate")[:, 0]
    return _sums(_sums(grown, side, 2), side, 1) / side**2


def smooth_mean(image: Tensor, radius: int) -> Tensor:
    """Return box means of box means [N, H, W]. No wave is turned into its negative, as one box mean does: corrections
    that are averaged so converge.
    """
    return box_mean(box_mean(image, radius), radius)


def _sums(x: Tensor, count: int, dim: int) -> Tensor:
    """Return sums of `count` neighbours along one axis, by sums of 1, 2, 4, ... neighbours."""
    length = x.shape[dim] - count + 1
    place = 0
    width = 1
    rest = count
    total: Tensor | None = None
    while True:
        if rest & 1:
            part = x.narrow(dim, place, length)
            total = part if total is None else total + part
            place += width
        rest >>= 1
        if not rest:
            assert total is not None
            return total
        x = x.narrow(dim, 0, x.shape[dim] - width) + x.narrow(dim, width, x.shape[dim] - width)
        width *= 2


def kept_noise(moved: Tensor) -> Tensor:
    """Return the share of the noise's variance [..., H, W] that is left at p + moved [2, ..., H, W], seen by `look`."""
    part = moved - moved.floor()
    # The sum of squared bilinear weights: between pixels a mean of two has half of the noise.
    share = part.square() + (1 - part).square()
    return share[0] * share[1]


def displacement(velocity: Tensor, acceleration: Tensor, offset: int, scale: int = 1) -> Tensor:
    """Return where paths lead after `offset` frames, [2, H, W], in cells of a scale."""
    return (velocity * offset + acceleration * (offset * offset / 2)) / scale


def look(image: Tensor, moved: Tensor, size: tuple[int, int] | None = None) -> tuple[Tensor, Tensor]:
    """Return an image [H, W] seen at p + moved [2, H, W], bilinear, and 1 where that lies inside, else 0.

    Inside are the first rows and columns, `size` of them, of an image that was filled; None: all.
    """
    height, width = image.shape
    rows, columns = image.shape if size is None else size
    y = torch.arange(height, dtype=image.dtype)[:, None] + moved[0]
    x = torch.arange(width, dtype=image.dtype)[None] + moved[1]
    inside = (y >= -0.5) & (y <= rows - 0.5) & (x >= -0.5) & (x <= columns - 0.5)
    grid = torch.stack([x.mul_(2 / max(width - 1, 1)).sub_(1), y.mul_(2 / max(height - 1, 1)).sub_(1)], dim=-1)
    seen = functional.grid_sample(image[None, None], grid[None], padding_mode="border", align_corners=True)
    return seen[0, 0], inside.to(image.dtype)


def enlarged(field: Tensor, shape: Sequence[int]) -> Tensor:
    """Return a field [2, h, w] at another scale."""
    return functional.interpolate(field[None], size=tuple(shape), mode="bilinear", align_corners=False)[0]
