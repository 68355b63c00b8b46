"""Cutting a large frame into overlapping tiles, and the weights that blend their results without a seam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

OVERLAP = 32  # px that neighbouring tiles share


@dataclass(frozen=True)
class Tile:
    """A part of the frame and how much its result counts, [h, w]; the weights of all tiles sum to 1 at every pixel."""

    y: int
    x: int
    weight: Array


def spans(length: int, side: int, overlap: int) -> list[tuple[int, Array]]:
    """Starts and weights of spans of `side` that cover `length` with at least `overlap` shared; weights sum to 1."""
    if length <= side:
        return [(0, np.ones(length, np.float32))]
    count = -(-(length - overlap) // (side - overlap))
    starts = [round(i * (length - side) / (count - 1)) for i in range(count)]
    ramp = np.minimum(1.0, np.arange(1, side + 1) / (overlap + 1))
    total = np.zeros(length)
    shapes = []
    for i, start in enumerate(starts):
        rise = ramp if i > 0 else np.ones(side)
        fall = ramp[::-1] if i < count - 1 else np.ones(side)
        shapes.append(rise * fall)
        total[start : start + side] += shapes[-1]
    return [
        (start, (shape / total[start : start + side]).astype(np.float32))
        for start, shape in zip(starts, shapes, strict=True)
    ]


def plan_tiles(height: int, width: int, pixels: int, overlap: int = OVERLAP) -> list[Tile]:
    """Tiles of at most `pixels` pixels, near-square unless the frame is flat. ValueError if less than a tile fits."""
    if height * width <= pixels:
        return [Tile(0, 0, np.ones((height, width), np.float32))]
    least = 2 * overlap + 16
    side = int(pixels**0.5)
    tall = height if height <= side else max(min(side, height), min(least, height))
    wide = min(width, pixels // tall)
    tall = min(height, pixels // wide) if wide else 0
    if (tall < least and tall < height) or (wide < least and wide < width):
        raise ValueError(
            f"the memory bound holds {pixels} pixels at a time; a tile needs at least {least} x {least}; raise --memory"
        )
    return [
        Tile(y, x, rows[:, None] * columns[None, :])
        for y, rows in spans(height, tall, overlap)
        for x, columns in spans(width, wide, overlap)
    ]
