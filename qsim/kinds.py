"""The kinds of values that settings and files hold: each states its bounds once, for Python, TOML, JSON and options.

Numbers are finite and within 1e30, so that products of them are, too.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

LARGEST = 1e30  # of numbers in SI units: products of larger ones overflow
SMALLEST = 1e-30  # of numbers above 0
UNLIMITED = (1 << 40) - 1  # whole numbers that reach this are not bounded by what they mean


def text_like(pattern: str, words: str) -> Meta:
    """Describe texts that match a pattern as a whole; messages say `words`."""
    return Meta(pattern=rf"^(?:{pattern})$(?!\n)", extra={"words": words})


Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
NotNegative = Annotated[float, Meta(ge=0.0, le=LARGEST)]
Positive = Annotated[float, Meta(ge=SMALLEST, le=LARGEST)]
Light = Annotated[float, Meta(ge=1e-6, le=1e6)]  # photons per pixel, or lux
Share = Annotated[float, Meta(ge=1e-6, le=1.0)]  # of a full exposure
Part = Annotated[float, Meta(ge=0.0, le=1.0)]  # of a whole
Shutter = Annotated[float, Meta(ge=0.0, le=1.0)]  # open share of a frame
FrameRate = Annotated[float, Meta(ge=1.0, le=1e8)]  # 1/s
Rise = Annotated[float, Meta(ge=-0.9, le=10.0)]  # of light, over what it was at first
Psnr = Annotated[float, Meta(ge=10.0, le=80.0)]  # dB
Speed = Annotated[float, Meta(ge=1e-3, le=1e3)]  # factor on all motions

Bits = Annotated[int, Meta(ge=1, le=16)]  # of a code
Whole = Annotated[int, Meta(ge=1, le=UNLIMITED)]
Count = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]
Frames = Annotated[int, Meta(ge=1, le=100_000)]
Seed = Annotated[int, Meta(ge=0, le=(1 << 31) - 1)]
Planes = Annotated[int, Meta(ge=1, le=1 << 24)]  # binary planes in one value

Text = Annotated[str, Meta(min_length=1)]
Name = Annotated[str, text_like(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}", "a name of letters, digits, '.', '_' and '-'")]
Digest = Annotated[str, text_like("[0-9a-f]{64}", "a SHA-256 of 64 hexadecimal digits")]
Split = Literal["train", "val", "test"]
RowOrder = Literal["down", "up", "right", "left"]  # rows from the top or the bottom, columns from the left or right
Schedule = Annotated[tuple[Share, ...], Meta(min_length=1, max_length=256)]  # exposures of codes, in turn
