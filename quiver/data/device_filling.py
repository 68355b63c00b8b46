"""Fills the dead and hot pixels of a batch of windows on a device, as defects.py fills them on the host.

    map of a window (host) -> Fill: neighbours and weights     codes, fills of a batch -> the same codes, filled there

The host searches the neighbours, as the order of equal distances is that of its search. A mean is summed in another
order than NumPy's: a code differs with a chance of about 1e-15.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy import ndarray as Array
from torch import Tensor

from qsim.keys import Key
from qsim.sensor.sensor import Sensor
from quiver.data.defects import NEIGHBOURS, STAGE, Filler, skips_codes
from quiver.data.device_words import uniform_of_one, words_at
from quiver.device import moved, pinned

FILL = "fill"  # of the windows of a batch, a list
_KEY = Key(0, 0, 0, STAGE).philox_key


@dataclass(frozen=True, eq=False)
class Fill:
    """How the n defective pixels of one window are filled; places are numbers of pixels of the window, not turned."""

    at: Array  # int64 [n]
    counters: Array  # int64 [n, 2]: row and column of the random numbers
    sources: Array  # int64 [n, NEIGHBOURS]
    weights: Array  # float64 [n, NEIGHBOURS]; of a choice the number up to which each source is taken
    picks: bool  # one source is chosen; otherwise their mean is taken


def fill_of(bad: Array, sensor: Sensor, tile: tuple[int, int] = (1, 1)) -> Fill:
    """Return how the defective pixels bool [side, side] are filled, each from pixels of its place in the tile."""
    rows, columns = tile
    side = bad.shape[1]
    picks = skips_codes(sensor)
    parts: list[tuple[Array, ...]] = []
    for i, j in np.ndindex(rows, columns):
        own = bad[i::rows, j::columns]
        if own.any():
            filler = Filler(own, picks)
            counters = np.argwhere(own)
            y, x = np.divmod(filler.sources, own.shape[1])
            at = (counters[:, 0] * rows + i) * side + counters[:, 1] * columns + j
            parts.append((at, counters, (y * rows + i) * side + x * columns + j, _weights(filler)))
    if not parts:
        return Fill(*_no_parts(), picks)
    at, counters, sources, weights = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Fill(at, counters, sources, weights, picks)


def _weights(filler: Filler) -> Array:
    """Return the weights of all sources, float64 [n, NEIGHBOURS], or the bounds of a choice."""
    missing = ((0, 0), (0, NEIGHBOURS - filler.weights.shape[1]))
    if not filler.picks:
        return np.pad(filler.weights, missing)
    bounds = filler.weights.cumsum(axis=1)
    bounds[:, -1] = np.inf
    return np.pad(bounds, missing, constant_values=np.inf)


def _no_parts() -> tuple[Array, Array, Array, Array]:
    none = np.zeros(0, np.int64)
    sources = np.zeros((0, NEIGHBOURS), np.int64)
    return none, none.reshape(0, 2), sources, sources.astype(np.float64)


@dataclass(frozen=True, eq=False)
class Fills:
    """The fills of a batch on a device, N defective pixels in all."""

    window: Tensor  # int64 [N]
    at: Tensor  # int64 [N]
    counters: Tensor  # int64 [N, 2]
    sources: Tensor  # int64 [N, NEIGHBOURS]
    weights: Tensor  # float64 [N, NEIGHBOURS]
    picks: Tensor  # bool [N]

    @classmethod
    def of(cls, fills: Sequence[Fill], device: torch.device) -> Fills:
        """Send the fills of all windows of a batch, without waiting for the device."""
        counts = [len(fill.at) for fill in fills]

        def sent(numbers: Array) -> Tensor:
            return moved(pinned(torch.from_numpy(numbers), device), device)

        return cls(
            window=sent(np.repeat(np.arange(len(fills)), counts)),
            at=sent(np.concatenate([fill.at for fill in fills])),
            counters=sent(np.concatenate([fill.counters for fill in fills])),
            sources=sent(np.concatenate([_padded(fill.sources) for fill in fills])),
            weights=sent(np.concatenate([fill.weights for fill in fills])),
            picks=sent(np.repeat([fill.picks for fill in fills], counts)),
        )

    def applied(self, codes: Tensor, places: Tensor) -> Tensor:
        """Return codes int64 [B, T, h, w], turned, with the defective pixels filled.

        `places` int64 [B, h w] has the pixel of the turned window for each one of the window that is not turned.
        """
        frames = torch.arange(codes.shape[1], device=codes.device)
        flat = codes.flatten(2)
        own = places.index_select(0, self.window)  # [N, h w]
        at = own.gather(1, self.at[:, None])
        sources = own.gather(1, self.sources)
        near = flat[self.window[:, None, None], frames[:, None], sources[:, None]]  # [N, T, NEIGHBOURS]
        row, column = (each[:, None] for each in self.counters.unbind(1))
        chance = uniform_of_one(words_at(_KEY >> 32, _KEY & 0xFFFFFFFF, frames, row, column))  # [N, T]
        weights = self.weights[:, None]
        means = torch.zeros_like(chance)
        for code, weight in zip(near.unbind(-1), weights.unbind(-1), strict=True):
            means = means + code.double() * weight
        number = (chance[..., None] > weights).sum(-1, keepdim=True).clamp(max=NEIGHBOURS - 1)
        chosen = near.gather(-1, number)[..., 0]
        found = torch.where(self.picks[:, None], chosen, (means + chance).floor().long())
        filled = flat.clone()
        filled[self.window[:, None], frames, at] = found
        return filled.view_as(codes)


def _padded(sources: Array) -> Array:
    return np.pad(sources, ((0, 0), (0, NEIGHBOURS - sources.shape[1])))
