"""Reads functions of one variable from tables on any device: straight lines between places, densest near both ends.

    table (x, f(x)) of NumPy -> Curves on a device;   x [B, ...] -> Place -> f(x) [B, ...], float32

`numpy.interp` searches the knots around every x, on the CPU. Here arithmetic tells the place: x lies at a distance t
from the nearer end of its range; the bits of t number equal parts of each octave, and a product numbers equal parts of
the range. Both numbers together count the places passed. Octaves keep steep rises at an end, as towards saturation;
equal parts keep the steps of a sensor that resolves single electrons. Several functions share a place. Nothing waits
for the host. The windows of a batch may have different tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy import ndarray as Array
from torch import Tensor

OCTAVES = 24  # below half of the range: a float beside an end has a place for itself
EVEN = 4096  # equal parts of the largest octave boundary below half of the range: 4096 to 8192 to the middle
MANTISSA = 23  # bits of a float32 after its exponent
LARGEST = 1e37  # of a coefficient


@dataclass(frozen=True, eq=False)
class Place:
    """Where numbers [B, ...] lie in a table."""

    index: Tensor  # int32 [n]
    distance: Tensor  # float32 [B, ...], from the nearer end


@dataclass(frozen=True, eq=False)
class Curves:
    """Functions f_0, f_1, ... of one variable for B windows; constant beyond the ends of their range."""

    bits: int  # an octave has 2^bits parts
    low: Tensor  # float32 [B]
    high: Tensor  # float32 [B]
    least: Tensor  # float32 [B], the distance at which octaves begin
    even: Tensor  # float32 [B], equal parts per unit of distance
    start: Tensor  # int32 [B], number of the window's first place, less that of `least` among all parts of octaves
    constants: Tensor  # float32 [functions, B * 2 * side(bits)]
    slopes: Tensor  # float32 [functions, B * 2 * side(bits)], over the distance

    def place(self, x: Tensor) -> Place:
        """Return where numbers float32 [B, ...] lie."""
        shape = (-1, *(1,) * (x.ndim - 1))
        above = x - self.low.view(shape)
        below = self.high.view(shape) - x
        upper = above > below
        distance = torch.minimum(above, below).clamp_(min=0)
        index = torch.maximum(distance, self.least.view(shape)).view(torch.int32) >> (MANTISSA - self.bits)
        index += self.start.view(shape)
        index += (distance * self.even.view(shape)).int()
        index.add_(upper, alpha=side(self.bits))
        return Place(index.flatten(), distance)

    def value(self, place: Place, function: int) -> Tensor:
        """Return the values float32 [B, ...] of a function at a place."""
        constant, slope = (x[function].index_select(0, place.index) for x in (self.constants, self.slopes))
        return constant.view_as(place.distance).addcmul_(slope.view_as(place.distance), place.distance)


def side(bits: int) -> int:
    """Return the number of places between an end and the middle."""
    return OCTAVES * 2**bits + 2 * EVEN


def curves(x: Array, functions: Sequence[Array], bits: int, device: torch.device) -> Curves:
    """Return functions [G] of rising x [G] as tables of one window, with 2^bits parts per octave."""
    low = np.float32(x[0])
    low = np.nextafter(low, np.float32(-np.inf)) if low > x[0] else low
    high = np.float32(x[-1])
    high = np.nextafter(high, np.float32(np.inf)) if high < x[-1] else high
    half = max(float(high) - float(low), 1e-30) / 2
    octave = np.floor(np.log2(half * (1 + 1e-6)))  # distances are rounded
    least = np.float32(2.0 ** (octave - OCTAVES + 1))
    first = int(least.view(np.int32)) >> (MANTISSA - bits)
    parts = (first + np.arange(1, OCTAVES * 2**bits + 1)) << (MANTISSA - bits)
    width = 2.0**octave / EVEN
    ends = [parts.astype(np.int32).view(np.float32).astype(float), width * np.arange(1, 2 * EVEN + 1)]
    distance = np.append(0.0, np.sort(np.concatenate(ends)))  # the ends of places; two at one distance skip a place
    points = np.concatenate([float(low) + distance, float(high) - distance])
    steps = np.maximum(np.diff(distance), 1e-38)
    values = np.stack([np.interp(points, x, function).reshape(2, -1) for function in functions])
    slopes = np.diff(values) / steps
    constants = values[..., :-1] - slopes * distance[:-1]
    both = np.stack([constants, slopes]).reshape(2, len(functions), -1).clip(-LARGEST, LARGEST)
    made = torch.from_numpy(both.astype(np.float32)).to(device)
    ends = torch.tensor([low, high, least, 1 / width], dtype=torch.float32, device=device).split(1)
    start = torch.tensor([-first], dtype=torch.int32, device=device)
    return Curves(bits, ends[0], ends[1], ends[2], ends[3], start, made[0], made[1])


def joined(parts: Sequence[Curves]) -> Curves:
    """Return the tables of a batch of windows, one of each part."""
    places = 2 * side(parts[0].bits)
    return Curves(
        parts[0].bits,
        torch.cat([part.low for part in parts]),
        torch.cat([part.high for part in parts]),
        torch.cat([part.least for part in parts]),
        torch.cat([part.even for part in parts]),
        torch.cat([part.start + i * places for i, part in enumerate(parts)]),
        torch.cat([part.constants for part in parts], dim=1),
        torch.cat([part.slopes for part in parts], dim=1),
    )
