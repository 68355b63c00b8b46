"""Decides how much of a frame a network computes at a time, within the memory bound and with the same result.

A U-Net has a reach of 36 px: tiles that overlap by twice as much give the result of the complete frame. The attention
and the gates of QUIVER average over the frame, and its recurrence reaches far: it takes the complete frame. A frame
too large for that is cut into tiles that are blended, and so is a frame too large for a compared network. Their result
differs: a warning states by how much.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray as Array

from quiver.data.codes import Codes
from quiver.restoration.parts import part_of, takes_clips
from quiver.tiles import Tile, cut_tiles

if TYPE_CHECKING:
    from torch import nn

BLENDED = 32  # px: half of the overlap of neighbouring tiles where no overlap makes them exact
TILING = 30_000_000  # bytes that tiles of several shapes take beyond those of the largest; 26 MB measured
STEP = 16  # px: tiles of the compared networks begin at multiples of it
MERGED_BYTES = 1_500  # per pixel that merging and MergeNet take
COUNTS = 0.1  # weight from which the result of a tile is compared with its neighbours


@dataclass(frozen=True)
class Pieces:
    """The cut of a frame."""

    tiles: list[Tile]
    exact: bool = True  # whether the result is that of the complete frame
    needed: int = 0  # bytes, about, for an exact cut; 0 for an exact one
    memory: int = 0  # bytes, the bound that led to a cut that is not exact

    @property
    def text(self) -> str:
        """Return the tiles of a cut that changes the result; empty for a cut that does not."""
        if self.exact:
            return ""
        tallest, widest = (max(tile.weight.shape[axis] for tile in self.tiles) for axis in (0, 1))
        return f"{len(self.tiles)} tiles of at most {tallest} x {widest}"


def cut_pieces(model: nn.Module, height: int, width: int, memory: int) -> Pieces:
    """Return the cut of a frame for a network and `memory` bytes. `ValueError` if they do not hold a small tile."""
    from quiver.model.quiver import QUIVER

    least = int(getattr(model, "least", 1))  # px: smaller tiles are filled to this side
    needed = bytes_needed(model, max(height, least), max(width, least))
    if needed <= memory:
        return Pieces(cut_tiles(height, width, height * width, 0))
    stated = memory
    memory = max(memory - weight_bytes(model), 0)
    pixels = pixels_in(model, memory)
    reach = getattr(model, "reach", None)
    if reach is not None:
        return Pieces(cut_tiles(height, width, pixels, reach, int(model.multiple)))  # type: ignore[arg-type]
    if takes_clips(model):  # recurrent, or aligned along any motion: no overlap makes tiles exact
        tiles = cut_tiles(height, width, pixels, BLENDED, STEP, blend=True, least=least)
        return Pieces(tiles, False, needed, stated)
    multiple = int(model.multiple)  # type: ignore[arg-type]
    if not isinstance(model, QUIVER):
        return Pieces(cut_tiles(height, width, pixels, BLENDED, multiple, blend=True), False, needed, stated)
    step = max(multiple, model.stride)
    pixels = max(memory - TILING, 0) // bytes_per_pixel(model)
    return Pieces(cut_tiles(height, width, pixels, BLENDED, step, blend=True), False, needed, stated)


def bytes_needed(model: nn.Module, height: int, width: int) -> int:
    """Return the working memory of a network for a tile, beside its weights."""
    pixels = height * width
    return weight_bytes(model) + bytes_per_pixel(model) * pixels + math.ceil(bytes_per_pair(model) * pixels**2)


def pixels_in(model: nn.Module, memory: int) -> int:
    """Return the pixels of a tile that `memory` bytes hold beside the weights."""
    each = bytes_per_pixel(model)
    pair = bytes_per_pair(model)
    return math.floor(2 * memory / (each + math.sqrt(each**2 + 4 * pair * memory)))  # of pair n^2 + each n = memory


def bytes_per_pair(model: nn.Module) -> float:
    """Return the working memory per pair of pixels of a tile: of MemDeblur, whose frames read five keys' worth.

    Two arrays of float32 hold the nearness of the positions, one per 16 x 16 px, of a frame and of what it reads.
    """
    return 2 * 4 * 5 / 256**2 if type(model).__name__ == "MemDeblur" else 0.0


def weight_bytes(model: nn.Module) -> int:
    """Return the size of the weights [bytes]: convolutions hold a copy of theirs, in another order, while they run."""
    return sum(weight.numel() * weight.element_size() for weight in model.parameters())


def bytes_per_pixel(model: nn.Module) -> int:
    """Return the working memory of a network per pixel of a tile, float32: about 1.5 times of what `quiver bench`
    measured.
    """
    from quiver.model.mergenet import MergeNet
    from quiver.model.quiver import QUIVER

    if type(model).__name__ in CLIP_BYTES:
        return clip_bytes(model)
    if isinstance(model, MergeNet):
        return MERGED_BYTES * max(24, model.config.width) // 24
    if not isinstance(model, QUIVER):
        return 4_000
    return 4000 + 1200 * model.config.channels


# Bytes per pixel that restoring a part of a clip takes at published width: measured with one frame, and more for each.
CLIP_BYTES = {
    "Bit2Bit": (2000, 700),
    "EMVD": (650, 20),
    "FastDVDnet": (1000, 30),
    "FloRNN": (10_000, 60),
    "MemDeblur": (2000, 90),
    "RVRT": (4400, 1280),
    "Spk2ImgNet": (15_000, 150),
    "StudentTeacher": (4000, 50),
}


def clip_bytes(network: Any) -> int:
    """Return the working memory per pixel of a network that takes clips: about 1.5 times of what was measured."""
    part = part_of(network)
    name = type(network).__name__
    first, more = CLIP_BYTES[name]
    share = network.config.width / type(network.config)().width
    if name == "EMVD":  # its wide layers see a sixteenth of the pixels: 21 times the width takes twice the memory
        share = 0.95 + 0.052 * share
    of_frame = more * max(share, 1) if name == "Bit2Bit" else more  # its layers hold all frames of a part
    return 500 + int(1.5 * (share * first + of_frame * part.seen))


@dataclass(frozen=True)
class Disagreement:
    """The least and the largest value of a pixel, [H, W] each, where two or more tiles count."""

    low: Array
    high: Array
    times: Array

    @classmethod
    def nothing(cls, height: int, width: int) -> Disagreement:
        """Return the record of a frame before any tile."""
        shape = (height, width)
        return cls(np.full(shape, np.inf, np.float32), np.full(shape, -np.inf, np.float32), np.zeros(shape, np.uint8))

    def add(self, tile: Tile, restored: Array) -> None:
        """Add the result of a tile, [h, w], where its weight is at least COUNTS."""
        part = (slice(tile.y, tile.y + restored.shape[0]), slice(tile.x, tile.x + restored.shape[1]))
        counts = tile.weight >= COUNTS
        np.minimum(self.low[part], restored, out=self.low[part], where=counts)
        np.maximum(self.high[part], restored, out=self.high[part], where=counts)
        self.times[part] += counts

    def measured(self) -> tuple[float, float]:
        """Return the root mean square and the largest difference; zeros where no pixel lies in two tiles."""
        apart = (self.high - self.low)[self.times > 1]
        return (float(np.sqrt(np.mean(apart**2))), float(apart.max())) if apart.size else (0.0, 0.0)


def told_of_cut(codes: Codes, pieces: Pieces, apart: Disagreement) -> str | None:
    """Return a line where a cut changes the answer: by how much tiles differ, and which memory avoids the cut.

    None for an exact cut. Tiles that agree may still differ from the uncut frame.
    """
    if pieces.exact:
        return None
    rms, most = apart.measured()
    more = f"; --memory {-(-pieces.needed // 10**6)}MB avoids the cut" if pieces.needed else ""
    return (
        f"{codes.name}: {pieces.memory / 1e6:.0f} MB hold no frame of {codes.shape[1]} x {codes.shape[2]} px; it is "
        f"cut into {pieces.text}, which differ where they overlap by {100 * rms:.2g} % of white rms, "
        f"{100 * most:.2g} % at most{more}"
    )
