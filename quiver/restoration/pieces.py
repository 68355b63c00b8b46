"""Decides how much of a clip a network computes at a time, within the memory bound: frames, and tiles of a frame.

    frames before | part | frames after  ->  network  ->  the part; the rest is thrown away
    cores that cover the frame, each grown by `reach` on its inner sides  ->  tiles that are computed

Parts begin at multiples of their length, so that a frame is restored alike whether a range of frames or the complete
stream is requested, and memory does not grow with the stream. Where a network restores one frame of a window, the
frames around a part are those of its windows, and the result is that of the complete clip. Recurrent networks are
limited: they see the past, and without a fixed look-ahead the future, only as far as their part.

A U-Net has a reach of 36 px: tiles that overlap by twice as much give the result of the complete frame. Tiles begin at
multiples of the network's stride, so that pooling uses the same cells; of all cuts whose tiles fit, the one with the
smallest total area is taken. The attention and the gates of QUIVER average over the frame, and its recurrence reaches
far: it takes the complete frame. A frame too large for that is cut into tiles that are blended, and so is a frame too
large for a compared network. Their result differs: a warning states by how much.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray as Array

from quiver.data.codes import Codes

if TYPE_CHECKING:
    from torch import nn

PAST = 10  # frames before a part, where a network sees the complete past: as many as in training
AROUND = 4  # frames before and after a part, where a network sees the complete clip
KEPT = 16  # frames of a part, where a network restores one frame of a window
KEPT_OF_CLIP = 8  # where it sees the complete clip: with AROUND, sixteen frames at a time
KEPT_OF_RECURRENT = 32  # ten frames computed again are a third more work; with 16 they are two thirds
BLENDED = 32  # px: half of the overlap of neighbouring tiles where no overlap makes them exact
TILING = 30_000_000  # bytes that tiles of several shapes take beyond those of the largest; 26 MB measured
STEP = 16  # px: tiles of the compared networks begin at multiples of it
MERGED_BYTES = 1_500  # per pixel that merging and MergeNet take
COUNTS = 0.1  # weight from which the result of a tile is compared with its neighbours


# ---- Parts of a clip


@dataclass(frozen=True)
class ClipPart:
    """The frames that are restored at a time, and those around them."""

    before: int
    kept: int
    after: int
    past: int  # most frames before a restored one that it depends on
    future: int  # most frames after it

    @property
    def seen(self) -> int:
        """Frames that the network has at a time."""
        return self.before + self.kept + self.after


def takes_clips(network: nn.Module) -> bool:
    """Return whether a network restores every frame of a clip: the compared networks do, and state a look-ahead."""
    return hasattr(network, "look_ahead")


def part_of(network: Any) -> ClipPart:
    """Return the parts in which a network restores a clip."""
    ahead = network.look_ahead
    if ahead is None:
        around, kept = getattr(network, "parts", (AROUND, KEPT_OF_CLIP))
        return ClipPart(around, kept, around, around + kept - 1, around + kept - 1)
    if hasattr(network, "frames_in"):
        before = network.frames_in - 1 - ahead
        return ClipPart(before, KEPT, ahead, before, ahead)
    return ClipPart(PAST, KEPT_OF_RECURRENT, ahead, PAST + KEPT_OF_RECURRENT - 1, ahead)


# ---- Tiles of a frame


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
    # All pairs of core heights and widths: the total area of their tiles, overlap included, is the work.
    area = np.where(most_y[:, None] * most_x <= pixels, all_y[:, None] * all_x, np.iinfo(np.int64).max)
    y, x = np.unravel_index(np.argmin(area), area.shape)
    if most_y[y] * most_x[x] > pixels:
        raise ValueError(
            f"the memory bound holds {pixels} pixels at a time; a tile needs at least {most_y.min()} x {most_x.min()}; "
            "raise memory="
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
            # Neighbours overlap by twice the reach; there one falls as the other rises, and both add up to 1.
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


# ---- The cut of a frame for a network and a memory


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
    more = f"; memory={-(-pieces.needed // 10**6)}MB avoids the cut" if pieces.needed else ""
    return (
        f"{codes.name}: {pieces.memory / 1e6:.0f} MB hold no frame of {codes.shape[1]} x {codes.shape[2]} px; it is "
        f"cut into {pieces.text}, which differ where they overlap by {100 * rms:.2g} % of white rms, "
        f"{100 * most:.2g} % at most{more}"
    )
