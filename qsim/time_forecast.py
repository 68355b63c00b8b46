"""Forecasts the time of a long loop from its first steps, and says it once."""

from __future__ import annotations

import time
from collections.abc import Callable

LONG = 20.0  # s: a loop that takes less needs no forecast
ENOUGH = 1.0  # s of steps from which a rate is taken


class TimeForecast:
    """Measures a loop of equal steps in equal parts; a part's first step takes longer, because it sets things up.

    Give each instance to a loop as its progress: it is called with (steps done, steps in all) of all parts together.
    """

    def __init__(
        self,
        what: str,
        say: Callable[[str], None],
        *,
        unit: str = "step",
        parts: int = 1,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._what = what
        self._say: Callable[[str], None] | None = say  # None: it was said
        self._unit = unit
        self._parts = parts
        self._clock = clock
        self._started = clock()
        self._first: tuple[int, float] | None = None  # steps done and the time, after the first call

    def __call__(self, done: int, total: int) -> None:
        """Take the time of a step; say the forecast when enough of them were timed, if it is long."""
        now = self._clock()
        if self._first is None:
            self._first = (done, now)
            return
        steps = done - self._first[0]
        since = now - self._first[1]
        if self._say is None or steps < 1 or since < ENOUGH:
            return
        step = since / steps
        set_up = max(self._first[1] - self._started - self._first[0] * step, 0.0)
        whole = total * step + self._parts * set_up
        if whole > LONG:
            self._say(f"{self._what} takes about {duration(whole)}, {step:.2g} s a {self._unit}")
        self._say = None


def duration(seconds: float) -> str:
    """Return a time to two digits, in the unit in which people count it."""
    for unit, length in (("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 1.5 * length:
            return f"{float(f'{seconds / length:.2g}'):g} {unit}"
    return f"{seconds:.0f} s"
