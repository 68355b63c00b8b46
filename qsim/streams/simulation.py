"""Simulates the stream of a sensor that sees a clip, block by block: radiance frames to codes.

    Draw --packed--> packed codes of a stream      --frames--> codes of some frames, for replay

A code takes one clip frame or several: binary planes that are summed (clocked pixels), or slices of one exposure in
which the light changes (counting pixels, and a QIS that is read once, which blurs motion).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clip_folder import ClipFolder
from qsim.files import Progress
from qsim.keys import Key
from qsim.optics.radiometry import Crop, LightLevel
from qsim.sensor import packing
from qsim.sensor.colour_filter import ColourFilter
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects import defect_table, event_simulation
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.event_simulation import Effects, IncidentLight
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD
from qsim.sensor.spike import SpikeCamera
from qsim.streams import gates
from qsim.streams.photons import clip_photons
from qsim.streams.rows import Rows
from qsim.streams.stream import Stream

LAWS = ("table", "process", "planes", "closed form", "events", "spikes")  # of `Draw.law`
UNEVEN = 0.01  # of the mean strength of a light, a difference that is stated
_BLOCK_PIXELS = 1 << 22  # photons held in memory at a time while sensing: 32 MiB of float64


@dataclass(frozen=True)
class Draw:
    """A `Sensing` applied to one clip: all parameters of its codes."""

    sensor: Sensor
    plane: Sensor  # draws one clip frame; the same as `sensor` unless planes are summed
    level: LightLevel  # per clip frame
    key: Key
    planes: int  # clip frames per code
    diffraction: bool
    defects: Defects | None = None
    followed: Effects | None = None  # counting pixels: the error of the closed form, if photons are followed instead
    engine: str = "auto"
    rows: Rows | None = None  # rows or columns at their own time; None: all at once
    colour: ColourFilter | None = None  # from the first pixel of the clip; None: the clip has one band
    shares: tuple[float, ...] | None = None  # exposures of codes in turn, over a full one; None: all are full
    origin: tuple[int, int] = (0, 0)  # (y, x) of the first pixel in the full frame

    @property
    def law(self) -> str:
        """How codes are drawn from random numbers, `drawn_by` of a stream; another law draws other codes.

        "table": one number against the cdf. "process": step by step, or the sum of all planes at once. "planes": one by
        one. "closed form" and "events": counting pixels, by their cdf and photon by photon. "spikes": spike cameras,
        plane after plane.
        """
        if isinstance(self.sensor, SpikeCamera):
            return "spikes"
        if self.followed is not None:
            return "events"
        few = self.sensor.bits <= 8
        if isinstance(self.sensor, QIS):
            pattern = None if self.defects is None else self.defects.pattern
            maps = {} if self.defects is None else self.defects.maps
            read_out = pattern is not None and (pattern.offset or pattern.read_noise)
            return "process" if not few or read_out or {"offset_map", "read_noise_map"} & set(maps) else "table"
        if not isinstance(self.sensor, BinarySPAD):
            return "closed form"
        disturbed = self.defects is not None and (self.defects.afterpulse or self.defects.crosstalk)
        return "planes" if few or self.sums or disturbed else "process"

    def light(self, clip: ClipFolder, start: int, stop: int) -> Array:
        """Return expected photons [stop - start, H, W] of clip frames, per clip frame, each row at its time."""
        whole = (0, 0, *clip.shape[1:])
        return np.stack([self._delayed(clip, t, whole) for t in range(start, stop)])

    def incident(self, clip: ClipFolder, t: int, crop: Crop | None = None) -> Array:
        """Return the expected photons [h, w] of clip frame t in a crop = (y, x, height, width) [px], behind filters."""
        photons = clip_photons(clip, t, self.level.factor, crop, diffraction=self.diffraction)
        if self.colour is None:
            return photons
        return self.colour.mosaic(photons, self.sensor.efficiency, (0, 0) if crop is None else crop[:2])

    def _delayed(self, clip: ClipFolder, t: int, crop: Crop) -> Array:
        """Return the same, with every row at its own time."""
        if self.rows is None:
            return self.incident(clip, t, None if crop == (0, 0, *clip.shape[1:]) else crop)
        shifts = self.rows.shifts(*clip.shape[1:], clip.frame_rate)
        return self.rows.delayed(lambda frame, part: self.incident(clip, frame, part), t, crop, shifts)

    def count(self, clip: ClipFolder) -> int:
        """Return the number of codes in a clip: its frames over those of a code; late rows need the frames after it."""
        more = 0 if self.rows is None else self.rows.reach(*clip.shape[1:], clip.frame_rate)
        return (len(clip) - more) // self.planes

    def about_flicker(self, clip: ClipFolder) -> str:
        """Return how the light of a code differs from its truth, that of its middle clip frame; empty below UNEVEN."""
        apart = 0.0  # of the mean strength of the light that differs most
        for strengths in clip.strengths.values():
            codes = strengths[: len(strengths) // self.planes * self.planes].reshape(-1, self.planes)
            apart = max(apart, float(np.abs(codes.mean(axis=1) - codes[:, self.planes // 2]).max()))
        if apart < UNEVEN:
            return ""
        what = "its truth has the light of its middle clip frame; render at the code rate with --shutter 1"
        return f"; light flickers within a code, by up to {100 * apart:.3g} % of its mean: {what}"

    def frames(self, clip: ClipFolder, start: int, stop: int) -> Array:
        """Return codes [stop - start, H, W] of stream frames start ... stop - 1.

        Pixels with a memory are simulated from the first frame of the clip.
        """
        array = self._array(clip)
        if self.followed is not None:
            return self._follow(clip, stop)[start:]
        first = 0 if self.remembers or (array is not None and array.memory) else start
        blocks = self.blocks(clip, first, stop, stop - first if first == start else 1)
        return np.concatenate([block for n, block in enumerate(blocks, first) if n >= start])

    def blocks(self, clip: ClipFolder, start: int, stop: int, step: int) -> Iterator[Array]:
        """Yield codes [t, H, W] of stream frames start ... stop - 1, `step` at a time, or (events) all at once."""
        if self.followed is not None:
            yield self._follow(clip, stop)[start:]
            return
        if self.shares is not None:
            array = self._array(clip)
            for t in range(start, stop, step):
                yield np.concatenate([self._gated(clip, n, array) for n in range(t, min(t + step, stop))])
            return
        places = [(t * self.planes, min(t + step, stop) * self.planes) for t in range(start, stop, step)]
        light = (self._exposed(self.light(clip, *place)) for place in places)
        array = self._array(clip)
        if isinstance(self.plane, SpikeCamera):
            yield from self.plane.spikes(light, clip.exposure, self.key.at(start), self.origin)
            return
        if array is not None:
            drawn: Iterator[Array] = array.blocks(
                light, self._exposure(clip), self.key.at(self._number(start)), self.origin, self.engine
            )
        else:
            keys = (self.key.at(self._number(t)) for t in range(start, stop, step))
            exposure = self._exposure(clip)
            each = zip(light, keys, strict=True)
            drawn = (self._sampled(None, p, exposure, key) for p, key in each)
        for block in drawn:
            yield self._summed(block)

    def packed(self, clip: ClipFolder, frames: int, progress: Progress | None = None) -> Iterator[Array]:
        """Yield all codes of a stream, packed row by row, some frames at a time: uint8 [t, H, ceil(W bits / 8)]."""
        step = max(1, _BLOCK_PIXELS // (clip.shape[1] * clip.shape[2] * self.planes))
        apart = self.remembers or self.shares is not None
        if self.followed is not None:
            yield packing.pack(self._follow(clip, frames, progress), self.sensor.bits)
            return
        if self.defects is not None or self.planes > 1 or apart:
            blocks: Iterator[Array] = (
                packing.pack(block, self.sensor.bits) for block in self.blocks(clip, 0, frames, step)
            )
        else:
            blocks = (
                self.plane.sample_packed(
                    self.light(clip, t, min(t + step, frames)),
                    clip.exposure,
                    key=self.key.at(t),
                    origin=self.origin,
                    engine=self.engine,
                )
                for t in range(0, frames, step)
            )
        done = 0
        for block in blocks:
            yield block
            done += len(block)
            if progress is not None:
                progress(done, frames)

    def _gated(self, clip: ClipFolder, t: int, array: PixelArray | None) -> Array:
        """Return the code [1, H, W] of stream frame t, whose exposure is its share of a full one."""
        assert self.shares is not None
        share = gates.share_of(self.shares, t)
        part = np.full(self.planes, share) if self.sums else gates.weights(share, self.planes)
        light = self.light(clip, t * self.planes, (t + 1) * self.planes) * part[:, None, None]
        key = self.key.at(self._number(t))
        exposure = share * self._exposure(clip)
        return self._summed(self._sampled(array, self._exposed(light), exposure, key))

    def _sampled(self, array: PixelArray | None, light: Array, exposure: float, key: Key) -> Array:
        """Return the codes of exposures of `plane`, or of a pixel array of it, both [t, H, W], at the clip's place."""
        source = self.plane if array is None else array
        return source.sample(light, exposure, key=key, origin=self.origin, engine=self.engine)

    @property
    def remembers(self) -> bool:
        """Whether a pixel's planes are drawn in order, from the first: the charge of a spike camera."""
        return isinstance(self.plane, SpikeCamera)

    @property
    def sums(self) -> bool:
        """Whether a code sums binary planes; otherwise several clip frames are the light of one exposure."""
        return self.plane is not self.sensor

    def _exposed(self, light: Array) -> Array:
        """Return the photons [t, H, W] of exposures of `plane` from those of clip frames."""
        return light if self.sums or self.planes == 1 else light.reshape(-1, self.planes, *light.shape[1:]).sum(axis=1)

    def _exposure(self, clip: ClipFolder) -> float:
        """Return the exposure of `plane` [s]."""
        return clip.exposure if self.sums else clip.exposure * self.planes

    def _number(self, frame: int) -> int:
        """Return the frame number in the key of a stream frame: planes are numbered one by one."""
        return frame * self.planes if self.sums else frame

    def _summed(self, drawn: Array) -> Array:
        """Return codes of stream frames from codes of planes, both [t, H, W]."""
        if not self.sums:
            return drawn
        grouped = drawn.reshape(-1, self.planes, *drawn.shape[1:])
        return grouped.sum(axis=1).astype(packing.code_dtype(self.sensor.bits))

    def _array(self, clip: ClipFolder) -> PixelArray | None:
        """Return the pixel array of the defects; None if neither defects nor single photons are simulated."""
        counts = self.followed is not None
        if self.defects is None and not counts:
            return None
        return PixelArray.of(self.defects or Defects(), self.plane, *clip.shape[1:], self.origin)

    def _slices(self, clip: ClipFolder) -> IncidentLight:
        """Return a function that reads the photons [slices, rows, W] of some rows of a stream frame."""

        def read(frame: int, row: int, rows: int) -> Array:
            crop = (row, 0, rows, clip.shape[2])
            first = frame * self.planes
            return np.stack([self._delayed(clip, t, crop) for t in range(first, first + self.planes)])

        return read

    def missed(self, clip: ClipFolder) -> Effects | None:
        """Return the error of the closed form of counting pixels in this clip; None if it is exact."""
        if not isinstance(self.plane, CountingSPAD):
            return None
        memory = event_simulation.memory_of(self.defects)
        if self.planes == 1 and not (memory.carry or memory.afterpulse):
            return None
        array = PixelArray.of(self.defects or Defects(), self.plane, *clip.shape[1:], self.origin)
        shape = (self.count(clip), *clip.shape[1:])
        return event_simulation.clip_effects(
            array, self._slices(clip), shape, self._exposure(clip), self.planes / clip.frame_rate
        )

    def _follow(self, clip: ClipFolder, frames: int, progress: Progress | None = None) -> Array:
        """Return codes [frames, H, W] of counting pixels, followed photon by photon from the first frame.

        `progress(done, frames)` is called after each row of pixels: all their frames are drawn together.
        """
        array = self._array(clip)
        assert array is not None
        shape = (frames, *clip.shape[1:])
        exposure = self._exposure(clip)
        frame_time = self.planes / clip.frame_rate

        def rows_done(done: int, rows: int) -> None:
            if progress is not None:
                progress(frames * done // rows, frames)

        return event_simulation.follow(
            array, self._slices(clip), shape, exposure, frame_time, self.key, self.origin, rows_done
        )

    def trace(self, clip: ClipFolder, frames: int) -> Iterator[tuple[Array, Array]]:
        """Yield the times [n] in s and kinds [n] of the events behind the first codes of each pixel, row by row.

        Time 0 is the start of the first exposure. `ValueError` for codes that were not followed photon by photon.
        """
        array = self._array(clip)
        if self.followed is None or array is None:
            raise ValueError(
                f"{clip.name}: its codes were not drawn photon by photon; sense a CountingSPAD with --follow"
            )
        shape = (frames, *clip.shape[1:])
        exposure = self._exposure(clip)
        frame_time = self.planes / clip.frame_rate
        return event_simulation.trace(array, self._slices(clip), shape, exposure, frame_time, self.key, self.origin)


def stored(stream: Stream) -> Draw:
    """Return the draw of a stored stream, from its json; `ValueError` for an imported stream."""
    meta = stream.meta
    for name in ("seed", "clip_key", "ppp", "mean_photons_before", "ppp_factor", "drawn_by"):
        if meta.get(name) is None:
            raise ValueError(f"{stream.path}: its description holds no {name}: it was not drawn from a clip by qsim")
    planes = int(meta.get("planes_per_code") or 1)
    law = meta["drawn_by"]
    if law not in LAWS:
        raise ValueError(f"{stream.path}: drawn by {law!r}, which is none of {', '.join(LAWS)}; sense it again")
    sensor = stream.sensor
    level = LightLevel(stream.photons_factor, meta["ppp"] / planes, meta["mean_photons_before"] / planes, None)
    key = Key(seed=meta["seed"], clip=meta["clip_key"])
    where = f"{stream.path.with_suffix('.json')}: defects"
    found = defect_table.from_dict(meta["defects"], where) if "defects" in meta else None
    followed = event_simulation.Effects(**meta["dead_time_effects"]) if law == "events" else None
    diffraction = bool(meta.get("diffraction", False))
    plane = plane_of(sensor, planes)
    draw = Draw(sensor, plane, level, key, planes, diffraction, found, followed, colour=stream.colour_filter)
    return dataclasses.replace(draw, rows=stream.rows, shares=stream.shares, origin=stream.origin)


OPTIONAL = (
    "defects",
    "rows",
    "colour",
    "exposures",
    "origin",
    "temperature",
    "pixel_pitch",
)  # keys that are left out where off


def same_settings(old: dict[str, Any], new: dict[str, Any]) -> bool:
    """Return whether two descriptions of streams have the same settings; folders of files do not count, nor do the
    stated effects of dead time: `drawn_by` tells what they led to.
    """
    old = _without_folders(old)
    new = _without_folders(new)
    new.pop("dead_time_effects", None)
    same = all(old.get(key) == value for key, value in new.items())
    return same and all(old.get(key) == new.get(key) for key in OPTIONAL)


def _without_folders(meta: dict[str, Any]) -> dict[str, Any]:
    """Return a copy of a description: a sensor file has its name alone, measured maps have their checksums."""
    meta = dict(meta)
    name = meta.get("sensor_name")
    table = meta.get("defects")
    if isinstance(name, str) and name.endswith(".toml"):
        meta = meta | {"sensor_name": Path(name).name}
    if isinstance(table, dict):
        maps = {key: value["sha256"] for key, value in table.items() if isinstance(value, dict) and "sha256" in value}
        meta = meta | {"defects": table | maps}
    return meta


def plane_of(sensor: Sensor, planes: int) -> Sensor:
    """Return the sensor of one clip frame: a single plane of a clocked SPAD, else the sensor."""
    return dataclasses.replace(sensor, bits=1) if planes > 1 and isinstance(sensor, BinarySPAD) else sensor
