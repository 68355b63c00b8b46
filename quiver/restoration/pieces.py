"""What of a frame is computed at a time, so that a network stays within a memory bound without another answer.

A U-Net sees 36 px far: tiles that overlap by twice as much give what the whole frame gives. QUIVER's attention and
gates average over the frame, and its recurrence carries far: it takes the frame whole, and only the initial estimate of
a FoldedQUIVER, which needs the most memory, runs tile by tile. A frame too large even for that is cut into tiles that
are blended. These do see less: `fill_network` measures by how much they disagree, and warns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy import ndarray as Array

from quiver.tiles import Tile, cut_tiles

if TYPE_CHECKING:
    from torch import nn

BLENDED = 32  # px: half of what neighbouring tiles share where no overlap makes them exact
STARTING = 60_000_000  # bytes that torch takes for its kernels when it is used first
ESTIMATE_BYTES = 1_200  # per pixel of an initial estimate of width 32; 930 measured
COUNTS = 0.1  # weight from which a tile's answer is compared with its neighbours'


@dataclass(frozen=True)
class Pieces:
    """How a frame is cut."""

    tiles: list[Tile]
    estimate_pixels: int | None = None  # that the initial estimate takes at a time; None: the whole tile
    exact: bool = True  # whether the answer is that of the whole frame
    needed: int = 0  # bytes, about, with which it would be

    @property
    def text(self) -> str:
        """The cut that changes the answer; empty if it does not."""
        if self.exact:
            return ""
        tallest, widest = (max(tile.weight.shape[axis] for tile in self.tiles) for axis in (0, 1))
        return f"{len(self.tiles)} tiles of at most {tallest} x {widest}"


def cut_pieces(model: nn.Module, height: int, width: int, memory: int, mode: str) -> Pieces:
    """The cut of a frame for a network and so many bytes; `ValueError` if they hold not even a small tile."""
    from quiver.model.folded import FoldedQUIVER
    from quiver.model.quiver import QUIVER
    from quiver.model.unet import SmallUNet

    multiple = int(model.multiple)  # type: ignore[arg-type]
    pixels = memory // bytes_per_pixel(model, mode)
    whole = Pieces(cut_tiles(height, width, height * width, 0))
    if height * width <= pixels:
        return whole
    if not isinstance(model, QUIVER):
        reach = getattr(model, "reach", None)
        blend = reach is None
        return Pieces(cut_tiles(height, width, pixels, reach or BLENDED, multiple, blend=blend), exact=not blend)
    padded = [side + -side % multiple for side in (height, width)]
    needed = bytes_per_pixel(model, mode) * height * width
    if isinstance(model, FoldedQUIVER) and model.estimate is not None:
        rest = STARTING + frame_bytes(model, mode) * padded[0] * padded[1]
        least = 16 + 2 * SmallUNet.REACH  # below, overlaps are most of the work
        per_pixel = ESTIMATE_BYTES * model.config.estimate_width // 32
        needed = min(needed, rest + per_pixel * min(least, padded[0]) * min(least, padded[1]))
        if memory >= needed:
            return Pieces(whole.tiles, estimate_pixels=(memory - rest) // per_pixel)
    step = max(multiple, model.stride)
    return Pieces(cut_tiles(height, width, pixels, BLENDED, step, blend=True), None, False, needed)


def bytes_per_pixel(model: nn.Module, mode: str) -> int:
    """Working memory of a network per pixel of the tile, float32, about 1.5 times of what `quiver bench` measured."""
    from quiver.model.folded import FoldedQUIVER
    from quiver.model.quiver import QUIVER

    if not isinstance(model, QUIVER):
        return 4_000
    held = 2 if mode == "windows" else 1  # windows of eleven frames at once
    stages = held * (4000 + 1200 * model.config.channels)
    if not isinstance(model, FoldedQUIVER):
        return stages
    return int(stages / model.config.fold**2) + 64 * model.config.estimate_width  # the estimate is at full size


def frame_bytes(model: nn.Module, mode: str) -> int:
    """Working memory per pixel of a FoldedQUIVER beside its initial estimate; nano: 1338, measured 1030."""
    from quiver.model.folded import FoldedQUIVER

    assert isinstance(model, FoldedQUIVER)
    held = 2 if mode == "windows" else 1
    return 700 + int(held * (1160 + 348 * model.config.channels) / model.config.fold**2)


@dataclass(frozen=True)
class Disagreement:
    """The least and the largest that tiles gave for a pixel, [H, W], where two or more of them count."""

    low: Array
    high: Array
    times: Array

    @classmethod
    def nothing(cls, height: int, width: int) -> Disagreement:
        shape = (height, width)
        return cls(np.full(shape, np.inf, np.float32), np.full(shape, -np.inf, np.float32), np.zeros(shape, np.uint8))

    def add(self, tile: Tile, restored: Array) -> None:
        """Take note of what a tile gave, [h, w], where its weight is at least COUNTS."""
        part = (slice(tile.y, tile.y + restored.shape[0]), slice(tile.x, tile.x + restored.shape[1]))
        counts = tile.weight >= COUNTS
        np.minimum(self.low[part], restored, out=self.low[part], where=counts)
        np.maximum(self.high[part], restored, out=self.high[part], where=counts)
        self.times[part] += counts

    def measured(self) -> tuple[float, float]:
        """Root mean square and largest difference; zeros where no pixel was seen twice."""
        apart = (self.high - self.low)[self.times > 1]
        return (float(np.sqrt(np.mean(apart**2))), float(apart.max())) if apart.size else (0.0, 0.0)
