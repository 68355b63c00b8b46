"""Estimates how every place of a frame moves through a window of noisy frames: one smooth path per place.

    frames [K, H, W] at scales 8, 4, 2 (phi of pooled codes) ->
    fast paths: scale 8, every velocity up to SPEED is tried, all frames vote -> scale 4, those of neighbours are tried
    slow paths: scale 4, every velocity up to SLOW is tried
    both: Gauss-Newton of velocity v and acceleration a at scale 4, all frames at once -> the better one at scale 2 ->
    Gauss-Newton at scale 2 -> no motion where it fits as well -> paths p + k v + k^2/2 a

Stripes of 16 px and finer textures vanish in cells of 8 px: only slow paths find them.

All frames of the window vote for one path, so that little light suffices; a pair of frames is never matched alone.
Costs are sums over blocks and the corrections of flat places follow their neighbours: no path is chosen by one pixel.
Frames that do not fit (occlusions, light that changes) lose their vote.

Ours; the steps are block matching, and the registration of Lucas and Kanade (1981) to the mean of all moved frames.
Fields are [2, H, W] = (down, right), in pixels of the full frame per frame, at cells of one scale.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from quiver.baselines.paths.moved_frames import (
    SCALES,
    Path,
    box_mean,
    displacement,
    enlarged,
    kept_noise,
    look,
    smooth_mean,
)
from quiver.baselines.paths.path_search import misfit, misfits_of, neighbours, search

SPEED = 18.0  # px/frame, the fastest that is tried; refinement goes slightly beyond
SLOW = 3.0  # px/frame, the fastest that is tried at scale 4
STILL = (3, 60.0)  # radius of the block [cells of scale 2] over which a path must fit better than none, and by how much
DETAIL = (6, 40.0)  # radius of the block [cells of scale 2] over which slow paths must fit better, and by how much
REFINE = ((4, 2, 2), (2, 4, 3))  # (scale, radius of the mean that is taken twice, in cells; iterations)
CORRECTION = 1.0  # px/frame, expected size of a correction of v
ACCELERATION = 0.1  # px/frame^2, expected size of a
MISFIT = 3.0  # variances of the noise at which a frame has half a vote
STIFFNESS = 50.0  # information of a block below which it follows its neighbours


def paths(
    pyramid: dict[int, Tensor], offsets: Sequence[int], codes: Tensor, deviation: Tensor
) -> tuple[Tensor, Tensor]:
    """Return velocity and acceleration [2, H, W] of frames at each scale: {scale: [K, H/scale, W/scale]}.

    `offsets` are the frames' places in time; 0 is the reference. The noise of a frame at a scale has the deviation
    1 / scale, as phi of pooled codes nearly has. Mean `codes` [K, H/2, W/2] of scale 2 and the `deviation` [H/2, W/2]
    of one code tell what moves: of four codes of one bit, phi has up to 1.8 times that variance.
    """
    coarse, middle, fine = (pyramid[scale] for scale in SCALES)
    shape = middle.shape[1:]
    fast = neighbours(middle, offsets, enlarged(search(coarse, offsets, SCALES[0], SPEED), shape), SCALES[1])
    slow = enlarged(search(middle, offsets, SCALES[1], SLOW), shape)
    found = [corrected(middle, offsets, (each, torch.zeros_like(each)), *REFINE[0]) for each in (fast, slow)]
    velocity, acceleration = corrected(fine, offsets, _better(fine, offsets, found), *REFINE[1])
    full = [SCALES[-1] * side for side in codes.shape[1:]]
    moves = moving(codes, deviation, offsets, velocity, acceleration)
    moves = functional.interpolate(moves[None, None].to(velocity.dtype), size=full)[0]
    return enlarged(velocity, full) * moves, enlarged(acceleration, full) * moves


def _better(frames: Tensor, offsets: Sequence[int], found: Sequence[Path]) -> Path:
    """Return the second path where it fits the frames [K, h, w] of scale 2 better by DETAIL, else the first one."""
    radius, margin = DETAIL
    fast, slow = ((enlarged(v, frames.shape[1:]), enlarged(a, frames.shape[1:])) for v, a in found)
    costs = [misfits_of(frames, offsets, path, SCALES[2], radius) for path in (fast, slow)]
    chosen = costs[0] - costs[1] > margin
    return torch.where(chosen, slow[0], fast[0]), torch.where(chosen, slow[1], fast[1])


def corrected(frames: Tensor, offsets: Sequence[int], path: Path, scale: int, radius: int, iterations: int) -> Path:
    """Return a path after this many steps of `correct`."""
    for _ in range(iterations):
        path = correct(frames, offsets, *path, scale, radius)
    return path


def moving(codes: Tensor, deviation: Tensor, offsets: Sequence[int], velocity: Tensor, acceleration: Tensor) -> Tensor:
    """Return where paths at scale 2 fit the codes (see `paths`) better than no motion does, beyond what noise explains:
    bool [h, w].
    """
    radius, margin = STILL
    nothing = torch.zeros_like(velocity)
    still, moved = (_spread(codes, deviation, offsets, *path) for path in ((nothing,) * 2, (velocity, acceleration)))
    return box_mean((still - moved)[None], radius)[0] * (2 * radius + 1) ** 2 > margin


def _spread(codes: Tensor, deviation: Tensor, offsets: Sequence[int], velocity: Tensor, acceleration: Tensor) -> Tensor:
    """Return misfits of moved frames to their mean, summed over frames [h, w]; 1 for one that the path leaves."""
    scale = SCALES[-1]
    moved = [displacement(velocity, acceleration, offset, scale) for offset in offsets]
    seen, there = (torch.stack(x) for x in zip(*map(look, codes, moved), strict=True))
    count = there.sum(0)
    mean = (seen * there).sum(0) / count
    noise = torch.stack([kept_noise(x) for x in moved]) * (1 - 1 / count)
    return torch.where(there > 0, misfit((seen - mean) * (scale / deviation), noise), 1.0).sum(0)


def correct(
    frames: Tensor, offsets: Sequence[int], velocity: Tensor, acceleration: Tensor, scale: int, radius: int
) -> tuple[Tensor, Tensor]:
    """Return velocity and acceleration [2, h, w] after one step of Gauss-Newton over about 4 radius + 1 cells.

    The step makes moved frames equal to their weighted mean. In time, velocity and acceleration are made independent:
    with k and q = k^2/2 about their means, q' = q - mix k has no part of k.
    """
    information = float(scale**2)  # of a cell: 1 / variance of the noise
    k = torch.tensor([float(offset) for offset in offsets])
    q = k * k / 2
    k = k - k.mean()
    q = q - q.mean()
    fast = float(k @ k)
    if fast == 0:
        return velocity, acceleration
    # Where the reference is not in the middle of the window, k and k^2 / 2 go
    # together; without that their equations fall apart into two.
    mix = float(k @ q) / fast
    q = q - mix * k
    bent = float(q @ q)
    mean, errors, share = _errors(frames, offsets, velocity, acceleration, scale)
    along = torch.tensordot(
        torch.stack([k, q]), errors, 1
    )  # [2, h, w]: errors that grow with time, and with its square
    edge = functional.pad(mean[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    slope = torch.stack([edge[2:, 1:-1] - edge[:-2, 1:-1], edge[1:-1, 2:] - edge[1:-1, :-2]]) / 2
    products = torch.stack(
        [*(share * slope.square()), share * slope[0] * slope[1], *(slope * along[0]), *(slope * along[1])],
    )
    yy, xx, yx, *pulls = smooth_mean(products, radius) * (information * (2 * radius + 1) ** 2)
    far = max(abs(offset) for offset in offsets)
    # A prior on the size of a correction keeps blocks with one edge, or none, from running along it.
    prior = (scale / CORRECTION) ** 2
    dv = _limited(_solved(yy * fast + prior, yx * fast, xx * fast + prior, -torch.stack(pulls[:2])), 1.5 / far)
    da = torch.zeros_like(dv)
    if bent > 1e-6:
        prior = (scale / ACCELERATION) ** 2
        pull = -torch.stack(pulls[2:]) - prior / scale * acceleration
        da = _limited(_solved(yy * bent + prior, yx * bent, xx * bent + prior, pull), 3 / far**2)
    moved = torch.cat([velocity + scale * (dv - mix * da), acceleration + scale * da])
    told = yy + xx
    sums = smooth_mean(torch.cat([moved * (told + 1), (told + 1)[None]]), radius)
    # Flat blocks know nothing of their motion, and follow those around that do.
    moved = torch.lerp(moved, sums[:4] / sums[4], STIFFNESS / (STIFFNESS + told))
    return moved[:2], moved[2:]


def _errors(
    frames: Tensor, offsets: Sequence[int], velocity: Tensor, acceleration: Tensor, scale: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean of the moved frames [h, w], their weighted deviations from it [K, h, w], the mean vote [h, w]."""
    seen, votes = zip(
        *(
            look(frame, displacement(velocity, acceleration, offset, scale))
            for frame, offset in zip(frames, offsets, strict=True)
        ),
        strict=True,
    )
    moved = torch.stack(seen)
    inside = torch.stack(votes)
    mean = (moved * inside).sum(0) / inside.sum(0)
    misfit = box_mean((moved - mean).square_(), 1) * (scale**2 / MISFIT)
    # Robust weights: what fits badly loses its vote, without a threshold.
    vote = inside / (1 + misfit.square_())
    mean = (moved * vote).sum(0) / vote.sum(0).clamp_(min=1e-6)
    return mean, (moved - mean).mul_(vote), vote.mean(0)


def _solved(yy: Tensor, yx: Tensor, xx: Tensor, pull: Tensor) -> Tensor:
    """Return the solution [2, h, w] of [[yy, yx], [yx, xx]] solution = pull [2, h, w], pixel by pixel."""
    return torch.stack([xx * pull[0] - yx * pull[1], yy * pull[1] - yx * pull[0]]) / (yy * xx - yx * yx)


def _limited(step: Tensor, most: float) -> Tensor:
    """Return steps [2, h, w] shortened to `most`."""
    return step * (most / (step[0].square() + step[1].square()).sqrt_().clamp_(min=most))
