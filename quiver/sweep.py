"""Where things move, found by trying: the velocity under which the frames of a window agree best.

    cost(v, p) = mean over p's surroundings of  sum_k w_k x_k(p + k v)^2 - (sum_k w_k x_k(p + k v))^2

the weighted variance over time along a straight path, k = frames from the centre, x = sqrt(code + OFFSET): without the
root, whose photon noise is about the same everywhere, the least variance would be where there is least light. All
velocities of a grid are tried, as plane sweeps try depths (Collins, "A space-sweep approach to true multi-image
matching", CVPR 1996); the best is refined in smaller steps and smoothed by a median. Nothing is learnt, nothing is
differentiated: photon noise that hides a pixel from its neighbour in time is averaged over frames and a neighbourhood
before anything is decided. What turns or accelerates moves straight on over the few frames that count; what is covered
and uncovered is left to the network.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from quiver.ops import warp

OFFSET = 0.05  # in units of full scale: about 3/8 of a 3-bit code (Anscombe 1948), too much for more bits
SIGMA = 2.0  # frames, of the weights over time
REACH = 4  # frames from the centre that count: beyond, weights are under 0.03
STEP = 0.5  # px/frame, of the grid of velocities
REFINED = (0.25, 0.125)  # px/frame, steps around the best
SIDE = 7  # px, of the surroundings and of the median
PREFERENCE = 0.02  # relative cost of 1 px/frame: where nothing tells velocities apart, things rest
FLOOR = 1e-6  # added to every variance, so that this holds for frames without noise too


@torch.no_grad()
def velocities(window: Tensor, largest: float) -> tuple[Tensor, Tensor]:
    """Frames [N, T, h, w], T odd -> velocity [N, 2, h, w] (x, y; px/frame) in the middle, and its cost [N, 1, h, w].

    `largest` bounds the tried components; the cost is that before the last median. Frame t shows at p + (t - T // 2) v
    what the middle one shows at p.
    """
    frames = (window.float().clamp(min=0) + OFFSET).sqrt()
    middle = frames.shape[1] // 2
    reach = min(REACH, middle)
    frames = frames[:, middle - reach : middle + reach + 1]
    times = torch.arange(-reach, reach + 1, device=frames.device)
    weights = torch.exp(-0.5 * (times / SIGMA) ** 2)
    weights = weights / weights.sum()
    velocity = _coarse(frames, weights, largest)
    for step in REFINED:
        velocity, cost = _refined(frames, weights, velocity, step)
        velocity = _median(velocity)
    return velocity, cost


def aligned(window: Tensor, velocity: Tensor) -> Tensor:
    """Frames [N, T, h, w] drawn to where the middle one shows the same: bilinear, clamped at the border."""
    count, length, height, width = window.shape
    times = torch.arange(length, device=window.device, dtype=velocity.dtype) - length // 2
    flow = times.view(1, -1, 1, 1, 1) * velocity[:, None]
    moved = warp(window.reshape(-1, 1, height, width), flow.reshape(-1, 2, height, width), "border")
    return moved.view(count, length, height, width)


def _coarse(frames: Tensor, weights: Tensor, largest: float) -> Tensor:
    """The best velocity of the grid; frames are shifted by whole pixels, rows and columns apart."""
    count, length, height, width = frames.shape
    reach, n = length // 2, int(largest / STEP)
    shifts = [[round(k * i * STEP) for i in range(-n, n + 1)] for k in range(-reach, reach + 1)]  # [frame][velocity]
    edge = math.ceil(reach * n * STEP)
    padded = F.pad(frames, (edge,) * 4, mode="replicate")
    columns = [
        torch.stack([padded[:, t, :, edge + s : edge + s + width] for s in along]) for t, along in enumerate(shifts)
    ]
    pooled = []
    for row in range(2 * n + 1):  # vy
        total = frames.new_zeros(2 * n + 1, count, height, width)  # by vx
        squares = torch.zeros_like(total)
        for t, along in enumerate(shifts):
            moved = columns[t][:, :, edge + along[row] : edge + along[row] + height]
            total.add_(moved, alpha=float(weights[t]))
            squares.addcmul_(moved, moved, value=float(weights[t]))
        variance = squares.addcmul_(total, total, value=-1)
        pooled.append(F.avg_pool2d(variance, SIDE + 1, 2, SIDE // 2, ceil_mode=True, count_include_pad=False))
    one = (torch.arange(2 * n + 1, device=frames.device, dtype=frames.dtype) - n) * STEP
    grid = torch.stack([one.repeat(2 * n + 1), one.repeat_interleave(2 * n + 1)])  # x, y
    paid = torch.cat(pooled).clamp(min=0).add_(FLOOR) * (1 + PREFERENCE * grid.norm(dim=0))[:, None, None, None]
    return F.interpolate(grid[:, paid.argmin(0)].transpose(0, 1), size=(height, width), mode="nearest")


def _refined(frames: Tensor, weights: Tensor, velocity: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """The best of a velocity and its eight neighbours at a distance of `step`, pixel by pixel, and its cost."""
    weights = weights.view(1, -1, 1, 1)
    best, lowest = velocity, None
    for dx in (0.0, -step, step):
        for dy in (0.0, -step, step):
            tried = velocity + velocity.new_tensor([dx, dy]).view(1, 2, 1, 1)
            moved = aligned(frames, tried)
            mean = (moved * weights).sum(1, keepdim=True)
            variance = (moved * moved * weights).sum(1, keepdim=True) - mean * mean
            cost = F.avg_pool2d(variance, SIDE, 1, SIDE // 2, count_include_pad=False)
            cost = cost.clamp(min=0).add(FLOOR) * (1 + PREFERENCE * tried.norm(dim=1, keepdim=True))
            if lowest is None:
                best, lowest = tried, cost
            else:
                best, lowest = torch.where(cost < lowest, tried, best), torch.minimum(cost, lowest)
    assert lowest is not None
    return best, lowest


def _median(field: Tensor) -> Tensor:
    """Each channel's median over SIDE x SIDE pixels."""
    flat = field.flatten(0, 1)[:, None]
    around = F.unfold(F.pad(flat, (SIDE // 2,) * 4, mode="replicate"), SIDE)
    return around.median(dim=1).values.view(field.shape)
