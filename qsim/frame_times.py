"""Says when the frames of a recording were taken."""

from __future__ import annotations

from dataclasses import dataclass

from qsim.kinds import NotNegative, Number, Text


@dataclass(frozen=True)
class Times:
    """When each frame was taken, as its source states it."""

    values: tuple[Number, ...]  # rising
    unit: Text  # s, or frames for numbers
    source: Text  # what states them, in words
    tick: NotNegative = 0.0  # to which they are rounded
