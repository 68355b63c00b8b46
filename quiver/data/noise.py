"""What training windows are drawn by: sensors with their defects, at light levels, as the data set's streams have them.

    streams of the clips, options -> choose -> Mixture of Noise;    Noise, clip, place -> window_codes

A window's defects are those of its place in the full frame, so a pixel has the same ones as in `qsim sense`. What
reaches into a window from outside is drawn with a margin: the neighbours' crosstalk, and the afterpulses of the frames
before, as far as the clip has them. Counting pixels that remember an earlier exposure are refused.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy import ndarray as Array

from quiver.data.codes import (
    Clip,
    Draw,
    Flawed,
    Flaws,
    Key,
    Light,
    Sensing,
    Sensor,
    Stream,
    assemble,
    clip_photons,
    draw_codes,
    of_sensor,
    read_defects,
    read_sensor,
)

NEGLIGIBLE = 1e-6  # chance of an afterpulse chain that is as long as the frames before a window


@dataclass(frozen=True)
class Noise(Light):
    """A light level and all that a stored stream says of what sees it; defects are those named here and no others."""

    lux: float | None = None  # on the faceplate, instead of `ppp`
    diffraction: bool = False
    record: str | None = None  # a sensor file's [sensor], as JSON; None: a named device
    defects: str | None = None  # a table [defects], as JSON; None: no defects

    @classmethod
    def of(cls, light: Light) -> Noise:
        """What a sensor's name or file means now; `ValueError` or `FileNotFoundError` where it means nothing."""
        if isinstance(light, Noise):
            return light
        if not light.sensor.endswith(".toml"):
            return cls(light.sensor, light.ppp, light.bits)
        sensor, flaws = read_sensor(light.sensor, light.bits)
        return cls(
            light.sensor,
            light.ppp,
            sensor.bits,
            record=_text(sensor.to_dict()),
            defects=None if flaws is None else _text(flaws.to_dict()),
        )

    @classmethod
    def of_stream(cls, stream: Stream) -> Noise:
        """What a stored stream was drawn by; `ValueError` for one that training windows cannot be drawn as."""
        meta, where = stream.meta, stream.path.with_suffix(".json")
        planes = meta.get("planes_per_code") or 1
        if planes != 1:
            raise ValueError(
                f"{where}: a code takes {planes} clip frames, a training window one for each; give --sensor, --bits "
                "and --ppp"
            )
        name = str(meta.get("sensor_name") or stream.sensor.to_dict()["model"])
        named = "sensor_name" in meta and not name.endswith(".toml")
        ppp, lux = meta.get("ppp_target"), meta.get("lux_target")
        if "ppp_target" not in meta:  # not drawn by us
            ppp = meta.get("ppp")
        defects = meta.get("defects")
        return cls(
            name,
            ppp,
            stream.bits,
            lux,
            bool(meta.get("diffraction", False)),
            None if named else _text(stream.sensor.to_dict()),
            None if defects is None else _text(defects),
        )

    @classmethod
    def from_dict(cls, values: Any) -> Noise:
        """Inverse of `to_dict`; strict, `ValueError`. Maps of defects may be elsewhere: they are read when drawn."""
        if not isinstance(values, dict) or set(values) != {field.name for field in fields(cls)}:
            raise ValueError(f"noise has {', '.join(field.name for field in fields(cls))}; got {repr(values)[:100]}")
        for name, kinds in _KINDS.items():
            if isinstance(values[name], bool) != (kinds is bool) or not isinstance(values[name], kinds):
                raise ValueError(f"noise: {name} is {repr(values[name])[:100]}")
        if len(values["sensor"]) > 500:
            raise ValueError(f"noise: a sensor of {len(values['sensor'])} characters")
        texts = {name: None if values[name] is None else _text(values[name]) for name in ("record", "defects")}
        found = cls(**(values | texts))
        if found.record is not None:
            _sensor(found.record)
        return found

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        texts = {name: getattr(self, name) for name in ("record", "defects")}
        return asdict(self) | {name: None if text is None else json.loads(text) for name, text in texts.items()}

    @property
    def label(self) -> str:
        """`3.25 PPP, 3 bit, spad-320x240`"""
        light = super().label if self.lux is None else f"{self.lux:g} lx, {self.bits} bit"
        return light if self.sensor == Light.sensor else f"{light}, {_short(self.sensor)}"

    @property
    def simple(self) -> Light:
        """The same as a plain `Light`, where it says no more than that."""
        light = Light(self.sensor, self.ppp, self.bits)
        return light if Noise(self.sensor, self.ppp, self.bits) == self else self

    def sensing(self, seed: int = 0) -> Sensing:
        """The same in qsim's words, without record and defects."""
        return Sensing(self.sensor, bits=self.bits, ppp=self.ppp, lux=self.lux, seed=seed, diffraction=self.diffraction)

    def device(self, exposure: float) -> Sensor:
        """The sensor for clips with this exposure [s]."""
        return super().device(exposure) if self.record is None else _sensor(self.record)

    def draw(self, clip: Clip, seed: int = 0) -> Draw:
        """All that decides the codes of a clip; `ValueError` where this noise does not fit it."""
        own = None if self.record is None else _sensor(self.record)
        return assemble(clip, self.sensing(seed), None if self.defects is None else _flaws(self.defects), own)


