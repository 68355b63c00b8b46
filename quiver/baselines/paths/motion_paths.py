"""Estimates how every place of a frame moves through a window of noisy frames: one smooth path per place.

    frames [B, K, H, W] at scales 8, 4, 2 (phi of pooled codes) -> the same without the shake of the camera
    (camera_motion.py) ->
    fast paths: scale 8, every velocity up to SPEED is tried, all frames vote -> scale 4, those of neighbours are tried
    slow paths: scale 4, every velocity up to SLOW is tried
    both: Gauss-Newton of velocity v and acceleration a at scale 4, all frames at once -> the better one at scale 2 ->
    Gauss-Newton at scale 2 -> no motion, or the smooth one of the camera, where it fits as well ->
    paths p + k v + k^2/2 a

Stripes of 16 px and finer textures vanish in cells of 8 px: only slow paths find them.

All frames of the window vote for one path, so that little light suffices; a pair of frames is never matched alone.
Costs are sums over blocks and the corrections of flat places follow their neighbours: no path is chosen by one pixel.
Frames that do not fit (occlusions, light that changes) lose their vote.

Ours; the steps are block matching, and the registration of Lucas and Kanade (1981) to the mean of all moved frames.
Fields are [B, 2, H, W] = (down, right), in pixels of the full frame per frame, at cells of one scale. All windows of a
batch have the same offsets; nothing waits for the host.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
import torch.nn.functional as functional
from torch import Tensor

from quiver.baselines.paths.camera_motion import (
    camera_motion,
    field,
    lattice,
    parted,
    seen_with_noise,
    seen_without,
    slope,
)
from quiver.baselines.paths.moved_frames import (
    SCALES,
    Path,
    box_mean,
    enlarged,
    look,
    look_still,
    look_with_noise,
    smooth_mean,
)
from quiver.baselines.paths.path_search import misfit, misfits_of, neighbours, search
from quiver.device import is_host

SPEED = 18.0  # px/frame, the fastest that is tried; refinement goes slightly beyond
SLOW = 3.0  # px/frame, the fastest that is tried at scale 4
STILL = (3, 60.0)  # radius of the block [cells of scale 2] over which a path must fit better than none, and by how much
PAN = 10.0  # by how much a path must fit the same block better than the smooth motion of the camera
GAIN = 120.0  # by how much a camera's motion must fit the frame better: sixty free numbers gain half of it from noise
BLOCK = 8  # cells of scale 2: side of the blocks that vote on the camera's motion
CERTAIN = 4.0  # of a motion's square in deviations of the noise, at which a block has half a vote
AGREE = 0.3  # of the votes that are expected if all blocks move as the camera does
SURE = 3.0  # deviations of the votes of blocks that know nothing
PANS = 2 / 3  # of AGREE and SURE suffices for a motion that is smooth in time: paths of their own can leave it
DETAIL = (6, 40.0)  # radius of the block [cells of scale 2] over which slow paths must fit better, and by how much
REFINE = ((4, 2, 2), (2, 4, 3))  # (scale, radius of the mean that is taken twice, in cells; iterations)
CORRECTION = 1.0  # px/frame, expected size of a correction of v
ACCELERATION = 0.1  # px/frame^2, expected size of a
MISFIT = 3.0  # variances of the noise at which a frame has half a vote
STIFFNESS = 50.0  # information of a block below which it follows its neighbours


@dataclass(frozen=True, eq=False)
class Moves:
    """Where every place of a frame goes: along its path, and from there as the camera shakes."""

    path: Path  # [B, 2, H, W] of the full frame
    shake: Tensor  # [B, K, 2, 3], of camera_motion.py, what no path follows; zero for windows without it
    far: Tensor | None = None  # [B, H, W], 1 where frames count that are too far for a path; None: there are none


def moves(pyramid: dict[int, Tensor], offsets: Sequence[int], codes: Tensor, deviation: Tensor) -> Moves:
    """Return how every place moves; arguments as of `paths`.

    The motion of the camera is found first, and taken if the places that can tell it agree. What is smooth in time of
    it is the path of every place that no other path fits better. The rest is shake, taken if it fits better than none;
    paths are found in the frames without it.
    """
    fine = SCALES[-1]
    camera = camera_motion(pyramid, offsets)
    smooth, shake = parted(camera, offsets)
    unit = fine / deviation
    rest = _spread(look_still(codes), None, None, unit)
    mean = seen_without(pyramid[fine], camera, fine)[0].mean(1)
    whole = _spread(*seen_with_noise(codes, camera, fine), unit)
    pans = agrees(rest - whole, told(mean, camera), PANS)
    if none_of(pans):
        return Moves(paths(pyramid, offsets, codes, deviation, still=rest), torch.zeros_like(shake))
    steady = _spread(*seen_with_noise(codes, camera - shake, fine), unit)
    shakes = (pans & agrees(steady - whole, told(mean, shake)))[:, None, None, None]
    smooth = torch.where(pans[:, None, None, None], smooth, 0.0)
    if none_of(shakes):
        still = torch.where(pans[:, None, None], steady, rest)
        return Moves(paths(pyramid, offsets, codes, deviation, smooth, still), torch.zeros_like(shake))
    shake = torch.where(shakes, shake, 0.0)
    without = {scale: torch.where(shakes, seen_without(x, shake, scale)[0], x) for scale, x in pyramid.items()}
    codes = torch.where(shakes, seen_without(codes, shake, fine)[0], codes)
    return Moves(paths(without, offsets, codes, deviation, smooth), shake)


def rests(found: Moves) -> Tensor:
    """Return 1 where a place neither moves nor is moved by its camera, else 0, [B, H, W]."""
    velocity, acceleration = found.path
    moved = velocity.abs().sum(1) + acceleration.abs().sum(1) + found.shake.abs().sum((1, 2, 3))[:, None, None]
    return (moved == 0).to(velocity.dtype)


def none_of(found: Tensor) -> bool:
    """Return whether nothing was found, so that what follows from it need not be computed; a GPU is not asked."""
    return is_host(found.device) and not found.numpy().any()


def told(mean: Tensor, camera: Tensor) -> Tensor:
    """Return how much a cell of the mean frame [B, h, w] tells of a motion [B, K, 2, 3]: [B, h, w].

    It is the square of what the motion changes there, in variances of the noise: what a cell gains if the motion is
    true, and loses if it is not.
    """
    places = lattice(*mean.shape[-2:], mean.device)
    pull = (slope(mean)[:, :, None] * places).flatten(1, 2)  # [B, 6, h, w], changes by each number of a motion
    numbers = camera.flatten(2)
    # The sum over frames of (numbers . pull)^2 is a quadratic form of pull: frames need not be seen one by one.
    form = numbers.mT @ numbers
    both = (form @ pull.flatten(2)).view_as(pull)
    return both.mul_(pull).sum(1).clamp_(min=0)  # of cells / scale px over 1 / scale of noise


def agrees(gain: Tensor, told: Tensor, share: float = 1.0) -> Tensor:
    """Return whether frames move as their camera does, bool [B], from what their cells gain and tell [B, h, w]; with
    this share of the votes that are asked for.

    Blocks vote, each with the certainty of its answer: a body that moves has few of them, however much it gains.
    """
    whole = functional.avg_pool2d(torch.stack([gain, told], dim=1), BLOCK, ceil_mode=True) * BLOCK**2
    gains, tells = whole.flatten(2).unbind(1)
    certain = tells / (tells + CERTAIN)
    # a gain has the mean E = tells and the deviation 2 sqrt(E): its sign is right by so much more often than wrong
    expected = (certain * torch.erf((tells / 8).sqrt())).sum(1)
    votes = (certain * gains.sign()).sum(1)
    by_chance = certain.square().sum(1).sqrt()
    enough = (votes > share * AGREE * expected) & (votes > share * SURE * by_chance)
    return enough & (gain.flatten(1).sum(1) > GAIN)


def paths(
    pyramid: dict[int, Tensor],
    offsets: Sequence[int],
    codes: Tensor,
    deviation: Tensor,
    smooth: Tensor | None = None,
    still: Tensor | None = None,
) -> Path:
    """Return velocity and acceleration [B, 2, H, W] of frames at each scale: {scale: [B, K, H/scale, W/scale]}.

    `offsets` are the frames' places in time; 0 is the reference. The noise of a frame at a scale has the deviation
    1 / scale, as phi of pooled codes nearly has. Mean `codes` [B, K, H/2, W/2] of scale 2 and the `deviation` of one
    code, [B, K, H/2, W/2], or [B, 1, H/2, W/2] where it is that of all frames, tell what moves: of four codes of one
    bit, phi has up to 1.8 times that variance. A path must fit better than no motion, or than the `smooth` motion of
    the camera, velocity and acceleration [B, 2, 2, 3]. The misfits [B, h, w] of that motion may be known: `still`, as
    `_spread` returns them.
    """
    coarse, middle, fine = (pyramid[scale] for scale in SCALES)
    shape = middle.shape[-2:]
    fast = neighbours(middle, offsets, enlarged(search(coarse, offsets, SCALES[0], SPEED), shape), SCALES[1])
    slow = enlarged(search(middle, offsets, SCALES[1], SLOW), shape)
    start = torch.cat([fast, slow])
    found = corrected(middle.repeat(2, 1, 1, 1), offsets, (start, torch.zeros_like(start)), *REFINE[0])
    velocity, acceleration = corrected(fine, offsets, _better(fine, offsets, found), *REFINE[1])
    found = (velocity, acceleration)
    base = None if smooth is None else field(smooth, *codes.shape[-2:])
    taken = moving(codes, deviation, offsets, found, base, still)
    full = [SCALES[-1] * side for side in codes.shape[-2:]]
    taken = functional.interpolate(taken[:, None].to(velocity.dtype), size=full)
    if smooth is None:
        return enlarged(velocity, full) * taken, enlarged(acceleration, full) * taken
    pan = field(smooth, *full)
    velocity, acceleration = (torch.lerp(pan[:, n], enlarged(x, full), taken) for n, x in enumerate(found))
    return velocity, acceleration


def _better(frames: Tensor, offsets: Sequence[int], found: Path) -> Path:
    """Return the second path where it fits the frames [B, K, h, w] of scale 2 better by DETAIL, else the first one.

    The paths [2 B, 2, ...] of all windows are followed by second ones of all windows.
    """
    radius, margin = DETAIL
    height = frames.shape[-2]
    both = [torch.cat(enlarged(field, frames.shape[-2:]).chunk(2), dim=2) for field in found]
    costs = misfits_of(frames, offsets, (both[0], both[1]), SCALES[2], radius)
    chosen = (costs[:, 0] - costs[:, 1] > margin)[:, None]
    velocity, acceleration = (torch.where(chosen, x[:, :, height:], x[:, :, :height]) for x in both)
    return velocity, acceleration


def corrected(frames: Tensor, offsets: Sequence[int], path: Path, scale: int, radius: int, iterations: int) -> Path:
    """Return a path after this many steps of `correct`."""
    for _ in range(iterations):
        path = correct(frames, offsets, *path, scale, radius)
    return path


def moving(
    codes: Tensor,
    deviation: Tensor,
    offsets: Sequence[int],
    path: Path,
    base: Tensor | None = None,
    still: Tensor | None = None,
) -> Tensor:
    """Return where paths at scale 2 fit the codes (see `paths`) better than no motion does, beyond what noise explains:
    bool [B, h, w]. A `base` [B, 2, 2, h, w], velocity and acceleration, stands for no motion; where it moves, paths
    lose no sharpness against it, and must only fit better than by the numbers that they have free. Its misfits are
    `still` if they are known.
    """
    radius, margin = STILL
    unit = SCALES[-1] / deviation
    least: Tensor | float = margin
    if base is not None:
        least = torch.where(base.abs().amax((1, 2)) > 0, PAN, margin)
    if still is None and base is not None:
        still = _spread(*look_with_noise(codes, (base[:, 0], base[:, 1]), offsets, SCALES[-1]), unit)
    elif still is None:
        still = _spread(look_still(codes), None, None, unit)
    gain = still.sub(_spread(*look_with_noise(codes, path, offsets, SCALES[-1]), unit))
    return box_mean(gain, radius) * (2 * radius + 1) ** 2 > least


def _spread(seen: Tensor, there: Tensor | None, kept: Tensor | None, unit: Tensor) -> Tensor:
    """Return misfits of seen frames [B, K, h, w] to their mean, in units of noise, summed over frames [B, h, w].

    A frame that is not `there` counts 1; None: all are. `kept` is the share of the noise; None: all of it.
    """
    frames = seen.shape[1]
    if there is None or kept is None:
        difference = (seen - seen.sum(1, keepdim=True) / frames).mul_(unit)
        return misfit(difference, torch.zeros_like(unit).expand_as(difference), 1 - 1 / frames).sum(1)
    count = there.sum(1, keepdim=True)
    mean = (seen * there).sum(1, keepdim=True) / count
    difference = (seen - mean).mul_(unit)
    parts = misfit(difference, torch.zeros_like(unit).expand_as(difference), kept.mul_(1 - 1 / count))
    return parts.mul_(there).add_(1 - there).sum(1)


@dataclass(frozen=True)
class Times:
    """Powers of offsets that are independent of each other and of 1: k less its mean, and q = k^2/2 less its part of k
    and of 1.
    """

    rows: Tensor  # [2, K] = (k, q)
    fast: float  # sum of k^2
    bent: float  # sum of q^2
    mix: float  # of k in k^2/2
    far: int  # the largest |k| before the mean was taken off


@lru_cache(maxsize=64)
def times_of(offsets: tuple[int, ...], device: torch.device) -> Times:
    """Return the powers of offsets, on a device."""
    k = torch.tensor(offsets, dtype=torch.float32)
    q = k * k / 2
    k = k - k.mean()
    q = q - q.mean()
    fast = float(k @ k)
    # Where the reference is not in the middle of the window, k and k^2 / 2 go together; without that their equations
    # fall apart into two.
    mix = float(k @ q) / fast if fast else 0.0
    q = q - mix * k
    far = max(abs(offset) for offset in offsets)
    return Times(torch.stack([k, q]).to(device), fast, float(q @ q), mix, far)


def correct(
    frames: Tensor, offsets: Sequence[int], velocity: Tensor, acceleration: Tensor, scale: int, radius: int
) -> Path:
    """Return velocity and acceleration [B, 2, h, w] after one step of Gauss-Newton over about 4 radius + 1 cells.

    The step makes moved frames equal to their weighted mean. In time, velocity and acceleration are made independent:
    with k and q = k^2/2 about their means, q' = q - mix k has no part of k.
    """
    information = float(scale**2)  # of a cell: 1 / variance of the noise
    times = times_of(tuple(offsets), frames.device)
    if times.fast == 0:
        return velocity, acceleration
    mean, errors, share = _errors(frames, offsets, (velocity, acceleration), scale)
    along = (times.rows @ errors.flatten(2)).view(-1, 2, *errors.shape[2:])  # errors that grow with k, and with q
    edge = functional.pad(mean[:, None], (1, 1, 1, 1), mode="replicate")
    slope = torch.cat([edge[..., 2:, 1:-1] - edge[..., :-2, 1:-1], edge[..., 1:-1, 2:] - edge[..., 1:-1, :-2]], dim=1)
    slope /= 2
    share = share[:, None]
    products = torch.cat(
        [share * slope.square(), share * slope[:, :1] * slope[:, 1:], slope * along[:, :1], slope * along[:, 1:]], dim=1
    )
    sums = smooth_mean(products, radius).mul_(information * (2 * radius + 1) ** 2)
    yy, xx, yx = sums[:, :3].split(1, dim=1)
    # A prior on the size of a correction keeps blocks with one edge, or none, from running along it.
    prior = (scale / CORRECTION) ** 2
    dv = _solved(yy * times.fast + prior, yx * times.fast, xx * times.fast + prior, -sums[:, 3:5])
    dv = _limited(dv, 1.5 / times.far)
    da = torch.zeros_like(dv)
    if times.bent > 1e-6:
        prior = (scale / ACCELERATION) ** 2
        pull = -sums[:, 5:] - prior / scale * acceleration
        da = _limited(
            _solved(yy * times.bent + prior, yx * times.bent, xx * times.bent + prior, pull), 3 / times.far**2
        )
    moved = torch.cat([velocity + scale * (dv - times.mix * da), acceleration + scale * da], dim=1)
    told = yy + xx
    means = smooth_mean(torch.cat([moved * (told + 1), told + 1], dim=1), radius)
    # Flat blocks know nothing of their motion, and follow those around that do.
    moved = torch.lerp(moved, means[:, :4] / means[:, 4:], STIFFNESS / (STIFFNESS + told))
    return moved[:, :2], moved[:, 2:]


def _errors(frames: Tensor, offsets: Sequence[int], path: Path, scale: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean of the moved frames [B, h, w], their weighted deviations from it [B, K, h, w], and the mean vote
    [B, h, w].
    """
    moved, inside = look(frames, path, offsets, scale)
    mean = (moved * inside).sum(1, keepdim=True) / inside.sum(1, keepdim=True)
    vote = box_mean((moved - mean).square_(), 1).mul_(scale**2 / MISFIT).square_().add_(1)
    # Robust weights: what fits badly loses its vote, without a threshold.
    vote = torch.div(inside, vote, out=vote)
    mean = (moved * vote).sum(1, keepdim=True) / vote.sum(1, keepdim=True).clamp_(min=1e-6)
    return mean[:, 0], moved.sub_(mean).mul_(vote), vote.mean(1)


def _solved(yy: Tensor, yx: Tensor, xx: Tensor, pull: Tensor) -> Tensor:
    """Return the solution [B, 2, h, w] of [[yy, yx], [yx, xx]] solution = pull [B, 2, h, w], pixel by pixel."""
    down, right = pull.split(1, dim=1)
    return torch.cat([xx * down - yx * right, yy * right - yx * down], dim=1) / (yy * xx - yx * yx)


def _limited(step: Tensor, most: float) -> Tensor:
    """Return steps [B, 2, h, w] shortened to `most`."""
    return step * (most / step.square().sum(1, keepdim=True).sqrt_().clamp_(min=most))
