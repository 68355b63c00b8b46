"""Measures the memory of this process, in bytes on every system."""

from __future__ import annotations

import contextlib
import os
import resource
import sys
from pathlib import Path


def peak_memory() -> int:
    """Return the largest resident memory of this process since `reset_peak`, or since its start [bytes]."""
    with contextlib.suppress(OSError, IndexError):  # of a system without /proc
        return int(Path("/proc/self/status").read_text(encoding="ascii").split("VmHWM:")[1].split()[0]) * 1024
    return _peak_of(resource.RUSAGE_SELF)


def peak_memory_of_children() -> int:
    """Return the resident memory of the largest child process that has ended [bytes]; 0 without one.

    Linux gives a child at least the memory that this process had when it started the child (getrusage(2)).
    """
    return _peak_of(resource.RUSAGE_CHILDREN)


def _peak_of(who: int) -> int:
    unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss: bytes on macOS, KiB elsewhere
    return resource.getrusage(who).ru_maxrss * unit


def reset_peak() -> int:
    """Start the peak again where the system can (Linux); return `peak_memory` [bytes]."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return peak_memory()


def resident_memory() -> int:
    """Return the resident memory of this process [bytes]; its peak where the system has no /proc."""
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    except OSError:
        return peak_memory()
    return int(pages) * os.sysconf("SC_PAGE_SIZE")