_KINDS: dict[str, Any] = {
    "sensor": str,
    "ppp": int | float | None,
    "bits": int | None,
    "lux": int | float | None,
    "diffraction": bool,
    "record": dict | None,
    "defects": dict | None,
}


def _text(values: Mapping[str, Any]) -> str:
    return json.dumps(values, sort_keys=True)


@lru_cache(maxsize=64)
def _sensor(text: str) -> Sensor:
    return read_sensor(json.loads(text))[0]


@lru_cache(maxsize=64)
def _flaws(text: str) -> Flaws:
    return read_defects(json.loads(text))


def _short(sensor: str) -> str:
    return sensor.rpartition("/")[2].removesuffix(".toml")


# ---- The mixture of a training run


@dataclass(frozen=True)
class Mixture:
    """What every window draws one of, and what there is to say of the choice."""

    noises: tuple[Noise, ...]
    remark: str = ""  # where it comes from, if not from the streams
    streams: tuple[Noise, ...] = ()  # of the clips

    @property
    def lines(self) -> list[str]:
        """One line for people, and one more where the data set's streams say something else."""
        told = [f"noise: {describe(self.noises)}" + (f" ({self.remark})" if self.remark else "")]
        if self.streams and set(self.streams) != set(self.noises):
            told.append(f"this differs from the data set's streams: {describe(self.streams)}")
        return told


def choose(
    clips: Sequence[Clip],
    sensors: Sequence[str] | None = None,
    ppp: Sequence[float] | None = None,
    bits: Sequence[int] | None = None,
) -> Mixture:
    """The noise of the clips' streams, with the sensors, light levels [photons/pixel] and bits that are asked for.

    Where sensors are asked for, streams of these are taken if there are any. Without streams the default sensor and
    light stand in for them. `ValueError` for a stream that training windows cannot be drawn as.
    """
    asked = bool(sensors or ppp or bits)
    streams = _streams(clips)
    if sensors and ppp and bits:  # nothing is left to the streams, whatever they are
        streams = [stream for stream in streams if (stream.meta.get("planes_per_code") or 1) == 1]
    found = _sorted(streams)
    if not asked:
        default = "" if found else "the default; the data set has no streams"
        return Mixture(found or (Noise(),), default, found)
    base = tuple(noise for noise in found if noise.sensor in (sensors or ())) or found or (Noise(),)
    asked_for = [
        _changed(noise, sensor, level, depth)
        for noise in base
        for sensor in sensors or (None,)
        for depth in bits or (None,)
        for level in ppp or (None,)
    ]
    return Mixture(_unique(asked_for), "as asked for", found)


def _streams(clips: Sequence[Clip]) -> list[Stream]:
    return [clip.stream(name) for clip in clips for name in clip.streams]


def _unique(noises: Iterable[Noise]) -> tuple[Noise, ...]:
    return tuple(dict.fromkeys(noises))


def _sorted(streams: Iterable[Stream]) -> tuple[Noise, ...]:
    """What streams were drawn by, each once, in an order that does not depend on their names."""
    found = _unique(Noise.of_stream(stream) for stream in streams)
    return tuple(sorted(found, key=lambda n: (n.sensor, n.bits or 0, n.lux or 0.0, n.ppp or 0.0, _text(n.to_dict()))))


def _changed(noise: Noise, sensor: str | None, ppp: float | None, bits: int | None) -> Noise:
    """A noise with the parts that were asked for."""
    if sensor is not None and (sensor != noise.sensor or sensor.endswith(".toml")):
        depth = bits if bits is not None or sensor.endswith(".toml") else noise.bits
        fresh = Noise.of(Light(sensor, noise.ppp, depth))
        noise = replace(fresh, lux=noise.lux, diffraction=noise.diffraction)
    if ppp is not None:
        noise = replace(noise, ppp=ppp, lux=None)
    if bits is not None and bits != noise.bits:
        if noise.record is not None:
            raise ValueError(f"{noise.sensor}: the file says bits = {noise.bits}, asked for {bits}; change one of them")
        noise = replace(noise, bits=bits)
    return noise


# ---- In words


def describe(noises: Sequence[Noise]) -> str:
    """`spad-320x240, 1 bit, 1 and 10 PPP, dark-count map; quiver-physical, 3 bits, 3.25 PPP`"""
    levels: dict[tuple[str, str, int | None], list[str]] = {}
    for noise in noises:
        effects = ", ".join([*_effects(noise), *(["diffraction"] if noise.diffraction else [])])
        levels.setdefault((_short(noise.sensor), effects, noise.bits), []).append(_level(noise))
    depths: dict[tuple[str, str, tuple[str, ...]], list[int | None]] = {}
    for (sensor, effects, bits), found in levels.items():
        depths.setdefault((sensor, effects, tuple(found)), []).append(bits)
    return "; ".join(
        ", ".join(part for part in (sensor, _bits(bits), _joined(found), effects) if part)
        for (sensor, effects, found), bits in depths.items()
    )


