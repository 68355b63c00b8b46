"""Restored video as a file: made on disk block by block, resumable, whole or absent.

PATH.npy.part, PATH.npy.part.json  ->  PATH.npy (float32 photons [T, H, W]) and PATH.json
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from quiver.data import Codes, read_json, write_json
from quiver.restoring import Progress, Restorer, check_finite

BLOCK_FRAMES = 256  # restored between two notes of how far a file has come


def restore_to_file(codes: Codes, method: Restorer, path: Path, progress: Progress | None = None) -> dict[str, Any]:
    """Restore a stream into PATH.npy (float32 photons [T, H, W]) and PATH.json; both appear when whole, the json last.

    Returns what the json says. Works on disk, BLOCK_FRAMES at a time, in PATH.npy.part: an interrupted restoration that
    has finished a block goes on there. A failure leaves nothing behind.
    """
    meta = {
        "format": "quiver-restored-1",
        "method": method.name,
        "description": method.description,
        "unit": "photons",
        "white": codes.white,
        "shape": list(codes.shape),
        "frame_rate": codes.frame_rate,
        "exposure": codes.exposure,
        "sensor": codes.sensor.to_dict(),
        "source": codes.source,
    }
    part, journal = path.with_name(path.name + ".part"), path.with_name(path.name + ".part.json")
    try:
        seconds = _fill_file(codes, method, part, journal, meta, progress)
    except BaseException as error:
        if isinstance(error, Exception) or not journal.exists():
            part.unlink(missing_ok=True)
            journal.unlink(missing_ok=True)
        raise
    path.with_suffix(".json").unlink(missing_ok=True)
    os.replace(part, path)
    meta["seconds_per_frame"] = seconds / codes.shape[0]
    write_json(path.with_suffix(".json"), meta)
    journal.unlink(missing_ok=True)
    return meta


def _fill_file(
    codes: Codes, method: Restorer, part: Path, journal: Path, meta: dict[str, Any], progress: Progress | None
) -> float:
    """Restore what is missing of PART, block by block, noting each in JOURNAL; the seconds it took, all in all."""
    length = codes.shape[0]
    done, seconds = _done(part, journal, meta)
    out = np.lib.format.open_memmap(part, mode="r+" if done else "w+", dtype=np.float32, shape=codes.shape)
    for first in range(done, length, BLOCK_FRAMES if method.seamless else length):
        block = out[first : first + BLOCK_FRAMES if method.seamless else length]
        block[:] = 0  # an interrupted block may have left something
        started = time.perf_counter()
        method.fill(codes, block, first, _shifted(progress, first, length, len(block)))
        check_finite(block, method.name, first)
        out.flush()
        seconds += time.perf_counter() - started
        write_json(journal, meta | {"done": first + len(block), "seconds": seconds})
    with open(part, "rb") as file:
        os.fsync(file.fileno())
    return seconds


def _done(part: Path, journal: Path, meta: dict[str, Any]) -> tuple[int, float]:
    """Frames that an interrupted restoration of the same thing has finished, and the seconds they took."""
    if not (part.exists() and journal.exists()):
        return 0, 0.0
    found = read_json(journal)
    done, seconds = int(found.pop("done", 0)), float(found.pop("seconds", 0.0))
    return (done, seconds) if found == meta else (0, 0.0)


def _shifted(progress: Progress | None, first: int, length: int, block: int) -> Progress | None:
    """Progress of a block as progress of the whole, in frames."""
    if progress is None:
        return None
    return lambda done, total: progress(first + done * block // total, length)
