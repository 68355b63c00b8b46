"""Estimates how every place of a frame moves through a window of noisy frames: one smooth path per place.

    frames [K, H, W] at scales 8, 4, 2 (phi of pooled codes) ->
    scale 8: every velocity up to SPEED is tried, all frames vote -> scale 4: neighbours' velocities are tried ->
    scales 4 and 2: Gauss-Newton of velocity v and acceleration a, all frames at once -> no motion where it fits as well
    -> paths p + k v + k^2/2 a

All frames of the window vote for one path, so that little light suffices; a pair of frames is never matched alone.
Costs are sums over blocks and the corrections of flat places follow their neighbours: no path is chosen by one pixel.
Frames that do not fit (occlusions, light that changes) lose their vote.

A frame seen between its pixels has less noise, so noise alone would prefer paths that lead there, and still scenes
would be blurred. Squared differences therefore count above the noise that interpolation leaves.

Ours; the steps are block matching, and the registration of Lucas and Kanade (1981) to the mean of all moved frames.
Fields are [2, H, W] = (down, right), in pixels of the full frame per frame, at cells of one scale.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

SCALES = (8, 4, 2)  # px of the full frame per cell, along one side
SPEED = 18.0  # px/frame, the fastest that is tried; refinement goes slightly beyond
PARTS = 4  # velocities that are tried per cell of scale 8 and frame
STEP = 1 / PARTS  # cells of scale 8 per frame, between them
FAR = 4  # frames from the reference that vote in the search
FITS = 4.0  # deviations of the noise; larger differences count by their size, not their square
OUTSIDE = 20.0  # cost of a path that leads out of all frames; of half of them, where it is still allowed, half
MOVES = 10.0  # cost of any motion, and
FASTER = 2.0  # of each e-fold of 1 + px/frame down and right: slower paths win among equals
STILL = (3, 60.0)  # radius of the block [cells of scale 2] over which a path must fit better than none, and by how much
NEVER = 1e9  # cost of a path that leads out of more than half of the frames
REFINE = ((4, 2, 2), (2, 4, 3))  # (scale, radius of the mean that is taken twice, in cells; iterations)
CORRECTION = 1.0  # px/frame, expected size of a correction of v
ACCELERATION = 0.1  # px/frame^2, expected size of a
MISFIT = 3.0  # variances of the noise at which a frame has half a vote
STIFFNESS = 50.0  # information of a block below which it follows its neighbours


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
    length, place, width, rest = x.shape[dim] - count + 1, 0, 1, count
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


def displacement(velocity: Tensor, acceleration: Tensor, offset: int, scale: int = 1) -> Tensor:
    """Return where paths lead after `offset` frames, [2, H, W], in cells of a scale."""
    return (velocity * offset + acceleration * (offset * offset / 2)) / scale


def look(image: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
    """Return an image [H, W] seen at p + moved [2, H, W], bilinear, and 1 where that lies inside, else 0."""
    height, width = image.shape
    y = torch.arange(height, dtype=image.dtype)[:, None] + moved[0]
    x = torch.arange(width, dtype=image.dtype)[None] + moved[1]
    inside = (y >= -0.5) & (y <= height - 0.5) & (x >= -0.5) & (x <= width - 0.5)
    grid = torch.stack([x.mul_(2 / max(width - 1, 1)).sub_(1), y.mul_(2 / max(height - 1, 1)).sub_(1)], dim=-1)
    seen = functional.grid_sample(image[None, None], grid[None], padding_mode="border", align_corners=True)
    return seen[0, 0], inside.to(image.dtype)


def paths(
    pyramid: dict[int, Tensor], offsets: Sequence[int], codes: Tensor, deviation: Tensor
) -> tuple[Tensor, Tensor]:
    """Return velocity and acceleration [2, H, W] of frames at each scale: {scale: [K, H/scale, W/scale]}.

    `offsets` are the frames' places in time; 0 is the reference. The noise of a frame at a scale has the deviation
    1 / scale, as phi of pooled codes nearly has. Mean `codes` [K, H/2, W/2] of scale 2 and the `deviation` [H/2, W/2]
    of one code tell what moves: of four codes of one bit, phi has up to 1.8 times that variance.
    """
    velocity = search(pyramid[SCALES[0]], offsets)
    acceleration = torch.zeros_like(velocity)
    for scale, radius, iterations in REFINE:
        shape = pyramid[scale].shape[1:]
        velocity, acceleration = enlarged(velocity, shape), enlarged(acceleration, shape)
        if scale == SCALES[1]:
            velocity = neighbours(pyramid[scale], offsets, velocity, scale)
        for _ in range(iterations):
            velocity, acceleration = correct(pyramid[scale], offsets, velocity, acceleration, scale, radius)
    full = [SCALES[-1] * side for side in codes.shape[1:]]
    moves = moving(codes, deviation, offsets, velocity, acceleration)
    moves = functional.interpolate(moves[None, None].to(velocity.dtype), size=full)[0]
    return enlarged(velocity, full) * moves, enlarged(acceleration, full) * moves


def enlarged(field: Tensor, shape: Sequence[int]) -> Tensor:
    """Return a field [2, h, w] at another scale."""
    return functional.interpolate(field[None], size=tuple(shape), mode="bilinear", align_corners=False)[0]


def search(frames: Tensor, offsets: Sequence[int]) -> Tensor:
    """Return the velocity [2, h, w] of each cell of scale 8 at which the frames [K, h, w] differ least from offset 0.

    Frames move by steps of STEP cells, in both axes, up to SPEED.
    """
    reference = frames[offsets.index(0)]
    most = round(SPEED / SCALES[0] / STEP)
    count = 2 * most + 1
    misfits, inside = torch.zeros(2, count, count, *reference.shape).unbind()
    voters = [(frame, offset) for frame, offset in zip(frames, offsets, strict=True) if 0 < abs(offset) <= FAR]
    if not voters:
        return torch.zeros(2, *reference.shape)
    for frame, offset in voters:
        _add_misfits(misfits, inside, reference, frame, offset, most)
    pace = torch.arange(-most, most + 1, dtype=frames.dtype).abs() * (STEP * SCALES[0])
    pace = (pace[:, None] + pace).flatten()
    cost = _cost(misfits.flatten(0, 1), inside.flatten(0, 1), len(voters), (1, 3))
    cost += (MOVES * (pace > 0) + FASTER * pace.log1p())[:, None, None]
    best = cost.argmin(0)
    down, right = best // count, best % count
    found = [place - most + _between(cost, best, step, place, count) for place, step in ((down, count), (right, 1))]
    return torch.stack(found) * (STEP * SCALES[0]) * (best != cost.shape[0] // 2)


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


def _add_misfits(misfits: Tensor, inside: Tensor, reference: Tensor, frame: Tensor, offset: int, most: int) -> None:
    """Add the misfit of a frame moved by every velocity to sums [2 most + 1, 2 most + 1, h, w], and 1 to `inside`,
    where the moved place lies in the frame.
    """
    (height, width), count, far = reference.shape, 2 * most + 1, abs(offset) * most
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
        misfits[v, :, rows] += _misfit((moved - reference[rows]).mul_(SCALES[0]), noise[v, :, None, None]).mul_(columns)
        inside[v, :, rows] += columns


def _misfit(difference: Tensor, noise: Tensor) -> Tensor:
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


def neighbours(frames: Tensor, offsets: Sequence[int], velocity: Tensor, scale: int) -> Tensor:
    """Return for each cell the velocity [2, h, w] that fits best: its own, or that of a cell of scale 8 beside it."""
    reference, step = frames[offsets.index(0)], SCALES[0] // scale
    height, width = reference.shape
    grown = functional.pad(velocity[None], (step,) * 4, mode="replicate")[0]
    moves = ((0, 0), (0, step), (0, -step), (step, 0), (-step, 0))
    choices = [grown[:, step + y : step + y + height, step + x : step + x + width] for y, x in moves]
    choices.append(torch.stack(choices).median(0).values)
    voters = [(frame, offset) for frame, offset in zip(frames, offsets, strict=True) if 0 < abs(offset) <= FAR]
    nothing, costs = torch.zeros_like(velocity), []
    for choice in choices:
        misfits, inside = torch.zeros(2, 1, height, width).unbind()
        for frame, offset in voters:
            moved = displacement(choice, nothing, offset, scale)
            seen, there = look(frame, moved)
            misfits += _misfit((seen - reference) * scale, 1 + kept_noise(moved)) * there
            inside += there
        costs.append(_cost(misfits, inside, len(voters), (2,))[0])
    best = torch.stack(costs).argmin(0)
    return torch.stack(choices).gather(0, best[None, None].expand(1, 2, -1, -1))[0]


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
    return torch.where(there > 0, _misfit((seen - mean) * (scale / deviation), noise), 1.0).sum(0)


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
    k, q = k - k.mean(), q - q.mean()
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
    moved, inside = torch.stack(seen), torch.stack(votes)
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
