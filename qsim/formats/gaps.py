"""Finds lost frames and uneven steps in the times that a recording states, and stores lost frames as missing.

Times of T frames -> Gaps: how many frames are lost after which frame, or how much the steps vary
"""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim.file_order import places
from qsim.formats.recording import Recording, Times

JITTER = 0.1  # of a step, by which stated times may differ from even ones
MOST_FILLED = 10  # times as many frames as there are: beyond it, the numbers are no times
NAMED = 3  # gaps that a message lists


@dataclass(frozen=True)
class Gaps:
    """What the times of frames say about their steps."""

    lost: dict[int, int]  # frame -> frames that are lost after it
    uneven: tuple[float, float, int] | None = None  # smallest and largest step, and the frame after which it is largest

    @property
    def total(self) -> int:
        return sum(self.lost.values())


def find(times: Times) -> Gaps:
    """Return the gaps: steps that are a multiple of the usual one; other steps make the recording uneven.

    Times that are even up to rounding (`tick`) have none, also where a step is shorter than a tick.
    """
    values = np.array(times.values)
    if len(values) < 3:
        return Gaps({})
    steps = np.diff(values)
    even = np.linspace(values[0], values[-1], len(values))
    if np.abs(values - even).max() <= 1.01 * times.tick:
        return Gaps({})
    usual = float(np.median(steps) if times.tick else steps.min())  # exact numbers count frames
    usual = float(steps[steps < 1.5 * usual].mean()) if usual > 0 else 0.0  # single steps, whose rounding cancels
    counts = np.maximum(np.rint(steps / usual), 1.0) if usual > 0 else np.ones(len(steps))
    usual = float((values[-1] - values[0]) / counts.sum())
    if np.abs(steps - counts * usual).max() > 2 * times.tick + JITTER * usual:
        return Gaps({}, (float(steps.min()), float(steps.max()), int(steps.argmax())))
    return Gaps({int(t): int(counts[t]) - 1 for t in np.flatnonzero(counts > 1)})


def of_names(paths: list[Path]) -> Times | None:
    """Return the numbers in the names of files in order, None if no single number counts or dates them."""
    found = places(paths)
    if found is None or any(a >= b for a, b in itertools.pairwise(found)):
        return None
    values = tuple(float(value) for value in found)
    digits = max(_decimals(value) for value in found)
    if digits == 0:
        return Times(
            values, "frames", "numbers in the names of the files", 1.0 if min(np.diff(values), default=1) > 1 else 0.0
        )
    return Times(values, "s", "decimals in the names of the files", 10.0**-digits)


def _decimals(value: Fraction) -> int:
    """Return the decimals of an exact decimal number."""
    digits = 0
    while value.denominator != 1:
        value *= 10
        digits += 1
    return digits


def told(path: Path, recording: Recording, keep: bool) -> Recording:
    """Warn of lost frames and uneven steps with their place, or (`keep`) return the light with missing frames.

    A missing frame is dark and all its pixels are marked as saturated: its light is a lower bound. `ValueError` for
    codes, which have no missing values, and for steps that are no multiples of a usual one.
    """
    if recording.times is None:
        return recording
    found = find(recording.times)
    source = recording.times.source
    unit = recording.times.unit
    if found.uneven is not None:
        small, large, t = found.uneven
        said = f"{path}: {source}: steps from {small:.4g} to {large:.4g} {unit}, the largest after frame {t}"
        if keep:
            raise ValueError(f"{said}; lost frames cannot be told from a variable rate, so leave keep_gaps=True out")
        warnings.warn(f"{said}; the frames are read as if they were even", stacklevel=4)
        return recording
    if not found.lost:
        return recording
    said = f"{path}: {source}: {_listed(found, recording.times)}"
    if not keep:
        warnings.warn(
            f"{said}; the frames on both sides are read as neighbours, and keep_gaps=True stores lost ones as missing",
            stacklevel=4,
        )
        return recording
    if not recording.is_light:
        raise ValueError(
            f"{said}; streams of codes hold no missing frames: leave keep_gaps=True out, or convert the parts"
        )
    if found.total > MOST_FILLED * recording.shape[0]:
        raise ValueError(f"{said}; more than {MOST_FILLED} times the frames that exist, so leave keep_gaps=True out")
    return _filled(recording, found)


def tell_files(paths: list[Path]) -> None:
    """Warn of files of many frames whose numbers leave some out, with their place."""
    times = of_names(paths)
    found = Gaps({}) if times is None or times.unit != "frames" else find(times)
    for t in list(found.lost)[:1]:
        warnings.warn(
            f"{paths[t].parent}: no file is between {paths[t].name} and {paths[t + 1].name} "
            f"({found.total} of {len(paths) + found.total} are missing); their frames are read as neighbours",
            stacklevel=5,
        )


def _listed(found: Gaps, times: Times) -> str:
    unit = "" if times.unit == "frames" else f" {times.unit}"
    first = list(found.lost.items())[:NAMED]
    places = ", ".join(
        f"{lost} between {times.values[t]:g} and {times.values[t + 1]:g}{unit} (after frame {t})" for t, lost in first
    )
    more = f", and {len(found.lost) - NAMED} more gaps" if len(found.lost) > NAMED else ""
    return f"{found.total} frame{'s are' if found.total > 1 else ' is'} lost: {places}{more}"


def _filled(recording: Recording, found: Gaps) -> Recording:
    """Return light with missing frames in its gaps."""
    frames, height, width = recording.shape
    steps = np.array([1 + found.lost.get(t, 0) for t in range(frames - 1)])
    place = np.concatenate([[0], np.cumsum(steps)])  # of each frame that exists
    total = int(place[-1]) + 1
    inner = recording.marked
    assert inner is not None

    def marked(start: int, stop: int) -> tuple[Array, Array]:
        light = np.zeros((stop - start, height, width), np.float32)
        mask = np.ones((stop - start, height, width), bool)
        first, last = (int(np.searchsorted(place, bound)) for bound in (start, stop))
        if first < last:
            at = place[first:last] - start
            light[at], mask[at] = inner(first, last)
        return light, mask

    missing = sorted(set(range(total)) - {int(t) for t in place})

    def read(start: int, stop: int) -> Array:
        return marked(start, stop)[0]

    reading = "; ".join(filter(None, (recording.reading, f"{found.total} lost frames are stored as missing")))
    source = replace(recording.source, missing_frames=tuple(missing))
    times = recording.times
    assert times is not None
    whole = replace(times, values=tuple(np.interp(range(total), place, times.values).tolist()))
    return replace(
        recording, shape=(total, height, width), read=read, marked=marked, source=source, reading=reading, times=whole
    )
