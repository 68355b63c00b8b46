"""Measures where the processor time of rendered frames goes; clip_rows.py and clip_earlier.py import it.

It imports nothing of qsim: the program of an earlier commit is measured with the same lines.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import wraps
from pkgutil import resolve_name
from statistics import median
from typing import Any
from unittest import mock

from qsim import records

REST = "rest"
AFTER = ("truth", "writing")  # parts that are not radiance


class Parts:
    """Processor seconds of all threads by part. An inner part interrupts the outer one."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._open = [REST]
        self._since = time.process_time()

    def turn(self) -> None:
        """Count the time since the last turn for the part that is open; launched kernels finish first."""
        import drjit as dr  # not before qsim has chosen its library

        dr.sync_thread()
        now = time.process_time()
        self.seconds[self._open[-1]] += now - self._since
        self._since = now

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count the block for a part."""
        self.turn()
        self._open.append(name)
        try:
            yield
        finally:
            self.turn()
            self._open.pop()

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function whose time counts for a part."""

        @wraps(function)
        def inside(*words: Any, **named: Any) -> Any:
            with self.part(name):
                return function(*words, **named)

        return inside


@contextmanager
def timed_parts(targets: Mapping[str, str]) -> Iterator[Parts]:
    """Yield parts that time functions inside the block; `targets` maps MODULE:CLASS.FUNCTION to the name of a part."""
    parts = Parts()
    with ExitStack() as stack:
        for target, name in targets.items():
            place, _, function = target.replace(":", ".").rpartition(".")
            owner = resolve_name(place)
            stack.enter_context(mock.patch.object(owner, function, parts.timed(name, getattr(owner, function))))
        yield parts


def timed_frames(
    renderer: Any, writer: Any, numbers: Sequence[int], targets: Mapping[str, str]
) -> tuple[dict[int, Any], dict[str, Any]]:
    """Render and store frames; return their radiance [H, W] by number, and the processor seconds of a frame.

    `processor_seconds` are those of the radiance, without ground truth and writing; `parts` are all by name. They are
    medians without the first frame, which compiles. `writer` holds as many frames as there are `numbers`.
    """
    pictures = {}
    taken = []
    with timed_parts(targets) as parts, writer:
        for place, t in enumerate(numbers):
            parts.turn()
            before = dict(parts.seconds)
            frame = renderer.frame(t)
            writer.add(place, frame.radiance, frame.sharp, frame.truth, frame.error, frame.fireflies)
            parts.turn()
            taken.append({name: seconds - before.get(name, 0.0) for name, seconds in parts.seconds.items()})
            pictures[t] = frame.radiance
    return pictures, middle(taken[1:], [*dict.fromkeys(targets.values()), REST])


def middle(taken: Sequence[Mapping[str, float]], names: Sequence[str]) -> dict[str, Any]:
    """Return the medians over frames, given by their seconds by part."""
    radiance = [sum(seconds for name, seconds in frame.items() if name not in AFTER) for frame in taken]
    parts = {name: round(median(frame.get(name, 0.0) for frame in taken), 5) for name in names}
    return {"processor_seconds": round(median(radiance), 5), "parts": parts}


def described(scene: Any, frames: int, frame_rate: float) -> dict[str, Any]:
    """Return what a writer of a clip needs to know of it."""
    return {
        "shape": [frames, scene.camera.height, scene.camera.width],
        "frame_rate": frame_rate,
        "exposure": 1 / frame_rate,
        "radiance_unit": "W m^-2 sr^-1",
        "camera": records.plain(scene.camera),
    }
