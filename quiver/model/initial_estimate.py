"""Estimates the centre frame from frames aligned along their motion, by a small U-Net; ours, not published.

    window [N, T, H, W] -> paths of best agreement -> aligned window -> learnt mean over time + correction of a U-Net

Before training, the estimate is about a Gaussian mean over time.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from quiver.model.blocks import RADIUS, WINDOW, join
from quiver.model.plane_sweep import aligned, disagreement, paths
from quiver.model.unet import SmallUNet
from quiver.tiles import cores, extents


class InitialEstimate(nn.Module):
    """A learnt mean over time plus the correction of a small U-Net, at full size.

    With `largest_velocity` above 0 px/frame the frames are aligned first (plane_sweep.py). The U-Net then takes the
    aligned and the given frames, the velocity as a share of the largest, and the standard deviation that is left over
    time. Outside training its results for the eight flips and quarter turns of its input are averaged (geometric
    self-ensemble, Lim et al. 2017, "EDSR").
    """

    SIGMA = 1.5  # frames, of the mean over time before training

    def __init__(self, width: int, largest_velocity: float = 0.0) -> None:
        super().__init__()
        self.largest_velocity = largest_velocity
        weights = [math.exp(-0.5 * ((t - RADIUS) / self.SIGMA) ** 2) for t in range(WINDOW)]
        self.weights = nn.Parameter(torch.tensor([weight / sum(weights) for weight in weights]))
        self.correction = SmallUNet(2 * WINDOW + 3 if largest_velocity else WINDOW, width)
        self.pixels: int | None = None  # of a tile of the U-Net outside training, at most; any number gives the same

    def forward(self, window: Sequence[Tensor]) -> Tensor:
        """Eleven folded frames [N, f2, h, w] in units of x -> estimate of the centre frame [N, f2, h, w]."""
        fold = math.isqrt(window[0].shape[1])
        frames = F.pixel_shuffle(torch.stack(list(window), dim=1), fold)[:, :, 0]  # [N, T, H, W]
        moved, stack = frames, [frames]
        if self.largest_velocity:
            velocity, acceleration = paths(frames, self.largest_velocity)
            moved = aligned(frames, velocity, acceleration)
            stack = [moved, frames, velocity / self.largest_velocity, disagreement(moved).sqrt()]
        mean = (moved * self.weights.view(1, -1, 1, 1)).sum(1, keepdim=True)
        stacked = join(*stack)
        return F.pixel_unshuffle(mean + (self.correction(stacked) if self.training else self._in_tiles(stacked)), fold)

    def _in_tiles(self, stack: Tensor) -> Tensor:
        """Run `averaged` tile by tile if the frame [N, C, H, W] has more than `pixels` pixels."""
        height, width = stack.shape[2:]
        if self.pixels is None or height * width <= self.pixels:
            return self.averaged(stack)
        reach = SmallUNet.REACH
        tall, wide = cores(height, width, self.pixels, reach, SmallUNet.MULTIPLE)
        picture = stack.new_empty(stack.shape[0], 1, height, width)
        for y, (top, bottom) in zip(range(0, height, tall), extents(height, tall, reach), strict=True):
            for x, (left, right) in zip(range(0, width, wide), extents(width, wide, reach), strict=True):
                part = self.averaged(stack[:, :, top:bottom, left:right])
                inner = part[:, :, y - top : y - top + tall, x - left : x - left + wide]
                picture[:, :, y : y + tall, x : x + wide] = inner
        return picture

    def averaged(self, stack: Tensor) -> Tensor:
        """Return the mean correction [N, 1, H, W] over the eight flips and quarter turns of the input [N, C, H, W]."""
        x = 2 * WINDOW if self.largest_velocity else None  # channel of the velocity's x; its y follows
        total = stack.new_zeros(stack.shape[0], 1, *stack.shape[2:])
        for turns in range(4):
            for flip in (False, True):
                result = self.correction(join(mirrored(stack, x) if flip else stack))
                total += (result.flip(3) if flip else result).rot90(-turns, (2, 3))
            stack = turned(stack, x)
        return total / 8


def mirrored(stack: Tensor, x: int | None) -> Tensor:
    """Exchange left and right of [N, C, H, W]; channels x and x + 1 are components of a vector (None: no vector)."""
    flipped = stack.flip(3)
    if x is not None:
        flipped[:, x] *= -1
    return flipped


def turned(stack: Tensor, x: int | None) -> Tensor:
    """Turn [N, C, H, W] by a quarter, so that a vector that points to the right then points up."""
    turned = stack.rot90(1, (2, 3))
    if x is None:
        return turned
    return torch.cat([turned[:, :x], turned[:, x + 1 : x + 2], -turned[:, x : x + 1], turned[:, x + 2 :]], dim=1)
