"""Handles signals while a command runs."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

ENDING = (signal.SIGTERM, signal.SIGHUP)  # what asks a program to end: a service manager, a terminal that closes


@contextlib.contextmanager
def handling(handler: Callable[[int, Any], Any], *numbers: signal.Signals) -> Iterator[None]:
    """Send signals to `handler` inside the block; in other threads than the main one nothing changes."""
    main_thread = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, handler) for number in numbers if main_thread}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def ending() -> contextlib.AbstractContextManager[None]:
    """Let termination and a closed terminal end the block as Ctrl-C does; a host's own handler, and nohup, stay."""
    numbers = [number for number in ENDING if signal.getsignal(number) is signal.SIG_DFL]
    return handling(signal.default_int_handler, *numbers)
