"""Says where the arrays of a published clip lie in their shard, so that a part of one is read without its format.

An array that is not compressed is read by its position: the bytes of frame t begin at `at[t]`, or, where all frames
follow each other, at `at + t * (bytes of a frame)`. Arrays of ground truth are compressed, and their format reads them.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from typing import Annotated, Any, Protocol

import numpy as np
from msgspec import Meta
from numpy import ndarray as Array

from qsim.kinds import Count, Name, text_like
from qsim.publishing.contents import CHANNELS, Sample
from qsim.publishing.place import Place

COMPRESSED = (*CHANNELS, "saturated")
DType = Annotated[str, text_like(r"[<|][fiub][1248]", "a type of numbers as <f2")]


@dataclass(frozen=True, kw_only=True)
class Located:
    """An array in a shard."""

    dtype: DType
    shape: Annotated[tuple[Count, ...], Meta(min_length=1)]
    at: Count | tuple[Count, ...] | None = None  # first byte, of all frames or of each; None: the format reads it
    bytes: Count | None = None  # of a compressed array that is read as one

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame."""
        return math.prod(self.shape[1:]) * np.dtype(self.dtype).itemsize


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A clip in a shard."""

    key: Annotated[str, text_like(r"[0-9]{9,}", "digits")]
    clip: Name
    row: Count = 0  # of parquet: the row in its group
    group: Count = 0  # of parquet
    description: tuple[Count, Count] | None = None  # first byte, and bytes; None: the format reads it
    arrays: dict[str, Located]


class ShardWriter(Protocol):
    """Writes the clips of one shard into a file."""

    def add(self, sample: Sample) -> Entry:
        """Add a clip; return where it is."""

    def close(self) -> None:
        """Complete the file."""


class ShardReader(Protocol):
    """Reads what is not at a stated position."""

    def array(self, where: Place, file: str, entry: Entry, field: str) -> Array:
        """Return an array."""

    def description(self, where: Place, file: str, entry: Entry) -> bytes:
        """Return the description, JSON."""


def npy_header(array: Array) -> bytes:
    """Return the header of a .npy file, version 1.0."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(array))
    return file.getvalue()


def little(array: Array) -> Array:
    """Return an array in the order of bytes and of axes in which it is stored."""
    return np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))


def of_type(array: Array) -> dict[str, Any]:
    """Return type and shape of an array, for `Located`."""
    return {"dtype": array.dtype.str, "shape": array.shape}
