"""Estimates the motion in a window of noisy frames: a grid search over velocities, then gradient refinement.

The path of a pixel minimises the weighted variance over time around it:

    path(k) = p + k v + k^2/2 a,   k = frames from the centre
    cost(v, a, p) = mean over p's surroundings of  sum_k w_k x_k(path(k))^2 - (sum_k w_k x_k(path(k)))^2

Here x = sqrt(code + OFFSET), which gives photon noise about the same variance everywhere. Without the root, the
variance would be least where the light is least.

1. At half the size, all velocities of a grid are tried, as plane sweeps try depths (Collins, "A space-sweep approach to
   true multi-image matching", CVPR 1996). A median smooths the result.
2. At full size, a step of Lucas and Kanade ("An iterative image registration technique", IJCAI 1981) corrects velocity
   and acceleration with all frames at once, g = gradient of the aligned mean, <> = mean over p's surroundings:

    dv = -(sum_k w_k k^2   <g g'>)^-1 <g sum_k w_k k   x_k(path(k))>
    da = -(sum_k w_k q_k^2 <g g'>)^-1 <g sum_k w_k q_k x_k(path(k))>,   q_k = k^2/2 - sum_k w_k k^2/2

3. The path of a neighbour replaces that of a pixel where it costs less (as in PatchMatch, Barnes et al., ACM TOG 28(3),
   2009). Steps 2 and 3 alternate.

Nothing is learnt and nothing is differentiated. Averaging over frames and surroundings comes before every decision, so
that photon noise does not decide. Occlusions are left to the network.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

OFFSET = 0.05  # of full scale: about 3/8 of a 3-bit code (Anscombe 1948); more than that for more bits
SIGMA = 2.0  # frames, of the weights over time
REACH = 4  # frames before and after the centre; beyond, weights are below 0.03
STEP = 0.5  # px/frame at half the size, between the velocities of the grid
SIDE = 7  # px at half the size, of the surroundings in step 1 and of the median
PREFERENCE = 0.02  # relative cost of 1 px/frame: of velocities with equal variance the smallest is taken
NEIGHBOURS = (8, 4)  # px, distance of the neighbours whose paths are tried, in the first and second turn
SMOOTH, EVEN = 3, 5  # px: smoothing of the mean before its gradient, and of dv and da
AROUND = (9, 15)  # px: side of <> for velocity and acceleration
MOST = (0.5, 0.2)  # px/frame, px/frame^2: largest correction of one step
DAMPING = (1e-4, 1e-3)  # added to <g g'>: gradients with a smaller square have little effect
FLOOR = 1e-6  # added to every variance, so that PREFERENCE also acts on frames without noise


@torch.no_grad()
def paths(window: Tensor, largest: float) -> tuple[Tensor, Tensor]:
    """Return velocity and acceleration [N, 2, H, W] (x, y; px/frame, px/frame^2) of the middle of frames [N, T, H, W].

    T is odd. `largest` bounds the components of the grid, in px/frame. A point at p in the middle frame, k = 0, is at
    p + k v + k^2/2 a in frame k.
    """
    middle = window.shape[1] // 2
    reach = min(REACH, middle)
    frames = window[:, middle - reach : middle + reach + 1].float().clamp(min=0)
    half = F.avg_pool2d(frames, 2, ceil_mode=True, count_include_pad=False)
    weights = time_weights(2 * reach + 1, frames.device)
    velocity = 2 * _resize(_median(best_of_grid(_stable(half), weights, largest / 2)), frames.shape[2:])
    frames = _stable(frames)
    path = _corrected(frames, torch.cat([velocity, torch.zeros_like(velocity)], 1))
    for distance in NEIGHBOURS:
        path = _corrected(frames, _cheapest(frames, path, distance))
    return path[:, :2], path[:, 2:]


@torch.no_grad()
def disagreement(moved_frames: Tensor) -> Tensor:
    """Return the remaining variance over time [N, 1, H, W] of aligned frames [N, T, H, W]."""
    return _variance(_stable(moved_frames.float().clamp(min=0)))


def time_weights(length: int, device: torch.device) -> Tensor:
    """Return the weights w_k [T] of `length` frames; their sum is 1."""
    weights = torch.exp(-0.5 * ((torch.arange(length, device=device) - length // 2) / SIGMA) ** 2)
    return weights / weights.sum()


def aligned(window: Tensor, velocity: Tensor, acceleration: Tensor) -> Tensor:
    """Align frames [N, T, H, W] to the middle one along paths [N, 2, H, W]: bilinear, clamped at the border."""
    count, length, height, width = window.shape
    with torch.autocast(window.device.type, enabled=False):
        dtype = torch.promote_types(window.dtype, torch.float32)
        frames, path = window.to(dtype), torch.cat([velocity, acceleration], 1).to(dtype)
        # Positions in grid_sample's units, -1 to 1 between the outer edges, built in its order of axes
        k = (torch.arange(length, device=window.device, dtype=path.dtype) - length // 2).view(1, -1, 1, 1, 1)
        unit = 2 / path.new_tensor([width, height, width, height])
        v, a = (path.permute(0, 2, 3, 1) * unit)[:, None].split(2, dim=-1)  # [N, 1, H, W, 2] each
        y, x = ((2 * torch.arange(n, device=window.device, dtype=path.dtype) + 1) / n - 1 for n in (height, width))
        grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).addcmul(k, v).addcmul_(k * k / 2, a)
        flat = frames.reshape(-1, 1, height, width)
        moved = F.grid_sample(flat, grid.flatten(0, 1), padding_mode="border", align_corners=False)
    return moved.view(count, length, height, width)


def best_of_grid(frames: Tensor, weights: Tensor, largest: float) -> Tensor:
    """Return the velocity [N, 2, h, w] of the grid that costs least; frames [N, T, h, w] are shifted by pixels."""
    count, length, height, width = frames.shape
    reach, n = length // 2, int(largest / STEP)
    shifts = [[round(k * i * STEP) for i in range(-n, n + 1)] for k in range(-reach, reach + 1)]  # [frame][velocity]
    edge = math.ceil(reach * n * STEP)
    padded = F.pad(frames, (edge,) * 4, mode="replicate")
    columns = [
        torch.stack([padded[:, t, :, edge + s : edge + s + width] for s in shift]) for t, shift in enumerate(shifts)
    ]
    along = (torch.arange(2 * n + 1, device=frames.device, dtype=frames.dtype) - n) * STEP
    best, lowest = None, None  # velocity [2, N, h, w] and its cost, of the rows so far
    for row in range(2 * n + 1):  # vy
        total = frames.new_zeros(2 * n + 1, count, height, width)  # by vx
        squares = torch.zeros_like(total)
        for t, shift in enumerate(shifts):
            moved = columns[t][:, :, edge + shift[row] : edge + shift[row] + height]
            total.add_(moved, alpha=float(weights[t]))
            squares.addcmul_(moved, moved, value=float(weights[t]))
        variance = squares.addcmul_(total, total, value=-1)
        grid = torch.stack([along, along[row].expand_as(along)])  # x, y
        unlikely = (1 + PREFERENCE * torch.hypot(*grid))[:, None, None, None]
        price, at = (means_at(variance, SIDE + 1, 2).clamp_(min=0).add_(FLOOR) * unlikely).min(0)
        found = grid[:, at]
        if best is None or lowest is None:
            best, lowest = found, price
        else:
            best, lowest = torch.where(price < lowest, found, best), torch.minimum(price, lowest)
    assert best is not None
    return F.interpolate(best.transpose(0, 1), size=(height, width), mode="nearest")


def _corrected(frames: Tensor, path: Tensor) -> Tensor:
    """Return velocity and acceleration [N, 4, H, W] after one step of Lucas and Kanade with all frames at once."""
    weights = time_weights(frames.shape[1], frames.device)
    k = torch.arange(len(weights), device=frames.device, dtype=frames.dtype) - len(weights) // 2
    moved_frames = aligned(frames, path[:, :2], path[:, 2:])
    mean = _mean_around(_over_time(moved_frames, weights), SMOOTH)
    padded = F.pad(mean, (1, 1, 1, 1), mode="replicate")
    gx, gy = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) / 2, (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) / 2
    steps = []
    for moment, side, most, damping in zip((k, k * k / 2), AROUND, MOST, DAMPING, strict=True):
        moment = moment - (weights * moment).sum()
        slope = _over_time(moved_frames, weights * moment)
        products = _mean_around(torch.cat([gx * gx, gx * gy, gy * gy, gx * slope, gy * slope], 1), side)
        xx, xy, yy, bx, by = products.split(1, dim=1)
        xx, yy = xx + damping, yy + damping
        solved = torch.cat([xy * by - yy * bx, xy * bx - xx * by], 1) / (xx * yy - xy * xy)
        step = solved / (weights * moment * moment).sum()
        steps.append(step.nan_to_num().clamp(-most, most))  # NaN: a single frame has no moments
    return path + _mean_around(torch.cat(steps, 1), EVEN)


def _cheapest(frames: Tensor, path: Tensor, distance: int) -> Tensor:
    """Return for each pixel the path [N, 4, H, W] that costs least: its own or that of one of four neighbours."""

    def cost(tried: Tensor) -> Tensor:
        velocity = tried[:, :2]
        paid = PREFERENCE / 2 * torch.hypot(velocity[:, :1], velocity[:, 1:])  # much faster than .norm
        return (_variance(aligned(frames, velocity, tried[:, 2:])) + FLOOR) * (1 + paid)

    best, lowest = path, cost(path)
    height, width = path.shape[2:]
    around = F.pad(path, (distance,) * 4, mode="replicate")
    for dy, dx in ((0, distance), (0, -distance), (distance, 0), (-distance, 0)):
        tried = around[:, :, distance + dy : distance + dy + height, distance + dx : distance + dx + width]
        price = cost(tried)
        best, lowest = torch.where(price < lowest, tried, best), torch.minimum(price, lowest)
    return best


def _variance(frames: Tensor) -> Tensor:
    """Return the weighted variance over time of [N, T, H, W], averaged around each pixel: [N, 1, H, W]."""
    weights = time_weights(frames.shape[1], frames.device)
    mean = _over_time(frames, weights)
    return _mean_around(_over_time(frames * frames, weights) - mean * mean, AROUND[0]).clamp(min=0)


def _over_time(frames: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted sum over time, [N, 1, H, W]."""
    return (frames * weights.view(1, -1, 1, 1)).sum(1, keepdim=True)


