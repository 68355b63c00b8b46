"""Declares the settings of a restoration: which codes, of which sensor in which light, by which method."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from qsim.kinds import Bits, Light, Positive, Seed, Text, Whole
from qsim.settings import setting
from quiver.data.hot_pixels import Wanted
from quiver.data.illumination import sensor_names
from quiver.restoration.interface import DEFAULT_METHOD


def method_names() -> Iterable[str]:
    """Return the methods that need no training, for shells to complete."""
    from quiver.restoration import restorers

    return restorers.method_names()


@dataclass(frozen=True)
class RestoreSettings:
    """What is restored, and where the result is written."""

    source: Annotated[
        Path,
        setting(
            "stream, clip folder, bare .npy array, or cubes of the challenge",
            positional=True,
        ),
    ]
    output: Annotated[
        Path,
        setting(
            ".npy to write, with a .json beside it; .zip: a submission to the challenge",
            short="o",
        ),
    ]
    method: Annotated[
        Text,
        setting(
            "method, weights file or run folder; auto: what is best on the stream",
            known=method_names,
        ),
    ] = DEFAULT_METHOD
    stream: Annotated[Text | None, setting("stream of a clip to restore", unset="the only one")] = None
    sensor: Annotated[
        Text | None,
        setting("a name of `qsim sensors`, or a .toml file", unset="quiver-physical", known=sensor_names),
    ] = None
    ppp: Annotated[
        Light | None,
        setting("mean photons per pixel and code, or of a sum", unset="that of the stored stream"),
    ] = None
    bits: Annotated[Bits | None, setting("bits per code", unset="3; of a .toml file its own, of truth values 1")] = None
    seed: Annotated[Seed | None, setting("seed of the noise, if a clip is sensed now", unset="0")] = None
    width: Annotated[Whole | None, setting("bare array: packed binary planes of this many pixels per row")] = None
    frame_rate: Annotated[
        Positive | None, setting("bare array: frames of the file per second, planes if they are summed", unset="2000")
    ] = None
    defects: Annotated[
        Path | None, setting("map of defective pixels, .npy [H, W], true where hot or dead: they are filled")
    ] = None
    scan: Wanted = None
    strict: Annotated[bool, setting("networks: refuse a stream outside their measured domain")] = False
    force: Annotated[bool, setting("replace an existing result")] = False
