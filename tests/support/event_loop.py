"""An event camera in a plain loop: pixel by pixel and event by event, the reference of qsim/sensor/event_pixels.py."""

from __future__ import annotations

from math import exp, inf, log, pi

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key
from qsim.sensor.event_camera import EventCamera
from qsim.sensor.event_pixels import EventPixels, Noise

Event = tuple[float, int, int]  # s from the first frame, pixel, polarity


def events_of(camera: EventCamera, currents: Array, seconds: float, key: Key) -> list[Event]:
    """Return the events of photocurrents [T, H, W] in e-/s, in order of time and pixel.

    Thresholds, phases and random numbers are those of `EventPixels`; all else is computed here.
    """
    begun = EventPixels(camera, currents[0], key)
    noise = Noise(key, currents.shape[1:], (0, 0))
    found: list[Event] = []
    for pixel in range(currents[0].size):
        levels = [float(frame.ravel()[pixel]) for frame in currents]
        found += _pixel(camera, levels, seconds, begun, noise, pixel)
    return sorted(found)


def _pixel(
    camera: EventCamera, levels: list[float], seconds: float, begun: EventPixels, noise: Noise, pixel: int
) -> list[Event]:
    """Return the events of one pixel from the photocurrent of each frame."""
    at = np.array([pixel])
    on = float(begun.on[pixel])
    off = float(begun.off[pixel])
    difference = float(begun.change[pixel])
    seen = log(levels[0])
    drawn = 0
    wait = float(noise.waits(at, np.array([0]))[0]) if camera.shot_noise else inf
    free = 0.0  # s, end of the refractory time
    found: list[Event] = []
    for frame in range(1, len(levels)):
        now = (frame - 1) * seconds
        end = frame * seconds
        mean = (levels[frame - 1] + levels[frame]) / 2
        bright = min(mean / camera.bright, 1) if camera.bright else 1.0
        before = seen
        seen = _filtered(camera, levels[frame - 1], levels[frame], before, bright, seconds)
        rate = (seen - before) / seconds + camera.leak_rate * camera.threshold_on
        noise_rate = camera.shot_noise * (1 - (1 - camera.shot_noise_bright) * bright)
        while now < end:
            noisy = now + wait / noise_rate if noise_rate > 0 else inf
            if free > now:  # held in reset
                step = min(free, noisy, end)
                wait -= (step - now) * noise_rate if noise_rate > 0 else 0
                now = step
                if step == noisy and step < end:  # swallowed
                    drawn += 1
                    wait = float(noise.waits(at, np.array([drawn]))[0])
                continue
            crossing = inf
            if rate > 0:
                crossing = now + max(on - difference, 0) / rate
            if rate < 0:
                crossing = now + max(off + difference, 0) / -rate
            step = min(crossing, noisy, end)
            wait -= (step - now) * noise_rate if noise_rate > 0 else 0
            difference += rate * (step - now)
            now = step
            if crossing <= min(noisy, end):
                found.append((now, pixel, int(rate > 0)))
                difference = 0.0
                free = now + camera.refractory
            elif noisy < end:
                found.append((now, pixel, int(noise.polarities(at, np.array([drawn]))[0])))
                difference = 0.0
                free = now + camera.refractory
                drawn += 1
                wait = float(noise.waits(at, np.array([drawn]))[0])
    return found


def _filtered(camera: EventCamera, first: float, last: float, seen: float, bright: float, seconds: float) -> float:
    """Return the low-passed log light after a frame: the ramp's own solution of dy/dt = (x - y) / tau."""
    if camera.cutoff is None:
        return log(last)
    tau = 1 / (2 * pi * camera.cutoff * bright)
    slope = (log(last) - log(first)) / seconds
    lag = slope * tau  # of y behind x, in the long run
    return log(last) - lag + (seen - log(first) + lag) * exp(-seconds / tau)
