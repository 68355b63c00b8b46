"""Fills the codes of hot and dead pixels from their neighbours, before any method sees them.

    map of defective pixels [H, W] -> Filler;   codes [T, H, W] --Filler.fill--> codes that every method reads

A defective pixel takes the mean of the codes of its eight nearest good pixels in the same frame, weighted by the
inverse square of their distance, and rounded up or down by chance, so that its expectation is this mean: rounding to
the nearest code would shift the light of few-bit codes. Where an electron is worth several codes, a mean may be a code
that the sensor cannot produce: there one of the eight codes is chosen by weight, with the same expectation. The chance
is keyed by frame and pixel: repeats are equal. Other frames are not used: what moves is elsewhere in them, and every
method merges frames itself.

The map is given, or known: a stream drawn with a table [defects] states its dead and hot pixels. Of a recording without
a map, hot pixels are found by their own codes where light moves (hot_pixels.py).
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim import files, keys
from qsim.arrays import plain
from qsim.keys import Key
from qsim.sensor.defects.defect_table import Defects as Defects
from qsim.sensor.defects.defect_table import from_dict as read_defects
from qsim.sensor.defects.good_pixels import behind, defective
from qsim.sensor.sensor import Sensor
from qsim.streams.simulation import Draw
from qsim.streams.stream import Stream

NEIGHBOURS = 8  # good pixels that a defective one is filled from
STAGE = 4  # of the random keys
REACH = 2  # standard deviations of read noise around an electron, within which codes occur


class Filler:
    """Fills the defective pixels of one map."""

    def __init__(self, bad: Array, picks: bool = False) -> None:
        """Find the neighbours of every defective pixel of a map, bool [H, W]. `ValueError` if no pixel is good.

        With `picks` a pixel takes the code of one neighbour; otherwise the mean of all.
        """
        from scipy.spatial import cKDTree

        if bad.all():
            raise ValueError(f"all {bad.size} pixels are marked as defective; the map is true at defective pixels")
        self.bad = bad
        self.picks = picks
        good = np.argwhere(~bad)
        count = min(NEIGHBOURS, len(good))
        distance, index = cKDTree(good).query(np.argwhere(bad), k=range(1, count + 1))
        self.sources: Array = np.flatnonzero(~bad)[index]  # [n, k]
        self.weights = distance**-2.0 / (distance**-2.0).sum(1, keepdims=True)  # [n, k]

    def fill(self, codes: Array, first: int) -> Array:
        """Return codes [T, H, W] with the defective pixels filled; frames are numbered from `first`."""
        flat = codes.reshape(len(codes), -1)
        near = flat[:, self.sources]  # [T, n, k]
        chance = keys.uniform(self._words(len(codes), first))
        filled = codes.copy()
        if self.picks:
            chosen = (chance[..., None] > self.weights.cumsum(axis=1)[:, :-1]).sum(axis=-1, keepdims=True)
            filled[:, self.bad] = np.take_along_axis(near, chosen, axis=-1)[..., 0]
        else:
            means = np.einsum("tnk,nk->tn", near.astype(float), self.weights)
            filled[:, self.bad] = np.floor(means + chance).astype(codes.dtype)
        return filled

    def _words(self, frames: int, first: int) -> Array:
        """Return the random words of the defective pixels of some frames, uint32 [T, n]: of these pixels alone."""
        y, x = np.nonzero(self.bad)
        t = np.repeat(np.arange(first, first + frames), len(y))
        at = np.stack([t, np.tile(y, frames), np.tile(x, frames)])
        return keys.words_at(Key(0, 0, 0, STAGE), at).reshape(frames, -1)


def skips_codes(sensor: Sensor) -> bool:
    """Return whether codes between those of n and n + 1 electrons hardly ever occur: read noise does not reach them."""
    return sensor.gain * (1 - 2 * REACH * sensor.blur) > 1


def of_draw(draw: Draw, exposure: float, shape: tuple[int, int]) -> Array | None:
    """Return the defective pixels of a clip that is sensed now."""
    light = draw.level.ppp * draw.planes
    return defective(draw.defects, draw.sensor, exposure * draw.planes, light, shape, draw.origin)


def of_stream(stream: Stream) -> tuple[Array | None, Sensor]:
    """Return the defective pixels that the description of a stream states, and the sensor of its good pixels.

    A warning where a map is missing.
    """
    table = stream.info.defects
    light = stream.info.light
    if not table or light is None:
        return None, stream.sensor
    _, height, width = stream.shape
    try:
        found = read_defects(table)
        bad = defective(found, stream.sensor, stream.exposure, light.ppp, (height, width), stream.origin)
        return bad, behind(bad, found, stream.sensor, (height, width), stream.origin)
    except (OSError, ValueError) as error:
        warnings.warn(f"{stream.path}: its hot and dead pixels are not filled: {files.wording(error)}", stacklevel=2)
        return None, stream.sensor


def read_map(path: Path) -> Array:
    """Return a map of defective pixels, bool [H, W], from a .npy of booleans or of 0 and 1. `ValueError` otherwise."""
    return check_map(np.asarray(files.load_array(path)), str(path))


def check_map(array: Array, name: str) -> Array:
    """Return a map of defective pixels, bool [H, W], of booleans or of 0 and 1. `ValueError` otherwise."""
    if array.ndim != 2 or not array.size or array.dtype.kind not in "bui" or not np.isin(array, (0, 1)).all():
        raise ValueError(
            f"{name}: a map of defective pixels is [H, W] of booleans, or of 0 and 1, and this is {array.dtype} "
            f"{list(array.shape)}; compare measured dark counts with a limit first"
        )
    return plain(array, bool)
