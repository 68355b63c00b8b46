"""Finds the frames of a stream at which another scene, or another light, begins, and single frames that are faulty.

    codes -> coarse light of each frame -> how unlike its predecessor it is, at the best shift -> cuts, faulty frames

Coarse light is a mean over squares of 16 px, four px apart, divided by that of the frame. What two such pictures share
is the part of their variance beyond noise that a shift of up to 24 px explains. So motion, a jolt and noise are no
cut. One frame that is unlike both neighbours, which are alike, is faulty: black, white or a flash. Where frames keep
being unlike, things move fast, and nothing is found.

No method looks across a cut: each scene is restored as a stream of its own (restoration/interface.py).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray as Array
from scipy.ndimage import uniform_filter

from quiver.data.codes import BLOCK_PIXELS, Codes

CELL = 4  # px between the squares
CELLS = 4  # along a square
REACH = 6  # cells, the largest shift
SMALLEST = 64  # px, side of a frame below which nothing is looked for
UNLIKE = 0.15  # of the variance beyond noise, from which two pictures are of different scenes: in motion it is 0.02
JUMP = 0.4  # natural logarithm of the ratio of two lights, from which the light is another one
SIGNAL = 3.0  # times the variance of noise, below which a picture tells nothing but its light
ALONE = 2  # frames around a cut without another one
DARK = 1e-3  # of the mean light of the stream's first frames: a darker frame is black


@dataclass(frozen=True)
class Coarse:
    """One frame as squares."""

    picture: Array  # [h, w], light of squares over that of the frame, less 1
    noise: float  # its variance
    light: float  # mean, photons


@dataclass(frozen=True)
class Cuts:
    """What was found in a stream, by the number of the frame."""

    starts: tuple[int, ...] = ()  # at which another scene or light begins
    faulty: tuple[int, ...] = ()  # unlike both neighbours


def cut_into_scenes(codes: Codes) -> Codes:
    """Return the codes of a stream with its cuts and faulty frames; the same where nothing can be looked for."""
    if codes.shares is not None or min(codes.shape[1:]) < SMALLEST:
        return codes
    try:
        found = find_cuts(codes)
    except ValueError:  # codes that tell no light
        return codes
    return replace(codes, cuts=found.starts, faulty=found.faulty)


def find_cuts(codes: Codes) -> Cuts:
    """Return the cuts and faulty frames of a stream; `ValueError` for a sensor whose mean code tells no light."""
    unlike: list[bool] = [False]  # frame t and its predecessor
    apart: list[bool] = [False, False]  # frame t and the one before its predecessor
    recent: deque[Coarse] = deque(maxlen=3)
    for frame in _coarse_frames(codes):
        recent.append(frame)
        if len(recent) > 1:
            unlike.append(_unlike(recent[-2], frame))
        if len(recent) == 3:
            # Two frames apart are compared only where both pairs between them are unlike.
            both = unlike[-1] and unlike[-2]
            apart.append(both and _unlike(recent[0], frame))
    return _judged(unlike, apart)


def _judged(unlike: list[bool], apart: list[bool]) -> Cuts:
    """Return cuts and faulty frames by which frames are unlike the one before, and the one before that."""
    length = len(unlike)
    faulty = [t for t in range(1, length - 1) if unlike[t] and unlike[t + 1] and not apart[t + 1]]
    explained = {t for fault in faulty for t in (fault, fault + 1)}
    changes = [t for t in range(1, length) if unlike[t] and t not in explained]
    starts = [t for t in changes if not any(0 < abs(t - other) <= ALONE for other in changes)]
    return Cuts(tuple(starts), tuple(faulty))


def _coarse_frames(codes: Codes) -> Iterator[Coarse]:
    """Yield all frames of a stream as squares, reading blocks of frames."""
    length, height, width = codes.shape
    table = codes.sensor.response(codes.exposure)
    slope = np.gradient(table.photons, table.mean)
    step = max(1, BLOCK_PIXELS // (height * width))
    rows = height // CELL
    columns = width // CELL
    samples = (CELL * CELLS) ** 2
    inner = (slice(CELLS // 2, 1 - CELLS // 2), slice(CELLS // 2, 1 - CELLS // 2))
    for first in range(0, length, step):
        block = codes.read(first, min(length, first + step))[:, : rows * CELL, : columns * CELL]
        cells = block.reshape(len(block), rows, CELL, columns, CELL).mean(axis=(2, 4))
        for mean in cells:
            squares = uniform_filter(mean, CELLS)[inner]
            light = table.invert(squares, samples)
            total = float(light.mean())
            scale = max(total, DARK * codes.white, 1e-12)
            spread = np.interp(squares, table.mean, table.variance) * np.interp(squares, table.mean, slope) ** 2
            yield Coarse(light / scale - 1, float(spread.mean()) / samples / scale**2, max(total, 1e-12))


def _unlike(before: Coarse, after: Coarse) -> bool:
    """Return whether two frames show different scenes, or the same in another light."""
    if abs(math.log(after.light / before.light)) > JUMP:
        return True
    if _share_unexplained(before, after, 0, 0) < UNLIKE:
        return False
    shifts = range(-REACH, REACH + 1)
    return all(_share_unexplained(before, after, y, x) >= UNLIKE for y in shifts for x in shifts)


def _share_unexplained(before: Coarse, after: Coarse, y: int, x: int) -> float:
    """Return the share of the variance of two pictures that a shift by so many cells leaves; 0 for pure noise."""
    height, width = before.picture.shape
    one = before.picture[max(0, -y) : height - max(0, y), max(0, -x) : width - max(0, x)]
    other = after.picture[max(0, y) : height - max(0, -y), max(0, x) : width - max(0, -x)]
    noise = before.noise + after.noise
    signal = float(one.var() + other.var()) - noise
    if signal < SIGNAL * noise:
        return 0.0
    return (float((one - other).var()) - noise) / signal
