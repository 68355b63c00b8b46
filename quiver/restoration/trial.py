"""Tries methods on small pieces of a stream, and finds which of them restores it best; no truth is needed.

    stream -> pieces spread over its frames -> each restored by every method, twice -> risk.py -> Verdict

A method that lags far behind the best is tried on no further piece. What a trial costs follows from the size of the
stream alone, never from a clock: a trial of the same stream ends alike on every machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key, hash_name
from quiver.data.codes import Codes, light_of
from quiver.restoration.interface import Restorer, scenes
from quiver.restoration.risk import Reading, block_sums, mean_and_error, redraw, scores

SIDE = 128  # px of a piece, less where the frame is smaller
MARGIN = 8  # px at the edges of a piece that are not scored: methods see less there than in the complete frame
SMALLEST = 48  # px, side of a frame below which nothing is tried
PIECES = 16
FEWEST = 3  # pieces before a method is given up, and of a trial at all
COST = 0.1  # of restoring the stream by the first method, at most
COSTS = {"qbp": 2.0, "qbp-bm3d": 4.0}  # over that of the network, per frame on one core; of other methods 1
SURE = 1.5  # standard errors by which another method must be better
MOST_TOLD = 99.9  # standard errors
HOPELESS = 4.0  # standard errors behind the best, from which a method is given up
PEAK = 2.5  # times the mean light: where PSNR clips the light, too
STAGE = 2000  # of the random keys of a trial


@dataclass(frozen=True)
class Place:
    """Where a piece lies."""

    frame: int  # that is restored
    y: int
    x: int
    height: int
    width: int


@dataclass(frozen=True)
class Verdict:
    """Which method restores a stream best."""

    best: str  # name of the method
    rival: str  # name of the best other one
    lead: float  # squared error of the rival less that of the best [photons^2]; below 0 where it is taken by default
    error: float  # standard error of the lead [photons^2]
    pieces: int

    @property
    def sure(self) -> bool:
        """Return whether the lead exceeds chance."""
        return self.lead > SURE * self.error

    def __str__(self) -> str:
        """Return one line: `4.1 standard errors better than qbp-bm3d on 6 pieces of the stream`."""
        if not self.sure:
            return f"no sure difference from {self.rival} on {self.pieces} pieces of the stream"
        share = min(self.lead / self.error, MOST_TOLD) if self.error else MOST_TOLD
        return f"{share:.1f} standard errors better than {self.rival} on {self.pieces} pieces of the stream"


@dataclass
class _Tally:
    """The scores of the methods over all pieces so far."""

    sums: dict[str, list[Array]] = field(default_factory=dict)  # of blocks, by method
    pixels: int = 0
    pieces: int = 0

    def behind(self, name: str, other: str) -> tuple[float, float]:
        """Return the mean squared error of a method less that of another [photons^2], and the standard error.

        They are compared on the pieces on which both were tried. The standard error is that of noise, or that of
        pieces which differ, whichever is larger.
        """
        both = min(len(self.sums[name]), len(self.sums[other]))
        gaps = [self.sums[name][n] - self.sums[other][n] for n in range(both)]
        pixels = self.pixels * both // self.pieces
        mean, noise = mean_and_error(np.concatenate(gaps), pixels)
        _, places = mean_and_error(np.array([gap.sum() for gap in gaps]), pixels)
        return mean, noise if both == 1 else max(noise, places)

    def in_order(self) -> list[str]:
        """Return the methods that were tried on all pieces, the best one first, and then the others."""
        return sorted(self.sums, key=lambda name: (-len(self.sums[name]), sum(float(p.sum()) for p in self.sums[name])))


def affordable(codes: Codes, methods: Sequence[Restorer], share: float = COST) -> int:
    """Return on how many pieces, PIECES at most, these methods can be tried for a share of restoring by the first.

    Pieces of a short stream are no more than fit between its ends side by side.
    """
    length, height, width = codes.shape
    if min(height, width) < SMALLEST:
        return 0
    area = min(SIDE, height) * min(SIDE, width)
    between_ends = length - 2 * _end(length, _window(methods))
    distinct = max(FEWEST, between_ends * height * width // area)
    piece = 2 * area * sum(cost_of(method) for method in methods)
    paid = share * length * height * width * cost_of(methods[0]) / piece
    return int(min(paid, distinct, PIECES))


def cost_of(method: Restorer) -> float:
    """Return the cost of a method per pixel and frame, in that of the network."""
    return COSTS.get(method.name.partition(":")[0], 1.0)


def tried(codes: Codes, methods: Sequence[Restorer], pieces: int, seed: int = 0) -> Verdict:
    """Return which of two or more methods restores a stream of one band best, tried on so many pieces.

    The first method is taken unless another one is better by SURE standard errors. `ValueError` for a sensor whose mean
    code does not rise with light.
    """
    reading = Reading.of(codes.sensor, codes.exposure)
    left = {method.name: method for method in methods}
    tally = _Tally({name: [] for name in left})
    peak = PEAK * light_of(codes)
    window = _window(methods)
    for n, place in enumerate(places(codes.shape, pieces, window, seed)):
        piece = _Piece.read(codes, place, window)
        _add(tally, piece, left, reading, peak, Key(seed, hash_name(codes.name), n, STAGE))
        if tally.pieces >= FEWEST:
            _give_up(left, tally)
        if len(left) == 1:
            break
    return _verdict(methods[0].name, tally)


def _window(methods: Sequence[Restorer]) -> int:
    """Return the largest window of the methods in frames."""
    return max(method.window for method in methods)


def _end(length: int, window: int) -> int:
    """Return the frames at each end of a stream where a window is not complete, fewer if there are no others."""
    return min(window // 2, (length - 1) // 2)


def places(shape: tuple[int, int, int], pieces: int, window: int, seed: int = 0) -> Iterator[Place]:
    """Yield where so many pieces of a stream [T, H, W] lie: at random, one in each of as many parts of its frames.

    Frames at the ends, where a window is not complete, are left out. The pieces come in random order, so that a trial
    that ends early has seen all parts of the stream.
    """
    length, height, width = shape
    rng = np.random.default_rng([seed, STAGE])
    rows = min(SIDE, height)
    columns = min(SIDE, width)
    end = _end(length, window)
    inner = length - 2 * end
    for part in rng.permutation(pieces):
        frame = end + min(inner - 1, int((part + rng.random()) * inner / pieces))
        y = int(rng.integers(height - rows + 1))
        x = int(rng.integers(width - columns + 1))
        yield Place(frame, y, x, rows, columns)


@dataclass(frozen=True)
class _Piece:
    """The codes of a piece, and the frame of them that is restored."""

    codes: Codes  # [t, h, w], in memory
    frame: int
    good: Array  # bool [h, w], pixels that are not filled from others

    @classmethod
    def read(cls, codes: Codes, place: Place, window: int) -> _Piece:
        """Return the piece at a place, with the frames around it that methods of this window see."""
        scene = next(scene for scene in scenes(codes) if place.frame in scene)
        first = max(scene.start, place.frame - window // 2)
        last = min(scene.stop, place.frame + window // 2 + 1)
        here = (slice(place.y, place.y + place.height), slice(place.x, place.x + place.width))
        seen = codes.read(first, last)[(slice(None), *here)].copy()
        good = np.ones(seen.shape[1:], bool) if codes.defective is None else ~codes.defective[here]
        return cls(_of_array(codes, seen), place.frame - first, good)

    def own(self) -> Array:
        """Return the codes [h, w] of the frame that is restored."""
        return self.codes.read(self.frame, self.frame + 1)[0]

    def restored(self, method: Restorer) -> Array:
        """Return the frame [photons, h, w] restored by a method."""
        return method.restore(self.codes, self.frame, self.frame + 1)[0]

    def with_frame(self, frame: Array) -> _Piece:
        """Return the piece with other codes [h, w] of the frame that is restored."""
        seen = self.codes.read(0, self.codes.shape[0]).copy()
        seen[self.frame] = frame
        return replace(self, codes=_of_array(self.codes, seen))


def _of_array(codes: Codes, seen: Array) -> Codes:
    """Return codes [t, h, w] of a stream as a stream in memory."""

    def read(start: int, stop: int) -> Array:
        return seen[start:stop]

    shape = (len(seen), seen.shape[1], seen.shape[2])
    return replace(codes, shape=shape, read=read, digest=str, defective=None, unfilled=None, cuts=())


def _add(
    tally: _Tally, piece: _Piece, methods: Mapping[str, Restorer], reading: Reading, peak: float, key: Key
) -> None:
    """Add the scores of the methods on a piece; light above the `peak` [photons] counts as this."""
    restored = {name: piece.restored(method) for name, method in methods.items()}
    centre = np.mean(list(restored.values()), axis=0, dtype=np.float64).clip(0)
    own = piece.own()
    redrawn = redraw(own, centre, piece.codes.sensor, piece.codes.exposure, key)
    changed = piece.with_frame(redrawn.after)
    valid = piece.good & (centre < peak)
    inner = (slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
    again = {name: changed.restored(method) for name, method in methods.items()}
    for name in methods:
        score = scores(np.minimum(restored[name], peak), np.minimum(again[name], peak), redrawn, reading)
        tally.sums[name].append(block_sums((valid * score)[inner]))
    tally.pixels += valid[inner].size
    tally.pieces += 1


def _give_up(left: dict[str, Restorer], tally: _Tally) -> None:
    """Remove the methods that lag far behind the best one."""
    best = tally.in_order()[0]
    for name in list(left):
        gap, error = tally.behind(name, best)
        if name != best and gap > HOPELESS * error:
            del left[name]


def _verdict(first: str, tally: _Tally) -> Verdict:
    """Return the method that is taken, and how it compares with the best other one."""
    best, *others = tally.in_order()
    if best != first:
        gap, error = tally.behind(first, best)
        if gap <= SURE * error:
            others = [best, *(name for name in others if name != first)]
            best = first
    rival = first if best != first else others[0]
    gap, error = tally.behind(rival, best)
    return Verdict(best, rival, gap, error, tally.pieces)