def _stable(frames: Tensor) -> Tensor:
    """Return roots of codes in units of full scale, whose photon noise is about the same everywhere."""
    return (frames + OFFSET).sqrt()


def _resize(field: Tensor, size: torch.Size) -> Tensor:
    return F.interpolate(field, size=size, mode="bilinear", align_corners=False)


def _mean_around(image: Tensor, side: int) -> Tensor:
    """Return means [N, C, H, W] over side x side pixels, of those inside the image."""
    return means_at(image, side, 1)


def means_at(image: Tensor, side: int, stride: int) -> Tensor:
    """See `_mean_around`: its means at every `stride`-th pixel only."""
    height, width = image.shape[2:]
    before = (side - 1) // 2
    sums = F.pad(image, (before, side - 1 - before, before, side - 1 - before))
    for dim, length in ((3, width), (2, height)):
        there = torch.ones(length, dtype=image.dtype, device=image.device)
        counts = _sums(F.pad(there, (before, side - 1 - before)), side, 0)[::stride]
        shape = [-1 if axis == dim else 1 for axis in range(4)]
        sums = _sums(sums, side, dim)[(slice(None),) * dim + (slice(None, None, stride),)] / counts.view(shape)
    return sums


def _sums(values: Tensor, side: int, dim: int) -> Tensor:
    """Return sums of `side` neighbours along one axis, by doubling and without cancellation."""
    length = values.shape[dim] - side + 1
    total, taken, width = None, 0, 1
    while True:
        if side & width:
            piece = values.narrow(dim, taken, length)
            total, taken = piece if total is None else total + piece, taken + width
        if 2 * width > side:
            assert total is not None
            return total
        shorter = values.shape[dim] - width
        values, width = values.narrow(dim, 0, shorter) + values.narrow(dim, width, shorter), 2 * width


def _median(field: Tensor) -> Tensor:
    """Return the median of each channel [N, C, H, W] over SIDE x SIDE pixels."""
    flat = field.flatten(0, 1)[:, None]
    around = F.unfold(F.pad(flat, (SIDE // 2,) * 4, mode="replicate"), SIDE)
    return around.median(dim=1).values.view(field.shape)
