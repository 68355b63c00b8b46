"""Describes the noise of training windows: a sensor with its defects at a light level, as a stream stores it.

For networks that take the noise of codes as an input, `noise_table` gives their variance at every mean, from the
exact law of the sensor. One table serves training windows and restored streams alike.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.files import sha256, to_json
from qsim.sensor import colour_filter
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.defect_table import from_dict as read_defects
from qsim.sensor.sensor import Sensor
from qsim.streams.clip import Clip
from qsim.streams.sensing import Sensing, assemble
from qsim.streams.simulation import Draw
from qsim.streams.stream import Stream
from quiver.data.illumination import Illumination, read_sensor

OTHERS = "give --sensor, --bits and --ppp, in Python WindowSettings(lights=...)"  # where a stream's noise is of no use
NODES = 4097  # of a table; between nodes the variance is read along straight lines


@dataclass(frozen=True)
class Noise(Illumination):
    """A light level and a sensor as a stored stream describes them; it has the stated defects and no others."""

    lux: float | None = None  # on the faceplate, instead of `ppp`
    diffraction: bool = False
    record: str | None = None  # a sensor file's [sensor], as JSON; None: a named device
    defects: str | None = None  # a table [defects], as JSON; None: no defects

    @classmethod
    def of(cls, light: Illumination) -> Noise:
        """Return the noise of a sensor's name or file. `ValueError` or `FileNotFoundError` for an unknown one."""
        if isinstance(light, Noise):
            return light
        if not light.sensor.endswith(".toml"):
            return cls(light.sensor, light.ppp, light.bits)
        sensor, found = read_sensor(light.sensor, light.bits)
        if colour_filter.from_toml(light.sensor) is not None:
            raise ValueError(f"{light.sensor}: training windows have one band; leave its table [colour] out")
        return cls(
            light.sensor,
            light.ppp,
            sensor.bits,
            record=as_text(sensor.to_dict()),
            defects=None if found is None else as_text(found.to_dict()),
        )

    @classmethod
    def of_stream(cls, stream: Stream) -> Noise:
        """Return the noise of a stored stream. `ValueError` if training windows cannot have it."""
        meta = stream.meta
        where = stream.path.with_suffix(".json")
        planes = meta.get("planes_per_code") or 1
        if planes != 1:
            raise ValueError(f"{where}: a code takes {planes} clip frames, a training window one for each; {OTHERS}")
        if stream.rows is not None:
            raise ValueError(f"{where}: its rows have their own time, those of a training window have one; {OTHERS}")
        if stream.shares is not None:
            raise ValueError(
                f"{where}: its codes have different exposures, those of a training window have one; {OTHERS}"
            )
        name = str(meta.get("sensor_name") or stream.sensor.to_dict()["model"])
        named = "sensor_name" in meta and not name.endswith(".toml")
        ppp = meta.get("ppp_target")
        lux = meta.get("lux_target")
        if "ppp_target" not in meta:  # written by another program
            ppp = meta.get("ppp")
        if lux is not None and "pixel_pitch" in meta:  # of a clip without a camera: these lux are so many photons
            ppp = meta["ppp"]
            lux = None
        defects = meta.get("defects")
        return cls(
            name,
            ppp,
            stream.bits,
            lux,
            bool(meta.get("diffraction", False)),
            None if named else as_text(stream.sensor.to_dict()),
            None if defects is None else as_text(defects),
        )

    @classmethod
    def from_dict(cls, values: Any) -> Noise:
        """Return the inverse of `to_dict`; strict, `ValueError`.

        The files of defect maps may be missing here: they are read when codes are drawn.
        """
        if not isinstance(values, dict) or set(values) != {field.name for field in fields(cls)}:
            raise ValueError(f"noise has {', '.join(field.name for field in fields(cls))}; got {repr(values)[:100]}")
        for name, kinds in _KINDS.items():
            if isinstance(values[name], bool) != (kinds is bool) or not isinstance(values[name], kinds):
                raise ValueError(f"noise: {name} is {repr(values[name])[:100]}")
        if len(values["sensor"]) > 500:
            raise ValueError(f"noise: a sensor of {len(values['sensor'])} characters")
        texts = {name: None if values[name] is None else as_text(values[name]) for name in ("record", "defects")}
        found = cls(**(values | texts))
        if found.record is not None:
            _sensor(found.record)
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        texts = {name: getattr(self, name) for name in ("record", "defects")}
        return asdict(self) | {name: None if text is None else json.loads(text) for name, text in texts.items()}

    @property
    def level(self) -> str:
        """Return light and bits as text: `3.25 PPP, 3 bit`, `10 lx, 3 bit`."""
        return super().level if self.lux is None else f"{self.lux:g} lx, {self.bits} bit"

    @property
    def label(self) -> str:
        """Return the text of tables: `3.25 PPP, 3 bit, spad-320x240`."""
        return self.level if self.sensor == Illumination.sensor else f"{self.level}, {short_name(self.sensor)}"

    @property
    def simple(self) -> Illumination:
        """Return a plain `Illumination` if that holds everything, else this noise."""
        light = Illumination(self.sensor, self.ppp, self.bits)
        return light if Noise(self.sensor, self.ppp, self.bits) == self else self

    def sensing(self, seed: int = 0) -> Sensing:
        """Return the same as settings of `qsim sense`, without record and defects."""
        return Sensing(self.sensor, bits=self.bits, ppp=self.ppp, lux=self.lux, seed=seed, diffraction=self.diffraction)

    def device(self, exposure: float) -> Sensor:
        """Return the sensor for clips with this exposure [s]."""
        return super().device(exposure) if self.record is None else _sensor(self.record)

    def draw(self, clip: Clip, seed: int = 0) -> Draw:
        """Return everything that decides the codes of a clip. `ValueError` where this noise does not fit it."""
        own = None if self.record is None else _sensor(self.record)
        return assemble(clip, self.sensing(seed), None if self.defects is None else stored_defects(self.defects), own)


