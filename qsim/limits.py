"""States how much of a file is read: bytes, counts, depth. One table, of which docs/limits.md is a copy.

What a header promises is compared with these numbers and with the size of the file before memory is asked for.
"""

from __future__ import annotations

from typing import NamedTuple


class Limit(NamedTuple):
    """A row of the table."""

    most: int
    unit: str
    of: str


TABLE: list[Limit] = []


def _limit(most: int, unit: str, of: str) -> int:
    """Add a row; return its number."""
    TABLE.append(Limit(most, unit, of))
    return most


TEXT = _limit(1 << 27, "bytes", "a description: JSON, TOML, a journal, a scene in Python, settings of a camera")
SIDE_FILE = _limit(1 << 20, "bytes", "the description of a raw recording (.cihx)")
METADATA = _limit(1 << 22, "bytes", "the description of a zarr array")
RECORD = _limit(1 << 16, "bytes", "the record of a writer that was killed")
CONFIGURATION = _limit(10_000, "characters", "the configuration in a file of weights")
WEIGHTS = _limit(1 << 34, "bytes", "a file of weights, or a checkpoint")
BENEATH = _limit(64, "levels", "tables inside tables of JSON and TOML")
WHOLE = _limit(1 << 64, "", "a whole number in JSON and TOML, which stays below")
SCENE_FILES = _limit(10_000, "files", "a scene, with all that it names")
ASSET = _limit(1 << 31, "bytes", "a mesh, a picture or another file that a scene names")
VERTICES = _limit(5_000_000, "vertices", "a mesh file")
BODIES = _limit(10_000, "bodies", "a glTF scene")
TEXELS = _limit(1 << 27, "pixels", "all pictures of a mesh file")
PIXELS = _limit(1 << 26, "pixels", "a frame, a page or a picture")
CHUNK = _limit(1 << 29, "bytes", "a chunk of HDF5 or zarr, in memory")
COUNTS = _limit(1 << 29, "counts", "a PTU or SDT file, or exposures of photon times, in memory")
COUNT_BYTES = _limit(1 << 32, "bytes", "an array of photon counts (.npz), in memory")
EVENTS = _limit(1 << 25, "events", "an event camera between two frames, in memory")
DEFLATED = _limit(1032, "times", "the bytes of a compressed file, unpacked: the most that deflate shrinks")


def rows() -> list[str]:
    """Return the table in Markdown, a line each."""
    found = ["| At most | Of |", "|--:|---|"]
    for one in TABLE:
        found.append(f"| {_number(one.most)} {one.unit} ".replace("  ", " ") + f"| {one.of} |")
    return found


def _number(most: int) -> str:
    """Return a number as people write it: powers of two above a thousand as such."""
    power = most.bit_length() - 1
    return f"2^{power}" if most == 1 << power and power > 12 else f"{most:,}"
