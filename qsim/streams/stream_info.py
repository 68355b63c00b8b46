"""Describes a stream: what NAME.json holds, as one record.

    StreamInfo = the codes (shape, bits, rates), the pixels that made them (sensor, defects, colour), the settings that
                 were asked for, and what came of them (light, key, law); of an imported stream its source instead

Fields that hold their default are not written. A key that no field has is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from qsim import records
from qsim.clip.source import Source
from qsim.files import VERSION
from qsim.frame_times import Times
from qsim.kinds import Bits, Count, Digest, Number, Positive, Text, Whole
from qsim.optics.radiometry import LightLevel
from qsim.sensor.colour_filter import ColourFilter
from qsim.sensor.defects.event_simulation import Effects
from qsim.sensor.sensor import Sensor
from qsim.settings import given
from qsim.streams.sensing import Sensing

_ELSEWHERE = ("sensor", "bits", "planes", "name", "defects", "colour")  # settings whose outcome the description holds


@dataclass(frozen=True, kw_only=True)
class StreamInfo:
    """The description of a stream: NAME.json without its format version and its own checksum."""

    shape: tuple[Whole, Whole, Whole]  # codes, height, width [px]
    bits: Bits  # of a code
    code_model: Text  # kind of code, that of the sensor where it is not stated otherwise
    exposure: Positive  # s of light in one code: in all its planes if it sums some, in a full one under a schedule
    frame_rate: Positive  # codes per second
    planes_per_code: Whole = 1  # clip frames in a code: planes that are summed, or slices of an exposure
    plane_rate: Positive | None = None  # planes per second, where codes leave some out; else one code follows the other
    sensor: dict[str, Any]  # model and parameters
    sensor_name: str = ""  # name or file; of a record, nothing
    defects: dict[str, Any] = field(default_factory=dict)  # table [defects]; measured maps with their checksums
    colour: ColourFilter | None = None  # from the first pixel on
    origin: tuple[Count, Count] = (0, 0)  # y, x of the first pixel in the full frame
    temperature: Number | None = None  # degrees C, at which a sensor file with such a law was read
    settings: dict[str, Any] = field(default_factory=dict)  # of `Sensing`, where they differ from their defaults
    clip: str = ""  # its name
    clip_key: Count | None = None  # of the random numbers, beside the seed; None: not drawn from this clip
    light: LightLevel | None = None  # of a code; None: not known
    drawn_by: str = ""  # law by which codes were drawn from random numbers (`Sensor.law`, or "events")
    dead_time_effects: Effects | None = None  # what the closed form of counting pixels leaves out
    planes_of: str = ""  # clip whose planes a study has summed
    orientation: Text = "upright"
    source: Source | None = None  # of an imported stream
    times: Times | None = None
    sha256: Digest | None = None  # of the codes' file
    software: dict[str, str] = field(default_factory=lambda: {"qsim": VERSION})

    def __post_init__(self) -> None:
        records.settle(self)
        if self.sensor.get("bits", self.bits) != self.bits:
            raise ValueError(f"bits: {self.bits} contradict those of the sensor, {self.sensor['bits']!r:.20}")
        records.refuse_unknown(self.settings, Sensing, "settings")
        _ = self.sensing

    @classmethod
    def of(cls, sensor: Sensor, **facts: Any) -> Self:
        """Return the description of codes of a sensor; `facts` are the other fields."""
        own: dict[str, Any] = {"bits": sensor.bits, "code_model": sensor.code_model, "sensor": sensor.to_dict()}
        return cls(**own | facts)

    @property
    def sensing(self) -> Sensing:
        """The settings that were asked for; of an imported stream, none."""
        return Sensing(self.sensor_name or str(self.sensor.get("model") or "sensor"), **self.settings)

    @property
    def seed(self) -> int | None:
        """The seed of the random numbers; None for codes that were not drawn from their clip."""
        return None if self.clip_key is None else self.sensing.seed

    @property
    def compared(self) -> dict[str, object]:
        """What makes a stream another one than asked for: equal for streams of equal codes.

        Folders of files do not count: sensor files have their name alone, and measured maps their checksums. Nor do the
        stated effects of dead time: `drawn_by` tells what they led to.
        """
        found = records.plain(self)
        for name in ("sha256", "software", "orientation", "dead_time_effects"):
            found.pop(name, None)
        maps = {key: value["sha256"] for key, value in self.defects.items() if "sha256" in _table(value)}
        return found | {"sensor_name": Path(self.sensor_name).name, "defects": self.defects | maps}


def stored_settings(sensing: Sensing) -> dict[str, Any]:
    """Return the settings that a description holds: those at their default, or with an outcome in it, are left out."""
    found = {name: value for name, value in given(sensing).items() if name not in _ELSEWHERE}
    return found | ({"group": True} if sensing.summed else {})


def _table(value: Any) -> dict[str, Any]:
    """Return a table in a table, or an empty one."""
    return value if isinstance(value, dict) else {}
