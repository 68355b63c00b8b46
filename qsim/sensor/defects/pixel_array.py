"""Draws the codes of a sensor with per-pixel maps and correlated noise.

Defects --PixelArray.of--> PixelArray: a sensor and its maps --sample, blocks--> codes
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from math import ceil, log
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim import files
from qsim.arrays import plain
from qsim.host import own_numbers
from qsim.keys import Key, require_counters
from qsim.sensor.defects.correlated_noise import CorrelatedNoise
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.fixed_pattern import PERFECT, Maps, draw_maps, lit, measured_dark_map
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD

Sampler = Callable[[Sensor, Array, float, Key, tuple[int, int]], Array]  # photons, exposure, key, origin -> codes


@own_numbers
@dataclass(frozen=True, eq=False)
class PixelArray:
    """A sensor model with per-pixel maps of one frame size, and its defects."""

    sensor: Sensor
    maps: Maps = PERFECT
    defects: Defects = field(default_factory=Defects)

    @classmethod
    def of(
        cls, defects: Defects, sensor: Sensor, height: int, width: int, origin: tuple[int, int] = (0, 0)
    ) -> PixelArray:
        """Return the pixel array of a device for frames of `height` x `width` pixels.

        `origin` (y, x) places a crop in the full frame, where measured maps begin; maps may be larger than the frames.
        `ValueError` if the defects do not fit the sensor, or a map does not cover the frames.
        """
        _check_model(defects, sensor)
        y, x = origin
        drawn = draw_maps(defects.pattern, (height, width), origin)
        measured: dict[str, Array] = {}
        for key, path in defects.maps.items():
            full = _read_map(path, key)
            if full.shape[0] < y + height or full.shape[1] < x + width:
                place = f" at row {y}, column {x}" if y or x else ""
                raise ValueError(
                    f"{path}: the {key} has {full.shape[0]} x {full.shape[1]} pixels, the frames {height} x {width}"
                    f"{place}; a map must cover the frames: measure a larger one, or draw smaller frames"
                )
            name = key.removesuffix("_map")
            if name == "dark":
                # A map of dark rates is kept relative to a rate of the sensor,
                # so that one factor per pixel scales its law.
                rate, full = measured_dark_map(full)
                sensor = sensor.with_dark_rate(rate)
            elif name == "read_noise" and isinstance(sensor, QIS):
                if not sensor.read_noise:
                    raise ValueError(f"{path}: a map of read noise needs a sensor with read_noise above 0")
                full = full / sensor.read_noise
            part = full[y : y + height, x : x + width]
            measured[name] = part != 0 if name == "dead" else part
        return cls(sensor, replace(drawn, **measured), defects)

    @property
    def memory(self) -> bool:
        """Whether a frame depends on earlier frames."""
        return bool(self.defects.afterpulse and isinstance(self.sensor, BinarySPAD))

    @property
    def follows_photons(self) -> bool:
        """Whether a counting pixel depends on the exposure before."""
        return self.sensor.follows_photons and bool(self.defects.carry_dead_time or self.defects.afterpulse)

    @property
    def reach(self) -> int:
        """Pixels beyond a crop that its codes depend on."""
        return 1 if self.defects.crosstalk else 0

    def lead(self, chance: float) -> int:
        """Return the number of earlier frames beyond which an influence has at most this probability."""
        if not (self.memory and isinstance(self.sensor, BinarySPAD)):
            return 0
        # An influence survives a plane with the probability of an afterpulse: a^(frames planes) <= chance.
        return ceil(log(chance) / log(self.defects.afterpulse) / self.sensor.planes)

    def crop(self, y: int, x: int, height: int, width: int) -> PixelArray:
        """Return the array of a crop [px] of the frame."""
        return replace(self, maps=self.maps.crop(y, x, height, width))

    def sample(
        self, photons: Array, exposure: float, *, key: Key, origin: tuple[int, int] = (0, 0), engine: str = "auto"
    ) -> Array:
        """Return codes [T, H, W] of expected photons [T, H, W]; without defects the bits of `Sensor.sample`.

        `exposure` is in s, `origin` (y, x) places a crop in the full frame. `ValueError` for afterpulses of a counting
        pixel (event_simulation.py), or of a clip that does not start at frame 0.
        """
        if self.defects.afterpulse and key.frame:
            raise ValueError(f"afterpulse has a memory: sample the clip from frame 0, not from frame {key.frame}")
        if self.defects.afterpulse and not isinstance(self.sensor, BinarySPAD):
            raise ValueError(
                "afterpulse: defined per binary plane; for counting pixels use event_simulation, a QIS has none"
            )
        return self._after(None, photons, exposure, key, origin, engine)[0]

    def blocks(
        self,
        photons: Iterable[Array],
        exposure: float,
        key: Key,
        origin: tuple[int, int] = (0, 0),
        engine: str | Sampler = "auto",
    ) -> Iterator[Array]:
        """Yield codes [t, H, W] of successive blocks of expected photons [t, H, W]; the first frame is key.frame.

        `exposure` is in s, `origin` (y, x) places a crop in the full frame. `engine` is that of `Sensor.sample`, or a
        function that draws the codes of pixels without correlated noise.
        """
        before = None
        for block in photons:
            codes, before = self._after(before, block, exposure, key, origin, engine)
            key = key.at(key.frame + len(block)) if key.frame + len(block) < 2**32 else key
            yield codes

    def _after(
        self,
        before: Array | None,
        photons: Array,
        exposure: float,
        key: Key,
        origin: tuple[int, int],
        engine: str | Sampler,
    ) -> tuple[Array, Array | None]:
        """Return codes [t, H, W] of a block, and the memory [H, W] for the next; `before` is that of the last."""
        clocked = isinstance(self.sensor, BinarySPAD)
        noise = CorrelatedNoise(self.defects.afterpulse if clocked else 0.0, self.defects.crosstalk)
        stack = plain(photons)
        if stack.ndim != 3:
            raise ValueError(f"photons have the shape [T, H, W], got {list(stack.shape)}")
        require_counters(key, stack.shape, origin, self.sensor.counters)
        if noise.crosstalk and isinstance(self.sensor, QIS):
            raise ValueError("crosstalk: a QIS has no avalanches; blur the light instead")
        if clocked and self.sensor.bits > 1 and (noise.afterpulse or noise.crosstalk):
            return self._sum_of_planes(before, noise, stack, exposure, key, origin, engine)
        codes = self._independent(stack, exposure, key, origin, engine)
        return noise.disturb(before, codes, self.sensor.levels - 1, key, self.maps.dead, origin)

    def _sum_of_planes(
        self,
        before: Array | None,
        noise: CorrelatedNoise,
        photons: Array,
        exposure: float,
        key: Key,
        origin: tuple[int, int],
        engine: str | Sampler,
    ) -> tuple[Array, Array | None]:
        """Return codes as sums of M planes, as BinarySPAD draws them, each with afterpulses of the plane before."""
        assert isinstance(self.sensor, BinarySPAD)
        m = self.sensor.planes
        plane = replace(self, sensor=self.sensor.plane)
        codes = np.zeros(photons.shape, self.sensor.dtype)
        for p in range(len(photons) * m):
            at = key.at(key.frame * m + p)
            # Planes are drawn one by one, since each may be disturbed by the one before: their sum has no closed law.
            fired = plane._independent(photons[p // m][None] / m, exposure / m, at, origin, engine)
            fired, before = noise.disturb(before, fired, 1, at, self.maps.dead, origin)
            codes[p // m] += fired[0]
        return codes, before

    def _independent(
        self, photons: Array, exposure: float, key: Key, origin: tuple[int, int], engine: str | Sampler
    ) -> Array:
        """Return codes [T, H, W] of pixels with maps and without correlated noise."""
        maps = self.maps
        sensor, light = lit(self.sensor, photons, exposure, maps)
        if maps.offset is None and maps.read_noise is None:
            codes = (
                sensor.sample(light, exposure, key=key, origin=origin, engine=engine)
                if isinstance(engine, str)
                else engine(sensor, light, exposure, key, origin)
            )
        elif isinstance(sensor, QIS):
            noise = 1.0 if maps.read_noise is None else maps.read_noise
            offset = 0.0 if maps.offset is None else maps.offset
            codes = np.stack(
                [
                    sensor.read_out(frame, exposure, key.at(key.frame + t), origin, noise, offset)
                    for t, frame in enumerate(light)
                ]
            )
        else:
            raise ValueError(f"{type(sensor).__name__} has no read-out: maps of offset and read noise are for a QIS")
        return codes if maps.dead is None else np.where(maps.dead, sensor.dtype(0), codes)


def _check_model(defects: Defects, sensor: Sensor) -> None:
    """Raise `ValueError` for defects that this model of sensor cannot have."""
    name = type(sensor).__name__
    if defects.read_out and not sensor.has_read_out:
        raise ValueError(f"defects: a {name} has no read-out; offset and read_noise are for a QIS")
    if sensor.has_read_out and defects.disturbed:
        raise ValueError("defects: a QIS has no avalanches, so neither afterpulse nor crosstalk")
    counting = sensor.follows_photons
    if (defects.carry_dead_time or defects.afterpulse_delay) and not counting:
        raise ValueError(f"defects: carry_dead_time and afterpulse_delay are for a CountingSPAD, this is a {name}")
    if counting and defects.afterpulse and not defects.afterpulse_delay:
        raise ValueError("defects: afterpulse of a counting pixel needs afterpulse_delay in seconds")


def require_effect(defects: Defects | None, sensor: Sensor) -> None:
    """Raise `ValueError` for defects drawn around a dark rate or read noise of 0, which would change nothing."""
    if defects is not None and defects.pattern.dark is not None and not sensor.dark_rate:
        raise ValueError("defects: dark spreads the sensor's dark rate, which is 0; state one, or give a dark_map")
    if defects is not None and defects.pattern.read_noise and isinstance(sensor, QIS) and not sensor.read_noise:
        raise ValueError("defects: read_noise spreads the sensor's read noise, which is 0; state one, or leave it out")


def _read_map(path: str, key: str) -> Array:
    """Return a measured map [H, W]; `ValueError` for another shape, or values that it cannot have."""
    array = np.array(files.load_array(Path(path)))
    if array.ndim != 2 or not array.size or array.dtype.kind not in "fuib" or not np.isfinite(array).all():
        raise ValueError(f"{path}: a {key} must be [H, W] of finite numbers, found {array.dtype} {list(array.shape)}")
    if key != "offset_map" and (array < 0).any():
        raise ValueError(f"{path}: a {key} must not have negative values")
    return array
