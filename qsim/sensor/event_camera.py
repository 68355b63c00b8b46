"""Describes event cameras: thresholds of contrast, bandwidth, refractory time, leak and noise; by name or in a file.

The effects are those of the published model of v2e (Hu, Liu and Delbruck, "v2e: From Video Frames to Realistic DVS
Events", CVPR Workshops 2021). event_pixels.py states their law.

    load("dvs")     load("mine.toml")

    # mine.toml: the fields and units of `EventCamera`, nothing else; a field that is left out has its default
    [sensor]
    model = "EventCamera"
    threshold_on = 0.25
    [sources]                    # optional: one sentence per field
    threshold_on = "steps of contrast of 2026-05-03"
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

from msgspec import Meta

from qsim import files, records
from qsim.checks import file_path, suggest
from qsim.host import own_numbers
from qsim.kinds import LARGEST, Seed

LEAST_THRESHOLD = 0.01  # of any pixel: mismatch cannot take a threshold below it
MODEL = "EventCamera"

Threshold = Annotated[float, Meta(ge=LEAST_THRESHOLD, le=20.0)]
Spread = Annotated[float, Meta(ge=0.0, le=1.0)]
Efficiency = Annotated[float, Meta(ge=1e-6, le=1.0)]
Current = Annotated[float, Meta(ge=1e-3, le=LARGEST)]
Seconds = Annotated[float, Meta(ge=0.0, le=10.0)]
Rate = Annotated[float, Meta(ge=0.0, le=1e4)]
Cutoff = Annotated[float, Meta(ge=1e-3, le=1e9)]


@dataclass(frozen=True, kw_only=True)
class EventCamera:
    """A pixel array that reports contrast. Thresholds are changes of the natural logarithm of the photocurrent."""

    quantum_efficiency: Efficiency = 0.8  # electrons per photon
    dark_current: Current = 100.0  # e-/s; it bounds the contrast of black pixels
    threshold_on: Threshold = 0.2  # of brighter light: exp(0.2) = +22 %
    threshold_off: Threshold = 0.2  # of darker light: exp(-0.2) = -18 %
    mismatch: Spread = 0.0  # standard deviation of both thresholds over the pixels, at least 0.01 each
    refractory: Seconds = 0.0  # s after an event during which a pixel is held in reset
    cutoff: Cutoff | None = None  # Hz, bandwidth of the photoreceptor in bright light; None: unlimited
    leak_rate: Rate = 0.0  # events (all ON) per second of a pixel in constant light
    shot_noise: Rate = 0.0  # events (half of them ON) per second of a pixel in the dark
    shot_noise_bright: Spread = 0.25  # share of them that is left in bright light
    bright: Current | None = None  # e-/s of bright light; None: 2.5 times the mean of the clip
    device_seed: Seed = 0  # which device of its kind: the thresholds are a function of it

    def __post_init__(self) -> None:
        records.settle(self)

    def to_dict(self) -> dict[str, Any]:
        """Return the record as files store it: {"model": "EventCamera", field: value, ...}."""
        return {"model": MODEL, **records.plain(self, complete=True)}

    def __str__(self) -> str:
        given = {name: value for name, value in vars(self).items() if value is not None}
        return f"{MODEL}: " + ", ".join(f"{name} {value:g}" for name, value in given.items())

    @property
    def needs_bright(self) -> bool:
        """Whether an effect depends on what bright light is."""
        return self.cutoff is not None or (self.shot_noise > 0 and self.shot_noise_bright < 1)

    def with_bright(self, current: float) -> EventCamera:
        """Return this camera with bright light of `current` [e-/s], unless it states its own."""
        return self if self.bright is not None else replace(self, bright=max(current, 1e-3))


@dataclass(frozen=True)
class NamedCamera:
    """One named event camera, and the source of each number."""

    what: str  # one line
    camera: EventCamera
    sources: Mapping[str, str]  # field -> source


_OURS = "our choice, not of one camera"
CAMERAS: Mapping[str, NamedCamera] = MappingProxyType(
    {
        "dvs": NamedCamera(
            "event camera with mismatch of thresholds, finite bandwidth, leak and shot noise (default)",
            EventCamera(
                mismatch=0.03,
                refractory=1e-4,
                cutoff=300.0,
                leak_rate=0.1,
                shot_noise=1.0,
            ),
            {
                "threshold_on": _OURS,
                "threshold_off": _OURS,
                "mismatch": _OURS,
                "cutoff": "our choice: 300 Hz in bright light, and in proportion to dimmer light",
                "leak_rate": _OURS,
                "shot_noise": "our choice: 1 event/s in the dark",
                "shot_noise_bright": _OURS,
                "refractory": "0.1 ms; our choice",
                "quantum_efficiency": "0.8; set equal to the QIS, so that a comparison shows the readout alone",
                "dark_current": "100 e-/s; our choice",
            },
        ),
        "dvs-ideal": NamedCamera(
            "event camera without mismatch, noise, leak, refractory time and limit of bandwidth",
            EventCamera(),
            {
                "threshold_on": _OURS,
                "threshold_off": _OURS,
                "quantum_efficiency": "0.8; set equal to the QIS, so that a comparison shows the readout alone",
                "dark_current": "100 e-/s; our choice",
            },
        ),
    }
)


def names() -> list[str]:
    """Return the names of all event cameras."""
    return list(CAMERAS)


@own_numbers
def load(name: str | Path | EventCamera) -> EventCamera:
    """Return the event camera of a name in `CAMERAS` or of a TOML file; an `EventCamera` is returned as given.

    `ValueError` names what is wrong.
    """
    if isinstance(name, EventCamera):
        return name
    if str(name) in CAMERAS:
        return CAMERAS[str(name)].camera
    path = file_path(name)
    if path.suffix != ".toml":
        raise ValueError(
            f"unknown event camera {str(name)!r}{suggest(str(name), names())}; there are {', '.join(names())}, or name "
            "a .toml file"
        )
    return _of_file(path)


def _of_file(path: Path) -> EventCamera:
    """Return the event camera of a TOML file with a table [sensor] and, optionally, [sources]; strict."""
    tables = files.read_toml(path, "file of an event camera")
    for key in tables:
        if key not in ("sensor", "sources"):
            raise ValueError(f"{path}: unknown table [{key}]{suggest(key, ('sensor', 'sources'))}")
    table = tables.get("sensor")
    if not isinstance(table, dict):
        raise ValueError(f'{path}: a table [sensor] with model = "{MODEL}" is missing')
    known = [field.name for field in fields(EventCamera)]
    stated = tables.get("sources", {})
    for key in stated if isinstance(stated, dict) else ():
        if key not in known:
            raise ValueError(f"{path}: unknown key {key!r} in [sources]{suggest(key, known)}")
    return from_dict(table, f"{path}: [sensor]")


def from_dict(settings: Mapping[str, Any], where: str = "event camera") -> EventCamera:
    """Return the camera that `EventCamera.to_dict` described; strict, `ValueError`."""
    if settings.get("model") != MODEL:
        raise ValueError(f'{where}: an event camera has model = "{MODEL}", got {settings.get("model")!r:.60}')
    values = {key: value for key, value in settings.items() if key != "model"}
    return records.convert(values, EventCamera, where)
