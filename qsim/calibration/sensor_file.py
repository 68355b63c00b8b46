"""Reads frames for a calibration, and writes its sensor file, values, residual plot and map of dark counts.

SENSOR.toml         a device for `--sensor SENSOR.toml`, each number with its source
SENSOR.json         every value with its interval, the warnings and the goodness of the fit
SENSOR.png          residuals of the histograms, in sigmas
SENSOR_dark.npy     DCR map [1/s], float32 [H, W] (SPAD)
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy import ndarray as Array

from qsim import files
from qsim.calibration.frame_statistics import FrameStatistics, measure, measure_sums
from qsim.calibration.results import Calibration
from qsim.clip.stream import Stream
from qsim.figures import figure_png, new_figure
from qsim.files import load_array
from qsim.formats import importing, photon_times
from qsim.formats.mat_files import mat_array
from qsim.formats.recording import Hints
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD

_BLOCK_BYTES = 1 << 25
_MOST_PLANES = 255  # of photon times: all are held at once


def read_stack(
    path: Path,
    *,
    bits: int,
    exposure: float,
    photons: float | None,
    hints: Hints = Hints(),  # noqa: B008 (frozen)
    planes: int | None = None,
) -> FrameStatistics:
    """Return the statistics of the frames in a file: `.npy` of integer values, a stream, or any recording of `convert`.

    `exposure` in seconds, `photons` per pixel and exposure. `hints` state where the values lie (its `bits` do not
    count); with a `width` and no `layout` an `.npy` is a photon cube of packed planes. With `planes` every value sums
    this number of binary planes. `ValueError` or `FileNotFoundError` naming the file.
    """
    if planes is None:
        blocks = _blocks(path, bits, exposure, None, hints)
        return measure(blocks, bits=bits, exposure=exposure, photons=photons, name=str(path))
    blocks = _blocks(path, planes.bit_length(), exposure, planes, hints)
    return measure_sums(blocks, planes=planes, exposure=exposure, photons=photons, name=str(path))


def _blocks(path: Path, bits: int, exposure: float, planes: int | None, hints: Hints) -> Iterator[Array]:
    """Return the frames of a file in blocks [t, H, W]."""
    stream = stream_of(path)
    if stream is not None:
        if hints.width not in (None, stream.shape[2]):
            raise ValueError(
                f"{path}: is a stream of {stream.shape[2]} pixels per row, not {hints.width}; leave --width out"
            )
        return _array_blocks(read_counts(path, replace(hints, width=None), bits, exposure * (planes or 1)))
    bare = hints == Hints(variable=hints.variable)
    if bare and path.suffix in (".npy", ".mat"):
        return _array_blocks(read_counts(path, hints, bits, exposure * (planes or 1)))
    if bare and path.suffix.lower() == ".npz":
        return _array_blocks(_photon_codes(path, bits, exposure, planes))
    if path.suffix == ".npy" and hints.layout is None:  # dark planes could be several layouts
        hints = replace(hints, layout="codes" if hints.width is None else "cube")
    recording = importing.read(path, replace(hints, bits=min(bits, 16)), compared=("bits",))
    if recording.is_light or recording.bits != bits:
        raise ValueError(f"{path}: holds {recording.source}, not values of {bits} bits")
    return (block for _, block in importing.blocks(recording))


def stream_of(path: Path) -> Stream | None:
    """Return the stream whose codes or description a file holds; None for other files."""
    if path.suffix not in (".npy", ".json"):
        return None
    side = path.with_suffix(".json")
    if not side.is_file() or "ppp_factor" not in files.read_json(side):
        return None
    return Stream.open(side)


def _photon_codes(path: Path, bits: int, exposure: float, planes: int | None) -> Array:
    """Return the counts [T, H, W] of photon times; for 1 bit and sums of planes those of a clocked SPAD."""
    photons = photon_times.read(path)
    stated = photons.exposure / (planes or 1)
    if not math.isclose(exposure, stated, rel_tol=1e-3):  # typed by hand
        raise ValueError(f"{path}: an exposure of {exposure:g} s; the photon times state {stated:g} s, give that")
    if planes is None and bits > 1:
        return np.asarray(np.minimum(photons.counts(), (1 << bits) - 1))
    parts = planes or 1
    if parts > _MOST_PLANES:
        raise ValueError(f"{path}: sums of {parts} planes; of photon times sums of at most {_MOST_PLANES} are made")
    return np.asarray(photons.clocked(parts).reshape(-1, parts, *photons.shape[1:]).sum(axis=1))


def read_counts(
    path: Path,
    hints: Hints = Hints(),  # noqa: B008 (frozen)
    bits: int | None = None,
    exposure: float | None = None,
) -> Array:
    """Return the frames [T, H, W] of an `.npy`, mapped, of a stream, read when they are used, or of a `.mat`.

    With `hints` other than the `variable` of a `.mat`, of any recording of `convert`, all in memory. `ValueError` or
    `FileNotFoundError` naming the file, also for a stream of other `bits`, or whose codes have another `exposure` [s].
    """
    bare = hints == Hints(variable=hints.variable)
    if path.suffix == ".mat" and bare:
        return mat_array(path, hints.variable)
    if hints.variable is not None and not path.is_dir():
        raise ValueError(f"{path}: --variable names an array of a .mat file; leave it out")
    stream = stream_of(path)
    if stream is not None:
        if bits not in (None, stream.bits):
            raise ValueError(f"{path}: is a stream of {stream.bits} bits per code, not {bits}; give what it states")
        if exposure is not None and not math.isclose(exposure, stream.exposure, rel_tol=1e-3):  # typed by hand
            raise ValueError(
                f"{path}: is a stream of codes of {stream.exposure:g} s, not of {exposure:g} s; give what it states, "
                "or convert it again with the true --exposure"
            )
        if not bare:
            raise ValueError(f"{path}: is a stream, which states its layout; leave the options of raw files out")
        return cast(Array, stream.codes)
    if not bare:
        recording = importing.read(path, replace(hints, bits=bits), compared=("bits",))
        if recording.is_light:
            raise ValueError(f"{path}: holds {recording.source} of light, not counts")
        return recording.read(0, recording.shape[0])
    array = load_array(path)
    array = array[None] if array.ndim == 2 else array
    if array.ndim != 3 or array.size == 0:
        raise ValueError(f"{path}: expected frames [T, H, W], found shape {list(array.shape)}")
    return array


def _array_blocks(array: Array) -> Iterator[Array]:
    step = max(1, _BLOCK_BYTES // (8 * array.shape[1] * array.shape[2]))
    for start in range(0, len(array), step):
        yield np.asarray(array[start : start + step])


def sensor_of(found: Calibration) -> Sensor:
    """Return the sensor that a calibration describes; an unmeasured efficiency is 1 (light in detected photons)."""
    value = {name: v.value for name, v in found.values.items()}
    if found.model == "QIS":
        efficiency = min(value.get("quantum_efficiency", 1.0), 1.0)
        return QIS(
            efficiency, value["dark_current"], value["read_noise"], found.bits, value["gain"], offset=value["offset"]
        )
    efficiency, dark = min(value.get("pde_fill", 1.0), 1.0), value.get("dark_count_rate", 0.0)
    if found.model == "BinarySPAD":
        return BinarySPAD(efficiency, dark, found.bits)
    return CountingSPAD(efficiency, dark, value.get("dead_time", 0.0), found.bits, found.paralyzable)


_UNMEASURED = {
    "quantum_efficiency": "1, not measured: give light in detected photons",
    "pde": "1, not measured: give light in detected photons",
    "dark_count_rate": "0, not measured",
    "dead_time": "0, not measured",
}


def to_toml(found: Calibration, title: str, dark_map: str | None = None) -> str:
    """Return the sensor as a device file, each number with its interval and method as its source.

    The map of dark counts is in a comment, because it fits only frames that are not larger.
    """
    lines = [f"# {title}", "[sensor]"]
    described = sensor_of(found).to_dict()
    lines += [f"{key} = {_toml(value)}" for key, value in described.items() if value is not None]
    lines += ["", "[sources]"]
    for key in described:
        v = found.values.get("pde_fill" if key == "pde" else key)
        if v is not None:
            lines.append(f'{key} = "{v.value:.6g}, 95 % interval {v.low:.6g} to {v.high:.6g} {v.unit}; {v.method}"')
        elif key in _UNMEASURED:
            lines.append(f'{key} = "{_UNMEASURED[key]}"')
    if dark_map is not None:
        lines += ["", "# [defects]  # uncomment to give every pixel its own dark counts", f'# dark_map = "{dark_map}"']
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)


def as_dict(found: Calibration) -> dict[str, Any]:
    """Return values, warnings and goodness for JSON; NaN becomes null."""
    return {
        "model": found.model,
        "bits": found.bits,
        "values": {name: asdict(value) for name, value in found.values.items()},
        "p_value": None if math.isnan(found.p_value) else found.p_value,
        "warnings": list(found.warnings),
    }


def figure(found: Calibration) -> bytes:
    """Return the residuals of every stack's histogram in sigmas as PNG; those of a good fit lie between -2 and 2."""
    drawing = new_figure(7, 3.2)
    axes = drawing.subplots()
    for i, residual in enumerate(found.residuals):
        axes.plot(np.flatnonzero(residual), residual[residual != 0], ".", markersize=3, label=f"stack {i}")
    axes.axhspan(-2, 2, color="tab:green", alpha=0.12)
    axes.set_xlabel("code")
    axes.set_ylabel("(observed - fitted) / sigma")
    p = "not tested" if math.isnan(found.p_value) else f"p = {found.p_value:.3g}"
    axes.set_title(f"{found.model}: histograms against the fitted model, {p}", fontsize=10)
    if found.residuals:
        axes.legend(fontsize=7, ncols=3)
    return figure_png(drawing)


def beside(path: Path) -> tuple[Path, Path, Path]:
    """Return the files beside a sensor file: its values, the plot of residuals, and the map of dark counts."""
    return path.with_suffix(".json"), path.with_suffix(".png"), path.with_name(f"{path.stem}_dark.npy")


def write(found: Calibration, path: Path, title: str) -> list[Path]:
    """Write all files of a calibration, the sensor file last; return their paths."""
    values, plot, dark_map = beside(path)
    files.write_json(values, as_dict(found))
    files.write_bytes(plot, figure(found))
    rates = found.maps.get("dark_count_rate")
    if rates is not None:
        with files.replacing(dark_map) as file:
            np.save(file, rates.astype(np.float32))
    files.write_bytes(path, to_toml(found, title, None if rates is None else dark_map.name).encode())
    return [values, plot, *([] if rates is None else [dark_map]), path]
