"""Draws the codes of a sensor exactly, with a table that decides nearly every pixel by one look-up.

    code = #{k : u >= F_k(photons)},  u uniform: grows with u and with photons

The plane of (sqrt(photons), u) is cut into cells. Where the code is equal in the two extreme corners of a cell, it is
equal everywhere in the cell. For the pixels in other cells (1 to 2 % at 3 bits) the sensor itself draws. Nothing is
approximated: the codes equal those of the sensor's reference engine (tested). The draw is several times faster and
needs NumPy only, for worker processes that must not use Dr.Jit.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy import ndarray as Array

from qsim import keys
from qsim.keys import Key
from qsim.sensor.distribution import Distribution
from qsim.sensor.sensor import Sensor

CELLS = 1024  # along each side of the table
U_SHIFT = 22  # 2^32 / CELLS words fall into one cell
TABLE_BITS = 7  # wider codes change within too many cells
MARGIN = 1e-12  # relative; wider than the rounding of sqrt and product


class CodeTable:
    """Codes by cell for one sensor at one exposure; 255 where the cell does not decide."""

    UNDECIDED = np.uint8(255)

    def __init__(self, sensor: Distribution, exposure: float) -> None:
        """Fill the table. `ValueError` for a sensor whose codes do not grow with light (a paralyzable counter)."""
        self.sensor = sensor
        self.exposure = exposure
        brightest = sensor.white(exposure)
        while sensor.cdf(np.array([brightest]), exposure)[0, -2] > 1e-4 and brightest < 64 * sensor.white(exposure):
            brightest *= 1.25
        edges = np.linspace(0, np.sqrt(brightest), CELLS) ** 2  # the last cell is open: all photons above
        darkest = edges * (1 - MARGIN)
        lightest = edges[1:] * (1 + MARGIN)
        low = sensor.cdf(darkest, exposure)[:, :-1]
        high = np.concatenate([sensor.cdf(lightest, exposure)[:, :-1], np.zeros((1, low.shape[1]))])
        if np.isfinite(sensor.brightest(exposure)) or (np.diff(low, axis=0) > 1e-9).any():
            raise ValueError("this sensor's codes do not grow with light; no table can hold them")
        u = np.arange(CELLS + 1) / CELLS
        least = np.stack([np.searchsorted(row, u[:-1], side="right") for row in low])
        most = np.stack([np.searchsorted(row, u[1:], side="right") for row in high])
        self.table = np.where(least == most, least, self.UNDECIDED).astype(np.uint8).ravel()
        self.steps = (CELLS - 1) / np.sqrt(brightest)

    def draw(self, photons: Array, first: Array, second: Array | None = None) -> Array:
        """Return codes, uint8 [...], of expected photons [...] and one 32-bit word per pixel [...].

        `LookupError` where 32 bits do not decide (one pixel in 10^8) and `second` words [...] are missing.
        """
        row = np.minimum(np.sqrt(photons) * self.steps, CELLS - 1).astype(np.int32)
        codes = self.table[row * CELLS + (first >> np.uint32(U_SHIFT)).astype(np.int32)]
        open_ = np.flatnonzero(codes == self.UNDECIDED)
        if open_.size:

            def further(undecided: Array) -> Array:
                if second is None:
                    raise LookupError("32 bits do not decide; give second words")
                return second.ravel()[open_[undecided]]

            light = photons.ravel()[open_]
            words = first.ravel()[open_]
            codes.ravel()[open_] = self.sensor.draw(light, self.exposure, words, further)
        return codes


@lru_cache(maxsize=256)  # 1 MB each
def _code_table(sensor: Sensor, exposure: float) -> CodeTable | None:
    """Return the table of a sensor; None for a sensor that a table cannot hold."""
    if sensor.bits > TABLE_BITS:
        return None
    try:
        return CodeTable(sensor, exposure)
    except ValueError:
        return None


def draws_at_once(sensor: Sensor) -> bool:
    """Return whether `draw_codes` draws a sum of planes from one number per pixel (`Row.at_once`)."""
    return sensor.bits <= TABLE_BITS


def draw_codes(sensor: Sensor, photons: Array, exposure: float, key: Key, origin: tuple[int, int] = (0, 0)) -> Array:
    """Return codes [T, H, W] of expected photons [T, H, W], frame t under `key.at(key.frame + t)`, without Dr.Jit.

    `origin` (y, x) places a crop in the full frame. The codes equal those of `sensor.sample(..., engine="reference")`
    where a sensor draws one number per pixel. A clocked SPAD draws one number per plane: its codes here have the same
    exact distribution, from other numbers.
    """
    table = _code_table(sensor, exposure)
    if table is None or not (photons.min() >= 0 and photons.max() < np.inf):  # the sensor names the bad pixel
        return sensor.sample(photons, exposure, key=key, origin=origin, engine="reference")
    first = keys.words(key, photons.shape, origin)
    try:
        return table.draw(photons, first)
    except LookupError:
        return table.draw(photons, first, keys.words(key, photons.shape, origin, redraw=1))
