"""Describes the recording that light or codes were imported from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from qsim import records
from qsim.kinds import Count, Digest, NotNegative, Number, Positive, RowOrder, Whole

Flip = Literal["none", "lr", "ud", "both"]  # left and right, up and down


@dataclass(frozen=True, kw_only=True)
class Source:
    """The recording that light or codes were imported from: what it states, and what its reader assumes."""

    format: str = ""
    transfer: str = ""  # curve of the light in its pixels
    black: Number | None = None  # pixel value without light that was subtracted
    scale: Positive | None = None  # light of the clip over that of the file, where half floats could not hold it
    taken_rate: Positive | None = None  # frames per second that were taken; those between them are estimated
    estimator: str = ""  # of the light between frames
    missing_frames: tuple[Count, ...] = ()  # that the recording lost and the clip marks as unknown
    bit_order: str = ""  # the bit of a byte that is the first pixel: msb, lsb, or in words
    orientation: str = ""  # of the rows and columns as they were stored, and how they were turned
    flip: Flip = "none"  # that was asked for
    columns_kept: Whole | None = None
    bitplanes: Whole | None = None  # that a value sums, where it is no 2^bits - 1
    raw_layout: str = ""
    camera: str = ""  # that made a raw recording
    exposure_stated: NotNegative | None = None  # s
    row_delay: Positive | None = None  # s, of photon times
    row_order: RowOrder | None = None
    attributes: dict[str, Any] = field(default_factory=dict)  # of a zarr array, as its writer chose them
    file: str = ""  # of a test set
    sha256: Digest | None = None  # of that file
    test_set: str = ""
    size: tuple[Whole, Whole] | None = None  # height, width [px] before it was made smaller
    seed: Count | None = None  # of warped pictures
    number: Count | None = None  # of the clip among warped pictures
    motion: NotNegative | None = None  # largest, px/frame
    shake: NotNegative | None = None  # share of warped pictures under a shaking camera
    patterns: NotNegative | None = None  # share of layers of warped pictures that repeat a small part

    def __post_init__(self) -> None:
        records.settle(self)
