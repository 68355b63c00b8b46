"""Composes the flow of a clip over several frames: where the point of each pixel is some frames later.

    flow of frames first ... last - 1 --follow every pixel--> flow [2, H, W] and validity [H, W] from first to last

A pixel is followed through the flow of every frame on its way. Between pixels the flow is that of the four around the
place, weighted as in bilinear interpolation, and only pixels of the same body count: motion is not mixed over an edge.
A point is lost where fewer than half of the weights remain. It then goes on with its last step, and is not valid.
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clip_folder import ClipFolder

KNOWN = 0.5  # of the weights around a place: with less, its flow is not known


def composed(clip: ClipFolder, first: int, last: int) -> tuple[Array, Array]:
    """Return flow, float32 [2, H, W] (u right, v down) [px], and validity, bool [H, W], from frame first to last.

    p of frame `first` is at p + flow(p) in frame `last`. It is valid if the point is seen in every frame on its way. Of
    one frame both are those of the clip. `ValueError` for frames that do not exist, and for clips without flow.
    """
    flow = clip.flow(first)
    valid = clip.valid(first)
    if last == first + 1:
        return flow, valid
    body = _body(clip, first)
    start = np.stack(np.meshgrid(*map(np.arange, flow.shape[1:]), indexing="ij")[::-1]).astype(np.float64)
    step = flow.astype(np.float64)
    valid = valid & np.isfinite(step).all(axis=0)
    step = np.where(np.isfinite(step), step, 0.0)
    moved = step
    for t in range(first + 1, last):
        found, known = _between(clip, t, start + moved, body)
        step = np.where(known, found, step)
        valid &= known
        moved = moved + step
    return moved.astype(np.float32), valid


def _between(clip: ClipFolder, t: int, place: Array, body: Array | None) -> tuple[Array, Array]:
    """Return the flow [2, H, W] of frame t at places (x, y) [2, H, W] px of points of a body, and where it is known."""
    flow = clip.flow(t)
    seen = clip.valid(t) & np.isfinite(flow).all(axis=0)
    bodies = _body(clip, t)
    height, width = seen.shape
    corner = np.floor(place)
    share = place - corner
    total = np.zeros(place.shape)
    weights = np.zeros(seen.shape)
    for right in (0, 1):
        for down in (0, 1):
            x = corner[0] + right
            y = corner[1] + down
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            at = (np.where(inside, y, 0).astype(int), np.where(inside, x, 0).astype(int))
            weight = np.abs(1 - right - share[0]) * np.abs(1 - down - share[1])
            usable = inside & seen[at]
            if body is not None and bodies is not None:
                usable &= bodies[at] == body
            weight = np.where(usable, weight, 0.0)
            total += weight * np.where(usable, flow[:, *at], 0.0)
            weights += weight
    known = weights >= KNOWN
    return total / np.where(known, weights, 1.0), known


def _body(clip: ClipFolder, t: int) -> Array | None:
    """Return the body of each pixel of frame t, int32 [H, W]; None if the clip does not state them."""
    return clip.body_id(t) if clip.holds("id") else None
