"""Checks single values of options and files: returns the value in its type, or reports the expected form."""

from __future__ import annotations

import difflib
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

ROW_ORDERS = ("down", "up", "right", "left")  # rows from the top or the bottom, columns from the left or the right
SPLITS = ("train", "val", "test")
MAX_PIXELS = 1 << 26  # of one frame: 8192 x 8192


class ArgumentError(ValueError):
    """A value that cannot be used, by the name of its argument; command lines replace the name by that of an option."""

    def __init__(self, argument: str, problem: str) -> None:
        super().__init__(f"{argument}: {problem}")
        self.argument = argument
        self.problem = problem


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


def text(value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise ValueError(f"expected a text in quotes, got {value!r}")
    return value


def flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"expected true or false, got {value!r}")
    return value


def real(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"expected a number, got {shown(value)}")
    return float(value)


def integer(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"expected a whole number, got {shown(value)}")
    return value


def positive(value: Any) -> float:
    number = real(value)
    if not 0 < number < float("inf"):
        raise ValueError(f"expected a number above 0, got {value!r}")
    return number


def light(value: Any) -> float:
    number = positive(value)
    if not 1e-6 <= number < 1e6:
        raise ValueError(f"expected a light level from 1e-6 to 1e6 photons per pixel (or lux), got {value!r}")
    return number


def speed(value: Any) -> float:
    number = positive(value)
    if not 1e-3 <= number <= 1e3:
        raise ValueError(f"expected a factor on all motions from 0.001 to 1000, got {value!r}")
    return number


def whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 100_000:
        raise ValueError(f"expected a whole number from 1 to 100000, got {value!r}")
    return value


def seed(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**31:
        raise ValueError(f"expected a whole number from 0 to 2^31 - 1, got {value!r}")
    return value


def bits(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 16:
        raise ValueError(f"expected 1 to 16 bits per code, got {value!r}")
    return value


def planes(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 1 << 24:
        raise ValueError(f"expected the number of binary planes in one value, 1 to 16777216, got {value!r}")
    return value


def frame_rate(value: Any) -> float:
    number = positive(value)
    if not 1 <= number <= 1e8:
        raise ValueError(f"expected frames per second from 1 to 1e8, got {value!r}; 0.5 ms per frame is 2000.0")
    return number


def shutter(value: Any) -> float:
    number = real(value)
    if not 0 <= number <= 1:
        raise ValueError(f"expected the open share of a frame, 0 to 1, got {value!r}; half of the frame is 0.5")
    return number


def psnr(value: Any) -> float:
    number = real(value)
    if not 10 <= number <= 80:
        raise ValueError(f"expected the wanted error in dB, 10 to 80, got {value!r}; 40.0 is 1 % of the peak")
    return number


def share(value: Any) -> float:
    number = real(value)
    if not 1e-6 <= number <= 1:
        raise ValueError(f"expected a share of a full exposure, above 0 (from 1e-6) to 1, got {shown(value)}")
    return number


def shares(value: Any) -> tuple[float, ...]:
    """Return a schedule of exposures, one share or a list of up to 256."""
    found = tuple(share(item) for item in (value if isinstance(value, list | tuple) else [value]))
    if not 1 <= len(found) <= 256:
        raise ValueError(f"expected 1 to 256 shares of a full exposure, got {len(found)}")
    return found


def row_order(value: Any) -> str:
    if value not in ROW_ORDERS:
        raise ValueError(f"expected the order in which rows are read, {', '.join(ROW_ORDERS)}, got {shown(value)}")
    return str(value)


def split(value: Any) -> str:
    if value not in SPLITS:
        raise ValueError(f"expected one of {', '.join(SPLITS)}, got {value!r}")
    return str(value)


def bands(value: Any) -> str:
    if value != "rgb":
        raise ValueError(f'expected "rgb", red, green and blue (leave bands out for one band), got {value!r}')
    return str(value)


def list_of(check: Callable[[Any], Any]) -> Callable[[Any], list[Any]]:
    """Return a check that takes one value or a list of different values, and returns a list."""

    def checked(value: Any) -> list[Any]:
        values = [check(item) for item in value] if isinstance(value, list) else [check(value)]
        if not values:
            raise ValueError("expected at least one value, got an empty list")
        seen = set()
        for item in values:
            if item in seen:
                raise ValueError(f"{item!r} is listed twice")
            seen.add(item)
        return values

    return checked


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
    """Return (T, H, W) if there is at least one frame of 1 to MAX_PIXELS pixels, else raise `ValueError`."""
    if len(shape) != 3:
        raise ValueError(f"{path}: expected frames [T, H, W], found an array of shape {list(shape)}")
    frames, height, width = (int(n) for n in shape)
    if frames < 1:
        raise ValueError(f"{path}: has no frames")
    if not (0 < height * width <= MAX_PIXELS and height > 0):
        raise ValueError(f"{path}: frames of {height} x {width} pixels; between 1 and {MAX_PIXELS} pixels are read")
    return frames, height, width
