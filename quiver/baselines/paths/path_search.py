"""Searches velocities: every one up to a speed is tried for each cell of a scale, and all frames of the window vote.

A frame seen between its pixels has less noise, so noise alone would prefer paths that lead there, and still scenes
would be blurred. Squared differences therefore count above the noise that interpolation leaves. Costs are sums over
blocks: no path is chosen by one pixel.

Velocities are tried by classes: those that differ by whole cells per frame see a frame between its cells alike, and
are one view of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
import torch.nn.functional as functional
from torch import Tensor

from quiver.baselines.paths.moved_frames import SCALES, Path, box_mean, look_with_noise
from quiver.device import is_gpu

PARTS = 4  # velocities that are tried per cell and frame
STEP = 1 / PARTS  # cells per frame, between them
FAR = 4  # frames from the reference that vote in the search
FITS = 4.0  # deviations of the noise; larger differences count by their size, not their square
OUTSIDE = 20.0  # cost of a path that leads out of all frames; of half of them, where it is still allowed, half
MOVES = 10.0  # cost of any motion, and
FASTER = 2.0  # of each e-fold of 1 + px/frame down and right: slower paths win among equals
NEVER = 1e9  # cost of a path that leads out of more than half of the frames
TOGETHER = 1 << 21  # differences of moved cells that a CPU makes in one step; fewer steps, but they leave its cache
HELD = 1 << 18  # costs that are made at a time on a CPU, whose cache then holds them


def search(frames: Tensor, offsets: Sequence[int], scale: int, speed: float) -> Tensor:
    """Return the velocity [B, 2, h, w] of each cell of a scale at which frames [B, K, h, w] differ least from offset 0.

    Frames move by steps of STEP cells, in both axes, up to `speed` in px/frame.
    """
    batch, _, height, width = frames.shape
    most = round(speed / scale / STEP)
    count = 2 * most + 1
    voting = voters(offsets)
    if not voting:
        return frames.new_zeros(batch, 2, height, width)
    cost = _misfits(frames * scale, offsets, most)
    # Noise alone would always prefer some motion to none among so many that are tried.
    pace = _pace(most, scale, frames.device)
    unit = SCALES[0] // scale
    radii = (unit, 3 * unit)
    blocks = [_blocks(height, width, voting, most, radius, frames.device) for radius in radii]
    step = count if is_gpu(frames.device) else max(1, HELD // (batch * count * height * width))
    for first in range(0, count, step):
        rows = slice(first, first + step)
        below = [_inside(down[:, rows], right, radius) for (down, right), radius in zip(blocks, radii, strict=True)]
        piece = cost[:, rows].flatten(1, 2)
        cost[:, rows] = _cost(piece, below, len(voting), radii).add_(pace[rows].view(-1, 1, 1)).view_as(cost[:, rows])
    return _least(cost, most) * (STEP * scale)


def neighbours(frames: Tensor, offsets: Sequence[int], velocity: Tensor, scale: int) -> Tensor:
    """Return for each cell the velocity [B, 2, h, w] that fits best: its own, or one of a cell of scale 8 beside it."""
    step = SCALES[0] // scale
    height, width = frames.shape[-2:]
    grown = functional.pad(velocity, (step,) * 4, mode="replicate")
    moves = ((0, 0), (0, step), (0, -step), (step, 0), (-step, 0))
    choices = [grown[..., step + y : step + y + height, step + x : step + x + width] for y, x in moves]
    choices.append(torch.stack(choices).median(0).values)
    tried = torch.stack(choices, dim=2)  # [B, 2, 6, h, w]
    costs = misfits_of(frames, offsets, (tried.flatten(2, 3), torch.zeros_like(tried).flatten(2, 3)), scale, 2)
    best = first_least(costs)[:, None]
    return tried.gather(2, best.expand(-1, 2, -1, -1, -1))[:, :, 0]


def misfits_of(frames: Tensor, offsets: Sequence[int], path: Path, scale: int, radius: int) -> Tensor:
    """Return the costs [B, C, h, w] of paths [B, 2, C * h, w] over blocks of this radius in cells."""
    batch, _, height, width = frames.shape
    centre = offsets.index(0)
    voting = voters(offsets)
    shape = (batch, path[0].shape[2] // height, height, width)
    if not voting:
        return frames.new_zeros(shape)
    places = [offsets.index(offset) for offset in voting]
    scaled = frames * scale
    seen, inside, kept = look_with_noise(_frames_at(scaled, places), path, voting, scale)
    reference = scaled[:, centre, None, None].expand(batch, len(voting), shape[1], height, width)
    misfits = misfit(seen.view(reference.shape), reference, kept.add_(1).view(reference.shape))
    misfits *= inside.view(reference.shape)
    return _cost(misfits.sum(1), [box_mean(inside.view(reference.shape).sum(1), radius)], len(voting), (radius,))


def voters(offsets: Sequence[int]) -> tuple[int, ...]:
    """Return the offsets of the frames that vote."""
    return tuple(offset for offset in offsets if 0 < abs(offset) <= FAR)


def _frames_at(frames: Tensor, places: Sequence[int]) -> Tensor:
    """Return some of the frames [B, K, h, w], without a list of numbers that had to be copied to the device."""
    return torch.stack([frames[:, place] for place in places], dim=1)


def misfit(one: Tensor, other: Tensor, noise: Tensor | float) -> Tensor:
    """Return squares of differences in deviations of the noise, less their mean where only noise differs: `noise`.

    Differences above FITS count by their size (Huber 1964).
    """
    return functional.huber_loss(one, other, reduction="none", delta=FITS).mul_(2).sub_(noise)


def _cost(misfits: Tensor, below: Sequence[Tensor], voters: int, radii: Sequence[int]) -> Tensor:
    """Return costs [B, N, h, w] from sums of misfits [B, N, h, w] over frames, and the frames of a block inside.

    They are sums over blocks and frames, as if all frames were inside, of several radii at once: sharp at edges, steady
    elsewhere.
    """
    cost: Tensor | None = None
    inside: Tensor | None = None
    for there, radius in zip(below, radii, strict=True):
        there = there.clamp(min=1e-6)
        part = box_mean(misfits, radius).mul_((2 * radius + 1) ** 2).div_(there)
        cost = part if cost is None else cost.add_(part)
        inside = there if inside is None else inside.add_(there)
    assert cost is not None
    assert inside is not None
    cost *= voters / len(radii)
    outside = inside.div_(len(radii) * voters).neg_().add_(1)
    cost += outside * OUTSIDE
    return torch.maximum(cost, outside.gt_(0.5 + 1e-4).mul_(2 * NEVER).sub_(NEVER))  # NEVER where too many leave


# ---- All velocities at once


def _misfits(frames: Tensor, offsets: Sequence[int], most: int) -> Tensor:
    """Return the misfits of frames [B, K, h, w], in deviations of the noise, moved by every velocity, summed over the
    voters where the moved place lies inside: [B, 2 most + 1, 2 most + 1, h, w].
    """
    voting = voters(offsets)
    beyond = -(-max(abs(offset) for offset in voting) * most // PARTS)
    fine = _between_cells(_frames_at(frames, [offsets.index(offset) for offset in voting]), beyond)
    reference = frames[:, offsets.index(0)]
    pixels = len(voting) * (2 * most + 1) ** 2 * reference.numel()
    if pixels <= TOGETHER or is_gpu(frames.device):
        return _by_places(fine, reference, voting, most, beyond)
    return _by_views(fine, reference, voting, most, beyond)


def _between_cells(frames: Tensor, beyond: int) -> Tensor:
    """Return frames [B, V, h, w] at every step of STEP cells, [B, V, PARTS, PARTS, h + 2 beyond + 1, w + 2 beyond].

    Between cells it is linear, the last cell repeats; farther out there is nothing: NaN.
    """
    part = torch.arange(PARTS, dtype=frames.dtype, device=frames.device)[:, None, None] * STEP
    grown = functional.pad(frames, (0, 1, 0, 1), mode="replicate")[:, :, None]
    lines = torch.lerp(grown[..., :-1, :], grown[..., 1:, :], part)[:, :, :, None]
    fine = torch.lerp(lines[..., :-1], lines[..., 1:], part)
    return functional.pad(fine, (beyond, beyond, beyond, beyond + 1), value=float("nan"))


def _by_places(fine: Tensor, reference: Tensor, voting: tuple[int, ...], most: int, beyond: int) -> Tensor:
    """Return `_misfits` of all velocities and voters by one look-up: few operations, for small frames and for GPUs."""
    height, width = reference.shape[-2:]
    places, noise = _places((height, width), voting, most, beyond, reference.device)
    moved = fine.flatten(1).index_select(1, places).view(len(fine), *noise.shape[:3], height, width)
    target = reference[:, None, None, None].expand(moved.shape)
    return misfit(moved, target, noise).nan_to_num_(0.0).sum(1)


def _by_views(fine: Tensor, reference: Tensor, voting: tuple[int, ...], most: int, beyond: int) -> Tensor:
    """Return `_misfits` class by class, whose velocities and voters stay in the cache of a CPU.

    Rows are as long as those of `fine`, so that all rows of a velocity are one line; what lies beyond `reference` in
    them is left out in the end.
    """
    batch, height, width = reference.shape
    count = 2 * most + 1
    line = fine.shape[-1]
    target = functional.pad(reference, (0, line - width)).view(batch, 1, 1, height * line)
    found = reference.new_empty(batch, count, count, height, width)
    for v in range(PARTS):
        for u in range(PARTS):
            shape = (batch, len(range(v, count, PARTS)), len(range(u, count, PARTS)), height * line)
            if not (shape[1] and shape[2]):
                continue
            total = reference.new_zeros(shape)
            part = torch.empty_like(total)
            backwards = voting[0] < 0
            for i, offset in enumerate(voting):
                if backwards and offset > 0:  # views have no negative steps: earlier frames are seen in reverse order
                    total = total.flip(1, 2)
                    backwards = False
                moved, noise = _view(fine[:, i], offset, (v - most, u - most), shape, beyond)
                torch.ops.aten.huber_loss.out(moved, target.expand(shape), 0, FITS, out=part)
                total.add_(part.sub_(noise / 2).nan_to_num_(0.0), alpha=2)
            total = total.flip(1, 2) if backwards else total
            found[:, v::PARTS, u::PARTS] = total.view(*shape[:3], height, line)[..., :width]
    return found


def _view(
    fine: Tensor, offset: int, first: tuple[int, int], shape: tuple[int, ...], beyond: int
) -> tuple[Tensor, float]:
    """Return a frame [B, PARTS, PARTS, H, W] moved by velocities `first` + PARTS (i, j), as lines [B, i, j, n], and the
    noise of its difference from the reference; for a negative offset velocities in reverse order.
    """
    kept = 1.0
    start = fine.storage_offset()
    for begin, number, step, each in zip(first, shape[1:3], fine.stride()[3:], fine.stride()[1:3], strict=True):
        move = offset * begin
        kept *= _kept(move % PARTS)
        cells = move // PARTS + (offset * (number - 1) if offset < 0 else 0)
        start += move % PARTS * each + (beyond + cells) * step
    line, column = fine.stride()[3:]
    return fine.as_strided(shape, (fine.stride(0), abs(offset) * line, abs(offset) * column, column), start), 1 + kept


def _kept(part: int) -> float:
    """Return the share of the noise's variance that is left along one axis after a move by so many parts of a cell."""
    return (part * STEP) ** 2 + (1 - part * STEP) ** 2


