"""Finds the codes that a path and the options of a command mean, and refuses options that have no effect.

An option is None until it is given. An option that would be ignored for this input is a `ValueError` with the reason.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quiver.data.clips import Clip, open_clips
from quiver.data.codes import Codes, codes_of, filled, light_of, open_stream, repaired, sensed, stream_codes
from quiver.data.defects import read_map
from quiver.data.illumination import Illumination, colour_filter, follows_light, read_sensor
from quiver.data.photon_cubes import cube_codes
from quiver.restoration.interface import AUTO
from quiver.restoration.mosaics import check_bands

if TYPE_CHECKING:
    from quiver.restoration.interface import Restorer

BARE = ("width", "planes", "frame_rate")  # missing in a bare array only
LIGHT = ("sensor", "ppp", "bits", "seed")
FRAME_RATE = 2000.0  # codes per second of a bare array


def refuse(args: argparse.Namespace, names: Sequence[str], why: str) -> None:
    """Raise `ValueError` with the first of these options that was given, and the reason why it has no effect."""
    for name in names:
        if getattr(args, name) is not None:
            raise ValueError(f"--{name.replace('_', '-')}: {why}; leave it out")


def refuse_idle(asked: Mapping[str, Any], methods: Sequence[Restorer]) -> None:
    """Raise `ValueError` for a mode, precision or device that none of the methods uses.

    A classical method that `auto` chose lets the precision and the device pass: they were meant for its network.
    """
    names = ", ".join(method.name for method in methods)
    for option in ("mode", "precision", "device"):
        value = asked.get(option)
        if value is None:
            continue
        if not any(method.learned for method in methods):
            if asked.get("method") == AUTO and option != "mode":
                continue
            raise ValueError(f"--{option}: acts on networks, and {names} is classical; leave it out")
        if option == "mode" and not any(method.identity.get("mode") == value for method in methods):
            raise ValueError(f"--mode {value}: {names} shares no work between frames, it has one mode; leave it out")


def codes_to_restore(args: argparse.Namespace) -> Codes:
    """Return the codes of `quiver restore`: a stored stream, a clip that is sensed now, or a bare array.

    Pixels that the map `--defects` or the sensor's file marks are filled (quiver/data/defects.py).
    """
    codes = _found(args)
    check_bands(codes)
    return codes if args.defects is None else filled(codes, read_map(args.defects))


def _found(args: argparse.Namespace) -> Codes:
    path: Path = args.source
    if path.is_dir():
        return _of_clip(path, args)
    if path.with_name(f"{path.name}.part").is_dir() and not path.exists():
        open_clips(path)  # raises: the clip is unfinished
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if path.suffix not in (".npy", ".json"):
        raise ValueError(f"{path}: not a stream, clip folder or .npy array; `qsim convert` makes a clip of other files")
    refuse(args, ["stream"], f"names a stream of a clip, and {path} is a file")
    if path.with_suffix(".json").is_file():
        stream = open_stream(path)
        refuse(args, (*LIGHT, *BARE), f"{path} is a stored stream, which has its own (see its .json)")
        return codes_of(stream)
    return _of_array(path, args)


def _of_clip(path: Path, args: argparse.Namespace) -> Codes:
    clips = open_clips(path)
    if not (path / "clip.json").exists():
        one = f", as in {clips[0].path}" if clips else "; none is finished yet"
        raise ValueError(f"{path}: is a data set; name one of its clips{one}")
    clip: Clip = clips[0]
    refuse(args, BARE, f"describes a bare array, and {path} is a clip")
    if args.ppp is None and args.stream is None and len(clip.streams) != 1:
        there = ", ".join(clip.streams) or "none"
        raise ValueError(f"{path}: choose one of its streams with --stream ({there}), or sense it now with --ppp")
    if args.stream is not None or args.ppp is None:
        stream = clip.stream(args.stream or clip.streams[0])
        now = "" if args.stream else " (with --ppp the clip is sensed again)"
        refuse(args, LIGHT, f"{stream.path} is a stored stream, which has its own{now}")
        return stream_codes(stream)
    return sensed(clip, Illumination.of(_sensor(args), args.ppp, _bits(args)), args.seed or 0)[0]


def _of_array(path: Path, args: argparse.Namespace) -> Codes:
    sensor = _sensor(args)
    refuse(args, ["seed"], f"is for noise that is drawn, and {path} holds codes already")
    if not follows_light(sensor):
        refuse(args, ["ppp"], f"{path} holds codes already, and the gain of {sensor} does not follow the light")
    light = Illumination.of(sensor, args.ppp, args.bits if args.width is not None else _bits(args))
    if args.output.resolve() == path.resolve():
        raise ValueError(f"{path}: would be replaced by what is made from it; name another with -o")
    codes = cube_codes(path, light, args.frame_rate or FRAME_RATE, planes=args.planes, width=args.width)
    if not sensor.endswith(".toml"):
        return codes
    return repaired(replace(codes, colour=colour_filter.from_toml(sensor)), read_sensor(sensor)[1])


def _sensor(args: argparse.Namespace) -> str:
    return args.sensor or "quiver-physical"


def _bits(args: argparse.Namespace) -> int | None:
    """Return the bits per code: as given, else those of a sensor's file, else 3."""
    return args.bits or (None if _sensor(args).endswith(".toml") else 3)


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
    light += f", {bad} of {height * width} pixels defective and filled from their neighbours" if bad else ""
    light += f", {codes.not_inverted} not inverted (restored light is too bright)" if codes.not_inverted else ""
    seen = f"{method.frames_used} frames" if method.seamless else f"all earlier and {method.look_ahead} later frames"
    return (
        f"{codes.name}: {length} frames of {height} x {width}, {codes.frame_rate:g} codes/s; "
        f"sensor {sensor}, {codes.sensor.bits} bit{light}, white of the sensor = {codes.white:.4g} photons; "
        f"method {method.name} ({method.description}), {seen} for each"
    )
