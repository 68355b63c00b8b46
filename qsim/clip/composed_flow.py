"""Composes the flow of a clip over several frames: where the point of each pixel is some frames later.

    flow of frames first ... last - 1 --follow every pixel--> flow [2, H, W] and validity [H, W] from first to last

A pixel is followed through the flow of every frame on its way. Between pixels the flow is that of the four around the
place, weighted as in bilinear interpolation, and only pixels of the same body count: motion is not mixed over an edge.
Of a body that hides itself only pixels at about the depth of the point count. A point is lost where none of them does.
It then goes on with its last step, and is not valid.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy import ndarray as Array

KNOWN = 0.01  # of the weights around a place: with less, its flow is not known
FAR = 1e30  # m: the depth of what has none
APART = 0.01  # of a depth: pixels of one body that are farther apart are not neighbours on it


class Moving(Protocol):
    """Frames with flow, as those of a clip folder."""

    def flow(self, t: int) -> Array:
        """Return flow, float32 [2, H, W] px, from frame t to the next."""

    def valid(self, t: int) -> Array:
        """Return bool [H, W]: whether the point of frame t is seen in the next one."""

    def holds(self, channel: str) -> bool:
        """Return whether the frames have a channel of truth, such as id."""

    def body_id(self, t: int) -> Array:
        """Return the body of each pixel, int32 [H, W]."""

    def depth(self, t: int) -> Array:
        """Return the depth of each pixel, float32 [H, W] m."""


def composed(clip: Moving, first: int, last: int) -> tuple[Array, Array]:
    """Return flow, float32 [2, H, W] (u right, v down) [px], and validity, bool [H, W], from frame first to last.

    p of frame `first` is at p + flow(p) in frame `last`. It is valid if the point is seen in every frame on its way. Of
    one frame both are those of the clip. `ValueError` for frames that do not exist, and for clips without flow.
    """
    flow = clip.flow(first)
    valid = clip.valid(first)
    if last == first + 1:
        return flow, valid
    body = clip.body_id(first) if clip.holds("id") else None
    depth = np.minimum(clip.depth(first).astype(np.float64), FAR) if clip.holds("Z") else None
    start = np.stack(np.meshgrid(*map(np.arange, flow.shape[1:]), indexing="ij")[::-1]).astype(np.float64)
    step = flow.astype(np.float64)
    valid = valid & np.isfinite(step).all(axis=0)
    step = np.where(np.isfinite(step), step, 0.0)
    moved = step
    for t in range(first + 1, last):
        found, known, depth = _between(clip, t, start + moved, body, depth)
        # Where the point is lost it goes on as it moved: a flow without holes, of which `valid` tells what to trust.
        step = np.where(known, found, step)
        valid &= known
        moved = moved + step
    return moved.astype(np.float32), valid


def _between(
    clip: Moving, t: int, place: Array, body: Array | None, depth: Array | None
) -> tuple[Array, Array, Array | None]:
    """Return the flow [2, H, W] of frame t at places (x, y) [2, H, W] px of points, where it is known, and their depth.

    The points are those of a body, and were at a depth in the frame before.
    """
    flow = clip.flow(t)
    seen = clip.valid(t) & np.isfinite(flow).all(axis=0)
    bodies = None if body is None else clip.body_id(t)
    depths = None if depth is None else np.minimum(clip.depth(t).astype(np.float64), FAR)
    height, width = seen.shape
    corner = np.floor(place)
    share = place - corner
    total = np.zeros(place.shape)
    deep = np.zeros(seen.shape)
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
            if depth is not None and depths is not None:
                # A body that hides a part of itself, as an arm before a trunk: its other side moves otherwise.
                usable &= np.abs(depths[at] - depth) <= APART * depth
                deep += np.where(usable, weight * depths[at], 0.0)
            weight = np.where(usable, weight, 0.0)
            total += weight * np.where(usable, flow[:, *at], 0.0)
            weights += weight
    known = weights >= KNOWN
    sums = np.where(known, weights, 1.0)
    return total / sums, known, None if depth is None else np.where(known, deep / sums, depth)