_KINDS: dict[str, Any] = {
    "sensor": str,
    "ppp": int | float | None,
    "bits": int | None,
    "lux": int | float | None,
    "diffraction": bool,
    "record": dict | None,
    "defects": dict | None,
}


def as_text(values: Mapping[str, Any]) -> str:
    """Return JSON with sorted keys."""
    return json.dumps(values, sort_keys=True)


@lru_cache(maxsize=64)
def _sensor(text: str) -> Sensor:
    return read_sensor(json.loads(text))[0]


@lru_cache(maxsize=64)
def stored_defects(text: str) -> Defects:
    """Return the defects of a table [defects] in JSON."""
    return read_defects(json.loads(text))


def short_name(sensor: str) -> str:
    """Return the name of a device, or of a file without folder and suffix."""
    return sensor.rpartition("/")[2].removesuffix(".toml")


def labels(lights: Iterable[Illumination]) -> dict[Illumination, str]:
    """Return the text of tables for each light: its label, and where several have one label, what tells them apart.

    That is the sensor's name, the path of its file, or diffraction and defects. `ValueError` where none of it does.
    """
    found = {light: light.label for light in lights}
    for form in (short_name, _in_its_folder, str):
        found |= {light: f"{light.level}, {form(light.sensor)}" for light in _of_one_label(found)}
    for light in _of_one_label(found):
        effects = [name for name in ("diffraction", "defects") if getattr(light, name, None)]
        found[light] = ", ".join([found[light], *effects])
    for light in _of_one_label(found):
        raise ValueError(f"two different lights are both called {found[light]!r} in tables; leave one of them out")
    return found


def _in_its_folder(sensor: str) -> str:
    return "/".join(sensor.split("/")[-2:])


def _of_one_label(labels: Mapping[Illumination, str]) -> list[Illumination]:
    times = Counter(labels.values())
    return [light for light, text in labels.items() if times[text] > 1]


def file_digests(lights: Iterable[Illumination]) -> dict[str, str]:
    """Return the SHA-256 of what each sensor file of the lights states, with the maps of its defects.

    A `Noise` states its sensor itself.
    """
    found: dict[str, str] = {}
    for path in dict.fromkeys(light.sensor for light in lights if not isinstance(light, Noise)):
        if path.endswith(".toml"):
            (sensor, defects), colour = read_sensor(path), colour_filter.from_toml(path)
            tables = (sensor.to_dict(), defects and defects.to_dict(), colour and colour.to_dict())
            found[path] = sha256(to_json(tables))
    return found


@lru_cache(maxsize=64)
def noise_table(sensor: Sensor, exposure: float) -> Array:
    """Return the variance of one code over 2^b - 1 at equal steps of its mean over 2^b - 1, float32 [NODES].

    Codes of `exposure` seconds. Below the mean of a dark pixel the variance is that of a dark pixel, and above the
    largest mean that of the brightest light. The array is shared and read-only. `ValueError` for a sensor whose mean
    code does not rise with light.
    """
    response = sensor.response(exposure)
    top = sensor.levels - 1
    steps = np.linspace(0, top, NODES)
    table = (np.interp(steps, response.mean, response.variance) / top**2).astype(np.float32)
    table.setflags(write=False)
    return table
