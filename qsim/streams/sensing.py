"""Declares the settings of a stream, each once: options, keys of recipes, Python arguments and stored descriptions."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from qsim import files, records
from qsim.checks import ArgumentError
from qsim.files import check_name
from qsim.kinds import Bits, Frames, Light, Name, Number, Positive, Rise, RowOrder, Schedule, Seed, Text
from qsim.plane_sums import Summed
from qsim.sensor import colour_filter, devices
from qsim.sensor.colour_filter import ColourFilter
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.file_laws import Conditions
from qsim.sensor.sensor import Sensor
from qsim.settings import setting
from qsim.streams.exposures import Timing
from qsim.streams.rows import Rows

# Settings of all that is sensed
AskedLux = Annotated[
    Light | None, setting("faceplate lux at 555 nm, instead of ppp", unit="lx", varied=True, example=1.3)
]
AskedSeed = Annotated[Seed, setting("seed of the noise", example=1)]
AskedPitch = Annotated[
    Positive | None,
    setting(
        "pixel pitch of a clip without a camera, for its lux: 1.1e-6",
        unit="m",
        recipe=False,
    ),
]


@dataclass(frozen=True)
class Sensing:
    """The settings of a stream: sensor, light level, seed; independent of the clip.

    `ValueError` for values out of their bounds, and for settings that exclude each other.
    """

    sensor: Annotated[
        Text | Sensor,
        setting(
            "a name of `qsim sensors`, a .toml file, or mine.py:Sensor", known=devices.names, example="quiver-physical"
        ),
    ]
    bits: Annotated[Bits | None, setting("bits per code", unset="the sensor's own", varied=True, example=[1, 3])] = None
    ppp: Annotated[
        Light | None,
        setting(
            "mean photons per pixel and code over the clip",
            unset="the clip's own light",
            varied=True,
            example=[3.25, 26.0],
        ),
    ] = None
    lux: AskedLux = None
    seed: AskedSeed = 0
    name: Annotated[
        Name | None, setting("name of the stream", unset="made from sensor, bits and light", short="o", example="dim")
    ] = None
    group: Annotated[bool, setting("sum 2^bits - 1 clip frames, as binary planes, to one code")] = False
    planes: Annotated[
        Summed | None, setting("clocked SPAD: sum so many clip frames, as binary planes, to one code", example=10)
    ] = None
    diffraction: Annotated[bool, setting("blur light with the lens's Airy pattern")] = False
    defects: Annotated[
        Text | Defects | None,
        setting(
            "file with a table [defects]: hot and dead pixels, maps, afterpulses, crosstalk",
            unset="that of the sensor's own .toml file",
            shown="FILE.toml",
            recipe=False,
        ),
    ] = None
    slices: Annotated[
        Frames,
        setting(
            "counting SPAD or QIS: clip frames per exposure, for motion blur",
            example=16,
        ),
    ] = 1
    row_delay: Annotated[
        Positive | None,
        setting("seconds from one row, or column, to the next", unit="s", unset="all at once", example=2e-06),
    ] = None
    row_order: Annotated[
        RowOrder | None,
        setting("direction of rows (down or up), or of columns (right or left)", unset="down", example="down"),
    ] = None
    colour: Annotated[
        Text | ColourFilter | None,
        setting(
            "colour filters: rggb, quad, rgbw, red, green, blue, or a .toml with a table [colour]",
            unset="those of the sensor's own .toml file",
            shown="MASK",
            example="rggb",
        ),
    ] = None
    exposures: Annotated[
        Schedule | None,
        setting(
            "shares of a code's time with light, in turn, as in 1,0.25,0.0625",
            unset="all of it",
            example=[1.0, 0.25],
        ),
    ] = None
    light_drift: Annotated[
        Rise,
        setting("rise of the light from the first code to the last, as a share", example=0.2),
    ] = 0.0
    follow: Annotated[bool, setting("counting SPAD: draw photon by photon, so that their times are known")] = False
    temperature: Annotated[
        Number | None,
        setting(
            "degrees C of a sensor file with dark_doubling", unit="degrees C", unset="the file's own", example=25.0
        ),
    ] = None
    pixel_pitch: AskedPitch = None

    def __post_init__(self) -> None:
        for name in ("sensor", "defects", "colour"):
            value = getattr(self, name)
            if isinstance(value, os.PathLike):
                object.__setattr__(self, name, os.fspath(value))
        records.settle(self)
        if self.ppp is not None and self.lux is not None:
            raise ValueError("give the light level as ppp or as lux, not both")
        if self.planes is not None:
            if self.group:
                raise ArgumentError("group", f"sums 2^bits - 1 planes, planes={self.planes} sums others; leave it out")
            if self.bits not in (None, self.planes.bit_length()):
                depth = self.planes.bit_length()
                raise ValueError(f"planes={self.planes}: their sum has {depth} bits, not {self.bits}; leave bits= out")
        if self.planes is not None and self.slices != 1:
            raise ArgumentError(
                "slices", f"are of one exposure, and planes={self.planes} are exposed one by one; give one of them"
            )
        if self.summed and self.slices != 1:
            raise ValueError("group sums planes, slices are of one exposure; give one of them")
        if self.row_order is not None and self.row_delay is None:
            raise ValueError(f"row_order {self.row_order}: orders rows that have their own time; give row_delay too")

    @property
    def summed(self) -> bool:
        """Whether clip frames are planes that a code sums."""
        return self.group or self.planes is not None

    @property
    def rows(self) -> Rows | None:
        """The readout of rows or columns at their own time; None: all at once."""
        return None if self.row_delay is None else Rows(self.row_delay, self.row_order or "down")

    def timing(self, frames: int, summed: bool) -> Timing:
        """Return when codes collect light that take so many clip frames each, `summed` as planes or as slices."""
        return Timing(frames, summed, self.rows, self.exposures, self.light_drift)

    @property
    def stream_name(self) -> str:
        """The given name, or one made of the settings: `quiver-physical_3bit_3.25ppp`."""
        if self.name is not None:
            return check_name(self.name)
        light = light_name(self.ppp, self.lux)
        bits = "" if self.depth is None else f"_{self.depth}bit"
        if self.planes is not None and self.planes != 2 ** self.planes.bit_length() - 1:
            bits += f"_{self.planes}planes"
        seed = f"_seed{self.seed}" if self.seed else ""
        sensor = Path(self.sensor_name).name.removesuffix(".toml").replace(".py:", "-")
        if isinstance(self.colour, str):
            sensor += f"-{Path(self.colour).name.removesuffix('.toml')}"
        elif self.colour is not None:
            sensor += f"-{files.sha256(files.to_json(self.colour.to_dict()))[:8]}"
        if isinstance(self.sensor, Sensor):
            sensor += f"-{files.sha256(files.to_json(self.sensor.to_dict()))[:8]}"
        return check_name(f"{sensor}{bits}_{light}{seed}")

    @property
    def sensor_name(self) -> str:
        """The sensor's name or file; of a record, its class."""
        return type(self.sensor).__name__ if isinstance(self.sensor, Sensor) else self.sensor

    @property
    def frames(self) -> int:
        """The clip frames in a code: planes that are summed, or slices of an exposure."""
        if not self.summed:
            return self.slices
        if self.planes is not None:
            return self.planes
        if isinstance(self.sensor, Sensor) and self.sensor.sums_planes:
            return self.sensor.levels - 1
        return 2 ** (self.depth or 1) - 1

    @property
    def depth(self) -> int | None:
        """The bits of a code, as requested, of a record, or of the file of a sum of planes; None: the device's own."""
        if self.bits is not None:
            return self.bits
        if self.planes is not None:
            return self.planes.bit_length()
        if isinstance(self.sensor, Sensor):
            return self.sensor.bits
        return devices.load(self.sensor, ppp=1.0).bits if self.summed and self.sensor.endswith(".toml") else None


