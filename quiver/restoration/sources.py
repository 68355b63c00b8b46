"""Finds the codes that a path and the settings of a restoration mean, and refuses settings that have no effect.

A setting is None until it is given. One that would be ignored for this input is an `ArgumentError` with the reason.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qsim.checks import ArgumentError
from qsim.files import load_array
from qsim.plane_sums import AS_STORED, PlaneSums
from quiver.data.clips import Clip, open_clips
from quiver.data.codes import Codes, codes_of, filled, light_of, open_stream, repaired, sensed, stream_codes, summed
from quiver.data.defects import read_map
from quiver.data.hot_pixels import scanned
from quiver.data.illumination import Illumination, colour_filter, follows_light, from_toml
from quiver.data.photon_cubes import cube_codes
from quiver.restoration.interface import AUTO
from quiver.restoration.mosaics import check_bands
from quiver.restoration.settings import RestoreSettings

if TYPE_CHECKING:
    from quiver.restoration.interface import Restorer

BARE = ("width", "frame_rate")  # missing in a bare array only
LIGHT = ("sensor", "ppp", "bits", "seed")
FRAME_RATE = 2000.0  # frames per second of a bare array


def refuse(asked: Any, names: Sequence[str], why: str) -> None:
    """Raise `ArgumentError` with the first of these settings that is given, and the reason why it has no effect."""
    for name in names:
        value = getattr(asked, name)
        if value is not None and (value is not False or name == "scan"):  # 0 is a given value
            raise ArgumentError(name, f"{why}; leave it out", off=value is False)


def refuse_idle(asked: Mapping[str, Any], methods: Sequence[Restorer]) -> None:
    """Raise `ArgumentError` for a mode, precision or device that is given and that none of the methods uses.

    A classical method that `auto` chose lets the precision pass: it was meant for its network.
    """
    names = ", ".join(method.name for method in methods)
    for argument in ("mode", "precision", "device"):
        value = asked.get(argument)
        if value is None:
            continue
        if argument == "device":
            if not any(method.any_device for method in methods):
                raise ArgumentError(
                    argument, f"{names} is a method of others, which computes where it will; leave it out"
                )
            continue
        if not any(method.learned for method in methods):
            if asked.get("method") == AUTO and argument != "mode":
                continue
            raise ArgumentError(argument, f"acts on networks, and {names} is classical; leave it out")
        if argument == "mode" and not any(method.identity.get("mode") == value for method in methods):
            raise ArgumentError(
                argument, f"{names} shares no work between frames, it has one mode, not {value}; leave it out"
            )


def codes_to_restore(asked: RestoreSettings, sums: PlaneSums = AS_STORED) -> Codes:
    """Return the codes of `quiver restore`: a stored stream, a clip that is sensed now, or a bare array.

    Planes are summed as asked. Pixels that the map `defects` or the sensor's file marks are filled
    (quiver/data/defects.py); without a map, those that a scan finds (quiver/data/hot_pixels.py).
    """
    codes = _found(asked, sums)
    check_bands(codes)
    if asked.defects is None:
        return scanned(codes, asked.scan)
    refuse(asked, ["scan"], "the map of defective pixels is given")
    return filled(codes, read_map(asked.defects))


def _found(asked: RestoreSettings, sums: PlaneSums) -> Codes:
    path: Path = asked.source
    if path.is_dir():
        return _of_clip(path, asked, sums)
    if path.with_name(f"{path.name}.part").is_dir() and not path.exists():
        open_clips(path)  # raises: the clip is unfinished
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if path.suffix not in (".npy", ".json"):
        raise ValueError(f"{path}: not a stream, clip folder or .npy array; `qsim convert` makes a clip of other files")
    refuse(asked, ["stream"], f"names a stream of a clip, and {path} is a file")
    if path.with_suffix(".json").is_file():
        stream = open_stream(path)
        refuse(asked, (*LIGHT, *BARE), f"{path} is a stored stream, which has its own (see its .json)")
        return summed(codes_of(stream), sums)
    return _of_array(path, asked, sums)


def _of_clip(path: Path, asked: RestoreSettings, sums: PlaneSums) -> Codes:
    clips = open_clips(path)
    if not (path / "clip.json").exists():
        one = f", as in {clips[0].path}" if clips else "; none is finished yet"
        raise ValueError(f"{path}: is a data set; name one of its clips{one}")
    clip: Clip = clips[0]
    refuse(asked, BARE, f"describes a bare array, and {path} is a clip")
    if asked.ppp is None and asked.stream is None and len(clip.streams) != 1:
        there = ", ".join(clip.streams) or "none"
        raise ValueError(f"{path}: choose one of its streams with stream= ({there}), or sense it now with ppp=")
    if asked.stream is not None or asked.ppp is None:
        stream = clip.stream(asked.stream or clip.streams[0])
        now = "" if asked.stream else " (with ppp= the clip is sensed again)"
        refuse(asked, LIGHT, f"{stream.path} is a stored stream, which has its own{now}")
        return summed(stream_codes(stream), sums)
    depth = asked.bits if sums.planes else _bits(asked)
    light = Illumination.of(_sensor(asked), asked.ppp, depth).over(sums.planes, asked.bits)
    return chosen_of_sensed(sensed(clip, light, asked.seed or 0)[0], clip, light.planes, sums)


def chosen_of_sensed(codes: Codes, clip: Clip, planes: int, sums: PlaneSums) -> Codes:
    """Return those codes of so many clip frames each that begin where `sums` says, in clip frames."""
    sums.over(len(clip), str(clip.path))  # raises: the clip has no such frames
    for name, value in (("start", sums.start), ("every", sums.every)):
        if value is not None and value % planes:
            raise ArgumentError(
                name, f"{value}: codes of {planes} frames of a clip begin at multiples of {planes}; give one of them"
            )
    stop = None if sums.stop is None else sums.stop // planes
    every = None if sums.every is None else sums.every // planes
    return summed(codes, PlaneSums((sums.start or 0) // planes or None, stop, every, summed=sums.summed))


def _of_array(path: Path, asked: RestoreSettings, sums: PlaneSums) -> Codes:
    sensor = _sensor(asked)
    refuse(asked, ["seed"], f"is for noise that is drawn, and {path} holds codes already")
    if not follows_light(sensor):
        refuse(asked, ["ppp"], f"{path} holds codes already, and the gain of {sensor} does not follow the light")
    planes = asked.width is not None or (sums.planes or 1) > 1 or sums.summed is not None
    light = Illumination.of(sensor, asked.ppp, asked.bits if planes else _bits(asked, _least_bits(path)))
    if asked.output.resolve() == path.resolve():
        raise ValueError(f"{path}: would be replaced by what is made from it; name another")
    codes = cube_codes(path, light, asked.frame_rate or FRAME_RATE, sums=sums, width=asked.width)
    if not sensor.endswith(".toml"):
        return codes
    return repaired(replace(codes, colour=colour_filter.from_toml(sensor)), from_toml(sensor))


def _sensor(asked: RestoreSettings) -> str:
    return asked.sensor or "quiver-physical"


def _bits(asked: RestoreSettings, otherwise: int = 3) -> int | None:
    """Return the bits per code: as given, else those of a sensor's file, else these."""
    return asked.bits or (None if _sensor(asked).endswith(".toml") else otherwise)


