"""Checks frames, and extends them beyond their edges: in space by repetition, in time by reflection."""

from typing import Any

import torch.nn.functional as F
from torch import Tensor


def check_frames(frames: Tensor) -> None:
    """Raise `ValueError` unless the frames are floating-point numbers [B, T, 1, H, W], none of the sides zero."""
    shape = tuple(frames.shape)
    if len(shape) != 5 or shape[2] != 1 or 0 in shape or not frames.is_floating_point():
        raise ValueError(
            f"frames must be floating-point numbers [B, T, 1, H, W], got {frames.dtype} {shape}; "
            "give codes divided by 2^b - 1"
        )


def pad_space(frames: Tensor, multiple: int, least: int = 1) -> Tensor:
    """[..., H, W] -> the same with rows and columns repeated below and right, to multiples and at least `least` px."""
    height, width = (max(-side // multiple * -multiple, -least // multiple * -multiple) for side in frames.shape[-2:])
    margins = (0, width - frames.shape[-1], 0, height - frames.shape[-2])
    flat = frames.reshape(-1, 1, *frames.shape[-2:])
    return F.pad(flat, margins, mode="replicate").view(*frames.shape[:-2], height, width)


def reflected(first: int, count: int, length: int) -> list[int]:
    """Return frames first ... first + count - 1 of a clip of that length; beyond its ends it runs backwards."""
    period = max(2 * (length - 1), 1)
    folded = (t % period for t in range(first, first + count))
    return [min(t, period - t) if length > 1 else 0 for t in folded]


def restored_range(network: Any, frames: Tensor, first: int, last: int, **known: Tensor) -> Tensor:
    """Clip [B, T, 1, H, W] -> restored frames first ... last - 1 of it [B, last - first, 1, H, W].

    For networks that restore one frame of a window: only the windows of these frames are computed. `known` are further
    inputs of its `windows`. ValueError for another shape.
    """
    check_frames(frames)
    before = network.frames_in - 1 - network.look_ahead
    count = last - first + network.frames_in - 1
    order = reflected(first - before, count, frames.shape[1])
    restored: Tensor = network.windows(pad_space(frames[:, order], network.multiple), **known)
    return restored[..., : frames.shape[-2], : frames.shape[-1]]