def _level(noise: Noise) -> str:
    return f"{noise.lux:g} lx" if noise.lux is not None else "own light" if noise.ppp is None else f"{noise.ppp:g} PPP"


def _joined(levels: Sequence[str]) -> str:
    """`1 and 10 PPP` of `1 PPP` and `10 PPP`."""
    units = {text.rpartition(" ")[2] for text in levels}
    if len(units) == 1:
        unit = units.pop()
        return f"{_and([text.rpartition(' ')[0] for text in levels])} {unit}"
    return _and(levels)


def _bits(bits: Sequence[int | None]) -> str:
    text = _and(["the sensor's own" if b is None else str(b) for b in bits])
    return f"{text} {'bit' if list(bits) == [1] else 'bits'}"


def _and(words: Sequence[str]) -> str:
    return " and ".join(part for part in (", ".join(words[:-1]), words[-1]) if part)


def _effects(noise: Noise) -> list[str]:
    """The defects, in words."""
    if noise.defects is None:
        return []
    table = json.loads(noise.defects)
    record = {} if noise.record is None else json.loads(noise.record)
    model = record.get("model") or type(Light(noise.sensor, noise.ppp or 1.0, noise.bits).device(5e-4)).__name__
    dark = "dark-current" if model == "QIS" else "dark-count"
    words = {
        "dark_map": f"{dark} map",
        "dark": f"{dark} spread",
        "gain_map": "gain map",
        "prnu": "PRNU {:.3g} %",
        "dead_map": "map of dead pixels",
        "dead": "{:.3g} % dead pixels",
        "offset_map": "offset map",
        "offset": "offsets",
        "read_noise_map": "read-noise map",
        "read_noise": "spread of read noise",
        "crosstalk": "crosstalk",
        "afterpulse": "afterpulses",
    }
    return [text.format(100 * table[key]) if "{" in text else text for key, text in words.items() if table.get(key)]


# ---- Drawing a window


class Placed(Protocol):
    """Where a window lies in its clip."""

    @property
    def start(self) -> int: ...
    @property
    def y(self) -> int: ...
    @property
    def x(self) -> int: ...
    @property
    def drift(self) -> tuple[int, int]: ...
    @property
    def backwards(self) -> bool: ...
    @property
    def key(self) -> Key: ...


@lru_cache(maxsize=16)
def _defective(flaws: str, sensor: Sensor, shape: tuple[int, int]) -> Flawed:
    return of_sensor(_flaws(flaws), sensor, *shape)


def check_windows(noise: Noise, clip: Clip) -> None:
    """`ValueError` if windows of this clip cannot be drawn with this noise, each on its own."""
    draw = noise.draw(clip)
    if noise.defects is not None:
        flawed = _defective(noise.defects, draw.plane, clip.shape[1:])
        if flawed.follows_photons:
            raise ValueError(
                f"{noise.sensor}: carry_dead_time and afterpulse of counting pixels reach from exposure to exposure, "
                "which training windows cannot follow; give --sensor with a file without them"
            )


def window_codes(
    noise: Noise, draw: Draw, clip: Clip, place: Placed, frames: int, side: int, scale: float = 1.0
) -> Array:
    """Codes [T, side, side] of a window with defects, in the order in which its frames are seen, not turned.

    The codes of `qsim sense` under `place.key`, cropped, as far as both draw the same numbers. `draw` is the noise for
    this clip, `scale` a factor on the light. A crop that drifts keeps the pixels of its first place: the scene moves,
    the sensor does not.
    """
    assert noise.defects is not None
    flawed = _defective(noise.defects, draw.plane, clip.shape[1:])
    length, height, width = clip.shape
    before = length - place.start - frames if place.backwards else place.start
    lead = min(flawed.lead(NEGLIGIBLE), before)
    (dy, dx), last, reach = place.drift, frames - 1, flawed.reach
    y, x = (sorted((first, first + last * way)) for first, way in zip((place.y, place.x), (dy, dx), strict=True))
    top, left = min(reach, y[0]), min(reach, x[0])
    rows = top + side + min(reach, height - y[1] - side)
    columns = left + side + min(reach, width - x[1] - side)

    def light(i: int) -> Array:
        moved = min(max(i, 0), last)  # frames outside of the window are seen from its ends
        crop = (place.y + dy * moved - top, place.x + dx * moved - left, rows, columns)
        return scale * clip_photons(clip, place.start + i, draw.level.factor, crop, diffraction=draw.diffraction)

    order = range(last + lead, -1, -1) if place.backwards else range(-lead, frames)
    stack = np.stack([light(i) for i in order])
    origin = (place.y - top, place.x - left)
    part = flawed.crop(*origin, rows, columns)
    key = place.key.at(place.start - lead if not place.backwards else 0)
    codes = next(part.blocks([stack], clip.exposure, key, origin, draw_codes))
    return codes[lead:, top : top + side, left : left + side]
