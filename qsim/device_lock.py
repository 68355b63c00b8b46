"""Lets one thread at a time use Dr.Jit and Mitsuba: two at once ended the process, or had each other's variables.

The lock is re-entrant, so a locked function may call another one. It is not held while a caller's own functions run,
as those that hear of progress. A forked child begins with a free lock: the thread that held it does not exist there.
"""

from __future__ import annotations

import functools
import os
import sys
import threading
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from qsim.backend import choose, on_gpu

P = ParamSpec("P")
T = TypeVar("T")

_locks = [threading.RLock()]


def one_thread_at_a_time(function: Callable[P, T]) -> Callable[P, T]:
    """Return the function under the lock of the compiled engine and the renderer."""

    @functools.wraps(function)
    def alone(*arguments: P.args, **options: P.kwargs) -> T:
        with _locks[0]:
            try:
                return function(*arguments, **options)
            finally:
                _finish_kernels()

    return alone


def one_thread_in_order(function: Callable[P, T]) -> Callable[P, T]:
    """Return the function under the same lock; where kernels run on a GPU, they may go on after it.

    All threads share one queue of the GPU, so kernels of the next thread begin behind them.
    """

    @functools.wraps(function)
    def alone(*arguments: P.args, **options: P.kwargs) -> T:
        with _locks[0]:
            try:
                return function(*arguments, **options)
            finally:
                if not on_gpu(choose().backend):
                    _finish_kernels()

    return alone


def _finish_kernels() -> None:
    """Wait for what this thread launched: kernels of the next thread do not know of it, and may read its output."""
    drjit = sys.modules.get("drjit")
    if drjit is not None:
        drjit.sync_thread()


def _renew() -> None:
    _locks[0] = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)
