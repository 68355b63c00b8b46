"""The one door from quiver to qsim: clips, light levels, streams, noise, files and console.

    clip, light -> codes [T, H, W] with all that a restorer must know; and the sharp photons it should return

Nothing here needs torch. Training windows, a `torch` data set, are in samples.py.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import __version__, keys
from qsim.checks import suggest
from qsim.cli.completion import add_completion
from qsim.cli.console import GOES_ON, STARTS_AGAIN, Parser, bar, command, note, output, run
from qsim.clip.clip import Clip
from qsim.clip.simulation import Draw, assemble
from qsim.clip.stream import Sensing, Stream, describe, prepare
from qsim.dataset.dataset import Dataset
from qsim.files import (
    Lock,
    check_ours,
    read_json,
    replacing,
    sealed,
    sha256,
    sync_folder,
    to_json,
    write_bytes,
    write_json,
)
from qsim.formats.array_files import load_npy
from qsim.formats.recording import reading
from qsim.keys import Key, hash_name
from qsim.optics.radiometry import WHITE_PER_MEAN, clip_photons, light_level
from qsim.sensor import devices
from qsim.sensor.defects.defect_table import Flawed, Flaws, from_toml, of_sensor
from qsim.sensor.defects.defect_table import from_dict as read_defects
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD
from quiver.data.code_table import TABLE_BITS, CodeTable

__all__ = [
    "GOES_ON",
    "STARTS_AGAIN",
    "Clip",
    "Codes",
    "Draw",
    "Flawed",
    "Flaws",
    "Key",
    "Light",
    "Lock",
    "Parser",
    "Sensing",
    "Sensor",
    "Stream",
    "__version__",
    "add_completion",
    "array_codes",
    "assemble",
    "bar",
    "check_ours",
    "clip_photons",
    "command",
    "cube_codes",
    "draw_codes",
    "follows_light",
    "has_sharp",
    "ideal_counter",
    "known",
    "light_level",
    "mean_light",
    "note",
    "of_sensor",
    "open_clips",
    "open_stream",
    "output",
    "peak_of",
    "read_defects",
    "read_json",
    "read_sensor",
    "reading",
    "replacing",
    "run",
    "sealed",
    "sensed",
    "sha256",
    "stored",
    "stream_codes",
    "suggest",
    "sync_folder",
    "truth",
    "windows_sensed",
    "write_bytes",
    "write_json",
]


DIGEST_BYTES = 1 << 24  # of an array, hashed at a time
PLANE_PIXELS = 1 << 24  # of packed planes that are unpacked at a time: 16 MB
WINDOW_STAGE = 1000  # of the random keys of published test windows, + frame; 0 is `qsim sense`


@dataclass(frozen=True)
class Light:
    """A light level and the sensor that sees it."""

    sensor: str = "quiver-physical"  # a named device of qsim, or a TOML file
    ppp: float | None = 3.25  # mean photons per pixel and exposure over the clip; None = the clip's own light
    bits: int | None = 3  # None = the device's own

    def device(self, exposure: float) -> Sensor:
        """The sensor for clips with this exposure [s]."""
        return _device(self, exposure)

    def sensing(self, seed: int = 0) -> Sensing:
        """The same in qsim's words."""
        return Sensing(self.sensor, bits=self.bits, ppp=self.ppp, seed=seed)

    def draw(self, clip: Clip, seed: int = 0) -> Draw:
        """All that decides the codes of a clip, with the defects of a sensor file; `ValueError` if it does not fit."""
        return prepare(clip, self.sensing(seed))

    @property
    def label(self) -> str:
        """`3.25 PPP, 3 bit`, as tables show it."""
        return ", ".join(
            (
                "own light" if self.ppp is None else f"{self.ppp:g} PPP",
                "own bits" if self.bits is None else f"{self.bits} bit",
            )
        )


def read_sensor(source: str | Mapping[str, Any], bits: int | None = None) -> tuple[Sensor, Flaws | None]:
    """The sensor of a file with its defects, or of the record of one; `ValueError` if it has other bits."""
    if isinstance(source, str):
        return devices.load(source, bits=bits), from_toml(source)
    return devices.from_dict(source), None


