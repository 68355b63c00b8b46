"""Damages plain values, for the properties of records: each damage is refused with its place."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

WRONG = ({"a": 1}, [[[]]], True, "\0", math.nan, math.inf, -1, 10**40, None)


def places(values: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Yield the path of every value in plain values, tables and lists included."""
    if path:
        yield path
    inner: Iterable[tuple[str | int, Any]] = ()
    if isinstance(values, dict):
        inner = values.items()
    elif isinstance(values, list):
        inner = enumerate(values)
    for key, value in inner:
        yield from places(value, (*path, key))


def replaced(values: Any, path: tuple[str | int, ...], wrong: Any) -> Any:
    """Return plain values with another one at a path."""
    changed = copy.deepcopy(values)
    at(changed, path[:-1])[path[-1]] = wrong
    return changed


def at(values: Any, path: Sequence[str | int]) -> Any:
    """Return the value at a path."""
    for key in path:
        values = values[key]
    return values


def attempt(make: Callable[[], Any]) -> tuple[Any, str]:
    """Return what a function returns, or the message of its `ValueError`."""
    try:
        return make(), ""
    except ValueError as error:
        return None, str(error)


def tables(values: Any) -> list[tuple[str | int, ...]]:
    """Return the paths of all tables of plain values, and of the whole."""
    found = [()] if isinstance(values, dict) else []
    return found + [path for path in places(values) if isinstance(at(values, path), dict)]
