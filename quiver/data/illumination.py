"""Describes what decides the codes of a clip beside the clip and the seed: a sensor, its light and its noise.

    settings of `qsim sense` -> Illumination -> draw (of a clip), sensor
    stored stream            -> Illumination, with the sensor and the defects that the stream states

A training window honours the settings in HONOURED; `refuse_others` refuses the rest.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

from qsim.checks import ArgumentError
from qsim.files import sha256, to_json
from qsim.sensor import colour_filter, devices
from qsim.sensor.colour_filter import ColourFilter
from qsim.sensor.defects.defect_table import Defects, from_toml
from qsim.sensor.defects.defect_table import from_dict as read_defects
from qsim.sensor.file_laws import Conditions
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD
from qsim.settings import given
from qsim.streams.clip import Clip
from qsim.streams.exposures import Timing
from qsim.streams.preparation import assemble, prepare
from qsim.streams.sensing import Sensing, filters_of
from qsim.streams.simulation import Draw
from qsim.streams.stream import Stream

DEFAULT = Sensing("quiver-physical", bits=3, ppp=3.25)
ALWAYS = ("sensor", "bits", "ppp")  # keys of every stored description
TABLES = ("record", "defects", "colour")  # what it also has, as tables: the sensor, its defects and colour filters
LEVEL = (*ALWAYS, "lux")  # settings that the text of a light states in its own words
TIMES = ("group", "slices", "row_delay", "row_order", "exposures", "light_drift")  # when codes collect light
HONOURED = (*LEVEL, *TIMES, "diffraction", "defects", "colour", "temperature", "pixel_pitch")
STATED = ("seed", "name", "follow")  # settings that change no law of the codes
OTHERS = "give sensor=, bits= and ppp=, in Python WindowSettings(lights=...)"  # where a stream's noise is of no use
LONGEST = 500  # characters of a stored name


def sensor_names() -> Iterable[str]:
    """Return the named sensors."""
    return devices.DEVICES


@dataclass(frozen=True)
class Illumination:
    """A sensor, the light that it receives, and its noise."""

    sensing: Sensing = DEFAULT  # its seed and name are of no meaning here
    # What a stream or a run states, as JSON; None: a named device, or a file that is read when codes are drawn
    record: str | None = field(default=None)  # table [sensor], with the laws of its file
    defects: str | None = field(default=None)  # table [defects]; with a record, None is no defects
    colour: str | None = field(default=None)  # table [colour], from the first pixel of the full frame; None: one band

    @classmethod
    def of(
        cls,
        sensor: str | Sensor = DEFAULT.sensor,
        ppp: float | None = DEFAULT.ppp,
        bits: int | None = DEFAULT.bits,
        **settings: Any,
    ) -> Illumination:
        """Return a light level [photons/pixel, None: the clip's own or `lux`] and bits [None: the sensor's own].

        `settings` are others of `Sensing`, such as temperature. `ValueError` for impossible ones.
        """
        return cls(Sensing(sensor, bits=bits, ppp=ppp, **settings))

    @classmethod
    def of_stream(cls, stream: Stream) -> Illumination:
        """Return the light and the noise of a stored stream. `ValueError` if training windows cannot have it."""
        refuse_others(unlike_windows(stream), str(stream.path.with_suffix(".json")))
        info = stream.info
        named = info.sensor_name != "" and not info.sensor_name.endswith(".toml") and "summed" not in info.sensor
        settings = {name: value for name, value in info.settings.items() if name in HONOURED}
        settings.pop("temperature", None)  # the record has its dark rate
        pitched = settings.pop("pixel_pitch", None) is not None
        # Of a stream of another program light alone is known, and lux of a clip without a camera are so many photons.
        if info.light is not None and (info.clip_key is None or pitched):
            settings.pop("lux", None)
            settings["ppp"] = info.light.ppp
        colour = info.colour
        if colour is not None:
            y, x = stream.clip.origin
            colour = colour.shifted(-y, -x)  # from the first pixel of the full frame on
        return cls(
            Sensing(info.sensor_name or str(info.sensor["model"]), bits=stream.bits, **settings),
            None if named else as_text(info.sensor),
            as_text(info.defects) if info.defects else None,
            None if colour is None else as_text(colour.to_dict()),
        )

    @classmethod
    def from_dict(cls, values: Any) -> Illumination:
        """Return the inverse of `to_dict`; strict, `ValueError`.

        The files of defect maps may be missing here: they are read when codes are drawn.
        """
        if not isinstance(values, dict) or not {*ALWAYS, *TABLES} <= set(values):
            raise ValueError(f"noise has {', '.join((*ALWAYS, *TABLES))}; got {repr(values)[:100]}")
        settings = dict(values)
        stated = {name: settings.pop(name) for name in TABLES}
        for name, table in stated.items():
            if table is not None and not isinstance(table, dict):
                raise ValueError(f"noise: {name} is {repr(table)[:100]}")
        if not isinstance(settings["sensor"], str) or len(settings["sensor"]) > LONGEST:
            raise ValueError(f"noise: sensor is {repr(settings['sensor'])[:100]}")
        try:
            sensing = Sensing(**settings)
        except (TypeError, ValueError) as error:
            raise ValueError(f"noise: {str(error)[:300]}") from None
        texts = {name: None if table is None else as_text(table) for name, table in stated.items()}
        made = cls(sensing, **texts)
        if made.record is not None:
            replace(made, defects=None).device(5e-4)  # checks the record; maps of defects may lie elsewhere
        if made.colour is not None:
            _ = made.filters  # checks the table
        return made

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON; settings that are off are left out."""
        values = {name: getattr(self.sensing, name) for name in ALWAYS} | given(self.sensing)
        texts = {name: getattr(self, name) for name in TABLES}
        return values | {name: None if text is None else json.loads(text) for name, text in texts.items()}

    @property
    def sensor(self) -> str:
        """The sensor's name or file."""
        return self.sensing.sensor_name

    @property
    def ppp(self) -> float | None:
        """Mean photons per pixel and exposure over the clip; None: the clip's own light, or that of `lux`."""
        return self.sensing.ppp

    @property
    def bits(self) -> int | None:
        """Bits per code; None: the sensor's own."""
        return self.sensing.bits

    @property
    def planes(self) -> int:
        """Clip frames of a code."""
        if self.sensing.summed and self.record is not None:
            return self.device(5e-4).levels - 1
        return self.sensing.frames

    @property
    def timing(self) -> Timing:
        """When codes collect light."""
        return self.sensing.timing(self.planes, self.sensing.summed)

    def over(self, planes: int | None, bits: int | None = None) -> Illumination:
        """Return the same with codes over so many clip frames; None: as it is.

        A clocked SPAD sums them as planes, which decides the bits of its codes. Of other sensors they are slices of an
        exposure. `ValueError` for a sum of other bits than those that are asked for, or that the sensor's file has.
        """
        if planes is None:
            return self
        depth = planes.bit_length()
        if self._leaves_bits_to_sums:
            return self.but(bits=depth).over(planes, bits)
        if planes == 1 or not self.device(5e-4).sums_planes:
            return self.but(group=False, slices=planes)
        if bits not in (None, depth):
            raise ArgumentError(
                "planes",
                f"a sum of {planes} planes has {depth} bits, and {bits} are asked for; give planes= or bits= alone",
            )
        if self._states_bits:
            devices.plane_bits(self.sensor, planes)  # refuses a file of other bits
        made = self.but(group=True, slices=1, bits=depth)
        if planes == 2**depth - 1 and self.record is None and not self._states_bits:
            return made
        plane = self.stated().device(5e-4)
        return replace(made, record=as_text(plane.of_planes(planes).to_dict()), defects=self.stated().defects)

    @property
    def _states_bits(self) -> bool:
        """Whether the sensor is a file that states the bits of its codes."""
        return self.record is None and "bits" in devices.table_of(self.sensor)

    @property
    def _leaves_bits_to_sums(self) -> bool:
        """Whether the sensor is a file of a clocked pixel without bits, which serves sums of any number of planes."""
        if self.record is not None or self.bits is not None:
            return False
        table = devices.table_of(self.sensor)
        model = devices.MODELS.get(str(table.get("model")))
        return model is not None and model.sums_planes and "bits" not in table

    def read_out_as(self, other: Illumination) -> Illumination:
        """Return the same with rows, shares and drift of another noise, and with its colour filters if it has none."""
        timed = self.but(**{name: getattr(other.sensing, name) for name in TIMES if name not in ("group", "slices")})
        return replace(timed, colour=self.colour or other.colour)

    def over_as_many_as(self, other: Illumination) -> Illumination:
        """Return the same with codes over as many clip frames as those of another noise.

        Where those are planes of a sum, one for each plane of this sensor's bits.
        """
        if other.sensing.summed and self.device(5e-4).sums_planes:
            return self.but(group=True)
        return self.over(other.planes)

    def but(self, **changes: Any) -> Illumination:
        """Return the same with other settings of `Sensing`."""
        return replace(self, sensing=replace(self.sensing, **changes))

    def stated(self) -> Illumination:
        """Return the same with all that the sensor's file states, so that a run does not depend on it.

        `ValueError` or `FileNotFoundError` for an unknown sensor, and for settings that training windows cannot have.
        """
        sensing = self.sensing
        refuse_others([name for name in given(sensing) if name not in HONOURED], self.sensor)
        if self.record is not None or self.defects is not None:
            return self
        file = sensing.sensor if isinstance(sensing.sensor, str) and sensing.sensor.endswith(".toml") else None
        colour = self._stated_colour(file)
        table = sensing.defects or file
        found = from_toml(table, needed=sensing.defects is not None) if isinstance(table, str) else table
        defects = None if found is None else as_text(found.to_dict())
        if isinstance(sensing.sensor, Sensor):
            devices.check_known(sensing.sensor)
            made = replace(sensing, sensor=self.sensor, bits=sensing.sensor.bits, defects=None, colour=None)
            return Illumination(made, as_text(sensing.sensor.to_dict()), defects, colour)
        if file is None:
            if sensing.temperature is not None:
                self.device(5e-4)  # raises: a named device has no law of temperature
            return Illumination(replace(sensing, defects=None, colour=None), None, defects, colour)
        bits = devices.load(file, bits=sensing.bits).bits
        record = as_text({**_with_own_spread(file, found), "bits": bits})
        return Illumination(replace(sensing, bits=bits, defects=None, colour=None), record, defects, colour)

    def _stated_colour(self, file: str | None) -> str | None:
        """Return the table [colour] of the settings or of the sensor's file, as JSON; None without filters."""
        found = filters_of(self.sensing)
        if self.colour is not None or found is None:
            return self.colour
        if file is not None and "qe_curve" in devices.table_of(file):
            raise ValueError(
                f"{file}: its filters follow qe_curve, and training windows need their efficiency; sense a stream with "
                "this file and train with the streams of the data set, or state [colour] efficiency"
            )
        return as_text(found.to_dict())

    @property
    def filters(self) -> ColourFilter | None:
        """The colour filters, from the first pixel of the full frame; None: one band."""
        return None if self.colour is None else stored_filters(self.colour)

    def device(self, exposure: float, wavelength: float | None = None) -> Sensor:
        """Return the sensor for codes of this exposure [s], in light of this wavelength [m, None: as cameras have]."""
        found = None if self.defects is None else stored_defects(self.defects)
        conditions = Conditions(self.sensing.temperature, wavelength, None if found is None else found.pattern.dark)
        if self.record is not None:
            return devices.of_table(json.loads(self.record), f"sensor of {self.sensor}", conditions)
        return devices.load(self.sensing.sensor, ppp=self.ppp, bits=self.bits, exposure=exposure, conditions=conditions)

    def draw(self, clip: Clip, seed: int = 0) -> Draw:
        """Return everything that decides the codes of a clip, with the defects of the sensor. `ValueError` if it does
        not fit the clip.
        """
        sensing = replace(self.sensing, seed=seed)
        if self.colour is not None:
            sensing = replace(sensing, colour=self.filters)
        if self.record is None and self.defects is None:
            return prepare(clip, sensing)
        found = None if self.defects is None else stored_defects(self.defects)
        if self.record is None:
            return assemble(clip, sensing, found)
        own = self.device(clip.exposure * self.planes, None if clip.camera is None else clip.camera.wavelength)
        return assemble(clip, replace(sensing, temperature=None), found, own)

    @property
    def others(self) -> list[str]:
        """The settings beside sensor, light and bits, as text: `diffraction`, `temperature 40`."""
        left_out = (*LEVEL, "seed", "name", "group", "slices")
        rest = {name: value for name, value in given(self.sensing).items() if name not in left_out}
        found = [name if value is True else f"{name} {_short(value)}" for name, value in rest.items()]
        if self.filters is not None:
            found.append(f"mask {' '.join(self.filters.mask)}")
        if self.planes == 1:
            return found
        return [f"{self.planes} {'planes' if self.sensing.summed else 'slices'}", *found]

    @property
    def light(self) -> str:
        """The light as text: `3.25 PPP`, `10 lx`, `own light`."""
        if self.sensing.lux is not None:
            return f"{self.sensing.lux:g} lx"
        return "own light" if self.ppp is None else f"{self.ppp:g} PPP"

    @property
    def label(self) -> str:
        """The text of tables: `3.25 PPP, 3 bit`."""
        bits = "own bits" if self.bits is None else f"{self.bits} bit"
        return ", ".join([self.light, bits, *self.others])


