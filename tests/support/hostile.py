"""Holds wrong values of every kind for files, and the bounds within which a file must be refused."""

from __future__ import annotations

import functools
import math
import statistics
import time
from pathlib import Path
from typing import Any

from torch import nn

NUMBERS = (0, -1, 1, 2, 3, 7, 64, 1e300, -1e300, 0.5, 1e-300, 2**31, 2**63, 10**9, 10**400, math.nan, math.inf)
VALUES: tuple[Any, ...] = (
    *NUMBERS,
    *(None, True, False, "", "3", "x" * 5000, [], {}, [2], [0], [10**9], [2] * 1000, [[2]], {"a": 1}, [None], ["2"]),
)
MEMORY = 200e6  # bytes for a file of some kB: far more than needed, far less than without bounds


@functools.cache
def patience() -> float:
    """Return CPU seconds for a file of some kB: those of making 20,000 layers, the median of five times 100."""
    times = []
    for _ in range(5):
        started = time.process_time()
        for _ in range(100):
            nn.Conv2d(1, 1, 1)
        times.append(time.process_time() - started)
    return 200 * statistics.median(times)


def one_line(error: BaseException, path: Path, cure: str = "") -> None:
    """Assert that the error is a ValueError of one line that names the file and the remedy."""
    text = str(error)
    assert cure in text
    assert isinstance(error, ValueError)
    assert text.startswith(str(path))
    assert "\n" not in text
    assert len(text) < 1000 + len(str(path))
