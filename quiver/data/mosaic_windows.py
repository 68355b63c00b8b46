"""Keeps the mask of colour filters in place when training windows are moved, turned and mirrored.

A network that sees mosaics knows one mask, from the first pixel of its window on. So a window begins at a place of the
tile from which the mask, turned like the window, is that mask again. A Bayer mask allows all eight turns.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from functools import lru_cache
from itertools import product

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.colour_filter import ColourFilter
from qsim.sensor.demosaicing import within
from qsim.sensor.sensor import Sensor
from quiver.data.defects import Filler, skips_codes

__all__ = ["TURNS", "filled_windows", "fitting_turns", "place_in_tile", "places_of_turns", "turned_frame", "within"]

TURNS = range(8)  # quarter turns 0..3, + 4 = mirrored first


def turned_frame(frame: Array, turn: int) -> Array:
    """Return frames [..., h, w] mirrored and turned: quarter turns 0..3, + 4 = mirrored first."""
    frame = frame[..., ::-1] if turn >= 4 else frame
    return np.rot90(frame, turn % 4, axes=(-2, -1))


@lru_cache(maxsize=64)
def places_of_turns(mask: tuple[str, ...], at_first: tuple[str, ...], side: int) -> dict[int, tuple[int, int]]:
    """Return for each turn that keeps the mask the row and column of the tile at which a window begins.

    The clip's first pixel lies at the first letter of `at_first`. A window [side, side], turned, has `mask` from its
    first pixel on.
    """
    rows = len(mask)
    columns = len(mask[0])
    repeats = np.arange(side)
    letters = np.array([list(row) for row in mask])
    wanted = letters[repeats[:, None] % rows, repeats % columns]
    seen = np.array([list(row) for row in at_first])
    found: dict[int, tuple[int, int]] = {}
    for turn, y, x in product(TURNS, range(rows), range(columns)):
        window = seen[(repeats[:, None] + y) % rows, (repeats + x) % columns]
        if turn not in found and np.array_equal(turned_frame(window, turn), wanted):
            found[turn] = y, x
    return found


def place_in_tile(start: int, at: int, period: int) -> int:
    """Return the nearest place from `start` down, else the first one from 0 on, that is `at` in the tile."""
    found = start - (start - at) % period
    return found if found >= 0 else at % period


def fitting_turns(
    filters: ColourFilter, at_first: ColourFilter, side: int, room: Sequence[int], allowed: Collection[int] = TURNS
) -> dict[int, tuple[int, int]]:
    """Return `places_of_turns` of allowed turns that a clip has room for: its size less the side, along y and x.

    `ValueError` if there is none, and for a side that no number of tiles fills.
    """
    period = math.lcm(*filters.tile)
    if side % period:
        raise ValueError(f"crop={side}: windows of a mosaic need a multiple of the mask's {period} px")
    found = places_of_turns(filters.mask, at_first.mask, side)
    fitting = {turn: (y, x) for turn, (y, x) in found.items() if turn in allowed and y <= room[0] and x <= room[1]}
    if not fitting:
        raise ValueError(f"crop={side}: the clip has no place for a window that begins with the mask; choose less")
    return fitting


def filled_windows(codes: Array, bad: Array, sensor: Sensor, tile: tuple[int, int]) -> Array:
    """Return codes [T, h, w] with the defective pixels bool [h, w] filled, each from pixels of its own colour."""
    rows, columns = tile
    filled = codes.copy()
    for i, j in np.ndindex(rows, columns):
        own = bad[i::rows, j::columns]
        if own.any():
            part = (slice(None), slice(i, None, rows), slice(j, None, columns))
            filled[part] = Filler(own, skips_codes(sensor)).fill(codes[part], 0)
    return filled
