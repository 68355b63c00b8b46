"""Measures event cameras: speed beside a plain loop, and what the clip's frame rate leaves of times and counts.

    python benchmarks/event_rows.py --page docs/results/events.md      # a minute on one core

Speed is of photocurrents in memory, one thread; the plain loop is the reference of the tests. The other tables draw one
scene at its frame rate and 64 times as often, with an ideal camera: events that only the fine clip has were between
frames. An event is matched with that of the same number in the same pixel and of the same polarity.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import result_page
from numpy import ndarray as Array

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

import event_loop
from clips import sliding_pattern

from qsim.keys import Key
from qsim.sensor.event_camera import CAMERAS, EventCamera, load
from qsim.sensor.event_pixels import EventPixels
from qsim.tables import markdown_table

RATE = 2000.0  # frames per second
FRAMES = 33
FINE = 64  # as many frames in the clip that stands for the truth
SPEEDS = (0.1, 0.3, 1.0, 3.0, 10.0)  # px per frame
WIDTHS = 1.0  # px, standard deviation of the blur of edges
FLICKERS = (0.02, 0.1, 0.2, 0.3, 0.5, 0.9)  # cycles per frame
KEY = Key(seed=0, clip=0)
Scene = Callable[[float], Array]


def drawn(camera: EventCamera, scene: Scene, per_frame: int) -> Array:
    """Return events [n] of a scene over FRAMES frames: pixel, p and t [frames], in this order."""
    seconds = 1 / (RATE * per_frame)
    pixels = EventPixels(camera, scene(0.0), KEY)
    found = []
    for n in range(1, (FRAMES - 1) * per_frame + 1):
        each = pixels.advance(scene(n / per_frame), seconds)
        times = (n - 1) / per_frame + each.times * RATE
        found += list(zip(each.pixels, each.polarities, times, strict=True))
    return np.array(sorted(found), dtype=[("pixel", int), ("p", int), ("t", float)])


def numbered(events: Array) -> dict[tuple[int, int, int], float]:
    """Return the times by pixel, polarity, and number among these."""
    counts: dict[tuple[int, int], int] = {}
    found = {}
    for pixel, polarity, at in events.tolist():
        number = counts.get((pixel, polarity), 0)
        counts[pixel, polarity] = number + 1
        found[pixel, polarity, number] = at
    return found


def compared(scene: Scene) -> list[str]:
    """Return the cells of a scene: events of the fine clip, their share at the frame rate, and errors of times."""
    fine = numbered(drawn(EventCamera(), scene, FINE))
    coarse = numbered(drawn(EventCamera(), scene, 1))
    both = fine.keys() & coarse.keys()
    apart = np.array([coarse[key] - fine[key] for key in both]) * 1e6 / RATE
    errors = ["-", "-"]
    if len(apart):
        errors = [f"{np.median(np.abs(apart)):.0f}", f"{np.percentile(np.abs(apart), 95):.0f}"]
    return [f"{len(fine)}", f"{100 * len(coarse) / len(fine):.1f} %", *errors]


def bars(speed: float) -> Scene:
    """Return bars of 12 px and a contrast of 1:4 with edges of WIDTHS px, at a speed in px per frame."""
    x = np.arange(96)[None, :] + 0.5

    def light(t: float) -> Array:
        phase = (x - speed * t) / 12
        distance = 12 * (np.abs((phase % 2) - 1) - 0.5)  # px from an edge
        return 1e4 * (1 + 3 / (1 + np.exp(-1.7 * distance / WIDTHS)))

    return light


def lamp(cycles: float) -> Scene:
    """Return light of a contrast of 1:4 that flickers as a sine, at a frequency in cycles per frame."""
    phases = np.linspace(0, 2 * np.pi, 24, endpoint=False)[None, :]
    return lambda t: 1e4 * (2.5 + 1.5 * np.sin(2 * np.pi * cycles * t + phases))


def speeds() -> list[list[str]]:
    """Return the cells of speed: camera, events per pixel and frame, ours and the loop in Mpixel frames per second."""
    light = sliding_pattern(30, 256, 256, 0) * 1e5
    rows = []
    for name in CAMERAS:
        camera = load(name).with_bright(2.5e5)
        pixels = EventPixels(camera, light[0], KEY)
        events = 0
        started = time.process_time()
        for frame in light[1:]:
            events += len(pixels.advance(frame, 1 / RATE).times)
        ours = 29 * 256 * 256 / (time.process_time() - started) / 1e6
        started = time.process_time()
        event_loop.events_of(camera, light[:, :32, :32], 1 / RATE, KEY)
        loop = 29 * 32 * 32 / (time.process_time() - started) / 1e6
        rows.append([name, f"{events / (29 * 256 * 256):.2f}", f"{ours:.0f}", f"{loop:.2f}"])
    return rows


def page() -> str:
    """Return the page of all tables."""
    motion = [[f"{speed:g}", *compared(bars(speed))] for speed in SPEEDS]
    flicker = [[f"{cycles:g}", *compared(lamp(cycles))] for cycles in FLICKERS]
    errors = ("times off by, median [us]", "95 % within [us]")
    lines = [
        *result_page.head("Event cameras: speed and range", "event_rows.py --page docs/results/events.md"),
        "One thread of one core. The plain loop takes pixel by pixel and event by event, and gives the same events.",
        "",
        *markdown_table(
            speeds(), ("camera", "events per pixel and frame", "Mpixel frames/s", "plain loop, Mpixel frames/s")
        ),
        "",
        f"Events of a clip of {RATE:g} frames per second beside those of {FINE} times as many, with an ideal camera.",
        f"Bars of 12 px with edges of {WIDTHS:g} px move:",
        "",
        *markdown_table(motion, ("px per frame", "events", "events at the frame rate", *errors)),
        "",
        "A light flickers as a sine, 1:4:",
        "",
        *markdown_table(flicker, ("cycles per frame", "events", "events at the frame rate", *errors)),
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    result_page.main(__doc__, page)
