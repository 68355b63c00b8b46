"""Estimates how the camera moves: one affine motion of the complete frame for every frame of a window.

    frames [B, K, h, w] (phi of pooled codes) -> shifts by correlation with the frames aligned so far, from the
    reference outwards -> Gauss-Newton of an affine motion, all frames at once -> motion [B, K, 2, 3]

A hand shakes, a car jolts: within eleven frames the direction changes, and no path with one velocity and one
acceleration follows. But such motion is that of the complete frame, and a few numbers for each frame tell it. All
pixels vote, so they are found at little light, too. Paths (motion_paths.py) are then found in frames without it.

Motion is [..., 2, 3] = (down, right) by (1, y, x): of px of the full frame, at places y and x from -1 to 1 across the
frame. The motion of the reference is zero.

Ours; the steps are correlation by Fourier transforms and the registration of Lucas and Kanade (1981) to the mean of all
moved frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
import torch.nn.functional as functional
from torch import Tensor

from quiver.baselines.paths.moved_frames import box_mean, kept_noise

SCALE = 4  # px per cell, at which frames are registered
DETAIL = 4  # cells: structure wider than twice this, as of light that changes, does not count in a correlation
REACH = 4  # cells from where the last two frames lead, at which a shift is looked for
SUDDEN = 0.1  # cells that a shift is away from there, at which it is e times less likely
STEPS = ((4, 1), (2, 3), (2, 3))  # of Gauss-Newton: scale; 1 for a shift, 3 for an affine motion
MOST = 1.0  # cells, largest correction of one step
MISFIT = 3.0  # variances of the noise at which a place has half a vote
SMALLEST = 8  # cells of a frame's side, below which no camera is looked for


def camera_motion(pyramid: dict[int, Tensor], offsets: Sequence[int]) -> Tensor:
    """Return the motion [B, K, 2, 3] of frames at each scale: {scale: [B, K, H/scale, W/scale]}.

    `offsets` are the frames' places in time; 0 is the reference. Frames of fewer than SMALLEST cells have none.
    """
    frames = pyramid[SCALE]
    batch, count, height, width = frames.shape
    if min(height, width) < SMALLEST or count == 1:
        return frames.new_zeros(batch, count, 2, 3)
    motion = functional.pad(shifts(frames, offsets).unsqueeze(-1), (0, 2)) * SCALE
    for scale, terms in STEPS:
        motion = _corrected(pyramid[scale], motion, offsets.index(0), scale, terms)
    return motion


# ---- Shifts


def shifts(frames: Tensor, offsets: Sequence[int]) -> Tensor:
    """Return the shift [B, K, 2] of frames [B, K, h, w] in cells: frame(p + shift) is like reference(p).

    From the reference outwards, each frame is correlated with the mean of those that are aligned already.
    """
    batch, _, height, width = frames.shape
    centre = offsets.index(0)
    found = {0: frames.new_zeros(batch, 2)}
    total = frames[:, centre]
    inside = torch.ones_like(total)
    detail = frames - box_mean(frames, DETAIL)
    spectra = torch.fft.rfft2(detail, s=(2 * height, 2 * width))  # filled by zeros: shifts do not wrap around
    for distance in range(1, max(abs(offset) for offset in offsets) + 1):
        here = [offset for offset in (-distance, distance) if offset in offsets]
        guess = torch.stack([_led_to(found, offset) for offset in here], dim=1)
        mean = total / inside
        template = torch.fft.rfft2(mean - box_mean(mean, DETAIL), s=(2 * height, 2 * width))
        places = [offsets.index(offset) for offset in here]
        likeness = torch.fft.irfft2(spectra[:, places] * template.conj()[:, None], s=(2 * height, 2 * width))
        moved = _peak(likeness * SCALE**2, guess)  # a cell's noise has the variance 1 / SCALE^2
        for n, offset in enumerate(here):
            found[offset] = moved[:, n]
        motion = functional.pad(moved.unsqueeze(-1), (0, 2))
        seen, there = seen_without(frames[:, places], motion)
        total = total + (seen * there).sum(1)
        inside = inside + there.sum(1)
    return torch.stack([found[offset] for offset in offsets], dim=1)


def _led_to(found: dict[int, Tensor], offset: int) -> Tensor:
    """Return where the last two frames on the way to an offset lead, [B, 2]; beside the reference, no shift."""
    step = 1 if offset > 0 else -1
    last = found[offset - step]
    return last if abs(offset) == 1 else 2 * last - found[offset - 2 * step]


def _peak(likeness: Tensor, guess: Tensor) -> Tensor:
    """Return the shift [B, N, 2] at the peak of likeness [B, N, H, W], REACH cells around the guess [B, N, 2] at most.

    `likeness` is a logarithm of the likelihood. A facade looks the same one window farther: shifts far from the guess
    are less likely. Shifts count from 0 upwards and, backwards, from the end. A parabola places the peak between cells.
    """
    height, width = likeness.shape[-2:]
    start = guess.round().to(torch.int64) - REACH - 1
    side = torch.arange(2 * REACH + 3, device=likeness.device)
    rows = (start[..., 0, None] + side) % height
    columns = (start[..., 1, None] + side) % width
    index = rows[..., :, None] * width + columns[..., None, :]
    near = likeness.flatten(2).gather(2, index.flatten(2)).view(index.shape)
    away = ((start[..., None] + side) - guess[..., None]).square()
    near = near - (away[..., 0, :, None] + away[..., 1, None, :]).sqrt() / SUDDEN
    inner = near[..., 1:-1, 1:-1].flatten(2)
    best = inner.argmax(-1)
    row = best // (2 * REACH + 1) + 1
    column = best % (2 * REACH + 1) + 1
    flat = near.flatten(2)
    line = 2 * REACH + 3

    def at(down: int, right: int) -> Tensor:
        return flat.gather(2, ((row + down) * line + column + right)[..., None])[..., 0]

    middle = at(0, 0)
    down = row + _between(at(-1, 0), middle, at(1, 0))
    right = column + _between(at(0, -1), middle, at(0, 1))
    return start + torch.stack([down, right], dim=-1)


def _between(before: Tensor, middle: Tensor, after: Tensor) -> Tensor:
    """Return the place of the top of a parabola beside its middle value, -0.5 to 0.5."""
    bend = (before + after - 2 * middle).clamp(max=-1e-12)
    return (0.5 * (before - after) / bend).clamp(-0.5, 0.5)


# ---- Frames without the motion of the camera


@lru_cache(maxsize=64)
def lattice(height: int, width: int, device: torch.device) -> Tensor:
    """Return (1, y, x) of each cell, [3, h, w]; y and x from -1 to 1 across the frame, the same at all scales."""
    y = (torch.arange(height, device=device, dtype=torch.float32) + 0.5) * (2 / height) - 1
    x = (torch.arange(width, device=device, dtype=torch.float32) + 0.5) * (2 / width) - 1
    return torch.stack([torch.ones(height, width, device=device), *torch.meshgrid(y, x, indexing="ij")])


def field(motion: Tensor, height: int, width: int) -> Tensor:
    """Return motion [B, K, 2, 3] at each cell, [B, K, 2, h, w] px."""
    _, y, x = lattice(height, width, motion.device)
    one, down, right = (part[..., None, None] for part in motion.unbind(-1))
    return (one + down * y).addcmul_(right, x)


def seen_without(frames: Tensor, motion: Tensor, scale: int = 1) -> tuple[Tensor, Tensor]:
    """Return frames [B, K, h, w] of a scale seen at p + motion [B, K, 2, 3], bilinear, and 1 where that is inside."""
    height, width = frames.shape[-2:]
    place = places(motion, height, width, scale)
    grid = place.flatten(0, 1).permute(0, 2, 3, 1)
    seen = functional.grid_sample(
        frames.reshape(-1, 1, height, width), grid, padding_mode="border", align_corners=False
    )
    right, down = place.unbind(2)
    # Floats: a truth value takes five times as long.
    inside = right.clamp(-1, 1).eq_(right).mul_(down.clamp(-1, 1).eq_(down))
    return seen.view(frames.shape), inside


def seen_with_noise(frames: Tensor, motion: Tensor, scale: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return what `seen_without` does, and the share of the noise's variance that is left there, [B, K, h, w]."""
    height, width = frames.shape[-2:]
    moved = places(motion, height, width, scale).add_(1)
    for place, side in zip(moved.unbind(2), (width, height), strict=True):
        place.mul_(side / 2).sub_(0.5).clamp_(0, side - 1)
    return *seen_without(frames, motion, scale), kept_noise(moved)


