"""Reads frames for a calibration, and writes its sensor file, values, residual plot and map of dark counts.

SENSOR.toml         a device for `--sensor SENSOR.toml`, each number with its source
SENSOR.json         every value with its interval, the warnings and the goodness of the fit
SENSOR.png          residuals of the histograms, in sigmas, and the distribution of dark rates over pixels (SPAD)
SENSOR_dark.npy     DCR map [1/s], float32 [H, W] (SPAD)
SENSOR_hot.npy      bool [H, W], true at hot pixels (SPAD); the map of `quiver restore --defects`
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy import ndarray as Array

from qsim import files
from qsim.calibration.frame_statistics import FrameStatistics, measure, measure_sums
from qsim.calibration.results import Calibration
from qsim.figures import figure_png, new_figure
from qsim.files import load_array
from qsim.formats import importing, photon_times
from qsim.formats.mat_files import mat_array
from qsim.formats.recording import Hints
from qsim.plane_sums import AS_STORED, PlaneSums, Read, Sums
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD
from qsim.streams.stream import Stream, is_stream

_BLOCK_BYTES = 1 << 25
_DARK_MAP = "_dark.npy"  # ends of file names
_HOT_MAP = "_hot.npy"
_MOST_PLANES = 255  # of photon times: all are held at once


def read_stack(
    path: Path,
    *,
    bits: int,
    exposure: float,
    photons: float | None,
    hints: Hints = Hints(),  # noqa: B008 (frozen)
    sums: PlaneSums = AS_STORED,
) -> FrameStatistics:
    """Return the statistics of the frames in a file: `.npy` of integer values, a stream, or any recording of `convert`.

    `exposure` in seconds, `photons` per pixel and exposure, both of one plane where planes are summed. `hints` state
    where the values lie (its `bits` do not count); with a `width` and no `layout` an `.npy` is a photon cube of packed
    planes. `sums` chooses frames of the file, sums its single planes, or says that its values are sums already.
    `ValueError` or `FileNotFoundError` naming the file.
    """
    stored = _stored(path, 1 if (sums.planes or 1) > 1 else bits, exposure, sums, hints)
    chosen = sums.over(stored.shape[0], str(path), bits=stored.bits, bare=True)
    told = chosen.within(sums.stored(stored.shape[0]))
    blocks = _blocks(stored, chosen)
    if told.planes == 1:
        found = measure(blocks, bits=bits, exposure=exposure, photons=photons, name=str(path))
    else:
        found = measure_sums(blocks, planes=told.planes, exposure=exposure, photons=photons, name=str(path))
    rate = None if stored.frame_rate is None else stored.frame_rate * (sums.summed or 1)
    return replace(found, rates=told.words(rate))


@dataclass(frozen=True)
class _Stored:
    """The frames of a file: their shape [T, H, W], those of a range, and the bits of a value."""

    shape: tuple[int, ...]
    read: Read
    bits: int
    frame_rate: float | None = None  # Hz, if the file states it


def _stored(path: Path, bits: int, exposure: float, sums: PlaneSums, hints: Hints) -> _Stored:
    """Return the frames of a file: values of so many bits, sums of planes, or single planes that will be summed."""
    planes = None if sums.summed == 1 else sums.summed
    if planes is not None:
        bits = planes.bit_length()
    stream = stream_of(path)
    if stream is not None:
        if hints.width not in (None, stream.shape[2]):
            raise ValueError(
                f"{path}: is a stream of {stream.shape[2]} pixels per row, not {hints.width}; leave width= out"
            )
        own = stream.sensor.levels - 1 if stream.sensor.sums_planes else 1
        if planes not in (None, own):
            raise ValueError(f"{path}: is a stream of sums of {own} planes, not {planes}; give what it states")
        codes = read_counts(path, replace(hints, width=None), bits, _seconds(bits, exposure, planes))
        return replace(_of_array(codes, bits), frame_rate=stream.info.frame_rate)
    bare = hints == Hints(variable=hints.variable)
    if bare and path.suffix in (".npy", ".mat"):
        return _of_array(read_counts(path, hints, bits, _seconds(bits, exposure, planes)), bits)
    if bare and path.suffix.lower() == ".npz":
        return _of_array(_photon_codes(path, bits, exposure, planes), bits)
    if path.suffix == ".npy" and hints.layout is None:  # dark planes could be several layouts
        hints = replace(hints, layout="codes" if hints.width is None else "cube")
    recording = importing.read(path, replace(hints, bits=min(bits, 16)), compared=("bits",))
    if recording.is_light or recording.bits != bits:
        raise ValueError(f"{path}: holds {recording.format}, not values of {bits} bits")
    return _Stored(recording.shape, recording.read, bits, recording.frame_rate)


def _seconds(bits: int, exposure: float, planes: int | None) -> float:
    """Return the exposure [s] of a value of so many bits: of one plane, or of all that are summed in it."""
    return exposure * (planes if planes is not None and bits > 1 else 1)


def _of_array(array: Array, bits: int) -> _Stored:
    return _Stored(array.shape, lambda start, stop: np.asarray(array[start:stop]), bits)


def _blocks(stored: _Stored, chosen: Sums) -> Iterator[Array]:
    """Return the chosen frames in blocks [t, H, W]."""
    read = chosen.of(stored.read)
    step = max(1, _BLOCK_BYTES // (8 * stored.shape[1] * stored.shape[2]))
    for start in range(0, chosen.codes, step):
        yield read(start, min(start + step, chosen.codes))


def stream_of(path: Path) -> Stream | None:
    """Return the stream whose codes or description a file holds; None for other files."""
    if path.suffix not in (".npy", ".json"):
        return None
    side = path.with_suffix(".json")
    if not side.is_file() or not is_stream(side):
        return None
    return Stream.open(side)


def _photon_codes(path: Path, bits: int, exposure: float, planes: int | None) -> Array:
    """Return the counts [T, H, W] of photon times; for 1 bit and sums of planes those of a clocked SPAD."""
    photons = photon_times.read(path)
    stated = photons.exposure / (planes or 1)
    if not math.isclose(exposure, stated, rel_tol=1e-3):  # typed by hand
        raise ValueError(f"{path}: an exposure of {exposure:g} s; the photon times state {stated:g} s, give that")
    if planes is None and bits > 1:
        return photons.counter_codes(bits)
    parts = planes or 1
    if parts > _MOST_PLANES:
        raise ValueError(f"{path}: sums of {parts} planes; of photon times sums of at most {_MOST_PLANES} are made")
    return photons.sums(parts)


def read_counts(
    path: Path,
    hints: Hints = Hints(),  # noqa: B008 (frozen)
    bits: int | None = None,
    exposure: float | None = None,
) -> Array:
    """Return the frames [T, H, W] of an `.npy` or a stream, read when they are used, of a `.mat`, or of photon times.

    With `hints` other than the `variable` of a `.mat`, of any recording of `convert`, all in memory. `ValueError` or
    `FileNotFoundError` naming the file, also for a stream of other `bits`, or whose codes have another `exposure` [s].
    """
    bare = hints == Hints(variable=hints.variable)
    if path.suffix == ".mat" and bare:
        return mat_array(path, hints.variable)
    if hints.variable is not None and not path.is_dir():
        raise ValueError(f"{path}: variable= names an array of a .mat file; leave it out")
    stream = stream_of(path)
    if stream is not None:
        if bits not in (None, stream.bits):
            raise ValueError(f"{path}: is a stream of {stream.bits} bits per code, not {bits}; give what it states")
        if exposure is not None and not math.isclose(exposure, stream.exposure, rel_tol=1e-3):  # typed by hand
            raise _other_exposure(path, stream, exposure)
        if not bare:
            raise ValueError(f"{path}: is a stream, which states its layout; leave the options of raw files out")
        return cast(Array, stream.codes)
    if not bare:
        recording = importing.read(path, replace(hints, bits=bits), compared=("bits",))
        if recording.is_light:
            raise ValueError(f"{path}: holds {recording.format} of light, not counts")
        return recording.read(0, recording.shape[0])
    if path.suffix.lower() == ".npz" and bits is not None and exposure is not None:
        return _photon_codes(path, bits, exposure, None)
    return _frames(path)


def _frames(path: Path) -> Array:
    """Return the frames [T, H, W] of an `.npy`; an array [H, W] is one frame."""
    stored = load_array(path)
    array = cast(Array, stored[None] if stored.ndim == 2 else stored)
    if array.ndim != 3 or array.size == 0:
        raise ValueError(f"{path}: expected frames [T, H, W], found shape {list(array.shape)}")
    return array


def _other_exposure(path: Path, stream: Stream, exposure: float) -> ValueError:
    """Return the error of an exposure [s] that a stream does not state."""
    cure = "give what it states, or convert it again with the true exposure="
    if stream.sums is not None and stream.sums.planes > 1:
        planes = stream.sums.planes
        cure = f"its codes are sums of {planes} planes: give summed={planes} and the exposure of one plane"
    return ValueError(f"{path}: is a stream of codes of {stream.exposure:g} s, not of {exposure:g} s; {cure}")


def sensor_of(found: Calibration) -> Sensor:
    """Return the sensor that a calibration describes; an unmeasured efficiency is 1 (light in detected photons)."""
    value = {name: v.value for name, v in found.values.items()}
    if found.model == "QIS":
        efficiency = min(value.get("quantum_efficiency", 1.0), 1.0)
        return QIS(
            efficiency, value["dark_current"], value["read_noise"], found.bits, value["gain"], offset=value["offset"]
        )
    efficiency = min(value.get("pde_fill", 1.0), 1.0)
    dark = value.get("dark_count_rate", 0.0)
    if found.model == "BinarySPAD":
        return BinarySPAD(efficiency, dark, found.bits)
    return CountingSPAD(efficiency, dark, value.get("dead_time", 0.0), found.bits, found.paralyzable)


_UNMEASURED = {
    "quantum_efficiency": "1, not measured: give light in detected photons",
    "pde": "1, not measured: give light in detected photons",
    "dark_count_rate": "0, not measured",
    "dead_time": "0, not measured",
}


def to_toml(found: Calibration, title: str, stem: str = "", *, own_pixels: bool = False) -> str:
    """Return the sensor as a device file, each number with its interval and method as its source.

    The map of dark counts, of a name that begins with `stem`, is a table of the file with `own_pixels`. Else it is in
    comments, because it fits only frames that are not larger. The file of a SPAD states no bits: its pixels are the
    same at every depth of a code.
    """
    lines = [f"# {title}", "[sensor]"]
    described = sensor_of(found).to_dict()
    if found.model != "QIS":
        described.pop("bits")
    lines += [f"{key} = {_toml(value)}" for key, value in described.items() if value is not None]
    lines += ["", "[sources]"]
    for key in described:
        v = found.values.get("pde_fill" if key == "pde" else key)
        if v is not None:
            lines.append(f'{key} = "{v.value:.6g}, 95 % interval {v.low:.6g} to {v.high:.6g} {v.unit}; {v.method}"')
        elif key in _UNMEASURED:
            lines.append(f'{key} = "{_UNMEASURED[key]}"')
    if "dark_count_rate" in found.maps:
        hot = int(found.maps["hot_pixels"].sum())
        lines += ["", f"# {hot} hot pixels, true in {stem}{_HOT_MAP}, a map of defects for restoring"]
        mark = "" if own_pixels else "# "
        if not own_pixels:
            lines += ["# Every pixel gets its own dark counts by the two lines below, without their #"]
        lines += [f"{mark}[defects]", f'{mark}dark_map = "{stem}{_DARK_MAP}"']
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)


def as_dict(found: Calibration) -> dict[str, object]:
    """Return values, warnings, goodness and hot pixels for JSON; ends that are open or missing become null."""
    return {
        "model": found.model,
        "bits": found.bits,
        "values": {name: {key: _json(v) for key, v in asdict(value).items()} for name, value in found.values.items()},
        "p_value": _json(found.p_value),
        "warnings": list(found.warnings),
    } | _hot_pixels(found)


def _json(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _hot_pixels(found: Calibration) -> dict[str, object]:
    """Return the places and dark rates [1/s] of the hot pixels, row by row; nothing without a map of them."""
    if "hot_pixels" not in found.maps:
        return {}
    rates = found.maps["dark_count_rate"]
    places = np.argwhere(found.maps["hot_pixels"])
    return {"hot_pixels": [{"y": int(y), "x": int(x), "dark_count_rate": float(rates[y, x])} for y, x in places]}


def figure(found: Calibration) -> bytes:
    """Return a PNG: residuals of every stack's histogram in sigmas, and the distribution of dark rates over pixels.

    Residuals of a good fit lie between -2 and 2.
    """
    rates = found.maps.get("dark_count_rate")
    both = rates is not None and bool(found.residuals)
    drawing = new_figure(12 if both else 7, 3.2)
    panels = drawing.subplots(1, 2 if both else 1, squeeze=False)
    if rates is None or both:
        _draw_residuals(panels[0, 0], found)
    if rates is not None:
        _draw_rates(panels[0, -1], rates, found)
    return figure_png(drawing)


def _draw_residuals(axes: Any, found: Calibration) -> None:
    for i, residual in enumerate(found.residuals):
        axes.plot(np.flatnonzero(residual), residual[residual != 0], ".", markersize=3, label=f"stack {i}")
    axes.axhspan(-2, 2, color="tab:green", alpha=0.12)
    axes.set_xlabel("code")
    axes.set_ylabel("(observed - fitted) / sigma")
    p = "not tested" if math.isnan(found.p_value) else f"p = {found.p_value:.3g}"
    axes.set_title(f"{found.model}: histograms against the fitted model, {p}", fontsize=10)
    if found.residuals:
        axes.legend(fontsize=7, ncols=3)


def _draw_rates(axes: Any, rates: Array, found: Calibration) -> None:
    """Draw the share of pixels above each measured dark rate, hot pixels in red, and the fitted median."""
    hot = found.maps["hot_pixels"].ravel()
    order = np.argsort(rates.ravel())
    shown = rates.ravel()[order]
    share = 1 - np.arange(order.size) / order.size
    positive = shown > 0
    for chosen, colour, label in ((~hot[order], "tab:blue", "pixels"), (hot[order], "tab:red", f"{hot.sum()} hot")):
        axes.plot(shown[chosen & positive], share[chosen & positive], ".", color=colour, markersize=3, label=label)
    median = found.values.get("dark_count_rate_median")
    if median is not None:
        axes.axvspan(median.low, median.high, color="tab:green", alpha=0.3, label="median")
    if positive.any():
        axes.set_xscale("log")
        axes.set_yscale("log")
    axes.set_xlabel("dark rate of a pixel [1/s], with counting noise")
    axes.set_ylabel("share of pixels above")
    axes.set_title(f"{found.model}: dark rates; {(rates <= 0).mean():.1%} of the pixels have none", fontsize=10)
    axes.legend(fontsize=7)


def beside(path: Path) -> dict[str, Path]:
    """Return the files beside a sensor file: its values, the plot, and the maps of dark counts and hot pixels."""
    return {
        "values": path.with_suffix(".json"),
        "plot": path.with_suffix(".png"),
        "dark_count_rate": path.with_name(f"{path.stem}{_DARK_MAP}"),
        "hot_pixels": path.with_name(f"{path.stem}{_HOT_MAP}"),
    }


def holds_values(path: Path) -> bool:
    """Return whether a file is the values of a calibration, as `write` writes them beside its other files."""
    try:
        return files.read_json(path).keys() >= {"model", "bits", "values", "hot_pixels"}
    except (OSError, ValueError):
        return False


def write(found: Calibration, path: Path, title: str, *, own_pixels: bool = False) -> list[Path]:
    """Write all files of a calibration, the sensor file last; return their paths."""
    names = beside(path)
    maps = [name for name in ("dark_count_rate", "hot_pixels") if name in found.maps]
    written = [names["values"], names["plot"], *(names[name] for name in maps), path]
    with files.replacing_together(*written) as (values, plot, *arrays, text):
        files.write_json(values, as_dict(found))
        files.write_bytes(plot, figure(found))
        for name, array in zip(maps, arrays, strict=True):
            kind = np.float32 if name == "dark_count_rate" else np.bool_
            with files.replacing(array) as file:
                np.save(file, found.maps[name].astype(kind))
        files.write_bytes(text, to_toml(found, title, path.stem, own_pixels=own_pixels).encode())
    return written