@lru_cache(maxsize=16)
def _places(
    size: tuple[int, int], voting: tuple[int, ...], most: int, beyond: int, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return where `_between_cells` holds the cells of each voter moved by each velocity, int32 [V * n * n * h * w],
    and the noise of their differences from the reference, [V, n, n, 1, 1].
    """
    lines = (size[0] + 2 * beyond + 1, size[1] + 2 * beyond)
    moves = torch.arange(-most, most + 1) * torch.tensor(voting)[:, None]  # [V, n]
    part = moves.remainder(PARTS)
    cells = moves.div(PARTS, rounding_mode="floor") + beyond
    plane = lines[0] * lines[1]
    rows = (part * PARTS * plane)[..., None] + (cells[..., None] + torch.arange(size[0])) * lines[1]  # [V, n, h]
    columns = (part * plane)[..., None] + cells[..., None] + torch.arange(size[1])  # [V, n, w]
    planes = torch.arange(len(voting))[:, None, None, None, None] * (PARTS**2 * plane)
    places = planes + rows[:, :, None, :, None] + columns[:, None, :, None, :]
    kept = torch.tensor([_kept(p) for p in range(PARTS)], dtype=torch.float32)[part]
    noise = (1 + kept[:, :, None] * kept[:, None, :])[..., None, None]
    return places.to(torch.int32).flatten().to(device), noise.to(device)


@lru_cache(maxsize=64)
def _pace(most: int, scale: int, device: torch.device) -> Tensor:
    """Return what velocities cost by themselves, [2 most + 1, 2 most + 1]."""
    pace = torch.arange(-most, most + 1, dtype=torch.float32).abs() * (STEP * scale)
    pace = pace[:, None] + pace
    return (MOVES * (pace > 0) + FASTER * pace.log1p()).to(device)


@lru_cache(maxsize=64)
def _blocks(
    height: int, width: int, voting: tuple[int, ...], most: int, radius: int, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return how many rows, and columns, of blocks lie inside frames: float32 [V, 2 most + 1, h] and [V, ..., w]."""
    found = []
    for length in (height, width):
        moves = torch.arange(-most, most + 1)[None, :, None] * torch.tensor(voting)[:, None, None]
        place = torch.arange(length) + moves.div(PARTS, rounding_mode="floor")
        inside = ((place >= 0) & (place < length)).to(torch.float32)
        grown = functional.pad(inside, (radius, radius), mode="replicate")
        found.append(grown.unfold(2, 2 * radius + 1, 1).sum(-1).to(device))
    return found[0], found[1]


def _inside(down: Tensor, right: Tensor, radius: int) -> Tensor:
    """Return the frames of a block inside, [1, N, h, w], from rows [V, nv, h] and columns [V, nu, w] inside each."""
    rows = down.permute(1, 2, 0)[:, None]  # [nv, 1, h, V]
    columns = right.permute(1, 0, 2)  # [nu, V, w]
    return (rows @ columns).flatten(0, 1)[None] / (2 * radius + 1) ** 2


def _least(cost: Tensor, most: int) -> Tensor:
    """Return the place of the least cost [B, n, n, h, w] beside velocity 0, [B, 2, h, w], in steps; between steps from
    a parabola. The first of equals wins.
    """
    count = 2 * most + 1
    down = first_least(cost.amin(2))  # [B, 1, h, w]
    line = cost.gather(1, down[:, :, None].expand(-1, -1, count, -1, -1))[:, 0]
    right = first_least(line)
    across = cost.gather(2, right[:, :, None].expand(-1, count, -1, -1, -1))[:, :, 0]
    found = [place - most + _between(costs, place) for costs, place in ((across, down), (line, right))]
    moves = (down != most) | (right != most)
    return torch.cat(found, dim=1) * moves


def first_least(costs: Tensor) -> Tensor:
    """Return the number of the first least cost of [B, N, h, w], int64 [B, 1, h, w]; much faster than `argmin`."""
    number = costs.shape[1]
    left = torch.arange(number, 0, -1, dtype=costs.dtype, device=costs.device)[:, None, None]
    least = costs.amin(1, keepdim=True)
    return number - costs.eq(least).to(costs.dtype).mul_(left).amax(1, keepdim=True).long()


def _between(cost: Tensor, place: Tensor) -> Tensor:
    """Return by how much the least cost lies beside the best place, -0.5 ... 0.5, from a parabola; 0 at the ends."""
    inner = ((place > 0) & (place < cost.shape[1] - 1)).long()
    at = [cost.gather(1, place + move * inner) for move in (-1, 0, 1)]
    bend = at[0] + at[2] - 2 * at[1]
    shift = ((at[0] - at[2]) / (2 * bend.clamp(min=1e-9))).clamp_(-0.5, 0.5)
    return shift * (inner * (bend > 1e-9))
