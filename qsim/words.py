"""Reads words that types do not explain, such as `240x320`, `2GB` or `0.1:30`; `ValueError` with the expected form."""

from __future__ import annotations


def count(text: str) -> int:
    """Return a whole number of at least 1."""
    if not text.strip().isdecimal() or int(text) < 1:
        raise ValueError(f"expected a whole number of at least 1, got {text!r}")
    return int(text)


def positive_numbers(text: str) -> tuple[float, ...]:
    """Return finite numbers above 0: `3.25,9.75` -> (3.25, 9.75)."""
    found = []
    for part in text.split(","):
        try:
            value = float(part)
        except ValueError:
            value = float("nan")
        if not 0 < value < float("inf"):
            raise ValueError(f"expected a number above 0, got {part!r}")
        found.append(value)
    return tuple(found)


def frame_size(text: str) -> tuple[int, int]:
    """Return rows and columns: `128x256` -> (128, 256)."""
    height, cross, width = text.partition("x")
    if not cross:
        raise ValueError(f"expected ROWSxCOLUMNS, as in 240x320, got {text!r}")
    return count(height), count(width)


def memory_size(text: str) -> int:
    """Return the bytes of `2GB`, `500MB`, `1.5GiB` or a number."""
    units = {"kb": 1e3, "mb": 1e6, "gb": 1e9, "kib": 2**10, "mib": 2**20, "gib": 2**30, "b": 1, "": 1}
    number = text.rstrip("KMGiBkmgb")
    unit = text[len(number) :].lower()
    try:
        value = float(number) * units[unit]
    except (ValueError, KeyError):
        value = float("nan")
    if not 1 <= value < 2**63:
        raise ValueError(f"expected a size such as 2GB or 500MB, got {text!r}")
    return int(value)


def part_of(text: str) -> tuple[int, int]:
    """Return `7/100` as (7, 100)."""
    first, _, last = text.partition("/")
    if not (first.isdigit() and last.isdigit() and 1 <= int(first) <= int(last)):
        raise ValueError(f"expected I/N with 1 <= I <= N, as in 7/100, got {text!r}")
    return int(first), int(last)


def steps(text: str) -> list[float]:
    """Return numbers above 0 of `3.25`, `0.5,3,26`, `0.1:30` (geometric steps) or `0.5:8:5` (five of them)."""
    import numpy as np

    words = text.split(":")
    try:
        if len(words) == 1:
            found = [float(word) for word in text.split(",")]
        else:
            low = float(words[0])
            high = float(words[1])
            count = int(words[2]) if len(words) == 3 else _doublings(low, high)
            found = [float(f"{v:.4g}") for v in np.geomspace(low, high, count)]
    except (ValueError, IndexError, ZeroDivisionError):
        found = []
    if not found or len(words) > 3 or not all(0 < v < float("inf") for v in found):
        raise ValueError(f"expected numbers above 0, as in 0.65 or 0.1,1,10 or 0.1:30 or 0.5:8:5, got {text!r}")
    return found


def _doublings(low: float, high: float) -> int:
    """Return the number of steps: one per factor of 2 if the range is a power of 2 up to 32, else six."""
    from math import isclose, log2

    octaves = log2(high / low)
    return round(octaves) + 1 if 0 < octaves < 5.5 and isclose(octaves, round(octaves)) else 6
