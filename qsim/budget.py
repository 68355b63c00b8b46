"""How much work a scene needs: bounces, instants per exposure, samples, from the error that is asked for."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Budget:
    """What a frame costs; the same record is stored in clip.json."""

    samples: int = 32  # per pixel and frame, all instants and both halves together
    bounces: int = 6  # scatterings along a path
    sub_frames: int = 9  # instants per exposure when the shutter is open
    sharp: bool = True  # also render the instant at mid-exposure when the shutter is open

    def __post_init__(self) -> None:
        for name in ("samples", "bounces", "sub_frames"):
            if getattr(self, name) < 1:
                raise ValueError(f"Budget.{name}: at least 1, got {getattr(self, name)!r}")

    def passes(self, instants: int, pixels: int, lanes: int) -> tuple[int, int]:
        """(samples of one pass, passes per instant): an even number of passes, none above `lanes` samples in flight."""
        wanted = math.ceil(self.samples / instants / 2)
        split = math.ceil(wanted * pixels / lanes)
        return grid_samples(math.ceil(wanted / split)), 2 * split


def grid_samples(samples: int) -> int:
    """The smallest count of at least `samples` that multijitter can lay out as a nearly square grid."""
    while True:
        columns = round(math.sqrt(samples))
        if columns * math.ceil(samples / columns) == samples:
            return samples
        samples += 1
