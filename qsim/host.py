"""Keeps what the host program has set in NumPy out of the numbers of this one, and leaves it as it is.

    @own_numbers        of a function, or of a class for all its public methods: inside, NumPy has its own defaults for
                        errors, in this thread and task alone

A program that lets NumPy raise on underflow would otherwise end in the tails of every distribution. quiver/host.py does
the same for torch.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, TypeVar

import numpy as np

Own = TypeVar("Own", bound=Callable[..., Any])

_MORE = ("__post_init__", "__getitem__", "__call__")  # methods that are public by another name
_MARK = "__own_numbers__"


def numbers() -> AbstractContextManager[Any]:
    """Return a context in which NumPy's errors are its defaults."""
    return np.errstate(divide="warn", over="warn", invalid="warn", under="ignore")


def own_numbers(own: Own) -> Own:
    """Let a function, or the methods of a class, compute as in a program that has set nothing in NumPy.

    Properties and generators are left as they are.
    """
    if isinstance(own, type):
        for name, member in list(vars(own).items()):
            if not name.startswith("_") or name in _MORE:
                _guard(own, name, member)
        return own
    return _guarded(own)


def _guard(owner: type, name: str, member: Any) -> None:
    """Replace a method of a class by one with its own numbers."""
    if isinstance(member, staticmethod | classmethod):
        setattr(owner, name, type(member)(_guarded(member.__func__)))
    elif inspect.isfunction(member):
        setattr(owner, name, _guarded(member))


def _guarded(function: Any) -> Any:
    if hasattr(function, _MARK) or inspect.isgeneratorfunction(function):
        return function

    @functools.wraps(function)
    def computed(*args: Any, **kwargs: Any) -> Any:
        with numbers():
            return function(*args, **kwargs)

    setattr(computed, _MARK, True)
    return computed