def places(motion: Tensor, height: int, width: int, scale: int) -> Tensor:
    """Return p + motion [B, K, 2, 3] at cells of a scale, (right, down) from -1 to 1: [B, K, 2, h, w].

    The map is affine, so each number is one of the row and one of the column, added.
    """
    _, y, x = lattice(height, width, motion.device)
    rows = y[:, 0]
    columns = x[0]
    place = motion.new_empty(*motion.shape[:2], 2, height, width)
    for n, (axis, side) in enumerate(((1, width), (0, height))):
        one, down, right = (motion[:, :, axis, :, None] * (2 / side / scale)).unbind(2)
        of_row = one + down * rows
        of_column = right * columns
        if axis:
            of_column += columns
        else:
            of_row += rows
        torch.add(of_row[..., :, None], of_column[..., None, :], out=place[:, :, n])
    return place


# ---- Parts


def parted(motion: Tensor, offsets: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return velocity and acceleration [B, 2, 2, 3] of a motion [B, K, 2, 3], px/frame and px/frame^2, and the rest of
    it, [B, K, 2, 3], which no smooth path follows.
    """
    powers, inverse = _smooth(tuple(offsets), motion.device)
    smooth = (inverse[:, :, None, None] * motion[:, None]).sum(2)
    return smooth, motion - (powers[:, :, None, None] * smooth[:, None]).sum(2)


@lru_cache(maxsize=64)
def _smooth(offsets: tuple[int, ...], device: torch.device) -> tuple[Tensor, Tensor]:
    """Return k and k^2/2 of offsets k, [K, 2], and what makes least squares of them, [2, K]."""
    powers = torch.tensor([[k, k * k / 2] for k in offsets], dtype=torch.float32)
    return powers.to(device), torch.linalg.pinv(powers).to(device)


# ---- Gauss-Newton


def _corrected(frames: Tensor, motion: Tensor, centre: int, scale: int, terms: int) -> Tensor:
    """Return motion [B, K, 2, 3] after one step that makes the moved frames equal to their weighted mean."""
    height, width = frames.shape[-2:]
    moved, inside = seen_without(frames, motion, scale)
    mean = (moved * inside).sum(1, keepdim=True) / inside.sum(1, keepdim=True).clamp(min=1)
    misfit = box_mean((moved - mean).square(), 1) * (scale**2 / MISFIT)
    vote = inside / (1 + misfit.square())
    mean = (moved * vote).sum(1, keepdim=True) / vote.sum(1, keepdim=True).clamp(min=1e-6)
    errors = ((moved - mean) * vote).flatten(2)
    places = lattice(height, width, frames.device)[:terms]
    pull = (slope(mean[:, 0])[:, :, None] * places).flatten(1, 2).flatten(2)  # [B, 2 * terms, h w]
    share = vote.mean(1).flatten(1)[:, None]
    normal = (pull * share) @ pull.transpose(1, 2)
    # a flat frame tells nothing of its motion, and must not divide by zero
    ridge = 1e-4 * normal.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] + 1e-9
    normal = normal + ridge * torch.eye(2 * terms, device=frames.device)
    right = pull @ errors.transpose(1, 2)  # [B, 2 * terms, K]
    step = -torch.linalg.solve_ex(normal, right)[0].transpose(1, 2).unflatten(2, (2, terms))
    # the mean may be moved as a whole against the reference, which is to stay
    step = (step - step[:, centre, None]).clamp(-MOST, MOST) * scale
    return motion + functional.pad(step, (0, 3 - terms))


def slope(image: Tensor) -> Tensor:
    """Return the slope of an image [B, h, w] down and right, per cell, [B, 2, h, w]."""
    edge = functional.pad(image[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    return torch.stack([edge[:, 2:, 1:-1] - edge[:, :-2, 1:-1], edge[:, 1:-1, 2:] - edge[:, 1:-1, :-2]], dim=1) / 2
