"""Decides in which parts a network that takes clips restores a long one.

    frames before | part | frames after  ->  network  ->  the part; the rest is thrown away

Parts begin at multiples of their length, so that a frame is restored alike whether a range of frames or the complete
stream is requested, and memory does not grow with the stream. Where a network restores one frame of a window, the
frames around a part are those of its windows, and the result is that of the complete clip. Recurrent networks are
limited: they see the past, and without a fixed look-ahead the future, only as far as their part.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import nn

PAST = 10  # frames before a part, where a network sees the complete past: as many as in training
AROUND = 4  # frames before and after a part, where a network sees the complete clip
# frames of a part; with AROUND, sixteen frames at a time
KEPT = 16
KEPT_OF_CLIP = 8
KEPT_OF_RECURRENT = 32  # ten frames computed again are a third more work; with 16 they are two thirds


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
