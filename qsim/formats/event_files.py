"""Writes events for other programs: HDF5 in the layout of DSEC, or a NumPy archive; each with a .json beside it.

    NAME.h5    events/t uint32 [N] us, events/x and events/y uint16 [N] px, events/p uint8 [N], 1 brighter
               ms_to_idx uint64 [M]: the first event with t >= 1000 m has the number ms_to_idx[m]
               t_offset  int64, 0: us to be added to t
               attributes height and width [px]
    NAME.npz   events [N], a structured array with the fields t int64 us, x and y uint16 px, p int8
               height, width [px]

Times begin in the middle of the exposure of frame 0. Memory does not grow with the events.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.streams.event_stream import EVENT, EventStream

SUFFIXES = (".h5", ".npz")
BLOCK = 1 << 20  # events at a time
_COLUMNS = {"t": np.uint32, "x": np.uint16, "y": np.uint16, "p": np.uint8}


def check(path: Path, stream: EventStream) -> None:
    """Raise `ValueError` for a file that cannot hold these events."""
    if path.suffix not in SUFFIXES:
        raise ValueError(f"{path}: events are written to .h5 or .npz; name it so")
    if path.suffix == ".h5" and stream.info.seconds * 1e6 >= 1 << 32:
        raise ValueError(
            f"{path}: {stream.info.seconds:.4g} s of events; this layout counts 2^32 us, or 71 minutes: write .npz"
        )


def write(stream: EventStream, path: Path) -> None:
    """Write the events of a clip to a file whose suffix names the layout; `check` comes first."""
    if path.suffix == ".h5":
        _write_hdf5(stream, path)
    else:
        _write_npz(stream, path)


def _write_hdf5(stream: EventStream, path: Path) -> None:
    import h5py

    _, height, width = stream.shape
    array = stream.array
    with h5py.File(path, "w") as file:
        file.attrs.update({"height": height, "width": width, "format": "events"})
        packed: dict[str, Any] = {"chunks": (min(len(array), 1 << 16),), "compression": "gzip"} if len(array) else {}
        columns: dict[str, Any] = {
            name: file.create_dataset(f"events/{name}", (len(array),), kind, **packed)
            for name, kind in _COLUMNS.items()
        }
        firsts: list[Array] = []
        until = 0  # ms, whose first events are known
        for start in range(0, len(array), BLOCK):
            block = array[start : start + BLOCK]
            for name, column in columns.items():
                column[start : start + len(block)] = block[name]
            last = int(block["t"][-1]) // 1000 + 1
            firsts.append(start + np.searchsorted(block["t"], 1000 * np.arange(until, last)))
            until = max(until, last)
        firsts.append(np.full(2 if until == 0 else 1, len(array)))
        file["ms_to_idx"] = np.concatenate(firsts).astype(np.uint64)
        file["t_offset"] = np.int64(0)


def _write_npz(stream: EventStream, path: Path) -> None:
    _, height, width = stream.shape
    array = stream.array
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open(zipfile.ZipInfo("events.npy"), "w", force_zip64=True) as file:
            header = {"descr": np.lib.format.dtype_to_descr(EVENT), "fortran_order": False, "shape": array.shape}
            np.lib.format.write_array_header_1_0(file, header)
            for start in range(0, len(array), BLOCK):
                file.write(np.asarray(array[start : start + BLOCK]).tobytes())
        for name, value in (("height", height), ("width", width)):
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w") as file:
                np.lib.format.write_array(file, np.array(value, np.int64))
