"""Chooses the noise of training windows: that of a data set's streams, changed by options."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from qsim.checks import ArgumentError
from qsim.dataset.clip_list import ClipList
from qsim.streams.clip import Clip
from qsim.streams.stream import Stream
from quiver.data.illumination import Illumination, as_text, short_name, unlike_windows


@dataclass(frozen=True)
class Mixture:
    """The noises of which every window draws one, and a remark on the choice."""

    noises: tuple[Illumination, ...]
    remark: str = ""  # its source, if not the streams
    streams: tuple[Illumination, ...] = ()  # of the clips

    @property
    def lines(self) -> list[str]:
        """Return one line on the noise, and a second one where the streams of the data set differ."""
        lines = [f"noise: {describe(self.noises)}" + (f" ({self.remark})" if self.remark else "")]
        if self.streams and set(self.streams) != set(self.noises):
            lines.append(f"this differs from the data set's streams: {describe(self.streams)}")
        return lines


def choose(
    clips: Sequence[Clip],
    sensors: Sequence[str] | None = None,
    ppp: Sequence[float] | None = None,
    bits: Sequence[int] | None = None,
    temperature: float | None = None,
    planes: int | None = None,
) -> Mixture:
    """Return the noise of the clips' streams, changed to the requested sensors, light levels [photons/pixel] and bits.

    In a data set the streams of the first clip of each series stand for those of all (`ClipList.alike`).
    A requested sensor has the light, bits, clip frames per code and defects of its streams. Without any, it has light,
    bits and clip frames of other streams, and the defects of its file, at `temperature` [degrees C]. Without streams,
    the default sensor and light are used. Codes over `planes` clip frames are those of `Illumination.over`.
    `ValueError` for a stream whose noise training windows cannot have, and for a temperature without sensors.
    """
    if temperature is not None and not sensors:
        raise ArgumentError("temperature", "is that of sensor files, and streams have theirs; name the sensor, too")
    asked = bool(sensors or ppp or bits or planes)
    streams = _streams(clips)
    if sensors and ppp and (bits or all(map(_is_file, sensors))):  # the streams decide nothing
        streams = [stream for stream in streams if not unlike_windows(stream)]
    found = _sorted(streams)
    if not asked:
        default = "" if found else "the default; the data set has no streams"
        return Mixture(found or (Illumination(),), default, found)
    base = tuple(noise for noise in found if noise.sensor in (sensors or ())) or found or (Illumination(),)
    asked_for: list[Illumination] = []
    for sensor in sensors or (None,):
        own = tuple(noise for noise in base if noise.sensor == sensor) or base
        asked_for += [
            _changed(noise, sensor, level, depth, temperature, planes)
            for noise in own
            for depth in bits or (None,)
            for level in ppp or (None,)
        ]
    return Mixture(_unique(asked_for), "as asked for", found)


def _streams(clips: Sequence[Clip]) -> list[Stream]:
    return [clip.stream(name) for clip in ClipList.of(clips).alike() for name in clip.streams]


def _is_file(sensor: str) -> bool:
    """Return whether a sensor is a file, which states its bits."""
    return sensor.endswith(".toml")


def _unique(noises: Iterable[Illumination]) -> tuple[Illumination, ...]:
    return tuple(dict.fromkeys(noises))


def _sorted(streams: Iterable[Stream]) -> tuple[Illumination, ...]:
    """Return the noise of each stream once, in an order that does not depend on the names of streams."""
    found = _unique(Illumination.of_stream(stream) for stream in streams)
    return tuple(sorted(found, key=_place))


def _place(noise: Illumination) -> tuple[object, ...]:
    """Return what noises are sorted by."""
    return noise.sensor, noise.bits or 0, noise.sensing.lux or 0.0, noise.ppp or 0.0, as_text(noise.to_dict())


def _changed(
    noise: Illumination,
    sensor: str | None,
    ppp: float | None,
    bits: int | None,
    temperature: float | None,
    planes: int | None,
) -> Illumination:
    """Return a noise with the requested changes."""
    if sensor is not None and (sensor != noise.sensor or _is_file(sensor) or temperature is not None):
        depth = bits if bits is not None or _is_file(sensor) else noise.bits
        fresh = Illumination.of(sensor, noise.ppp, depth, temperature=temperature).over(planes, bits).stated()
        fresh = fresh.but(lux=noise.sensing.lux, diffraction=noise.sensing.diffraction).read_out_as(noise)
        noise = fresh if planes is not None else fresh.over_as_many_as(noise)
    if ppp is not None:
        noise = noise.but(ppp=ppp, lux=None)
    if bits is not None and bits != noise.bits:
        if noise.record is not None:
            raise ValueError(
                f"{noise.sensor}: the file has bits = {noise.bits}, the request {bits}; change one of them"
            )
        noise = noise.but(bits=bits)
    return noise.over(planes, bits)


# ---- Description


def describe(noises: Sequence[Illumination]) -> str:
    """Return the text for people: `spad-320x240, 1 bit, 1 and 10 PPP, dark-count map; quiver-physical, 3 bits, 3.25
    PPP`.
    """
    levels: dict[tuple[str, str, int | None], list[str]] = {}
    for noise in noises:
        effects = ", ".join([*_effects(noise), *noise.others])
        levels.setdefault((short_name(noise.sensor), effects, noise.bits), []).append(noise.light)
    depths: dict[tuple[str, str, tuple[str, ...]], list[int | None]] = {}
    for (sensor, effects, bits), found in levels.items():
        depths.setdefault((sensor, effects, tuple(found)), []).append(bits)
    return "; ".join(
        ", ".join(part for part in (sensor, _bits(bits), _joined(found), effects) if part)
        for (sensor, effects, found), bits in depths.items()
    )


def _joined(levels: Sequence[str]) -> str:
    """Return `1 and 10 PPP` for `1 PPP` and `10 PPP`."""
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


def _effects(noise: Illumination) -> list[str]:
    """Return the names of the defects."""
    if noise.defects is None:
        return []
    table = json.loads(noise.defects)
    record = {} if noise.record is None else json.loads(noise.record)
    named = Illumination.of(noise.sensor, noise.ppp or 1.0, noise.bits)
    model = record.get("model") or type(named.device(5e-4)).__name__
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
