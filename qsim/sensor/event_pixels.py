"""Simulates the pixels of an event camera: exact crossings of log light that is linear between frames.

    photocurrent i [e-/s] -> x = ln i -> low-pass: y -> difference D = y - y(last event) + leak -> events at thresholds

Between two frames, dt apart:

    x        linear in time; i stands for its mean over both frames in the laws of bandwidth and noise
    y        dy/dt = (x - y) / tau,  tau = 1 / (2 pi f),  f = cutoff min(i / bright, 1): solved exactly at the frames,
             linear between them
    leak     D grows by leak_rate threshold_on per second, as if light grew: ON events
    events   ON where D reaches the pixel's threshold_on, OFF where it reaches -threshold_off; then D = 0, and for the
             refractory time the pixel is held there: light that changes meanwhile is lost
    noise    a Poisson process of rate shot_noise (1 - (1 - shot_noise_bright) min(i / bright, 1)), ON or OFF with equal
             probability; a noise event resets the pixel as any other, and is swallowed within a refractory time

**The laws that follow**, of a pixel whose D changes by r per second:

    period of events     threshold / |r| + refractory, so at most 1 / refractory events per second
    number of events     floor(|change of ln i| / threshold) without noise, leak and refractory time
    constant light       1 / (threshold_on of the pixel / (leak_rate threshold_on) + refractory) leak events per second,
                         or n / (1 + n refractory) noise events per second of noise rate n

Pixels begin just reset; where they leak, anywhere in the period of the leak with equal probability, as in a camera that
has been running. Thresholds are normal with the spread `mismatch`, at least LEAST_THRESHOLD, and functions of
`device_seed` and pixel; noise is a function of key, pixel and number of the noise event. A change within 1e-9 of a
threshold has reached it, so that whole multiples count.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi

import numpy as np
from numpy import ndarray as Array

from qsim import limits
from qsim.keys import Key, hash_name, normal, require_counters, uniform, uniform_pair, words, words_at
from qsim.sensor.event_camera import LEAST_THRESHOLD, EventCamera

OFF = 0
ON = 1
REACHED = 1e-9  # of a threshold, by which a change may miss it
_DEVICE = hash_name("event camera")  # clip of the keys of thresholds
_PHASE = hash_name("event camera: phase of the leak")
_NOISE = hash_name("event camera: shot noise")


@dataclass(frozen=True)
class Emitted:
    """Events of some pixels, in no order."""

    times: Array  # s from the start of the interval, float64 [n]
    pixels: Array  # y W + x, int64 [n]
    polarities: Array  # OFF or ON, uint8 [n]


def thresholds(camera: EventCamera, shape: tuple[int, int], origin: tuple[int, int] = (0, 0)) -> tuple[Array, Array]:
    """Return the thresholds of brighter and of darker light of each pixel, float64 [H, W] each, both above 0."""
    found = []
    for name in ("threshold_on", "threshold_off"):
        key = Key(camera.device_seed, _DEVICE, stage=hash_name(name))
        spread = normal(*uniform_pair(words(key, shape, origin, 0), words(key, shape, origin, 1)))
        found.append(np.maximum(getattr(camera, name) + camera.mismatch * spread, LEAST_THRESHOLD))
    return found[0], found[1]


class Noise:
    """The shot noise of each pixel: exponential waits in units of the mean interval, and polarities."""

    def __init__(self, key: Key, shape: tuple[int, int], origin: tuple[int, int]) -> None:
        self._key = replace(key, stage=_NOISE + key.stage)
        self._width = shape[1]
        self._origin = origin

    def waits(self, pixels: Array, numbers: Array) -> Array:
        """Return the waits before the noise events of these numbers of pixels [n]; their mean is 1."""
        first, second = (words_at(self._key, self._at(pixels, numbers), redraw) for redraw in (0, 1))
        return np.asarray(-np.log(uniform(first, second)))

    def polarities(self, pixels: Array, numbers: Array) -> Array:
        """Return OFF or ON for noise events of pixels, uint8 [n]."""
        return (words_at(self._key, self._at(pixels, numbers), 2) >> 31).astype(np.uint8)

    def _at(self, pixels: Array, numbers: Array) -> Array:
        y, x = np.divmod(pixels, self._width)
        return np.stack([numbers, y + self._origin[0], x + self._origin[1]])


class EventPixels:
    """The state of all pixels between two frames; `advance` takes the next frame. Memory does not grow with frames."""

    def __init__(self, camera: EventCamera, current: Array, key: Key, origin: tuple[int, int] = (0, 0)) -> None:
        """Begin with the photocurrent of the first frame [H, W] in e-/s.

        `camera.bright` is needed where an effect depends on it. `ValueError` for currents that are not above 0.
        """
        shape = current.shape
        if len(shape) != 2:
            raise ValueError(f"photocurrent has the shape [H, W], got {list(shape)}")
        if camera.needs_bright and camera.bright is None:
            raise ValueError("EventCamera.bright: state the photocurrent of bright light, as in bright=1e4")
        require_counters(key, shape, origin)
        self.camera = camera
        self.on, self.off = (each.ravel() for each in thresholds(camera, shape, origin))
        self.current = _checked(current)
        self.light = np.log(self.current)  # x
        self.seen = self.light  # y
        self.change = np.zeros(current.size)  # D
        if camera.leak_rate > 0:
            # As a camera that has been running: the time since the last leak event is uniform over their period.
            phase = words(replace(key, stage=_PHASE + key.stage), shape, origin)
            self.change = uniform(phase).ravel() * self.on
        self.held = np.zeros(current.size)  # s from now until the end of the refractory time
        self.noise = Noise(key, shape, origin)
        self.drawn = np.zeros(current.size, np.int64)  # noise events of each pixel so far
        self.wait = np.full(current.size, np.inf)  # until the next one, in mean intervals
        if camera.shot_noise > 0:
            self.wait = self.noise.waits(np.arange(current.size), self.drawn)

    def advance(self, current: Array, seconds: float) -> Emitted:
        """Return the events until the next frame, whose photocurrent [H, W] in e-/s is `seconds` later."""
        growth, noise_rate, seen = self._follow(_checked(current), seconds)
        grown = self.change + growth
        # Most pixels stay between both thresholds and advance together; the others go from event to event.
        quiet = (grown < self.on * (1 - REACHED)) & (grown > self.off * (REACHED - 1))
        if self.camera.refractory > 0:
            quiet &= self.held == 0
        if self.camera.shot_noise > 0:
            quiet &= self.wait > noise_rate * seconds
        busy = np.flatnonzero(~quiet)
        found, change, held, wait = self._busy(busy, growth[busy] / seconds, noise_rate[busy], seconds)
        self.change = grown
        self.change[busy] = change
        if self.camera.refractory > 0:
            self.held[busy] = np.maximum(held - seconds, 0)
        if self.camera.shot_noise > 0:
            self.wait -= noise_rate * seconds
            self.wait[busy] = wait
        self.seen = seen
        return found

    def _follow(self, current: Array, seconds: float) -> tuple[Array, Array, Array]:
        """Return growth of D without events, rate of noise [1/s] and filtered log light at the next frame, [n] each."""
        camera = self.camera
        light = np.log(current)
        bright = np.ones_like(current)
        if camera.needs_bright:
            bright = np.minimum((self.current + current) / (2 * (camera.bright or 1.0)), 1)
        seen = light if camera.cutoff is None else self._filtered(light, 2 * pi * camera.cutoff * bright, seconds)
        growth = seen - self.seen + camera.leak_rate * camera.threshold_on * seconds
        rate = camera.shot_noise * (1 - (1 - camera.shot_noise_bright) * bright)
        self.current = current
        self.light = light
        return growth, rate, seen

    def _filtered(self, light: Array, pace: Array, seconds: float) -> Array:
        """Return y at the next frame, of light linear in time and of pace 1 / tau [1/s]: exact."""
        passed = -np.expm1(-pace * seconds)  # 1 - exp(-dt / tau)
        slope = (light - self.light) / seconds
        return np.asarray(self.seen + (self.light - self.seen) * passed + slope * (seconds - passed / pace))

    def _busy(
        self, pixels: Array, rate: Array, noise_rate: Array, seconds: float
    ) -> tuple[Emitted, Array, Array, Array]:
        """Return the events of pixels [n] whose D grows by `rate` [1/s, n], and D, refractory time and wait at the end.

        Each pass goes on to the next noise event of the pixels that have one.
        """
        change = self.change[pixels]
        held = self.held[pixels]
        with np.errstate(divide="ignore"):
            noisy = np.where(noise_rate > 0, self.wait[pixels] / noise_rate, np.inf)
        parts = []
        left = np.arange(len(pixels))
        budget = float(limits.EVENTS)
        while len(left):
            stop = np.minimum(noisy[left], seconds)
            places = pixels[left]
            run = _Run((self.on[places], self.off[places]), rate[left], change[left], held[left], stop)
            run.until_stop(self.camera.refractory)
            budget -= run.number.sum()
            _check_budget(budget)
            which, times, polarities = run.events()
            parts.append(Emitted(times, places[which], polarities))
            change[left], held[left] = run.after()
            left = left[noisy[left] < seconds]
            if len(left):
                parts.append(self._noise_events(pixels, left, noisy, change, held))
                waits = self.noise.waits(pixels[left], self.drawn[pixels[left]])
                noisy[left] += waits / noise_rate[left]
        with np.errstate(invalid="ignore"):
            # Waits are kept in mean intervals, so that they go on at the rate of the next
            # interval: a Poisson process of changing rate, by inverting its integral.
            wait = np.where(noise_rate > 0, (noisy - seconds) * noise_rate, self.wait[pixels])
        return _joined(parts), change, held, wait

    def _noise_events(self, pixels: Array, left: Array, noisy: Array, change: Array, held: Array) -> Emitted:
        """Return the noise events at the times `noisy`, and set the state of their pixels after them."""
        at = noisy[left]
        free = held[left] <= at
        taken = left[free]
        polarities = self.noise.polarities(pixels[left], self.drawn[pixels[left]])[free]
        self.drawn[pixels[left]] += 1
        change[taken] = 0
        # A noise event resets the pixel as any other; within a refractory time it is swallowed.
        held[taken] = at[free] + self.camera.refractory
        held[left] = np.maximum(held[left], at)
        return Emitted(at[free], pixels[taken], polarities)


class _Run:
    """Pixels [n] whose D grows evenly, from the time `start` at which they are free until `stop`; times in s."""

    def __init__(self, both: tuple[Array, Array], rate: Array, change: Array, start: Array, stop: Array) -> None:
        on, off = both
        self._rate = rate
        self._change = change
        self._start = start
        self._stop = stop
        self._crossing = np.where(rate > 0, on, off)
        self._room = np.maximum(self._crossing - np.sign(rate) * change, 0)

    def until_stop(self, refractory: float) -> None:
        """Find the number of events of each pixel: the first after `room`, the others after a whole threshold each."""
        speed = np.abs(self._rate)
        with np.errstate(divide="ignore", invalid="ignore"):
            self._first = self._start + self._room / speed
            self._period = self._crossing / speed + refractory
            # The first threshold after `room`, then one each period. 1 + REACHED: a
            # change that misses a threshold by rounding has reached it.
            number = np.floor((self._stop - self._first) / self._period + (1 + REACHED))
        runs = (speed > 0) & np.isfinite(self._first) & np.isfinite(self._period) & (self._start < self._stop)
        self.number = np.where(runs, np.maximum(number, 0), 0)
        self._refractory = refractory

    def events(self) -> tuple[Array, Array, Array]:
        """Return the pixel's place in the arrays, time and polarity of each event."""
        number = self.number.astype(np.int64)
        which = np.repeat(np.arange(len(number)), number)
        order = np.arange(len(which)) - np.repeat(np.cumsum(number) - number, number)
        times = np.minimum(self._first[which] + order * self._period[which], self._stop[which])
        return which, times, np.where(self._rate[which] > 0, ON, OFF).astype(np.uint8)

    def after(self) -> tuple[Array, Array]:
        """Return D at `stop`, and the time from which each pixel is free."""
        with np.errstate(invalid="ignore"):
            last = np.minimum(self._first + (self.number - 1) * self._period, self._stop)
        fired = self.number > 0
        free = np.where(fired, last + self._refractory, self._start)
        # D begins again at 0 with the last event, and grows from the end of the refractory time on.
        grown = self._rate * np.maximum(self._stop - free, 0)
        return np.where(fired, grown, self._change + grown), free


def _check_budget(left: float) -> None:
    """Raise `ValueError` where more events came between two frames than are held in memory."""
    if left < 0:
        raise ValueError(
            f"more than {limits.EVENTS} events between two frames; give higher thresholds, a refractory time, or a "
            "clip of more frames per second"
        )


def _checked(current: Array) -> Array:
    """Return photocurrents as float64 [H W]; `ValueError` for one that has no logarithm."""
    found = np.asarray(current, np.float64).ravel()
    if not (np.isfinite(found) & (found > 0)).all():
        raise ValueError(f"photocurrent {found[~(np.isfinite(found) & (found > 0))][0]!r} e-/s is not above 0")
    return found


def _joined(parts: list[Emitted]) -> Emitted:
    """Return the events of all parts."""
    empty = Emitted(np.empty(0), np.empty(0, np.int64), np.empty(0, np.uint8))
    every = [empty, *parts]
    return Emitted(
        np.concatenate([part.times for part in every]),
        np.concatenate([part.pixels for part in every]),
        np.concatenate([part.polarities for part in every]),
    )