def _least_bits(path: Path) -> int:
    """Return the bits per code of a bare array that states none: 1 of truth values, else 3."""
    return 1 if load_array(path).dtype == np.bool_ else 3


def _numbers(frames: Sequence[int]) -> str:
    """Return frame numbers as text, ten at most."""
    shown = ", ".join(map(str, frames[:10]))
    return shown if len(frames) <= 10 else f"{shown} and {len(frames) - 10} more"


def told_of_faults(codes: Codes) -> str | None:
    """Return one line on the faulty frames of a stream; None without any."""
    if not codes.faulty:
        return None
    return f"{codes.name}: unlike both frames beside them (black, white or a flash): {_numbers(codes.faulty)}"


def assumed(codes: Codes, method: Restorer) -> str:
    """Return one line with everything that a restoration assumes."""
    length, height, width = codes.shape
    sensor = codes.sensor_name or type(codes.sensor).__name__
    stated = codes.ppp is not None and codes.ppp > 0
    light = f", {light_of(codes):.4g} photons/pixel" + ("" if stated else " (estimated from the codes)")
    bad = 0 if codes.defective is None else int(codes.defective.sum())
    if codes.colour is not None:
        rows, columns = codes.colour.tile
        light += f", each of {rows} x {columns} places of the colour filters alone, then demosaiced"
    light += f", {codes.scan}" if codes.scan else ""
    light += f", {bad} of {height * width} pixels defective and filled from their neighbours" if bad else ""
    light += f", cut before frames {_numbers(codes.cuts)}" if codes.cuts else ""
    light += f", {codes.not_inverted} not inverted (restored light is too bright)" if codes.not_inverted else ""
    seen = f"{method.frames_used} frames" if method.seamless else f"all earlier and {method.look_ahead} later frames"
    return (
        f"{codes.name}: {length} frames of {height} x {width}, {codes.rates}; "
        f"sensor {sensor}, {codes.sensor.bits} bit{light}, white of the sensor = {codes.white:.4g} photons; "
        f"method {method.name} ({method.description}), {seen} for each"
    )
