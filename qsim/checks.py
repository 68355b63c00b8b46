"""Checks names, paths and arrays, and words values for messages. What single values expect: kinds.py, records.py."""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, get_args

import numpy as np

from qsim import kinds, limits

ROW_ORDERS: tuple[str, ...] = get_args(kinds.RowOrder)
SPLITS: tuple[str, ...] = get_args(kinds.Split)


class ArgumentError(ValueError):
    """A value that cannot be used, by the name of its argument; command lines replace the name by that of an option.

    Of a flag that may be unset, `off` is the value False: its option is another one.
    """

    def __init__(self, argument: str, problem: str, *, off: bool = False) -> None:
        super().__init__(f"{argument}{'=False' if off else ''}: {problem}")
        self.argument = argument
        self.problem = problem
        self.off = off


def suggest(word: str, known: Iterable[str]) -> str:
    """Return ` (did you mean '...'?)`, or an empty text if no known word is close."""
    close = difflib.get_close_matches(word, list(known), n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""


def shown(value: Any) -> str:
    """Return a value for a message, at most 60 characters."""
    if isinstance(value, int) and abs(value) >= 10**30:  # Python refuses to print thousands of digits
        return "a number of more than 30 digits"
    try:
        return repr(value)[:60]
    except RecursionError:
        return "a value that is nested too deeply"


def file_path(value: Any) -> Path:
    """Return the path of a name; `ValueError` for a value of another type."""
    if not isinstance(value, str | os.PathLike):
        raise ValueError(f"path is the name of a file or folder, got {shown(value)}")
    return Path(value)


def require_finite(name: str, values: np.ndarray) -> None:
    """Raise `ValueError` with value and index of the first value that is not finite."""
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        raise ValueError(f"{name}: {values[index]} at index {index}; every value must be finite")


def check_video(path: Path, shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Return (T, H, W) of frames [T, H, W], or [T, 3, H, W] in colour; errors as of `check_shape`."""
    in_colour = len(shape) == 4 and shape[1] == 3
    return check_shape(path, (shape[0], *shape[2:]) if in_colour else shape)


def check_shape(path: Path, shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Return (T, H, W) if there is at least one frame of 1 to limits.PIXELS pixels, else raise `ValueError`."""
    if len(shape) != 3:
        raise ValueError(f"{path}: expected frames [T, H, W], found an array of shape {list(shape)}")
    frames, height, width = (int(n) for n in shape)
    if frames < 1:
        raise ValueError(f"{path}: has no frames")
    if not (0 < height * width <= limits.PIXELS and height > 0):
        raise ValueError(f"{path}: frames of {height} x {width} pixels; between 1 and {limits.PIXELS} pixels are read")
    return frames, height, width
