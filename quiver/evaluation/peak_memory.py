"""Peak resident memory of this process, as Linux counts it; elsewhere the highest since the start."""

from __future__ import annotations

import contextlib
import resource
from pathlib import Path


def reset_peak() -> int:
    """Forget the peak so far; resident memory of this process now, bytes. (Linux; elsewhere the old peak stays.)"""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return peak_memory()


def peak_memory() -> int:
    """Largest resident memory of this process since `reset_peak`, bytes."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return int(status.split("VmHWM:")[1].split()[0]) * 1024
