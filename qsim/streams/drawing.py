"""Draws codes from the light of a stream's exposures, by the law that the sensor states (`Sensor.law`).

light of clip frames --Exposures--> photons of each exposure --Drawer: sensor, key--> codes

Sampled    laws "table", "process", "planes", "closed form" and "spikes": the sensor draws block by block
Followed   law "events": counting pixels, photon by photon, all codes of a pixel together
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.files import Progress
from qsim.keys import Key
from qsim.sensor import packing
from qsim.sensor.defects import event_simulation
from qsim.sensor.defects.event_simulation import Effects, IncidentLight
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.sensor.sensor import Sensor
from qsim.streams.exposures import Exposures, Read, steps


@dataclass(frozen=True)
class Drawer(ABC):
    """What the codes of a stream are drawn from."""

    sensor: Sensor  # of a code
    exposed: Sensor  # of one exposure; the same unless planes are summed
    array: PixelArray | None  # of `exposed` with its defects; None without any
    exposures: Exposures
    read: Read  # photons of a clip frame
    key: Key
    origin: tuple[int, int]  # (y, x) of the first pixel in the full frame
    engine: str

    @abstractmethod
    def blocks(self, start: int, stop: int, step: int) -> Iterator[Array]:
        """Yield codes [t, H, W] of stream frames start ... stop - 1, `step` at a time where they need not be one."""

    def frames(self, start: int, stop: int) -> Array:
        """Return codes [stop - start, H, W] of stream frames start ... stop - 1; those before where pixels remember."""
        # Pixels with a memory are drawn from the first frame on; frames that nobody asked for are thrown away.
        first = 0 if self.remembers else start
        blocks = self.blocks(first, stop, 1 if self.remembers else stop - first)
        return np.concatenate([block for n, block in enumerate(blocks, first) if n >= start])

    def packed(self, frames: int, step: int, progress: Progress | None = None) -> Iterator[Array]:
        """Yield the first codes packed row by row, `step` frames at a time: uint8 [t, H, ceil(W bits / 8)]."""
        done = 0
        for block in self.packed_blocks(frames, step):
            yield block
            done += len(block)
            if progress is not None:
                progress(done, frames)

    def packed_blocks(self, frames: int, step: int) -> Iterator[Array]:
        """Yield the same without a call of progress: uint8 [t, H, ceil(W bits / 8)]."""
        return (packing.pack(block, self.sensor.bits) for block in self.blocks(0, frames, step))

    @property
    def remembers(self) -> bool:
        """Whether a code depends on those before it, so that all are drawn from the first."""
        return self.exposed.keeps_charge or (self.array is not None and self.array.memory)


class Sampled(Drawer):
    """The sensor draws the codes of each exposure; planes are summed."""

    def blocks(self, start: int, stop: int, step: int) -> Iterator[Array]:
        even = self.exposures.timing.shares is None
        if even:
            drawn = self._drawn(start, steps(start, stop, step))
        else:  # a code has its own exposure
            drawn = (block for t in range(start, stop) for block in self._drawn(t, [(t, t + 1)]))
        for block in drawn:
            yield self._summed(block)

    def _drawn(self, start: int, places: Iterable[tuple[int, int]]) -> Iterator[Array]:
        """Yield the codes [n, H, W] of equal exposures, of successive ranges of stream frames from `start` on."""
        light = (self.exposures.light(self.read, *place) for place in places)
        source = self.exposed if self.array is None else self.array
        # Exposures that follow each other have numbers that follow each other: one key names a block of any length.
        key = self.key.at(self.exposures.number(start))
        return source.blocks(light, self.exposures.seconds(start), key, self.origin, self.engine)

    def packed_blocks(self, frames: int, step: int) -> Iterator[Array]:
        timing = self.exposures.timing
        # The engine packs only codes that are drawn as they are stored: no map, memory, sum or schedule changes them.
        if self.array is not None or self.remembers or timing.frames > 1 or timing.shares is not None:
            yield from super().packed_blocks(frames, step)
            return
        for start, stop in steps(0, frames, step):  # the engine joins the bits of codes itself
            yield self.exposed.sample_packed(
                self.exposures.light(self.read, start, stop),
                self.exposures.seconds(start),
                key=self.key.at(start),
                origin=self.origin,
                engine=self.engine,
            )

    def _summed(self, drawn: Array) -> Array:
        """Return codes of stream frames from codes of exposures, both [t, H, W]."""
        timing = self.exposures.timing
        if not timing.summed:
            return drawn
        grouped = drawn.reshape(-1, timing.frames, *drawn.shape[1:])
        return grouped.sum(axis=1).astype(packing.code_dtype(self.sensor.bits))


class Followed(Drawer):
    """Counting pixels, followed photon by photon from the first frame on."""

    def blocks(self, start: int, stop: int, step: int) -> Iterator[Array]:
        yield self._codes(stop)[start:]

    def frames(self, start: int, stop: int) -> Array:
        return self._codes(stop)[start:]

    def packed(self, frames: int, step: int, progress: Progress | None = None) -> Iterator[Array]:
        yield packing.pack(self._codes(frames, progress), self.sensor.bits)

    def _codes(self, frames: int, progress: Progress | None = None) -> Array:
        """Return codes [frames, H, W]; `progress(done, frames)` after each row of pixels: its frames are one draw."""

        def rows_done(done: int, rows: int) -> None:
            if progress is not None:
                progress(frames * done // rows, frames)

        return event_simulation.follow(*self._given(frames), self.key, self.origin, rows_done)

    def trace(self, frames: int) -> Iterator[tuple[Array, Array]]:
        """Yield the times [n] in s and kinds [n] of the events behind the first codes of each pixel, row by row."""
        return event_simulation.trace(*self._given(frames), self.key, self.origin)

    def missed(self) -> Effects:
        """Return the error of the closed form of counting pixels in this clip."""
        return event_simulation.clip_effects(*self._given(len(self.exposures)))

    def _given(self, frames: int) -> tuple[PixelArray, IncidentLight, tuple[int, int, int], float, float]:
        """Return pixels, light, shape of the codes, exposure [s] and period [s], as event_simulation takes them."""
        assert self.array is not None
        _, height, width = self.exposures.shape
        period = self.exposures.timing.frames / self.exposures.frame_rate

        def light(t: int, row: int, rows: int) -> Array:
            (exposure,) = self.exposures[t]
            return self.exposures.slices(self.read, exposure, (row, 0, rows, width))

        return self.array, light, (frames, height, width), self.exposures.seconds(0), period


DRAWERS: dict[str, type[Drawer]] = {
    "table": Sampled,
    "process": Sampled,
    "planes": Sampled,
    "closed form": Sampled,
    "events": Followed,
    "spikes": Sampled,
}
