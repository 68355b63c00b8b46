"""Searches velocities: every one up to a speed is tried for each cell of a scale, and all frames of the window vote.

A frame seen between its pixels has less noise, so noise alone would prefer paths that lead there, and still scenes
would be blurred. Squared differences therefore count above the noise that interpolation leaves. Costs are sums over
blocks: no path is chosen by one pixel.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from quiver.baselines.paths.moved_frames import SCALES, Path, box_mean, displacement, kept_noise, look

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
    # Noise alone would always prefer some motion to none among so many that are tried.
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
        misfits += misfit((seen - reference) * scale, 1 + kept_noise(moved)) * there
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
