"""Adds noise correlated in time and space: afterpulses of clocked pixels, optical crosstalk. Off by default.

    codes of independent pixels [T, H, W] --disturb--> codes

Afterpulses depend on earlier frames: they need the clip from its first frame. Crosstalk depends on neighbours: it needs
a margin of one pixel around a crop. Afterpulses of counting pixels are simulated in event_simulation.py.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key, uniform, words

# stages of a clip's key; crosstalk takes one per direction
_AFTERPULSE = 101
_CROSSTALK = 102
_PER_STAGE = 1 << 20  # from the stages of one use of a clip to those of the next
_DIRECTIONS = ((-1, 0), (1, 0), (0, -1), (0, 1))  # from a pixel to the neighbour that it disturbs


@dataclass(frozen=True)
class CorrelatedNoise:
    """Probabilities of additional detections."""

    afterpulse: float = 0.0  # of a detection in plane n + 1 caused by one in plane n
    crosstalk: float = 0.0  # that an avalanche causes one in a given neighbour of the four

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < 1:
                raise ValueError(f"{name} must be a probability below 1, got {value!r}")

    def disturb(
        self, before: Array | None, codes: Array, top: int, key: Key, dead: Array | None, origin: tuple[int, int]
    ) -> tuple[Array, Array | None]:
        """Return codes [T, H, W] up to `top` with afterpulses and crosstalk, and the memory [H, W] for the next frame.

        `before` is the memory from the frame before, None at the first of the clip; `dead` pixels [H, W] stay 0.
        """
        if not (self.afterpulse or self.crosstalk):
            return codes, None
        result = np.empty_like(codes)
        for t, frame in enumerate(codes):
            at = key.at(key.frame + t)
            fired, before = _afterpulses(frame, before, at, dead, self.afterpulse, origin)
            result[t] = _crosstalk(fired, top, at, dead, self.crosstalk, origin)
        return result, before


def _step(key: Key, number: int) -> Key:
    """Return the key of a random step of this noise: keys of different stages, as of two uses, share no numbers."""
    return replace(key, stage=number + _PER_STAGE * key.stage)


def _afterpulses(
    plane: Array, before: Array | None, key: Key, dead: Array | None, probability: float, origin: tuple[int, int]
) -> tuple[Array, Array]:
    """Return a plane [H, W] with afterpulses of the plane before, and the memory [H, W] for the next.

    The memory is the plane before crosstalk. At constant light, P(fire) tends to p / (1 - a (1 - p)), where p is the
    probability without afterpulses and a that of an afterpulse.
    """
    if not probability or before is None:
        return plane, plane
    released = uniform(words(_step(key, _AFTERPULSE), plane.shape, origin)) < probability
    # A released carrier fires a pixel that did not fire anyway; a plane has one bit.
    after = plane | (before & released.astype(plane.dtype))
    after = after if dead is None else np.where(dead, plane.dtype.type(0), after)
    return after, after


def _crosstalk(
    codes: Array, top: int, key: Key, dead: Array | None, probability: float, origin: tuple[int, int]
) -> Array:
    """Return codes [H, W] up to `top`, each avalanche with this probability of one more in each of four neighbours.

    The additional avalanches cause no others. A code n adds Binomial(n, probability) to a neighbour, drawn under the
    key of the source pixel.
    At constant light a plane fires with 1 - (1 - p) (1 - p probability)^4.
    """
    if not probability:
        return codes
    from scipy.special import bdtr

    total = codes.astype(np.int64)
    height, width = codes.shape
    for number, (dy, dx) in enumerate(_DIRECTIONS):
        u = uniform(words(_step(key, _CROSSTALK + number), codes.shape, origin))
        sent = np.zeros(codes.shape, np.int64)
        j = 0
        # Binomial(n, probability) by inversion: count the steps of its cdf below u.
        while (more := (j < codes) & (u >= bdtr(j, np.maximum(codes, 1), probability))).any():
            sent = sent + more
            j = j + 1
        # Avalanches sent beyond the edge of the frame leave it.
        target = (slice(max(dy, 0), height + min(dy, 0)), slice(max(dx, 0), width + min(dx, 0)))
        source = (slice(max(-dy, 0), height + min(-dy, 0)), slice(max(-dx, 0), width + min(-dx, 0)))
        total[target] += sent[source]
    total = np.minimum(total, top)
    return (total if dead is None else np.where(dead, 0, total)).astype(codes.dtype)
