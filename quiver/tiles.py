"""Cuts a large frame into tiles: exactly, where a result depends on near pixels only, or with blended seams.

    cores that cover the frame, each grown by `reach` on its inner sides  ->  tiles that are computed

Where a pixel depends on nothing farther than `reach`, a core has the result of the complete frame. Tiles begin at
multiples of the network's stride, so that pooling uses the same cells. Of all cuts whose tiles fit, the one with the
smallest total area is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array


@dataclass(frozen=True)
class Tile:
    """A part of the frame and the weight of its result, [h, w]; the weights of all tiles sum to 1 at every pixel."""

    y: int
    x: int
    weight: Array


def extents(length: int, core: int, reach: int) -> list[tuple[int, int]]:
    """Return first and last + 1 pixel of each span: `core` pixels of `length`, grown by `reach` on both sides."""
    return [(max(0, start - reach), min(length, start + core + reach)) for start in range(0, length, core)]


def cores(height: int, width: int, pixels: int, reach: int, multiple: int, least: int = 1) -> tuple[int, int]:
    """Return height and width of the cores whose tiles hold at most `pixels` pixels and have the smallest total area.

    `multiple` divides reach and cores. A side below `least` counts as `least`: the network fills it. `ValueError` if
    the smallest tile does not fit.
    """
    if max(height, least) * max(width, least) <= pixels:
        return height, width
    found = []
    for length in (height, width):
        tried = np.arange(multiple, length + multiple, multiple)
        ends = [extents(length, int(core), reach) for core in tried]
        found.append(
            (tried, *(np.array([kind(max(b - a, least) for a, b in spans) for spans in ends]) for kind in (max, sum)))
        )
    (tall, most_y, all_y), (wide, most_x, all_x) = found
    area = np.where(most_y[:, None] * most_x <= pixels, all_y[:, None] * all_x, np.iinfo(np.int64).max)
    y, x = np.unravel_index(np.argmin(area), area.shape)
    if most_y[y] * most_x[x] > pixels:
        raise ValueError(
            f"the memory bound holds {pixels} pixels at a time; a tile needs at least {most_y.min()} x {most_x.min()}; "
            "raise --memory"
        )
    return int(tall[y]), int(wide[x])


def spans(length: int, core: int, reach: int, blend: bool) -> list[tuple[int, Array]]:
    """Return starts and weights [n] of spans that cover `length`; the weights sum to 1.

    A weight is 1 in the core and 0 beyond; with `blend` it rises and falls linearly over the overlap.
    """
    shapes = []
    total = np.zeros(length)
    for start, (first, last) in zip(range(0, length, core), extents(length, core, reach), strict=True):
        at = np.arange(first, last)
        shape = ((at >= start) & (at < start + core)).astype(float)
        if blend:
            rise = (at - start + reach + 1) / (2 * reach + 1) if start else np.ones(len(at))
            fall = (start + core + reach - at) / (2 * reach + 1) if start + core < length else np.ones(len(at))
            shape = np.clip(rise, 0, 1) * np.clip(fall, 0, 1)
        shapes.append((first, shape))
        total[first:last] += shape
    return [(first, (shape / total[first : first + len(shape)]).astype(np.float32)) for first, shape in shapes]


def cut_tiles(
    height: int, width: int, pixels: int, reach: int, multiple: int = 1, *, blend: bool = False, least: int = 1
) -> list[Tile]:
    """Return tiles of at most `pixels` pixels that start at multiples of `multiple`; one tile if the frame fits.

    A side below `least` counts as `least`. `ValueError` if the smallest tile does not fit.
    """
    reach = -(-reach // multiple) * multiple
    tall, wide = cores(height, width, pixels, reach, multiple, least)
    return [
        Tile(y, x, rows[:, None] * columns[None, :])
        for y, rows in spans(height, tall, reach, blend)
        for x, columns in spans(width, wide, reach, blend)
    ]