@lru_cache(maxsize=64)
def _device(light: Light, exposure: float) -> Sensor:
    return devices.load(light.sensor, ppp=light.ppp, bits=light.bits, exposure=exposure)


@lru_cache(maxsize=64)
def _code_table(sensor: Sensor, exposure: float) -> CodeTable | None:
    """None for a sensor that a table cannot hold."""
    if sensor.bits > TABLE_BITS:
        return None
    try:
        return CodeTable(sensor, exposure)
    except ValueError:
        return None


def follows_light(sensor: str) -> bool:
    """Whether the gain of a named sensor is set from the photons per pixel."""
    return sensor in devices.DEVICES and devices.DEVICES[sensor].follows_light


def draw_codes(sensor: Sensor, photons: Array, exposure: float, key: Key, origin: tuple[int, int] = (0, 0)) -> Array:
    """Codes [T, H, W] of expected photons [T, H, W], frame t under `key.at(key.frame + t)`; quick, without Dr.Jit.

    `origin` (y, x) places a crop in the full frame.

    The codes of `sensor.sample(..., engine="reference")` where a sensor draws one number per pixel. A clocked SPAD
    draws one per plane: its codes have the same exact distribution, from other numbers.
    """
    table = _code_table(sensor, exposure)
    if table is None or not (photons.min() >= 0 and photons.max() < np.inf):  # the sensor names the bad pixel
        return sensor.sample(photons, exposure, key=key, origin=origin, engine="reference")
    first = keys.words(key, photons.shape, origin)
    try:
        return table.draw(photons, first)
    except LookupError:
        return table.draw(photons, first, keys.words(key, photons.shape, origin, redraw=1))


def open_clips(path: Path | str, split: str | None = None) -> list[Clip]:
    """The finished clips of a data set folder, all or of one split; or the one clip of a clip folder."""
    path = Path(path)
    return [Clip.open(path)] if (path / "clip.json").exists() else Dataset.open(path).clips(split)


def has_sharp(clip: Clip) -> bool:
    """Whether the clip stores sharp frames beside the exposed ones."""
    return "sharp/000000.exr" in clip.meta["checksums"]


@dataclass(frozen=True)
class Codes:
    """A few-bit stream with all that a restorer must know; frames are read when asked for."""

    name: str
    shape: tuple[int, int, int]  # T, H, W
    sensor: Sensor
    exposure: float  # s, of one code
    frame_rate: float  # codes per second
    read: Callable[[int, int], Array]  # codes uint8 [stop - start, H, W] of frames start .. stop - 1
    source: str  # where they come from, for provenance
    digest: Callable[[], str] = str  # SHA-256 of what is read, computed when asked for; empty: not known
    sensor_name: str = ""  # of a device or a file; empty: the sensor's model
    ppp: float | None = None  # mean photons per pixel and code; None: not known

    @property
    def white(self) -> float:
        """Photons at which x = 1."""
        return self.sensor.white(self.exposure)


