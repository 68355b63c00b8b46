"""The conditions of a service: what a process lacks when no person started it, and what happens to it meanwhile."""

from __future__ import annotations

import itertools
import os
import pwd
import signal
import sys
import time
from collections.abc import Callable
from typing import NoReturn

YEARS = 10 * 365 * 86400.0  # s


def no_errors() -> None:
    """Standard error is closed, as of a daemon."""
    os.close(2)
    sys.stderr = None  # type: ignore[assignment]


def full_log() -> None:
    """Standard error goes to a full disk."""
    os.dup2(os.open("/dev/full", os.O_WRONLY), 2)


def no_home() -> None:
    """No home, and a user without a name."""
    for name in ("HOME", "USER", "LOGNAME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR"):
        os.environ.pop(name, None)

    def unknown(uid: int) -> NoReturn:
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    pwd.getpwuid = unknown


def home_to_read() -> None:
    """A home in which nobody can write, not even root."""
    os.environ["HOME"] = "/proc"
    for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR"):
        os.environ.pop(name, None)


def narrow_mask() -> None:
    """New files are of their owner alone."""
    os.umask(0o077)


def jumping_clock() -> None:
    """Each look at the clock finds it ten years before or after the last."""
    now = time.time
    shifts = itertools.cycle((0.0, YEARS, -YEARS))
    time.time = lambda: now() + next(shifts)
    time.time_ns = lambda: int(1e9 * time.time())


CONDITIONS: dict[str, Callable[[], None]] = {
    made.__name__: made for made in (no_errors, full_log, no_home, home_to_read, narrow_mask, jumping_clock)
}


def killed() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def hung_up() -> None:
    """The terminal closes."""
    os.kill(os.getpid(), signal.SIGHUP)


def terminated() -> None:
    """A service manager ends the service."""
    os.kill(os.getpid(), signal.SIGTERM)


def stopped() -> None:
    """The process stops for a moment."""
    me = os.getpid()
    if os.fork() == 0:
        time.sleep(0.05)
        os.kill(me, signal.SIGCONT)
        os._exit(0)
    os.kill(me, signal.SIGSTOP)
    os.wait()


EVENTS: dict[str, Callable[[], None]] = {made.__name__: made for made in (killed, hung_up, terminated, stopped)}
