"""Handles signals while a command runs."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any


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