def array_digest(array: Array) -> str:
    """SHA-256 of an array's type, shape and values; a memory map is read piece by piece."""
    found = hashlib.sha256(f"{array.dtype.str} {array.shape}".encode())
    step = max(1, DIGEST_BYTES // max(1, array[:1].nbytes))
    for start in range(0, len(array), step):
        found.update(np.ascontiguousarray(array[start : start + step]).data)
    return found.hexdigest()


def array_codes(codes: Array, sensor: Sensor, exposure: float, name: str = "codes", source: str = "memory") -> Codes:
    """Codes [T, H, W] in memory or a memory map; `ValueError` if empty or with codes the sensor cannot produce."""
    if codes.ndim != 3 or codes.size == 0 or not np.issubdtype(codes.dtype, np.integer):
        raise ValueError(f"{name}: expected integer codes [T, H, W], none of them 0, got {codes.dtype} {codes.shape}")

    def read(start: int, stop: int) -> Array:
        part = np.asarray(codes[start:stop])
        if part.max() >= sensor.levels or part.min() < 0:
            t, y, x = (int(i) for i in np.argwhere((part < 0) | (part >= sensor.levels))[0])
            raise ValueError(
                f"{name}: code {part[t, y, x]} at (t, y, x) = {(t + start, y, x)}; a {sensor.bits}-bit sensor has "
                f"0..{sensor.levels - 1}; give the right --bits"
            )
        return part

    return Codes(name, codes.shape, sensor, exposure, 1 / exposure, read, source, lambda: array_digest(codes))


def sensed(clip: Clip, light: Light, seed: int = 0) -> tuple[Codes, float]:
    """A clip as a sensor sees it, drawn when read, and the light factor: the codes that `qsim sense` would store."""
    sensing, draw = light.sensing(seed), light.draw(clip, seed)

    def read(start: int, stop: int) -> Array:
        try:
            return draw.frames(clip, start, stop)
        except ValueError as error:
            raise ValueError(f"{clip.path}: frames {start}..{stop - 1}: {error}") from None

    codes = Codes(
        name=f"{clip.name}, {light.label}",
        shape=clip.shape,
        sensor=draw.sensor,
        exposure=clip.exposure,
        frame_rate=clip.frame_rate,
        read=read,
        source=f"{clip.path} seen by {light.sensor} ({light.label}), seed {seed}",
        digest=lambda: sha256(to_json({"clip_meta": clip.meta} | describe(clip, sensing, draw))),
        sensor_name=light.sensor,
        ppp=draw.level.ppp,
    )
    return codes, draw.level.factor


def stream_codes(stream: Stream) -> Codes:
    """A stored stream."""
    meta = stream.meta
    return Codes(
        stream.name,
        stream.shape,
        stream.sensor,
        stream.exposure,
        float(meta["frame_rate"]),
        stream.codes,
        str(stream.path),
        lambda: array_digest(stream.packed),
        str(meta.get("sensor_name") or ""),
        meta.get("ppp"),
    )


def open_stream(path: Path) -> Stream:
    """The stored stream whose .npy or .json this is; `ValueError` if it is video that `quiver restore` wrote."""
    if "seconds_per_frame" in read_json(path.with_suffix(".json")):
        raise ValueError(f"{path}: is restored video; name the stream or the clip that it was made from")
    return Stream.open(path.with_suffix(".json"))


def stored(clip: Clip, name: str) -> tuple[Codes, float]:
    """A stored stream of a clip, and its light factor; `ValueError` where a code sums several clip frames."""
    stream = clip.stream(name)
    if stream.shape != clip.shape:
        raise ValueError(
            f"{stream.path}: {list(stream.shape)}, but its clip is {list(clip.shape)}; only streams with one code per "
            "clip frame can be scored"
        )
    return stream_codes(stream), stream.photons_factor


def truth(clip: Clip, factor: float, start: int, stop: int) -> Array:
    """Sharp expected photons [stop - start, H, W] of a clip under a light factor: what a restorer should return."""
    return np.stack([clip_photons(clip, t, factor, sharp=True) for t in range(start, stop)])


def known(clip: Clip, start: int, stop: int) -> Array | None:
    """bool [stop - start, H, W]: where the light of frames is known, not cut off by a saturated camera; None = all."""
    if not clip.meta.get("saturated_pixels"):
        return None
    return ~np.stack([clip.saturated(t) for t in range(start, stop)])


def mean_light(clip: Clip, factor: float) -> float:
    """Mean expected photons per pixel and exposure of a clip under a light factor."""
    return factor * (clip.mean_radiance if clip.camera is None else clip.mean_photons)


def peak_of(light: float, peak: float | None = None) -> float:
    """The peak of a score [photons]: `peak` if given, else 2.5 times the mean light of the stream.

    `ValueError` for a stream without light.
    """
    found = WHITE_PER_MEAN * light if peak is None else peak
    if not 0 < found < float("inf"):
        raise ValueError(f"the peak of a score is a number of photons above 0, got {found!r}; is there any light?")
    return found


def cube_codes(
    path: Path, light: Light, frame_rate: float, *, planes: int | None = None, width: int | None = None
) -> Codes:
    """Codes from a bare .npy: integers [T, H, W], or with `width` binary planes [T, H, ceil(W/8)], first pixel in the
    highest bit. Every `planes` = 2^b - 1 of them (default 1) are summed to one b-bit code of a clocked SPAD; what is
    left at the end is not used. `frame_rate` counts codes per second. `ValueError` where these do not fit together.
    """
    array = load_npy(path)
    if width is None:
        if planes is not None:
            raise ValueError(f"{path}: planes = {planes} sums packed binary planes; give their width in pixels, too")
        codes = array_codes(array, light.device(1 / frame_rate), 1 / frame_rate, path.name, str(path))
    else:
        codes = _summed(path, array, light, frame_rate, planes or 1, width)
    return replace(codes, digest=lambda: array_digest(array), sensor_name=light.sensor)


def plane_bits(planes: int) -> int:
    """Bits of a code that sums so many binary planes; `ValueError` unless that is 2^b - 1 with b = 1 ... 16."""
    bits = planes.bit_length()
    if 1 <= planes == 2**bits - 1 < 2**16:
        return bits
    lower, higher = 2 ** ((planes + 1).bit_length() - 1) - 1, 2 ** (planes + 1).bit_length() - 1
    near = 1 if planes < 1 else 65535 if higher > 65535 else f"{lower} or {higher}"
    raise ValueError(f"planes: a b-bit code sums 2^b - 1 binary planes, got {planes}; use {near}")


def _summed(path: Path, cube: Array, light: Light, frame_rate: float, planes: int, width: int) -> Codes:
    """Packed planes as codes, summed when they are read."""
    bits = plane_bits(planes)
    if light.bits not in (None, bits):
        raise ValueError(f"{path}: sums of {planes} planes are {bits}-bit codes, got bits = {light.bits}; leave it out")
    sensor = replace(light, bits=bits).device(1 / frame_rate)
    if planes > 1 and not isinstance(sensor, BinarySPAD):
        raise ValueError(
            f"{light.sensor}: only a clocked SPAD sums planes, this is a {type(sensor).__name__}; "
            "give another sensor, as in spad-320x240"
        )
    if cube.ndim != 3 or cube.dtype != np.uint8 or cube.shape[2] != (width + 7) // 8 or 0 in cube.shape:
        raise ValueError(
            f"{path}: {cube.dtype} {list(cube.shape)} is no cube of packed planes {width} px wide; "
            f"that would be uint8 [T, H, {(width + 7) // 8}]"
        )
    if len(cube) < planes:
        raise ValueError(f"{path}: {len(cube)} planes are fewer than the {planes} of one code")
    together = max(1, PLANE_PIXELS // (cube.shape[1] * width))  # planes unpacked at a time

    def code(t: int) -> Array:
        total = np.zeros((cube.shape[1], width), np.uint16)  # at most 65535
        for start in range(t * planes, (t + 1) * planes, together):
            part = cube[start : min(start + together, (t + 1) * planes)]
            total += np.unpackbits(part, axis=2, count=width).sum(axis=0, dtype=np.uint16)
        return total.astype(np.uint8 if bits <= 8 else np.uint16)

    return Codes(
        name=path.name,
        shape=(len(cube) // planes, cube.shape[1], width),
        sensor=sensor,
        exposure=1 / frame_rate,
        frame_rate=frame_rate,
        read=lambda start, stop: np.stack([code(t) for t in range(start, stop)]),
        source=str(path),
    )


def windows_sensed(clip: Clip, light: Light, seed: int, centres: range) -> Iterator[Codes]:
    """The published test: each window of 11 frames brought to the light level on its own, with noise of its own.

    `ValueError` for a light without a level (the clip's own), which cannot be forced.
    """
    if light.ppp is None:
        raise ValueError("the published protocol forces the exposure of every window; give --ppp")
    sensor = light.device(clip.exposure)
    for t in centres:
        photons = np.stack([clip_photons(clip, i) for i in range(t - 5, t + 6)])
        codes = draw_codes(
            sensor,
            photons * (light.ppp / max(float(photons.mean()), 1e-9)),
            clip.exposure,
            Key(seed=seed, clip=hash_name(clip.name), stage=WINDOW_STAGE + t),
        )
        yield array_codes(codes, sensor, clip.exposure, name=f"{clip.name} window {t}")


def ideal_counter(bits: int) -> Sensor:
    """A sensor that counts every detected photon up to 2^bits - 1, for measured photon counts."""
    return QIS(quantum_efficiency=1.0, dark_current=0.0, read_noise=0.0, bits=bits)