def _short(value: object) -> str:
    """Return the value of a setting as text."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def _with_own_spread(file: str, found: Defects | None) -> dict[str, Any]:
    """Return the table [sensor] of a file. A median dark rate follows the spread of the defects; where these have none,
    it becomes the mean by the spread that the file itself states, as in `devices.from_toml`.
    """
    table = dict(devices.table_of(file))
    median = table.get("median")
    own = from_toml(file)
    follows = found is not None and found.pattern.dark is not None
    if isinstance(median, float | int) and not follows and own is not None and own.pattern.dark is not None:
        table["median"] = median * own.pattern.dark.mean
    return table


def unlike_windows(stream: Stream) -> list[str]:
    """Return the settings of a stored stream that training windows cannot have."""
    unlike = [name for name in stream.info.settings if name not in (*HONOURED, *STATED)]
    stated = replace(stream.info.sensing, bits=stream.info.bits)
    planes = stream.sensor.levels - 1 if stated.summed else stated.frames
    if stream.timing != stated.timing(planes, stated.summed and planes > 1):
        unlike.append(f"codes of {stream.info.planes_per_code} clip frames that its settings do not state")
    return unlike


def refuse_others(names: Iterable[str], where: str) -> None:
    """Raise `ValueError` for settings that training windows cannot have, if there are any."""
    if unlike := ", ".join(names):
        raise ValueError(f"{where}: training windows cannot have {unlike}; {OTHERS}")


# ---- Names in tables


def short_name(sensor: str) -> str:
    """Return the name of a device, or of a file without folder and suffix."""
    return sensor.rpartition("/")[2].removesuffix(".toml")


def labels(lights: Iterable[Illumination]) -> dict[Illumination, str]:
    """Return the text of tables for each light: its label, and where several have one label, what tells them apart.

    That is the sensor's name, the path of its file, or that it has defects. `ValueError` where none of it does.
    """
    found = {light: light.label for light in lights}
    for form in (short_name, _in_its_folder, str):
        found |= {light: f"{light.label}, {form(light.sensor)}" for light in _of_one_label(found)}
    for light in _of_one_label(found):
        found[light] += ", defects" if light.defects is not None else ""
    for light in _of_one_label(found):
        raise ValueError(f"two different lights are both called {found[light]!r} in tables; leave one of them out")
    return found


def _in_its_folder(sensor: str) -> str:
    return "/".join(sensor.split("/")[-2:])


def _of_one_label(labels: Mapping[Illumination, str]) -> list[Illumination]:
    times = Counter(labels.values())
    return [light for light, text in labels.items() if times[text] > 1]


# ---- Sensors and their files


def read_sensor(source: str | Mapping[str, Any], bits: int | None = None) -> tuple[Sensor, Defects | None]:
    """Return the sensor of a file with its defects, or the sensor of a record. `ValueError` if its bits differ."""
    if isinstance(source, str):
        return devices.load(source, bits=bits), from_toml(source)
    return devices.from_dict(source), None


def file_digests(lights: Iterable[Illumination]) -> dict[str, str]:
    """Return the SHA-256 of what each sensor file of the lights states, with the maps of its defects.

    A light with a record states its sensor itself.
    """
    found: dict[str, str] = {}
    for path, bits in {light.sensor: light.bits for light in lights if light.record is None}.items():
        if path.endswith(".toml"):
            sensor, defects = read_sensor(path, bits)
            colour = colour_filter.from_toml(path)
            tables = (sensor.to_dict(), defects and defects.to_dict(), colour and colour.to_dict())
            found[path] = sha256(to_json(tables))
    return found


@lru_cache(maxsize=256)
def is_known(sensor: Sensor) -> bool:
    """Return whether a sensor is of a model of qsim, not of a class of one's own."""
    return devices.is_known(sensor)


def follows_light(sensor: str) -> bool:
    """Return whether the gain of a named sensor is set from the photons per pixel."""
    return sensor in devices.DEVICES and devices.DEVICES[sensor].follows_light


def ideal_clocked(planes: int = 1) -> Sensor:
    """Return a clocked SPAD that detects every photon and nothing else, whose codes sum so many planes."""
    return BinarySPAD(pde=1.0, dark_count_rate=0.0).of_planes(planes)


def ideal_counter(bits: int) -> Sensor:
    """Return a sensor that counts every photon up to 2^bits - 1, for measured photon counts."""
    return QIS(quantum_efficiency=1.0, dark_current=0.0, read_noise=0.0, bits=bits)


def as_text(values: Mapping[str, Any]) -> str:
    """Return JSON with sorted keys."""
    return json.dumps(values, sort_keys=True)


@lru_cache(maxsize=64)
def stored_filters(text: str) -> ColourFilter:
    """Return the colour filters of a table [colour] in JSON."""
    return colour_filter.from_dict(json.loads(text))


@lru_cache(maxsize=64)
def stored_defects(text: str) -> Defects:
    """Return the defects of a table [defects] in JSON."""
    return read_defects(json.loads(text))