def sensor_of(sensing: Sensing, *, ppp: float | None, exposure: float, conditions: Conditions) -> Sensor:
    """Return the sensor whose codes are drawn, in so many photons per pixel and code and of an exposure [s]."""
    bits = sensing.bits
    if sensing.planes is not None:
        bits = devices.plane_bits(sensing.sensor, sensing.planes, bits)
    made = devices.load(sensing.sensor, ppp=ppp, bits=bits, exposure=exposure, conditions=conditions)
    return as_summed(made, sensing)


def as_summed(sensor: Sensor, sensing: Sensing) -> Sensor:
    """Return a sensor with codes of the planes that are asked for; `ValueError` for one that sums none."""
    if sensing.planes is None:
        return sensor
    if not sensor.sums_planes:
        kind = type(sensor).__name__
        raise ValueError(f"{sensing.sensor_name}: planes= is for a clocked SPAD (BinarySPAD), this is a {kind}")
    return sensor.plane.of_planes(sensing.planes)


def light_name(ppp: float | None, lux: float | None) -> str:
    """Return a light level as a part of a name: `3.25ppp`, `10lx`, or `asis` for the clip's own light."""
    found = "asis"
    if ppp is not None:
        found = f"{ppp:g}ppp"
    if lux is not None:
        found = f"{lux:g}lx"
    return found.replace("e+", "e")  # a name holds no +


def filters_of(sensing: Sensing) -> ColourFilter | None:
    """Return the colour filter array that the settings or the sensor's file state; None without one."""
    if sensing.colour is not None:
        return colour_filter.load(sensing.colour) if isinstance(sensing.colour, str) else sensing.colour
    return colour_filter.from_toml(sensing.sensor_name) if sensing.sensor_name.endswith(".toml") else None


def frames_needed(sensing: Sensing, height: int, width: int, frame_rate: float) -> int:
    """Return the clip frames of the first code: its planes or slices, and those that its last row still needs."""
    rows = sensing.rows
    return sensing.frames + (0 if rows is None else rows.reach(height, width, frame_rate))
