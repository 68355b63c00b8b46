"""A first picture of the centre frame, straight from the window: not part of the published design."""

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
    """Not part of the published design: a first picture straight from the window, for quick learning.

    A learnt mean over time plus an hourglass over the stacked frames, at full size; before training it is about a
    Gaussian mean. With `sweep` the frames are first drawn along the paths on which they agree (sweep.py, up to about
    `sweep` px/frame), and the hourglass sees them both ways, beside the velocity as a share of `sweep` and the
    standard deviation that is left over time. When it is not being trained, its answers to the eight flips and quarter
    turns of all this are averaged: what it learnt in minutes differs among them (Lim et al. 2017, "EDSR", call it
    geometric self-ensemble).
    """

    SIGMA = 1.5  # frames

    def __init__(self, width: int, sweep: float = 0.0) -> None:
        super().__init__()
        self.sweep = sweep
        weights = [math.exp(-0.5 * ((t - RADIUS) / self.SIGMA) ** 2) for t in range(WINDOW)]
        self.weights = nn.Parameter(torch.tensor([weight / sum(weights) for weight in weights]))
        self.correction = SmallUNet(2 * WINDOW + 3 if sweep else WINDOW, width)
        self.pixels: int | None = None  # most that the hourglass takes at once when not trained; the numbers agree

    def forward(self, window: Sequence[Tensor]) -> Tensor:
        """Eleven folded frames [N, f2, h, w] -> [N, f2, h, w]."""
        fold = math.isqrt(window[0].shape[1])
        frames = F.pixel_shuffle(torch.stack(list(window), dim=1), fold)[:, :, 0]  # [N, T, H, W]
        drawn, stack = frames, [frames]
        if self.sweep:
            velocity, acceleration = paths(frames, self.sweep)
            drawn = aligned(frames, velocity, acceleration)
            stack = [drawn, frames, velocity / self.sweep, disagreement(drawn).sqrt()]
        mean = (drawn * self.weights.view(1, -1, 1, 1)).sum(1, keepdim=True)
        seen = join(*stack)
        return F.pixel_unshuffle(mean + (self.correction(seen) if self.training else self._in_tiles(seen)), fold)

    def _in_tiles(self, stack: Tensor) -> Tensor:
        """`averaged`, tile by tile where the frame has more than `pixels` pixels."""
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
        """The hourglass's mean answer to the eight flips and quarter turns of what it sees."""
        x = 2 * WINDOW if self.sweep else None  # channel of the velocity's x; its y follows
        total = stack.new_zeros(stack.shape[0], 1, *stack.shape[2:])
        for turns in range(4):
            for flip in (False, True):
                answer = self.correction(join(mirrored(stack, x) if flip else stack))
                total += (answer.flip(3) if flip else answer).rot90(-turns, (2, 3))
            stack = turned(stack, x)
        return total / 8


def mirrored(stack: Tensor, x: int | None) -> Tensor:
    """[N, C, H, W] with left and right exchanged; channels x and x + 1 are components of a vector (None: no vector)."""
    flipped = stack.flip(3)
    if x is not None:
        flipped[:, x] *= -1
    return flipped


def turned(stack: Tensor, x: int | None) -> Tensor:
    """The same after a quarter turn: what pointed to the right points up."""
    turned = stack.rot90(1, (2, 3))
    if x is None:
        return turned
    return torch.cat([turned[:, :x], turned[:, x + 1 : x + 2], -turned[:, x : x + 1], turned[:, x + 2 :]], dim=1)
