"""Reads MATLAB files of binary planes or counts, of level 5 (scipy) and of level 7.3 (h5py)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim import limits, opening
from qsim.checks import check_shape
from qsim.clip.source import Source
from qsim.file_order import numbered
from qsim.files import decoding_errors
from qsim.formats.recording import Hints, Recording, checked_codes


def read_mat(path: Path, hints: Hints) -> Recording:
    """Read SwissSPAD .mat: OUTPUT [H, W, T] of a file, or of part_1.mat ... part_n.mat in a folder with info.json.

    An array of another name is read if `hints.variable` names it or if it is the only array of frames.
    """
    files = [path]
    if path.is_dir():
        files = numbered(list(path.glob("part_*.mat")))
        info = path / "info.json"
        if info.is_file():
            with decoding_errors(info, "JSON"):
                wanted = int(json.loads(opening.text(info))["no_parts"])
            if len(files) > wanted:
                raise ValueError(f"{path}: {len(files)} parts, and info.json states {wanted}; move the others away")
            files = [path / f"part_{k}.mat" for k in range(1, min(wanted, 100_000) + 1)]
        elif [file.name for file in files] != [f"part_{k}.mat" for k in range(1, len(files) + 1)]:
            there = ", ".join(file.name for file in files[:5])
            raise ValueError(
                f"{path}: its parts are not numbered 1, 2, ... without a gap: {there}; add what is missing"
            )
        for file in files:
            if not file.is_file():
                raise FileNotFoundError(f"{file}: missing, though info.json states {len(files)} parts")
        if not files:
            raise FileNotFoundError(f"{path}: holds no part_1.mat")
    parts = [mat_array(file, hints.variable) for file in files]
    if len({part.shape[1:] for part in parts}) > 1:
        raise ValueError(f"{path}: the parts differ in size: {sorted({part.shape[1:] for part in parts})}")
    planes = np.concatenate(parts)
    bits = hints.bits or 1
    codes = checked_codes(path, planes, bits, 0)
    return Recording(check_shape(path, codes.shape), lambda a, b: codes[a:b], Source(format="SwissSPAD .mat"), bits)


def mat_array(path: Path, variable: str | None = None) -> Array:
    """Return an array of a .mat file as [T, H, W]: level 5 by scipy, 7.3 (HDF5, axes reversed) by h5py.

    It is `variable`; without a name OUTPUT, or the only array of numbers in two (one frame) or three dimensions.
    """
    with opening.opened(path) as file:
        head = file.read(1024)
    if b"\x89HDF\r\n\x1a\n" in head:
        return _hdf_array(path, variable)
    import scipy.io

    with decoding_errors(path, "MATLAB 5 .mat"):
        numbers = ("int", "uint", "single", "double", "logical")
        shapes = {name: shape for name, shape, kind in scipy.io.whosmat(path) if kind.startswith(numbers)}
        name = _chosen(path, variable, shapes)
        _plausible(path, shapes[name])
        return _frames_first(path, name, scipy.io.loadmat(path, variable_names=[name])[name])


def _hdf_array(path: Path, variable: str | None) -> Array:
    import h5py

    with decoding_errors(path, "MATLAB 7.3 .mat"), h5py.File(path, "r") as file:
        own = [name for name in file if isinstance(file.get(name, getlink=True), h5py.HardLink)]
        wanted = variable or "OUTPUT"
        if wanted in file.keys() - set(own):
            raise ValueError(
                f"{path}: {wanted} is a link, which may lead into another file; store the planes themselves"
            )
        shapes = {name: file[name].shape for name in own if isinstance(file[name], h5py.Dataset)}
        name = _chosen(path, variable, shapes)
        stored = file[name]
        if stored.external or stored.is_virtual:
            raise ValueError(f"{path}: {name} lies in other files, which are not read; store the planes themselves")
        _plausible(path, stored.shape)
        if stored.dtype.kind not in "buif":
            raise ValueError(f"{path}: {name} is {stored.dtype} {list(stored.shape)}, expected numbers [T, W, H]")
        return _frames_first(path, name, stored[...].T)


def _chosen(path: Path, variable: str | None, shapes: dict[str, tuple[int, ...]]) -> str:
    """Return the name of the array to read; `ValueError` with the names if there are several."""
    if variable is not None:
        if variable not in shapes:
            raise ValueError(f"{path}: has no array {variable}; it holds {sorted(shapes)}")
        return variable
    if "OUTPUT" in shapes:
        return "OUTPUT"
    images = sorted(
        name for name, shape in shapes.items() if len(shape) in (2, 3) and min(shape) > 0 and max(shape) > 1
    )
    if len(images) == 1:
        return images[0]
    if not images:
        raise ValueError(f"{path}: has no array of frames; it holds {sorted(shapes)}")
    raise ValueError(f"{path}: holds the arrays {images}; choose one with variable={images[0]}")


def _frames_first(path: Path, name: str, planes: Array) -> Array:
    """Return MATLAB's [H, W, T] or [H, W] as [T, H, W]; whole numbers stored as floats become integers."""
    if planes.dtype.kind not in "buif" or planes.ndim not in (2, 3):
        raise ValueError(f"{path}: {name} is {planes.dtype} {list(planes.shape)}, expected unsigned [H, W, T]")
    planes = planes if planes.ndim == 3 else planes[..., None]
    if planes.dtype.kind in "if":
        whole = np.rint(planes)
        if planes.size and not (np.isfinite(planes).all() and (whole == planes).all() and whole.min() >= 0):
            raise ValueError(f"{path}: {name} holds values that are not counts: expected whole numbers >= 0")
        planes = whole.astype(np.uint32) if not planes.size or whole.max() < 2**32 else planes
    return np.ascontiguousarray(planes.transpose(2, 0, 1))


def _plausible(path: Path, shape: tuple[int, ...]) -> None:
    """Raise `ValueError` if a header states more values than deflate can hold in the file."""
    promised = float(np.prod(shape, dtype=float))
    size = path.stat().st_size
    if promised > limits.DEFLATED * size:
        raise ValueError(f"{path}: the header states {promised:.3g} values, which {size} bytes cannot hold")
