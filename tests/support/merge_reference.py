"""Merging and its inputs as plain NumPy and torch on the CPU, one window and one frame at a time.

What `quiver.baselines.path_merge`, its paths and `quiver.restoration.merge_inputs` compute in batches on any device is
compared with this.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as functional
from numpy import ndarray as Array
from torch import Tensor

from quiver.baselines.information_domain import FLOOR, InformationDomain

# ---- Moved frames

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
    share = part.square() + (1 - part).square()
    return share[0] * share[1]


def cubic_weights(part: Tensor) -> Tensor:
    """Return the four weights [4, ...] of the cubic kernel of Keys (1981) with a slope of -0.75, at places between the
    second and the third pixel.
    """
    a = -0.75

    def beside(x: Tensor) -> Tensor:
        return ((a + 2) * x - (a + 3)) * x * x + 1

    def beyond(x: Tensor) -> Tensor:
        return ((a * x - 5 * a) * x + 8 * a) * x - 4 * a

    return torch.stack([beyond(1 + part), beside(part), beside(1 - part), beyond(2 - part)])


def in_picture(moved: Tensor, size: tuple[int, int] | None = None) -> Tensor:
    """Return where pixels go by moved [2, H, W], at the last pixels of `size` where that lies beyond them."""
    height, width = moved.shape[-2:]
    rows, columns = (height, width) if size is None else size
    y = (torch.arange(height, dtype=moved.dtype)[:, None] + moved[0]).clamp(0, rows - 1)
    x = (torch.arange(width, dtype=moved.dtype)[None] + moved[1]).clamp(0, columns - 1)
    return torch.stack([y, x])


def kept_noise_of_cubic(moved: Tensor) -> Tensor:
    """Return the share of the noise's variance [..., H, W] that is left at p + moved [2, ..., H, W], seen by `look` of
    cubics.
    """
    share = cubic_weights(moved - moved.floor()).square().sum(0)
    return share[0] * share[1]


def displacement(velocity: Tensor, acceleration: Tensor, offset: int, scale: int = 1) -> Tensor:
    """Return where paths lead after `offset` frames, [2, H, W], in cells of a scale."""
    return (velocity * offset + acceleration * (offset * offset / 2)) / scale


def look(
    image: Tensor, moved: Tensor, size: tuple[int, int] | None = None, mode: str = "bilinear"
) -> tuple[Tensor, Tensor]:
    """Return an image [H, W] seen at p + moved [2, H, W], and 1 where that lies inside, else 0.

    Inside are the first rows and columns, `size` of them, of an image that was filled; None: all.
    """
    height, width = image.shape
    rows, columns = image.shape if size is None else size
    y = torch.arange(height, dtype=image.dtype)[:, None] + moved[0]
    x = torch.arange(width, dtype=image.dtype)[None] + moved[1]
    inside = (y >= -0.5) & (y <= rows - 0.5) & (x >= -0.5) & (x <= columns - 0.5)
    grid = torch.stack([x.mul_(2 / max(width - 1, 1)).sub_(1), y.mul_(2 / max(height - 1, 1)).sub_(1)], dim=-1)
    seen = functional.grid_sample(image[None, None], grid[None], mode=mode, padding_mode="border", align_corners=True)
    return seen[0, 0], inside.to(image.dtype)


def enlarged(field: Tensor, shape: Sequence[int]) -> Tensor:
    """Return a field [2, h, w] at another scale."""
    return functional.interpolate(field[None], size=tuple(shape), mode="bilinear", align_corners=False)[0]


# ---- Search of velocities

PARTS = 4  # velocities that are tried per cell and frame
STEP = 1 / PARTS  # cells per frame, between them
FAR = 4  # frames from the reference that vote in the search
FITS = 4.0  # deviations of the noise; larger differences count by their size, not their square
OUTSIDE = 20.0  # cost of a path that leads out of all frames; of half of them, where it is still allowed, half
MOVES = 10.0  # cost of any motion, and
FASTER = 2.0  # of each e-fold of 1 + px/frame down and right: slower paths win among equals
NEVER = 1e9  # cost of a path that leads out of more than half of the frames


def search(frames: Tensor, offsets: Sequence[int], scale: int, speed: float) -> Tensor:
    """Return the velocity [2, h, w] of each cell of a scale at which the frames [K, h, w] differ least from offset 0.

    Frames move by steps of STEP cells, in both axes, up to `speed` in px/frame.
    """
    reference = frames[offsets.index(0)]
    most = round(speed / scale / STEP)
    count = 2 * most + 1
    misfits, inside = torch.zeros(2, count, count, *reference.shape).unbind()
    voters = _voters(frames, offsets)
    if not voters:
        return torch.zeros(2, *reference.shape)
    for frame, offset in voters:
        _add_misfits(misfits, inside, reference, frame, offset, most, scale)
    pace = torch.arange(-most, most + 1, dtype=frames.dtype).abs() * (STEP * scale)
    pace = (pace[:, None] + pace).flatten()
    unit = SCALES[0] // scale
    cost = _cost(misfits.flatten(0, 1), inside.flatten(0, 1), len(voters), (unit, 3 * unit))
    cost += (MOVES * (pace > 0) + FASTER * pace.log1p())[:, None, None]
    best = cost.argmin(0)
    down = best // count
    right = best % count
    found = [place - most + _between(cost, best, step, place, count) for place, step in ((down, count), (right, 1))]
    return torch.stack(found) * (STEP * scale) * (best != cost.shape[0] // 2)


def neighbours(frames: Tensor, offsets: Sequence[int], velocity: Tensor, scale: int) -> Tensor:
    """Return for each cell the velocity [2, h, w] that fits best: its own, or that of a cell of scale 8 beside it."""
    step = SCALES[0] // scale
    height, width = frames.shape[1:]
    grown = functional.pad(velocity[None], (step,) * 4, mode="replicate")[0]
    moves = ((0, 0), (0, step), (0, -step), (step, 0), (-step, 0))
    choices = [grown[:, step + y : step + y + height, step + x : step + x + width] for y, x in moves]
    choices.append(torch.stack(choices).median(0).values)
    nothing = torch.zeros_like(velocity)
    best = torch.stack([misfits_of(frames, offsets, (choice, nothing), scale, 2) for choice in choices]).argmin(0)
    return torch.stack(choices).gather(0, best[None, None].expand(1, 2, -1, -1))[0]


def misfits_of(frames: Tensor, offsets: Sequence[int], path: Path, scale: int, radius: int) -> Tensor:
    """Return the cost [h, w] of a path over blocks of this radius in cells."""
    reference = frames[offsets.index(0)]
    voters = _voters(frames, offsets)
    misfits, inside = torch.zeros(2, 1, *reference.shape).unbind()
    for frame, offset in voters:
        moved = displacement(*path, offset, scale)
        seen, there = look(frame, moved)
        misfits += misfit((seen - reference) * scale, 1 + kept_noise(in_picture(moved))) * there
        inside += there
    return _cost(misfits, inside, len(voters), (radius,))[0]


def _voters(frames: Tensor, offsets: Sequence[int]) -> list[tuple[Tensor, int]]:
    """Return the frames [h, w] that vote, and their offsets."""
    return [(frame, offset) for frame, offset in zip(frames, offsets, strict=True) if 0 < abs(offset) <= FAR]


def _cost(misfits: Tensor, inside: Tensor, voters: int, radii: Sequence[int]) -> Tensor:
    """Return costs [N, h, w] from sums of misfits [N, h, w] over the frames `inside` of which N paths stay.

    They are sums over blocks and frames, as if all frames were inside, of several radii at once: sharp at edges, steady
    elsewhere.
    """
    below = [box_mean(inside, radius) for radius in radii]
    above = [box_mean(misfits, radius) * (2 * radius + 1) ** 2 for radius in radii]
    cost = torch.stack([x / y.clamp_(min=1e-6) for x, y in zip(above, below, strict=True)]).mean(0) * voters
    outside = 1 - torch.stack(below).mean(0) / max(voters, 1)
    return torch.where(outside > 0.5 + 1e-4, NEVER, cost + OUTSIDE * outside)


def _add_misfits(
    misfits: Tensor, inside: Tensor, reference: Tensor, frame: Tensor, offset: int, most: int, scale: int
) -> None:
    """Add the misfit of a frame moved by every velocity to sums [2 most + 1, 2 most + 1, h, w], and 1 to `inside`,
    where the moved place lies in the frame.
    """
    height, width = reference.shape
    count = 2 * most + 1
    far = abs(offset) * most
    fine, start = _in_steps(frame, far)
    line = fine.shape[1]
    part = torch.tensor([offset * (u - most) % PARTS * STEP for u in range(count)])
    noise = 1 + kept_noise(torch.stack(torch.meshgrid(part, part, indexing="ij")))
    columns = torch.zeros(count, 1, width)
    for u in range(count):
        columns[u, :, _kept(offset * (u - most), width)] = 1
    for v in range(count):
        down = offset * (v - most)
        rows = _kept(down, height)
        if rows.start >= rows.stop:
            continue
        corner = (start + rows.start * PARTS + down) * line + start - far
        places = (count, rows.stop - rows.start, width), (abs(offset), PARTS * line, PARTS), corner
        moved = fine.as_strided(*places)  # by -far ... far steps to the right
        moved = moved if offset > 0 else moved.flip(0)
        misfits[v, :, rows] += misfit((moved - reference[rows]).mul_(scale), noise[v, :, None, None]).mul_(columns)
        inside[v, :, rows] += columns


def misfit(difference: Tensor, noise: Tensor) -> Tensor:
    """Return squares of differences in deviations of the noise, less their mean where only noise differs: `noise`.

    Differences above FITS count by their size (Huber 1964).
    """
    size = difference.abs()
    square = size.clamp(max=FITS)
    return size.mul_(2).sub_(square).mul_(square).sub_(noise)


def _in_steps(frame: Tensor, far: int) -> tuple[Tensor, int]:
    """Return a frame [h, w] at every step of STEP cells, at least `far` steps beyond its border, and the place of its
    first cell on either axis. Between cells it is linear; beyond the border the last cell repeats.
    """
    beyond = -(-far // PARTS)
    grown = functional.pad(frame[None, None], (beyond, beyond + 1) * 2, mode="replicate")[0, 0]
    parts = [part * STEP for part in range(PARTS)]
    lines = torch.stack([torch.lerp(grown[:-1], grown[1:], part) for part in parts], 1).flatten(0, 1)
    fine = torch.stack([torch.lerp(lines[:, :-1], lines[:, 1:], part) for part in parts], 2).flatten(1)
    return fine, beyond * PARTS


def _kept(move: int, length: int) -> slice:
    """Return the cells that lie in a frame of `length` cells after a move by so many steps."""
    cells = move // PARTS
    return slice(max(0, -cells), max(0, min(length, length - cells)))


def _between(cost: Tensor, best: Tensor, step: int, place: Tensor, count: int) -> Tensor:
    """Return by how much the least cost lies beside the best step, -0.5 ... 0.5, from a parabola; 0 at the ends."""
    inner = (place > 0) & (place < count - 1)
    at = [cost.gather(0, torch.where(inner, best + move, best)[None])[0] for move in (-step, 0, step)]
    bend = at[0] + at[2] - 2 * at[1]
    shift = (at[0] - at[2]) / (2 * bend.clamp(min=1e-9))
    return torch.where(inner & (bend > 1e-9), shift.clamp(-0.5, 0.5), 0.0)


# ---- Paths

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
    noise = torch.stack([kept_noise(in_picture(x)) for x in moved]) * (1 - 1 / count)
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
    vote = inside / (1 + misfit.square_())
    mean = (moved * vote).sum(0) / vote.sum(0).clamp_(min=1e-6)
    return mean, (moved - mean).mul_(vote), vote.mean(0)


def _solved(yy: Tensor, yx: Tensor, xx: Tensor, pull: Tensor) -> Tensor:
    """Return the solution [2, h, w] of [[yy, yx], [yx, xx]] solution = pull [2, h, w], pixel by pixel."""
    return torch.stack([xx * pull[0] - yx * pull[1], yy * pull[1] - yx * pull[0]]) / (yy * xx - yx * yx)


def _limited(step: Tensor, most: float) -> Tensor:
    """Return steps [2, h, w] shortened to `most`."""
    return step * (most / (step[0].square() + step[1].square()).sqrt_().clamp_(min=most))


# ---- Merged frames

# (cells of 2 x 2 px beside the own one whose mean difference is squared, and over which squares are averaged; statistic
# up to which frames agree; excess over it at which a frame has half its weight)
STATISTICS = ((1, 1, 3.0, 1.0), (0, 2, 1.6, 0.25))
GROUPS = ((-1,), (1,), (-2, -3), (2, 3), (-4, -5), (4, 5))  # offsets of the frames that `Merged.groups` averages


@dataclass(frozen=True)
class Merged:
    """Mean codes and counts of one frame, float32 [H, W] each."""

    mean_code: Array
    count: Array
    alone: Array  # codes of the frame
    near: Array  # mean code of the frame and its two neighbours, moved and weighted
    near_count: Array
    still: Array  # mean code of the window without motion
    frames: int  # in the window
    groups: Array  # [6, H, W], mean codes of GROUPS, moved and not weighted
    group_counts: Array  # [6, H, W], codes whose mean has the noise of each; 0 without a frame in the picture


@dataclass(frozen=True)
class Prepared:
    """One frame: its codes [H, W], and phi of pooled codes at every scale; sides are multiples of the largest."""

    codes: Tensor
    pyramid: dict[int, Tensor]
    size: tuple[int, int]  # of the frame before it was filled


def prepared(codes: Array, domain: InformationDomain) -> Prepared:
    """Return a frame of codes [H, W] with its pyramid; bottom and right repeat the last pixels."""
    height, width = codes.shape
    fill = (0, -width % SCALES[0], 0, -height % SCALES[0])
    frame = functional.pad(torch.from_numpy(codes.astype(np.float32))[None, None], fill, mode="replicate")
    pooled = {scale: functional.avg_pool2d(frame, scale)[0, 0] for scale in SCALES}
    pyramid = {scale: torch.from_numpy(domain.forward(image.numpy())) for scale, image in pooled.items()}
    return Prepared(frame[0, 0], pyramid, (height, width))


def merge(window: Sequence[Prepared], offsets: Sequence[int], domain: InformationDomain) -> Merged:
    """Return the merged reference frame of a window of frames; `offsets` are their places in time, with 0."""
    with torch.no_grad():
        pyramid = {scale: torch.stack([frame.pyramid[scale] for frame in window]) for scale in SCALES}
        codes = torch.stack([functional.avg_pool2d(frame.codes[None], SCALES[-1])[0] for frame in window])
        reach = max(5, len(window) // 2)
        voting = [i for i, offset in enumerate(offsets) if abs(offset) <= reach]
        seen = {scale: frames[voting] for scale, frames in pyramid.items()}
        near_offsets = [offsets[i] for i in voting]
        velocity, acceleration = paths(seen, near_offsets, codes[voting], deviation_of(codes[voting], domain))
        both = (velocity, acceleration, *paths(pyramid, offsets, codes, deviation_of(codes, domain)))
        resting = torch.stack([(field == 0).all(0) for field in both]).all(0)
        resting &= torch.from_numpy(unchanged(codes, voting, domain))
        moved = torch.empty(len(window), *window[0].codes.shape)
        inside = torch.ones_like(moved)
        kept = torch.ones_like(moved)
        for i, (frame, offset) in enumerate(zip(window, offsets, strict=True)):
            if offset:
                moves = displacement(velocity, acceleration, offset)
                moved[i], inside[i] = look(frame.codes, moves, frame.size, "bicubic")
                if abs(offset) > reach:
                    inside[i] *= resting
                kept[i] = kept_noise_of_cubic(in_picture(moves, frame.size))
            else:
                moved[i] = frame.codes
        weight = weights(moved, inside, offsets, domain)
        near = [i for i, offset in enumerate(offsets) if abs(offset) <= 1]
        still = sum((frame.codes for frame in window[1:]), window[0].codes) / len(window)
        alone = window[offsets.index(0)].codes.numpy()
        groups = [[i for i, offset in enumerate(offsets) if offset in group] for group in GROUPS]
        counts = torch.stack([inside[group].sum(0) for group in groups])
        sums = torch.stack([(moved[group] * inside[group]).sum(0) for group in groups])
        noise = torch.stack([(kept[group] * inside[group]).sum(0) for group in groups])
        return Merged(
            *_weighted(moved, weight, kept),
            alone,
            *_weighted(moved[near], weight[near], kept[near]),
            still.numpy(),
            frames=len(window),
            groups=(sums / counts.clamp(min=1)).numpy(),
            group_counts=torch.where(counts > 0, counts.square() / noise, 0.0).numpy(),
        )


def deviation_of(codes: Tensor, domain: InformationDomain) -> Tensor:
    """Return the deviation of a code [h, w] of frames [K, h, w] that stand still."""
    return variance_of(box_mean(codes.mean(0)[None], 2)[0], domain).sqrt()


def unchanged(codes: Tensor, near: Sequence[int], domain: InformationDomain) -> Array:
    """Return where the mean of the other frames is that of those `near`, all around: bool [2 h, 2 w] of codes
    [K, h, w].
    """
    far = [i for i in range(len(codes)) if i not in near]
    if not far:
        return np.ones([2 * side for side in codes.shape[1:]], bool)
    difference = (codes[far].mean(0) - codes[near].mean(0)).numpy()
    variance = variance_of(box_mean(codes.mean(0)[None], 1)[0], domain).numpy() * (1 / len(far) + 1 / len(near)) / 4
    same = np.ones(difference.shape, bool)
    for side, beside, most in ((1, 16, 3.0), (4, 4, 2.5)):
        rows, columns = (length // side for length in difference.shape)
        blocks, noise = (x.reshape(rows, side, columns, side).mean((1, 3)) for x in (difference, variance / side**2))
        squares = blocks**2 / noise
        for y in range(rows):
            for x in range(columns):
                around = squares[max(0, y - beside) : y + beside + 1, max(0, x - beside) : x + beside + 1]
                if around.mean() >= 1 + most * np.sqrt(2 / around.size):
                    same[y * side : (y + 1) * side, x * side : (x + 1) * side] = False
    return same.repeat(2, 0).repeat(2, 1)


def variance_of(mean_code: Tensor, domain: InformationDomain) -> Tensor:
    """Return the variance of a code [...] at mean codes [...], FLOOR at least."""
    variance = np.interp(mean_code.numpy(), domain.mean_code, domain.variance)
    return torch.from_numpy(np.maximum(variance, FLOOR).astype(np.float32))


def _weighted(moved: Tensor, weight: Tensor, kept: Tensor) -> tuple[Array, Array]:
    """Return the weighted mean [H, W] of frames that keep shares of their noise, and the number of codes whose mean has
    its noise.
    """
    total = weight.sum(0)
    return ((moved * weight).sum(0) / total).numpy(), (total.square() / (weight.square() * kept).sum(0)).numpy()


def weights(moved: Tensor, inside: Tensor, offsets: Sequence[int], domain: InformationDomain) -> Tensor:
    """Return weights [K, H, W] of moved codes [K, H, W], 0 where not `inside`; the reference has the weight 1."""
    centre = offsets.index(0)
    half = functional.avg_pool2d((moved * inside).sum(0)[None] / inside.sum(0)[None], 2)
    variance = variance_of(box_mean(half, 1)[0], domain)
    weight = torch.zeros_like(moved)
    weight[centre] = 1.0
    for i, offset in enumerate(offsets):
        if abs(offset) == 1:
            weight[i] = agreement(moved[i] - moved[centre], 2 * variance) * inside[i]
    near = [i for i, offset in enumerate(offsets) if abs(offset) <= 1]
    total = weight[near].sum(0)
    base = (weight[near] * moved[near]).sum(0) / total
    base_share = functional.avg_pool2d((1 / total)[None], 2)[0]
    for side in (-1, 1):
        for pair in range(1, max(abs(offset) for offset in offsets) // 2 + 1):
            group = [i for i, offset in enumerate(offsets) if offset * side > 0 and abs(offset) // 2 == pair]
            if not group:
                continue
            count = inside[group].sum(0).clamp_(min=1)
            mean = (moved[group] * inside[group]).sum(0) / count
            share = functional.avg_pool2d((1 / count)[None], 2)[0]
            weight[group] = agreement(mean - base, (share + base_share) * variance) * inside[group]
    return weight


def agreement(difference: Tensor, variance: Tensor) -> Tensor:
    """Return weights [H, W] from a difference of moved codes [H, W] and its variance per pixel [H/2, W/2]."""
    cells = functional.avg_pool2d(difference[None], 2)
    excess = torch.zeros_like(variance)
    for beside, around, tolerance, softness in STATISTICS:
        pixels = 4 * (2 * beside + 1) ** 2
        statistic = box_mean(box_mean(cells, beside).square() * (pixels / variance), around)[0]
        excess = torch.maximum(excess, (statistic - tolerance) / softness)
    return enlarged((1 / (1 + excess))[None], difference.shape)[0]


def stream(
    read: Callable[[int], Array], length: int, domain: InformationDomain, window: int, frames: range
) -> Iterator[Merged]:
    """Yield merged frames of a stream of `length` frames.

    `read` returns the codes [H, W] of one frame. A frame is read and pooled once; windows are moved into the stream.
    """
    kept: deque[tuple[int, Prepared]] = deque()
    for t in frames:
        first = max(0, min(t - window // 2, length - window))
        last = min(length, first + window) - 1
        while kept and kept[0][0] < first:
            kept.popleft()
        for i in range(kept[-1][0] + 1 if kept else first, last + 1):
            kept.append((i, prepared(read(i), domain)))
        yield merge([frame for _, frame in kept], [i - t for i, _ in kept], domain)


# ---- Inputs of the network

LOCAL = 8  # px: half the side of the squares whose mean code tells the local level
NEARBY = 2  # px, likewise, of the level around a pixel, and of the noise of groups
UNIT = 4.0  # deviations of the noise that a channel's 1 stands for
MOST = 4.0  # of a channel of a group: a frame of another scene tells no more
LEAST_LIGHT = 1e-3  # photons, added to light before it is compared with its noise
REACH = 16  # px within which places are looked for that look alike, by even shifts
AROUND = 1  # cells of 2 x 2 px beside the own one that are compared
TOLERANCE = 1.25  # mean square of differences over their variance up to which places look alike
SOFTNESS = 0.15  # excess over it at which a place has a quarter of its weight


@dataclass(frozen=True)
class MergeInputs:
    """Inputs of one frame, float32."""

    channels: Tensor  # [17, H, W]
    phi: Tensor  # [H, W], of the merged mean code
    deviation: Tensor  # [H, W], of the noise of phi


def merge_inputs(merged: Merged, domain: InformationDomain) -> MergeInputs:
    """Return the inputs of a merged frame [H, W].

    Channels: the merged phi over its local level; the frame alone, the nearest three, the unmoved window and the level
    around the pixel over the merged phi, each in units of its noise; the deviation of the noise; the logarithm of the
    light over its noise, which is low where codes carry nothing; and six groups of moved frames over the merged frame,
    in units of their noise, which tell what merging left out; what looks alike in the merged frame and in the frame
    alone. Levels are phi of pooled codes: phi of single pixels loses light near saturation.
    """
    phi, deviation = _stabilised(merged.mean_code, merged.count, domain)
    alone, alone_deviation = _stabilised(merged.alone, np.ones_like(merged.alone), domain)
    near, near_deviation = _stabilised(merged.near, merged.near_count, domain)
    still, still_deviation = _stabilised(merged.still, np.full_like(merged.still, merged.frames), domain)
    mean_code = torch.from_numpy(merged.mean_code)[None]
    around = box_mean(mean_code, NEARBY)[0].numpy()
    local = domain.forward(box_mean(mean_code, LOCAL)[0].numpy())
    light = np.interp(local, domain.phi, domain.photons)
    blurred = np.interp(local, domain.phi, domain.slope) * deviation
    known = np.log2((light + LEAST_LIGHT) / (blurred + LEAST_LIGHT)).clip(-4, 8) / UNIT
    channels = [
        (phi - local) / (UNIT * deviation),
        (alone - phi) / (UNIT * alone_deviation),
        (near - phi) / (UNIT * near_deviation),
        (still - phi) / (UNIT * still_deviation),
        (domain.forward(around) - phi) / (UNIT * deviation),
        deviation,
        known,
        *_groups(merged, around, domain),
        *_alike(phi, deviation, phi, deviation),
        *_alike(alone, alone_deviation, phi, deviation),
    ]
    stacked = np.stack(channels, dtype=np.float32, casting="same_kind")
    return MergeInputs(torch.from_numpy(stacked), torch.from_numpy(phi), torch.from_numpy(deviation))


def _groups(merged: Merged, around: Array, domain: InformationDomain) -> Array:
    """Return groups over the merged frame [6, H, W], in units of their noise at the level around; 0 without a frame."""
    variance = np.maximum(np.interp(around, domain.mean_code, domain.variance), FLOOR)
    apart = (merged.groups - merged.mean_code) * np.sqrt(merged.group_counts / variance) / UNIT
    found: Array = apart.clip(-MOST, MOST)
    return found


def _alike(image: Array, noise: Array, phi: Array, deviation: Array) -> list[Array]:
    """Return what looks alike in an image [H, W] over phi, in units of its noise, and the octaves of less noise."""
    mean, variance = mean_of_alike(image, np.square(noise))
    apart = ((mean - phi) / (UNIT * deviation)).clip(-MOST, MOST)
    return [apart, np.log2(np.square(deviation) / variance) / (2 * UNIT)]


def mean_of_alike(image: Array, variance: Array) -> tuple[Array, Array]:
    """Return the mean [H, W] of the places of an image [H, W] that look alike, and its variance, place by place."""
    height, width = image.shape
    of_cells = variance.reshape(height // 2, 2, width // 2, 2).mean((1, 3)).repeat(2, 0).repeat(2, 1)
    total = np.ones_like(image)
    squares = of_cells.copy()
    sums = image.copy()
    for down in range(-REACH, REACH + 1, 2):
        rows = np.arange(max(0, -down), min(height, height - down))
        for right in range(-REACH, REACH + 1, 2):
            here = np.ix_(rows, np.arange(max(0, -right), min(width, width - right)))
            if (down, right) == (0, 0) or not image[here].size:
                continue
            there = here[0] + down, here[1] + right
            square = np.square(image[here] - image[there])
            cells = square.reshape(square.shape[0] // 2, 2, square.shape[1] // 2, 2).mean((1, 3))
            unit = (of_cells[here] + of_cells[there])[::2, ::2]
            statistic = box_mean(torch.from_numpy(cells / unit)[None], AROUND)[0].numpy()
            weight = 1 / (1 + np.maximum(statistic - TOLERANCE, 0) / SOFTNESS) ** 2
            weight = weight.repeat(2, 0).repeat(2, 1)
            total[here] += weight
            squares[here] += np.square(weight) * of_cells[there]
            sums[here] += weight * image[there]
    return sums / total, squares / np.square(total)


def _stabilised(mean_code: Array, count: Array, domain: InformationDomain) -> tuple[Array, Array]:
    """Return phi and its deviation, float32 [H, W], of the mean of `count` codes; half a count below saturation."""
    most = np.maximum(domain.mean_code[-1] - 0.5 / count, domain.mean_code[0])
    mean_code = np.minimum(mean_code, most)
    deviation = domain.noise(mean_code) / np.sqrt(count)
    return domain.forward(mean_code), deviation.astype(np.float32)
