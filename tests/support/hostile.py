"""Files with anything in them: refused in one line, in bounded time and memory."""

from __future__ import annotations

import functools
import hashlib
import math
import time
from pathlib import Path
from typing import Any

NUMBERS = (0, -1, 1, 2, 3, 7, 64, 1e300, -1e300, 0.5, 1e-300, 2**31, 2**63, 10**9, 10**400, math.nan, math.inf)
VALUES: tuple[Any, ...] = (
    *NUMBERS,
    *(None, True, False, "", "3", "x" * 5000, [], {}, [2], [0], [10**9], [2] * 1000, [[2]], {"a": 1}, [None], ["2"]),
)
MEMORY = 200e6  # bytes, for one file of some kB: far more than it needs, far less than an unbounded one takes


@functools.cache
def patience() -> float:
    """CPU seconds for one file of some kB: as long as hashing 2 GB takes, 200 times 10 MB here."""
    started = time.process_time()
    hashlib.sha256(bytes(10_000_000)).digest()
    return 200 * (time.process_time() - started)


def one_line(error: BaseException, path: Path, cure: str = "") -> None:
    """A ValueError in one line of moderate length that names the file and the cure."""
    text = str(error)
    assert cure in text
    assert isinstance(error, ValueError)
    assert text.startswith(str(path))
    assert "\n" not in text
    assert len(text) < 1000 + len(str(path))
