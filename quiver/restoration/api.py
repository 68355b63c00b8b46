"""Restores in one line, for notebooks: a stream, a clip, a path or an array of codes in, photons out."""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim.notebook import reporting
from qsim.plane_sums import PlaneSums
from quiver.data.clips import Clip
from quiver.data.codes import (
    Codes,
    LazyArray,
    Sensor,
    Stream,
    array_codes,
    filled,
    open_stream,
    sensed,
    stream_codes,
    summed,
)
from quiver.data.cuts import cut_into_scenes
from quiver.data.defects import check_map
from quiver.data.hot_pixels import scanned
from quiver.data.illumination import Illumination, is_known
from quiver.host import own_numbers
from quiver.restoration.automatic import chosen
from quiver.restoration.interface import AUTO, DEFAULT_METHOD, RestoreOptions, refuse_outside, remarks
from quiver.restoration.restored_file import check_finite
from quiver.restoration.sources import chosen_of_sensed, codes_of, refuse_idle, told_of_faults

Opened = Stream | Clip | Array
Source = Opened | str | os.PathLike[str]


@own_numbers
def restore(  # noqa: PLR0913 (settings of a public function)
    source: Source | LazyArray,
    method: str = DEFAULT_METHOD,
    *,
    sensor: Sensor | None = None,
    exposure: float | None = None,
    ppp: float | None = None,
    device: str | None = None,
    mode: str | None = None,
    strict: bool = False,
    defects: Array | None = None,
    planes: int | PlaneSums | None = None,
    scan: bool | None = None,
) -> Array:
    """Return restored video, float32 [T, H, W], in photons per pixel and exposure (expected, before quantum
    efficiency). Of a stream behind colour filters it is [T, 3, H, W]: the photons of R, G and B.

    `source` is one of these: a `Stream`; a `Clip` (its only stream; with `ppp` the default sensor senses it now); the
    path of either; integer codes [T, H, W], for which `sensor` and `exposure` [s] must be given. `method` is a
    classical method (naive, moment, likelihood, transform-denoise, qbp, qbp-bm3d, path-merge), the weights that ship
    (mergenet), a .safetensors file or a folder of `quiver train`. `device` is auto, cpu or cuda; `mode` (exact,
    streaming, windows) is for networks. `auto` takes mergenet, or a classical method where that is better on pieces of
    the stream, or for a short stream was measured to be better, and `likelihood` for codes of different exposures.
    `defects` [H, W] is true at hot and dead pixels, which are filled from their neighbours, as are those that a
    stream's description states; crosstalk and afterpulses, which are not inverted, warn. A network outside of what it
    was measured for warns; with `strict` it is a `ValueError`. `planes` sums so many successive frames of one bit to a
    code; with `exposure` that of one plane, the photons are those of the sum. Codes of a clip that is sensed now are
    over so many of its frames, and `ppp` is that of a code. `qsim.PlaneSums` states which planes, too. Of arrays and
    imported streams without a map, hot pixels are looked for, filled and told by a warning; `scan=False` leaves them.
    `ValueError` or `FileNotFoundError` where the arguments do not fit together.

    A notebook shows a bar while it restores.

        video = quiver.restore(stream)
    """
    opened = np.asarray(source) if isinstance(source, LazyArray) else _opened(source)
    if not isinstance(method, str):
        raise ValueError(f"method= is a name, a weights file or a run folder as text, got {method!r}")
    bad = None if defects is None else check_map(np.asarray(defects), "defects=")
    sums = planes if isinstance(planes, PlaneSums) else PlaneSums(planes=planes)
    codes = _codes(opened, sensor, exposure, ppp, sums)
    codes = cut_into_scenes(scanned(codes, scan) if bad is None else filled(codes, bad))
    runner, _ = chosen(method, codes, RestoreOptions(device=device or "auto", mode=mode or "exact"))
    refuse_idle({"device": device, "mode": mode, "method": method}, [runner])
    found = remarks([runner], codes)
    if strict:
        refuse_outside([runner], found, "strict=", named=method != AUTO)
    if codes.not_inverted:
        found.append(f"{codes.name}: {codes.not_inverted} not inverted, restored light is too bright")
    if codes.scan and codes.defective is not None:
        found.append(f"{codes.name}: {codes.scan}, and filled; leave them with scan=False")
    if faults := told_of_faults(codes):
        found.append(faults)
    for text in found:
        warnings.warn(text, stacklevel=3)  # behind `own_numbers`
    with reporting(None, codes.name) as progress:
        restored = runner.restore(codes, progress=progress)
    try:
        check_finite(restored, runner.name)
    except ValueError as error:
        if is_known(codes.sensor):
            raise
        own = type(codes.sensor).__name__
        what = str(error).partition(";")[0]
        raise ValueError(
            f"{what}; its sensor is a {own}, of no model of this package: check its cdf_of, log_pmf_of and slope_of, "
            "or use a classical method, as in method='moment'"
        ) from None
    return restored


def _codes(source: Opened, sensor: Sensor | None, exposure: float | None, ppp: float | None, sums: PlaneSums) -> Codes:
    """Return the codes of a source, summed as asked; of a clip that is sensed now over as many frames."""
    if isinstance(source, np.ndarray):
        if ppp is not None:
            raise ValueError("ppp= is for a clip that is sensed now, and an array holds codes already; leave it out")
        return summed(_array(source, sensor, exposure), sums)
    if sensor is not None or exposure is not None:
        raise ValueError("sensor= and exposure= are for arrays, and a clip or a stream has its own; leave them out")
    if isinstance(source, Stream):
        if ppp is not None:
            raise ValueError("ppp= is for a clip that is sensed now, and a stream has its own light; leave it out")
        return summed(codes_of(source), sums)
    if ppp is not None:
        light = Illumination.of("quiver-physical", ppp, 3).over(sums.planes)
        return chosen_of_sensed(sensed(source, light)[0], source, light.planes, sums)
    if len(source.streams) != 1:
        there = ", ".join(source.streams) or "none"
        raise ValueError(
            f"{source.path}: give one of its streams ({there}) as clip.stream(NAME), or ppp= to sense it now"
        )
    return summed(stream_codes(source.stream(source.streams[0])), sums)


def _opened(source: Source) -> Opened:
    """Return the stream or clip of a path; other sources as they are. `ValueError` for a bare array."""
    if not isinstance(source, str | os.PathLike):
        return source
    path = Path(source)
    if path.suffix == ".npy" and path.is_file() and not path.with_suffix(".json").is_file():
        raise ValueError(f"{path}: a bare array; give numpy.load of it with sensor= and exposure= in seconds")
    return Clip.open(path) if path.is_dir() or not path.exists() else open_stream(path)


def _array(codes: Array, sensor: Sensor | None, exposure: float | None) -> Codes:
    """Return the codes of an array [T, H, W]; `ValueError` for what is no sensor, and no exposure [s]."""
    if sensor is None or exposure is None:
        raise ValueError("an array of codes has no sensor and no exposure; give sensor= and exposure= in seconds")
    if not isinstance(sensor, Sensor):
        raise ValueError(f"sensor= is a sensor, as qsim.load_sensor(NAME, ...) returns it, got {sensor!r}")
    if not 0 < exposure < float("inf"):
        raise ValueError(f"exposure= is in seconds and above 0, got {exposure!r}")
    return replace(array_codes(codes, sensor, exposure), unmapped=True)
