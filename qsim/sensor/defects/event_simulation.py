"""Simulates counting pixels photon by photon: slow, and the reference of `CountingSPAD`.

    flux inside each exposure -> arrival times -> avalanches that find the pixel live -> counts -> codes

It covers three effects that the closed forms leave out: light that varies within an exposure, dead time carried into
the next frame, and afterpulses. `effects` estimates the size of each. `sample` follows photons only if one of them
exceeds TOLERANCE; otherwise the closed form draws.

The pixel is gated: between exposures it detects nothing, but dead times and trapped carriers continue in real time.
A counted avalanche leaves, with probability `afterpulse`, one trapped carrier. It is released after an exponential
delay of mean `afterpulse_delay`. A release while the pixel is dead is not counted, but it restarts the dead time of
a paralyzable pixel; a release between exposures does nothing. A release while the pixel is live is counted as any other
avalanche, and may leave a carrier as well. Crosstalk is added to the counts of all pixels in the end, as to those of
the closed form: its avalanches have no times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import reduce
from heapq import heapify, heappop, heappush

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key, require_counters
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects.correlated_noise import CorrelatedNoise
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.fixed_pattern import lit
from qsim.sensor.defects.pixel_array import PixelArray

TOLERANCE = 1e-3  # relative change of the mean count that a closed form may miss
_STRIP_BYTES = 1 << 25  # of light in memory while single pixels are followed through a clip

# of an event: the pixel counted it; it was a trapped carrier, no arrival
DETECTED = 1
RELEASED = 2
Event = tuple[float, int]  # time [s] and the sum of these

IncidentLight = Callable[[int, int, int], Array]  # (frame, first row, rows) -> photons [slices, rows, W]


@dataclass(frozen=True)
class Memory:
    """The memory of a pixel; without it, the pixel is the memoryless `CountingSPAD`."""

    carry: bool = False  # dead times and trapped carriers continue in the next frame
    afterpulse: float = 0.0  # probability that a counted avalanche leaves a trapped carrier
    afterpulse_delay: float = 0.0  # s, mean of the exponential delay from avalanche to release

    def __post_init__(self) -> None:
        if not 0 <= self.afterpulse < 1:
            raise ValueError(f"Memory.afterpulse must be a probability below 1, got {self.afterpulse!r}")
        if self.afterpulse > 0 and not self.afterpulse_delay > 0:
            raise ValueError(f"Memory.afterpulse_delay must be in seconds and above 0, got {self.afterpulse_delay!r}")


@dataclass(frozen=True)
class State:
    """A pixel between two exposures."""

    dead_until: float = -np.inf  # s
    trapped: tuple[float, ...] = ()  # s, when carriers will be released


@dataclass(frozen=True)
class Effects:
    """Relative error of the mean count of the closed form, to leading order, for the worst pixel."""

    varying_flux: float
    carried_dead_time: float
    afterpulses: float

    @property
    def largest(self) -> float:
        return max(self.varying_flux, self.carried_dead_time, self.afterpulses)

    def __str__(self) -> str:
        return (
            f"varying flux {self.varying_flux:.2g}, carried dead time {self.carried_dead_time:.2g}, "
            f"afterpulses {self.afterpulses:.2g} of the mean count"
        )


def sample(
    sensor: CountingSPAD,
    photons: Array,
    exposure: float,
    *,
    frame_time: float,
    key: Key,
    memory: Memory = Memory(),
    origin: tuple[int, int] = (0, 0),
) -> tuple[Array, Effects, str]:
    """Return codes [T, H, W], the effects, and the method used ("closed form" or "events").

    `photons` [T, S, H, W] are expected in S equal slices of each exposure [s]; `frame_time` [s] is the period of the
    frames. Photons are followed if an effect exceeds TOLERANCE. Each pixel has a separate random stream, so a crop at
    its `origin` (y, x) gets the codes of the full frame. Single frames do not: a memory is simulated from the first.
    """
    if photons.ndim != 4 or not photons.size:
        raise ValueError(f"photons have the shape [T, slices, H, W], got {list(photons.shape)}")
    if not frame_time >= exposure > 0:
        raise ValueError(f"frame_time {frame_time!r} s must be at least the exposure {exposure!r} s, both above 0")
    sensor.arrivals(photons, exposure)  # checks the light level
    require_counters(key, (len(photons), *photons.shape[2:]), origin)
    found = effects(sensor, photons, exposure, frame_time, memory)
    if found.largest <= TOLERANCE:
        return sensor.sample(photons.sum(axis=1), exposure, key=key, origin=origin), found, "closed form"
    return _follow_pixels(sensor, photons, exposure, frame_time, memory, key, origin), found, "events"


def _follow_pixels(
    sensor: CountingSPAD,
    photons: Array,
    exposure: float,
    frame_time: float,
    memory: Memory,
    key: Key,
    origin: tuple[int, int],
) -> Array:
    """Return codes [T, H, W] of photons [T, S, H, W], each pixel from a separate random stream."""
    frames, _, height, width = photons.shape
    codes = np.empty((frames, height, width), sensor.dtype)
    for y, x in np.ndindex(height, width):
        # A stream of random numbers for each pixel: how many a pixel takes
        # depends on its history, so no counter could name them.
        rng = pixel_stream(key, y + origin[0], x + origin[1])
        counts = simulate(sensor, photons[:, :, y, x], exposure, frame_time, memory, rng)
        codes[:, y, x] = np.minimum(counts, sensor.levels - 1)
    return codes


def effects(sensor: CountingSPAD, photons: Array, exposure: float, frame_time: float, memory: Memory) -> Effects:
    """Return the relative size of each effect for photons [T, S, ...]: the largest of all pixels and frames.

    At r arrivals per second a dead time tau loses about r^2 tau counts per second. If r varies with the coefficient of
    variation c, the loss grows by the factor 1 + c^2. Counts of a paralyzable pixel, r exp(-r tau) per second, change
    by the share c^2 r tau (r tau - 2) / 2. An afterpulse adds at most its probability.
    """
    slices = photons.shape[1]
    rates = sensor.efficiency * np.asarray(photons, float) + sensor.dark_rate * exposure / slices
    arrivals = rates.sum(axis=1)
    share = sensor.dead_time / exposure
    # With n = sum of the slices: S sum n_i^2 - n^2 = c^2 n^2, where c is the coefficient of variation of the flux.
    spread = slices * (rates**2).sum(axis=1) - arrivals**2  # c^2 lambda^2
    varying = share * np.divide(spread, arrivals, out=np.zeros_like(arrivals), where=arrivals > 0)
    if sensor.paralyzable:
        varying = varying * np.maximum(1.0, arrivals * share / 2)  # no less than that share
    reach = max(0.0, sensor.dead_time - (frame_time - exposure)) / exposure
    carried = float(_carried(sensor, arrivals, share, reach).max()) if memory.carry else 0.0
    return Effects(float(varying.max()), carried, memory.afterpulse)


def _carried(sensor: CountingSPAD, arrivals: Array, share: float, reach: float) -> Array:
    """Return the relative error of the mean count without carried dead time: n = `arrivals` per exposure -> [...].

    A dead time lasts `share` exposures, `reach` of them after the gap between two exposures. A pixel is dead at the
    start with probability n reach, for reach / 2 on average. A bright paralyzable pixel loses more, as it counts an
    arrival only if none came in the dead time before. With y = n reach and x = n share, carried dead times take
    1 - (1 + y) exp(-y) counts and leave (1 + y) exp(-y) - exp(-x) + n (1 - share) exp(-x).
    """
    dim = arrivals * reach**2 / 2
    if not sensor.paralyzable:
        return dim
    y = arrivals * min(reach, 1.0)
    x = arrivals * min(share, 1.0)
    taken = -np.expm1(-y) - y * np.exp(-y)
    left = np.exp(-y) * (y - np.expm1(y - x)) + arrivals * max(1 - share, 0.0) * np.exp(-x)
    return np.maximum(dim, taken / np.maximum(left, np.finfo(float).tiny))


def simulate(
    sensor: CountingSPAD,
    photons: Array,
    exposure: float,
    frame_time: float,
    memory: Memory,
    rng: np.random.Generator,
    log: list[Event] | None = None,
) -> Array:
    """Return counts [T], not clipped, of one pixel for expected photons [T, S] in S equal slices of each exposure.

    `log` receives every event of the exposures, in time order; it changes no count.
    """
    rates = sensor.efficiency * photons + sensor.dark_rate * exposure / photons.shape[1]
    counts = np.zeros(len(photons), np.int64)
    state = State()
    for t, row in enumerate(rates):
        start = t * frame_time
        arrivals = arrival_times(row, start, exposure, rng)
        counts[t], state = expose(sensor, arrivals, start, exposure, memory, state, rng, log)
        if not memory.carry:
            state = State()
    return counts


def arrival_times(rates: Array, start: float, exposure: float, rng: np.random.Generator) -> list[float]:
    """Return the times [s] of a Poisson process with `rates` [S] expected arrivals in equal slices of the exposure."""
    slices = np.repeat(np.arange(len(rates)), rng.poisson(rates))
    return list(start + (slices + rng.random(slices.size)) * (exposure / len(rates)))


def expose(
    sensor: CountingSPAD,
    arrivals: list[float],
    start: float,
    exposure: float,
    memory: Memory,
    state: State,
    rng: np.random.Generator,
    log: list[Event] | None = None,
) -> tuple[int, State]:
    """Return the count of one exposure and the state after it; arrivals [s] and released carriers in time order."""
    waiting = [*arrivals, *(time for time in state.trapped if time >= start)]
    # A carrier is known by the time of its release. Two equal times have probability 0.
    carriers = set(state.trapped)
    heapify(waiting)
    count = 0
    dead_until = state.dead_until
    while waiting and waiting[0] < start + exposure:
        time = heappop(waiting)
        live = time >= dead_until
        if live:
            count += 1
            if memory.afterpulse and rng.random() < memory.afterpulse:
                carriers.add(release := time + rng.exponential(memory.afterpulse_delay))
                heappush(waiting, release)
        if log is not None:
            log.append((time, DETECTED * live + RELEASED * (time in carriers)))
        # A paralyzable pixel begins a new dead time with every avalanche, counted or not.
        if live or sensor.paralyzable:
            dead_until = time + sensor.dead_time
    return count, State(dead_until, tuple(waiting))


def pixel_stream(key: Key, row: int, column: int) -> np.random.Generator:
    """Return the random generator of one pixel of the full frame."""
    return np.random.Generator(np.random.Philox(key=[key.philox_key, row << 32 | column], counter=[0, 0, 0, key.frame]))


# ---- Clips of a pixel array


def memory_of(defects: Defects | None) -> Memory:
    """Return the memory of counting pixels with these defects."""
    if defects is None:
        return Memory()
    return Memory(defects.carry_dead_time, defects.afterpulse, defects.afterpulse_delay)


def clip_effects(
    array: PixelArray, light: IncidentLight, shape: tuple[int, int, int], exposure: float, frame_time: float
) -> Effects:
    """Return the largest effects of a clip of `shape` (T, H, W) that the closed form leaves out."""
    frames, height, _ = shape
    each = (
        effects(sensor, photons[None], exposure, frame_time, memory_of(array.defects))
        for sensor, photons in (_lit(array, light(t, 0, height), 0, exposure) for t in range(frames))
    )
    return reduce(_largest, each)


def _largest(a: Effects, b: Effects) -> Effects:
    """Return the larger of each effect."""
    return Effects(*(max(getattr(a, f.name), getattr(b, f.name)) for f in fields(Effects)))


def _lit(array: PixelArray, photons: Array, row: int, exposure: float) -> tuple[CountingSPAD, Array]:
    """Return the sensor and the light [slices, rows, W] of rows from `row` on, with the maps applied."""
    slices, rows, width = photons.shape
    sensor, light = lit(array.sensor, photons, exposure / slices, array.maps.crop(row, 0, rows, width))
    assert isinstance(sensor, CountingSPAD)
    return sensor, light


def follow(
    array: PixelArray,
    light: IncidentLight,
    shape: tuple[int, int, int],
    exposure: float,
    frame_time: float,
    key: Key,
    origin: tuple[int, int] = (0, 0),
    progress: Callable[[int, int], None] | None = None,
) -> Array:
    """Return codes of a clip of `shape` (T, H, W), each pixel followed photon by photon from the first frame.

    Crosstalk is drawn after that, between the pixels of each frame. `origin` (y, x) places a crop in the full frame.
    `progress(rows done, rows)` is called after each row.
    """
    codes = np.empty(shape, array.sensor.dtype)
    memory = memory_of(array.defects)
    for first, sensor, photons in _strips(array, light, shape, exposure):
        for i in range(photons.shape[2]):
            y = first + i
            place = (origin[0] + y, origin[1])
            row = photons[:, :, i : i + 1]
            codes[:, y : y + 1] = _follow_pixels(sensor, row, exposure, frame_time, memory, key, place)
            if progress is not None:
                progress(y + 1, shape[1])
    if array.maps.dead is not None:
        codes[:, array.maps.dead] = 0
    noise = CorrelatedNoise(crosstalk=array.defects.crosstalk)
    return noise.disturb(None, codes, array.sensor.levels - 1, key, array.maps.dead, origin)[0]


def trace(
    array: PixelArray,
    light: IncidentLight,
    shape: tuple[int, int, int],
    exposure: float,
    frame_time: float,
    key: Key,
    origin: tuple[int, int] = (0, 0),
) -> Iterator[tuple[Array, Array]]:
    """Yield the events behind the codes of `follow`, pixel by pixel, row by row: times [n] in s, kinds uint8 [n].

    A kind is the sum of DETECTED and RELEASED. Dead pixels have no events. `ValueError` for pixels with crosstalk.
    """
    if array.defects.crosstalk:
        raise ValueError("crosstalk: its detections have no times; leave it out of [defects] and sense the clip again")
    memory = memory_of(array.defects)
    for first, sensor, photons in _strips(array, light, shape, exposure):
        for y, x in np.ndindex(photons.shape[2:]):
            log: list[Event] = []
            if array.maps.dead is None or not array.maps.dead[first + y, x]:
                rng = pixel_stream(key, origin[0] + first + y, origin[1] + x)
                simulate(sensor, photons[:, :, y, x], exposure, frame_time, memory, rng, log)
            times, kinds = zip(*log, strict=True) if log else ((), ())
            yield np.array(times, np.float64), np.array(kinds, np.uint8)


def _strips(
    array: PixelArray, light: IncidentLight, shape: tuple[int, int, int], exposure: float
) -> Iterator[tuple[int, CountingSPAD, Array]]:
    """Yield the first row, the sensor and the light [T, slices, rows, W] of strips of a clip that fit into memory."""
    frames, height, width = shape
    slices = len(light(0, 0, 1))
    step = max(1, _STRIP_BYTES // (8 * frames * slices * width))
    for y in range(0, height, step):
        parts = [_lit(array, light(t, y, min(step, height - y)), y, exposure) for t in range(frames)]
        yield y, parts[0][0], np.stack([part for _, part in parts])
