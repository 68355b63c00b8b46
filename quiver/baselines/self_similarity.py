"""Averages a noisy picture with places of itself that look alike: what repeats has little noise then.

    picture and its variance [B, H, W] -> mean of places that look alike, and its variance

Around every cell of 2 x 2 pixels a square of cells is compared with the squares some cells away. Where their difference
is no larger than noise explains, the two are averaged. Every even number of pixels up to REACH is tried in both
directions, so that whatever repeats within REACH pixels has a partner: of an odd period the second repetition.

Differences are relative to the exact noise of both places, so one tolerance serves all light; nothing waits for the
host.

Ours, after the non-local means of Buades, Coll and Morel (2005), with weights that fall where noise ends.
"""

from __future__ import annotations

import torch
from torch import Tensor

from quiver.baselines.paths.moved_frames import box_mean

REACH = 16  # px
AROUND = 1  # cells beside the own one that are compared: squares of 6 x 6 px
TOLERANCE = 1.25  # mean square of differences over their variance up to which places look alike
SOFTNESS = 0.15  # excess over it at which a place has a quarter of its weight


@torch.no_grad()
def mean_of_alike(image: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean of what looks alike and its variance, float32 [B, H, W], of an image [B, H, W].

    `variance` [B, H, W] is that of the image's noise; H and W are even.
    """
    parts = _cells(image)
    noise = _cells(variance).mean(1)
    total = torch.ones_like(noise)
    squares = noise.clone()
    sums = parts.clone()
    height, width = noise.shape[-2:]
    for down, right in _shifts(height, width):
        here, there = _overlap(down, right, height, width)
        one = parts[..., *here]
        other = parts[..., *there]
        unit = noise[..., *here] + noise[..., *there]
        weight = (one - other).square_().mean(1).div_(unit)
        weight = box_mean(weight, AROUND).sub_(TOLERANCE).div_(SOFTNESS).clamp_(min=0).add_(1)
        weight = weight.square_().reciprocal_()
        square = weight.square()
        for mine, its in ((here, there), (there, here)):
            total[..., *mine] += weight
            squares[..., *mine].addcmul_(square, noise[..., *its])
            sums[..., *mine].addcmul_(weight[:, None], parts[..., *its])
    return _pixels(sums.div_(total[:, None])), _pixels(squares.div_(total.square_())[:, None].expand_as(parts))


def _shifts(height: int, width: int) -> list[tuple[int, int]]:
    """Return the shifts in cells of one half of the plane; the other half is the same pairs."""
    most = REACH // 2
    found = [(0, right) for right in range(1, most + 1)]
    found += [(down, right) for down in range(1, most + 1) for right in range(-most, most + 1)]
    return [(down, right) for down, right in found if down < height and abs(right) < width]


def _overlap(down: int, right: int, height: int, width: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the cells that have a partner after a shift, and their partners."""
    here = slice(0, height - down), slice(max(0, -right), width - max(0, right))
    there = slice(down, height), slice(max(0, right), width + min(0, right))
    return here, there


def _cells(image: Tensor) -> Tensor:
    """Return the four pixels of every cell, [B, 4, H/2, W/2], of [B, H, W]."""
    height, width = image.shape[-2:]
    split = image.reshape(-1, height // 2, 2, width // 2, 2).permute(0, 2, 4, 1, 3)
    return split.reshape(-1, 4, height // 2, width // 2)


def _pixels(cells: Tensor) -> Tensor:
    """Return [B, H, W] of cells [B, 4, H/2, W/2]."""
    _, _, height, width = cells.shape
    return cells.view(-1, 2, 2, height, width).permute(0, 3, 1, 4, 2).reshape(-1, 2 * height, 2 * width)
