"""Looks up which bit depth is best once its codes are restored, in what was measured with the default restorer.

The table is `qsim/measurements/restored_bits.json`, dB by motion, light and bits; `PAGE` shows it with its conditions.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from qsim.clip.motion_statistics import CODE_BITS

TABLE = Path(__file__).parents[2] / "measurements" / "restored_bits.json"
PAGE = "docs/results/restorer_bits.md"
NEAR = 2.0  # largest factor between a study's light or motion and the place of the table that stands for it


@dataclass(frozen=True)
class Restored:
    """The matched PSNR of restored codes by their bits, at one motion and light."""

    px: float  # motion per frame of `CODE_BITS` bits
    ppp: float  # photons per pixel and plane
    psnr_db: Mapping[int, float]

    @property
    def best(self) -> int:
        """The bits of the highest PSNR."""
        return max(self.psnr_db, key=lambda bits: self.psnr_db[bits])


@cache
def table() -> tuple[Restored, ...]:
    """Return every measured place."""
    found = json.loads(TABLE.read_bytes())
    places = [(px, ppp) for px in found["px"] for ppp in found["ppp"]]
    rows = [row for of_motion in found["psnr_db"] for row in of_motion]
    return tuple(
        Restored(px, ppp, dict(zip(found["bits"], row, strict=True)))
        for (px, ppp), row in zip(places, rows, strict=True)
    )


def nearest(px: float, ppp: float) -> Restored | None:
    """Return the measured place nearest to a motion and a light; None if either is more than `NEAR` times away.

    Motion below the slowest measured one counts as rest from half of that motion down.
    """
    slowest = min(place.px for place in table() if place.px > 0)

    def away(place: Restored) -> tuple[float, float]:
        light = abs(math.log(ppp / place.ppp))
        if place.px == 0:
            return (0.0 if px < slowest / NEAR else math.inf), light
        return (abs(math.log(px / place.px)) if px > 0 else math.inf), light

    place = min(table(), key=lambda one: math.hypot(*away(one)))
    # The factor itself is near, too, whatever its logarithm is rounded to.
    return place if max(away(place)) <= math.log(NEAR) + 1e-9 else None


def worse(losses: Mapping[int, float]) -> str:
    """Return how many dB neighbouring depths lose, as ", 2 and 4 bits are 0.3 and 1.5 dB worse"; "" without any."""
    if not losses:
        return ""
    bits = " and ".join(map(str, losses))
    many = "bit is" if list(losses) == [1] else "bits are"
    return f", {bits} {many} {' and '.join(f'{loss:.1f}' for loss in losses.values())} dB worse"


def beside(bits: int, known: Sequence[int]) -> list[int]:
    """Return the next shallower and the next deeper of the known depths."""
    return [*[b for b in sorted(known) if b < bits][-1:], *[b for b in sorted(known) if b > bits][:1]]


def sentence(px: float, ppp: float) -> str:
    """Return what restoring changes: the best depth of restored codes near a motion and a light, and its neighbours."""
    found = nearest(px, ppp)
    if found is None:
        return f"what restoring changes was not measured near here ({PAGE})"
    best = found.psnr_db[found.best]
    losses = {bits: best - found.psnr_db[bits] for bits in beside(found.best, list(found.psnr_db))}
    edge = ">= " if found.best == max(found.psnr_db) else ""
    return (
        f"after restoring {edge}{found.best} bit{'s' if found.best > 1 else ''}{worse(losses)} (measured at "
        f"{found.px:g} px per {CODE_BITS}-bit frame and {found.ppp:g} photons per plane: {PAGE})"
    )
