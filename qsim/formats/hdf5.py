"""Reads stacks of frames in HDF5 files: one dataset, by its path, with the axes that the user names."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import limits, opening
from qsim.files import decoding_errors
from qsim.formats.array_files import Values, codes_of, light_of
from qsim.formats.recording import Hints, Recording

LISTED = 20  # datasets that a message names


def read_hdf5(path: Path, hints: Hints) -> Recording:
    """Read a dataset of numbers: codes of `bits` (1 for bool), or light (floats, or with `transfer` or `white`).

    Without `dataset` the only array of two or more axes is read. `ValueError` for a dataset behind a link or in other
    files, which could be any file.
    """
    import h5py

    opening.regular(path)
    with decoding_errors(path, "HDF5"), h5py.File(path, "r") as file:
        name = hints.dataset.strip("/") if hints.dataset is not None else _only(path, _datasets(file))
        stored = _dataset(path, file, name)
        shape = tuple(stored.shape)
        dtype = stored.dtype
        promised = math.prod(shape) * dtype.itemsize
        if promised > limits.DEFLATED * path.stat().st_size:
            raise ValueError(f"{path}: {name} states {promised:.3g} bytes, which {path.stat().st_size} cannot hold")
        if stored.chunks is not None and math.prod(stored.chunks) * dtype.itemsize > limits.CHUNK:
            raise ValueError(f"{path}: {name} is stored in chunks above {limits.CHUNK} bytes, too large to read")

    def read(index: tuple[Any, ...]) -> Array:
        with decoding_errors(path, "HDF5"), h5py.File(path, "r") as opened:
            return np.asarray(_dataset(path, opened, name)[index])

    as_light = dtype.kind == "f" or hints.transfer is not None or hints.white is not None
    source = f"HDF5 {name}"
    if not as_light and dtype.kind in "ui" and hints.bits is None:
        raise ValueError(
            f"{path}: {name} holds {dtype} {list(shape)}; add bits= for codes, or transfer=linear for light"
        )
    values = Values(shape, dtype, read)
    return light_of(path, values, source, hints) if as_light else codes_of(path, values, source, hints)


def _dataset(path: Path, file: Any, name: str) -> Any:
    """Return a dataset that lies in this file; `ValueError` for links, and for data in other files."""
    import h5py

    place = file
    for part in name.split("/"):
        if not isinstance(place, h5py.Group) or part not in place or part in ("", ".", ".."):
            raise ValueError(f"{path}: has no dataset {name}; it holds {_listed(_datasets(file))}")
        if not isinstance(place.get(part, getlink=True), h5py.HardLink):
            raise ValueError(f"{path}: {name} is a link, which may lead into another file; name the dataset itself")
        place = place[part]
    if not isinstance(place, h5py.Dataset):
        raise ValueError(f"{path}: {name} is a group; it holds {_listed(_datasets(place))}")
    if place.external or place.is_virtual:
        raise ValueError(f"{path}: {name} lies in other files, which are not read; store the frames themselves")
    if place.dtype.kind not in "buif" or place.shape is None:
        raise ValueError(f"{path}: {name} is {place.dtype}; numbers are expected")
    return place


def _datasets(group: Any) -> dict[str, tuple[int, ...]]:
    """Return path -> shape of the arrays of numbers with two or more axes, without following links."""
    import h5py

    found: dict[str, tuple[int, ...]] = {}

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "buif" and len(item.shape or ()) >= 2:
            found[name] = tuple(item.shape)

    group.visititems(visit)
    return found


def _only(path: Path, found: dict[str, tuple[int, ...]]) -> str:
    videos = [name for name, shape in found.items() if len(shape) >= 3] or list(found)
    if len(videos) == 1:
        return videos[0]
    if not videos:
        raise ValueError(f"{path}: holds no array of frames")
    raise ValueError(f"{path}: holds {_listed(found)}; choose with dataset=, as in dataset={videos[0]}")


def _listed(found: dict[str, tuple[int, ...]]) -> str:
    shown = [f"{name} {list(shape)}" for name, shape in list(found.items())[:LISTED]]
    return ", ".join(shown + ["..."] * (len(found) > LISTED)) or "no arrays"
