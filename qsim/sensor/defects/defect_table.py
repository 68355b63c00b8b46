"""The defects and the memory of a device as a user writes them, and the draws that need them. All off by default.

    [defects] of a sensor file --from_toml--> Flaws --of_sensor--> Flawed: a sensor and its maps --> codes

    # my_sensor.toml, below [sensor]; every line may be left out, and then changes no bit
    [defects]
    device_seed = 7                # which device of its kind: the fixed pattern is a function of it
    prnu = 0.01                    # relative standard deviation of the efficiency
    dark = { spread = 0.18, hot_share = 0.022, hot_from = 3.0, hot_to = 400.0, tail = 0.67 }   # of the dark rate
    dead = 0.001                   # share of pixels that never fire
    offset = 0.2                   # QIS: codes rms (with `dark`: the dark signal non-uniformity)
    read_noise = 0.1               # QIS: relative standard deviation of the read noise
    dark_map = "my_dark.npy"       # measured [H, W], beside this file: 1/s (its mean replaces the sensor's dark rate),
    gain_map = "my_gain.npy"       # efficiency over the sensor's,
    dead_map = "my_bad.npy"        # true where a pixel never fires,
    offset_map = "my_offset.npy"   # codes,
    read_noise_map = "my_rn.npy"   # e- rms
    crosstalk = 0.001              # chance that an avalanche sets off one given neighbour of the four
    afterpulse = 0.01              # clocked: chance that a plane that fired fires again in the next
    afterpulse_delay = 2e-8        # counting: s, mean delay of the afterpulse of a count
    carry_dead_time = true         # counting: a dead time goes on in the next exposure

Counting pixels whose light changes inside the exposure, whose dead time goes on, or that afterpulse are followed photon
by photon (events.py) where the largest of these effects passes events.TOLERANCE; below, the closed form draws.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import reduce
from math import ceil, log
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import files
from qsim.checks import suggest
from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects import event_simulation, fixed_pattern
from qsim.sensor.defects.fixed_pattern import DarkSpread, Defects, Maps
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import SPAD, BinarySPAD

_MAPS = {"gain_map": "prnu", "dark_map": "dark", "dead_map": "dead", "offset_map": "offset",
         "read_noise_map": "read_noise"}  # fmt: skip
_PATTERN = ("device_seed", "prnu", "dead", "offset", "read_noise")
_DISTURBANCES = ("crosstalk", "afterpulse", "afterpulse_delay")
_KEYS = (*_PATTERN, "dark", *_MAPS, *_DISTURBANCES, "carry_dead_time")
_STRIP_BYTES = 1 << 25  # of light in memory while single pixels are followed through a clip

Light = Callable[[int, int, int], Array]  # (frame, first row, rows) -> photons [slices, rows, W]


@dataclass(frozen=True)
class Flaws:
    """What a table [defects] says."""

    pattern: Defects = field(default_factory=Defects)
    maps: Mapping[str, str] = field(default_factory=dict)  # key of the table -> .npy file
    crosstalk: float = 0.0
    afterpulse: float = 0.0
    afterpulse_delay: float = 0.0  # s
    carry_dead_time: bool = False

    @property
    def none(self) -> bool:
        """Whether nothing is switched on."""
        pattern = replace(self.pattern, device_seed=0)
        return pattern == Defects() and not (self.maps or self.crosstalk or self.afterpulse or self.carry_dead_time)

    def to_dict(self) -> dict[str, Any]:
        """As written beside a stream; measured maps with their checksums."""
        pattern = {key: getattr(self.pattern, key) for key in _PATTERN if getattr(self.pattern, key)}
        if self.pattern.dark is not None:
            pattern["dark"] = asdict(self.pattern.dark)
        maps = {key: {"file": path, "sha256": files.sha256(Path(path))} for key, path in self.maps.items()}
        own = {key: getattr(self, key) for key in (*_DISTURBANCES, "carry_dead_time") if getattr(self, key)}
        return pattern | maps | own


def from_toml(path: str | Path) -> Flaws | None:
    """The table [defects] of a TOML file, None if there is none or all of it is off; strict, `ValueError`."""
    path = Path(path)
    table = files.read_toml(path, "file of defects").get("defects", {})
    if not isinstance(table, dict):
        raise ValueError(f"{path}: [defects] is a table, got {table!r}")
    found = {key: str((path.parent / table[key]).resolve()) for key in _MAPS if isinstance(table.get(key), str)}
    flaws = from_dict(table | found, f"{path}: [defects]")
    return None if flaws.none else flaws


def from_dict(table: Mapping[str, Any], where: str = "defects") -> Flaws:
    """Flaws of a table, or of what `to_dict` wrote, whose maps have to be unchanged; strict, `ValueError`."""
    for key in table:
        if key not in _KEYS:
            meant = suggest(key, _KEYS) or f"; known are {', '.join(_KEYS)}"
            raise ValueError(f"{where}: unknown key {key!r}{meant}")
    for name, pattern in _MAPS.items():
        if name in table and pattern in table:
            raise ValueError(f"{where}: {pattern} and {name} say the same thing twice; leave one out")
    dark = table.get("dark")
    if dark is not None and not isinstance(dark, Mapping):
        raise ValueError(f"{where}: dark is a table of {', '.join(f.name for f in fields(DarkSpread))}, got {dark!r}")
    for key in dark or {}:
        if key not in {f.name for f in fields(DarkSpread)}:
            raise ValueError(f"{where}: unknown key {key!r} of dark")
    if not isinstance(table.get("carry_dead_time", False), bool):
        raise ValueError(f"{where}: carry_dead_time is true or false, got {table['carry_dead_time']!r}")
    seed = table.get("device_seed", 0)
    if isinstance(seed, bool) or not isinstance(seed, int):
        raise ValueError(f"{where}: device_seed is a whole number, got {seed!r}")
    numbers = {key: table[key] for key in _PATTERN if key in table}
    disturbances = {key: _number(table[key], key, where) for key in _DISTURBANCES if key in table}
    try:
        spread = None if dark is None else DarkSpread(**dark)
        pattern_of_device = Defects(**numbers, dark=spread)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    maps = {key: _map_file(table[key], key, where) for key in _MAPS if key in table}
    for key in ("crosstalk", "afterpulse"):
        if not 0 <= disturbances.get(key, 0.0) < 1:
            raise ValueError(f"{where}: {key} is a probability below 1, got {table[key]!r}")
    return Flaws(pattern_of_device, maps, **disturbances, carry_dead_time=table.get("carry_dead_time", False))


def _number(value: Any, key: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < float("inf"):
        raise ValueError(f"{where}: {key} is a number of at least 0, got {value!r}")
    return float(value)


def _map_file(value: Any, key: str, where: str) -> str:
    """The path of a map that is there and, where a checksum is given, unchanged."""
    path, digest = (value.get("file"), value.get("sha256")) if isinstance(value, Mapping) else (value, None)
    if not isinstance(path, str):
        raise ValueError(f"{where}: {key} is the name of a .npy file, got {value!r}")
    if not Path(path).is_file():
        raise FileNotFoundError(f"{where}: {key}: {path}: no such file")
    if digest is not None and files.sha256(Path(path)) != digest:
        raise ValueError(f"{where}: {key}: {path} has changed since the stream was drawn")
    return path


# ---- A sensor with its maps


@dataclass(frozen=True, eq=False)
class Flawed:
    """A sensor whose pixels differ: its record, the maps of one frame size, and what disturbs the draw."""

    sensor: Sensor
    maps: Maps
    flaws: Flaws

    @property
    def memory(self) -> bool:
        """Whether a frame depends on those before it."""
        return bool(self.flaws.afterpulse and isinstance(self.sensor, BinarySPAD))

    @property
    def follows_photons(self) -> bool:
        """Whether a counting pixel remembers the exposure before."""
        return isinstance(self.sensor, CountingSPAD) and bool(self.flaws.carry_dead_time or self.flaws.afterpulse)

    @property
    def reach(self) -> int:
        """Pixels beyond a crop that its codes depend on."""
        return 1 if self.flaws.crosstalk else 0

    def lead(self, chance: float) -> int:
        """Frames before a frame after which what went before matters with this chance at most."""
        if not (self.memory and isinstance(self.sensor, BinarySPAD)):
            return 0
        return ceil(log(chance) / log(self.flaws.afterpulse) / self.sensor.planes)

    def crop(self, y: int, x: int, height: int, width: int) -> Flawed:
        """A part of the frame, with the maps of its pixels."""
        return replace(self, maps=self.maps.crop(y, x, height, width))

    def blocks(
        self,
        photons: Iterable[Array],
        exposure: float,
        key: Key,
        origin: tuple[int, int] = (0, 0),
        engine: str | fixed_pattern.Sampler = "auto",
    ) -> Iterator[Array]:
        """Codes of successive blocks of photons [t, H, W], the first of which is frame key.frame.

        `origin` (y, x) places a crop in the full frame; `engine` as in `defects.sample_after`.
        """
        afterpulse = self.flaws.afterpulse if isinstance(self.sensor, BinarySPAD) else 0.0
        before = None
        for block in photons:
            codes, before = fixed_pattern.sample_after(
                before,
                self.sensor,
                block,
                exposure,
                key=key,
                maps=self.maps,
                disturbances=(afterpulse, self.flaws.crosstalk),
                origin=origin,
                engine=engine,
            )
            key = key.at(key.frame + len(block)) if key.frame + len(block) < 2**32 else key
            yield codes


def of_sensor(flaws: Flaws, sensor: Sensor, height: int, width: int) -> Flawed:
    """The maps of the device for frames of this size; `ValueError` where they do not fit the sensor or the size.

    Measured maps may be larger: frames lie in their upper left corner.
    """
    _check_model(flaws, sensor)
    drawn = fixed_pattern.draw_maps(flaws.pattern, (height, width))
    measured: dict[str, Array] = {}
    for key, path in flaws.maps.items():
        whole = _read_map(path, key)
        if whole.shape[0] < height or whole.shape[1] < width:
            raise ValueError(
                f"{path}: the {key} has {whole.shape[0]} x {whole.shape[1]} pixels, the frames {height} x {width}; "
                "a map covers the whole sensor"
            )
        name = key.removesuffix("_map")
        if name == "dark":
            rate, whole = fixed_pattern.measured_dark_map(whole)
            sensor = _with_dark(sensor, rate)
        elif name == "read_noise" and isinstance(sensor, QIS):
            if not sensor.read_noise:
                raise ValueError(f"{path}: a map of read noise needs a sensor whose read_noise is above 0")
            whole = whole / sensor.read_noise
        measured[name] = whole[:height, :width] != 0 if name == "dead" else whole[:height, :width]
    return Flawed(sensor, replace(drawn, **measured), flaws)


def _check_model(flaws: Flaws, sensor: Sensor) -> None:
    """`ValueError` for what this model of sensor cannot have."""
    name = type(sensor).__name__
    read_out = flaws.pattern.offset or flaws.pattern.read_noise or {"offset_map", "read_noise_map"} & set(flaws.maps)
    if read_out and not isinstance(sensor, QIS):
        raise ValueError(f"defects: a {name} has no read-out; offset and read_noise are for a QIS")
    if isinstance(sensor, QIS) and (flaws.afterpulse or flaws.crosstalk):
        raise ValueError("defects: a QIS has no avalanches, so neither afterpulse nor crosstalk")
    counting = isinstance(sensor, CountingSPAD)
    if (flaws.carry_dead_time or flaws.afterpulse_delay) and not counting:
        raise ValueError(f"defects: carry_dead_time and afterpulse_delay are for a CountingSPAD, this is a {name}")
    if counting and flaws.afterpulse and not flaws.afterpulse_delay:
        raise ValueError("defects: afterpulse of a counting pixel needs afterpulse_delay in seconds")


def _with_dark(sensor: Sensor, rate: float) -> Sensor:
    if isinstance(sensor, QIS):
        return replace(sensor, dark_current=rate)
    if isinstance(sensor, SPAD):
        return replace(sensor, dark_count_rate=rate)
    raise ValueError(f"{type(sensor).__name__}: unknown to the dark map")


def _read_map(path: str, key: str) -> Array:
    array = np.array(files.load_array(Path(path)))
    if array.ndim != 2 or not array.size or array.dtype.kind not in "fuib" or not np.isfinite(array).all():
        raise ValueError(f"{path}: a {key} is [H, W] of finite numbers, found {array.dtype} {list(array.shape)}")
    if key != "offset_map" and (array < 0).any():
        raise ValueError(f"{path}: a {key} has no negative values")
    return array


# ---- Counting pixels, photon by photon


def memory_of(flaws: Flaws | None) -> event_simulation.Memory:
    """What counting pixels remember."""
    if flaws is None:
        return event_simulation.Memory()
    return event_simulation.Memory(flaws.carry_dead_time, flaws.afterpulse, flaws.afterpulse_delay)


def effects(
    flawed: Flawed, light: Light, shape: tuple[int, int, int], exposure: float, frame_time: float
) -> event_simulation.Effects:
    """The largest effects of a clip [T, H, W] that a closed form would miss."""
    frames, height, _ = shape
    each = (
        event_simulation.effects(sensor, photons[None], exposure, frame_time, memory_of(flawed.flaws))
        for sensor, photons in (_lit(flawed, light(t, 0, height), 0, exposure) for t in range(frames))
    )
    return reduce(_largest, each)


def _largest(a: event_simulation.Effects, b: event_simulation.Effects) -> event_simulation.Effects:
    return event_simulation.Effects(
        *(max(getattr(a, f.name), getattr(b, f.name)) for f in fields(event_simulation.Effects))
    )


def _lit(flawed: Flawed, photons: Array, row: int, exposure: float) -> tuple[CountingSPAD, Array]:
    """Light [slices, rows, W] of rows from `row` on, with the pixels' own efficiencies and dark rates in it."""
    slices, rows, width = photons.shape
    sensor, light = fixed_pattern.lit(flawed.sensor, photons, exposure / slices, flawed.maps.crop(row, 0, rows, width))
    assert isinstance(sensor, CountingSPAD)
    return sensor, light


def follow(
    flawed: Flawed, light: Light, shape: tuple[int, int, int], exposure: float, frame_time: float, key: Key
) -> Array:
    """Codes [T, H, W] of a clip, every pixel followed photon by photon from the first frame on; slow."""
    frames, height, width = shape
    codes = np.empty(shape, flawed.sensor.dtype)
    memory, top = memory_of(flawed.flaws), flawed.sensor.levels - 1
    slices = len(light(0, 0, 1))
    step = max(1, _STRIP_BYTES // (8 * frames * slices * width))
    for y in range(0, height, step):
        rows = min(step, height - y)
        parts = [_lit(flawed, light(t, y, rows), y, exposure) for t in range(frames)]
        sensor, photons = parts[0][0], np.stack([part for _, part in parts])
        for i, x in np.ndindex(rows, width):
            rng = event_simulation.pixel_stream(key, y + i, x)
            counts = event_simulation.simulate(sensor, photons[:, :, i, x], exposure, frame_time, memory, rng)
            codes[:, y + i, x] = np.minimum(counts, top)
    if flawed.maps.dead is not None:
        codes[:, flawed.maps.dead] = 0
    return codes
