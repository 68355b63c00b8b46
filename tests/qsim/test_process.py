"""Tests the memory of the process: bytes on Linux and on macOS."""

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from qsim import process


def test_the_peak_follows_an_allocation_and_can_be_reset():
    code = (
        "import numpy as np; from qsim import process\n"
        "before = process.reset_peak()\n"
        "held = np.ones(1 << 23)\n"  # 64 MiB
        "grown = process.peak_memory() - before\n"
        "assert 60 << 20 < grown < 80 << 20, grown\n"
        "assert process.resident_memory() <= process.peak_memory()\n"
        "del held\n"
        "assert process.reset_peak() < before + (16 << 20)\n"
    )
    if not Path("/proc/self/clear_refs").exists():
        pytest.skip("only Linux can reset the peak")
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])


@pytest.mark.parametrize(("system", "unit"), [("darwin", 1), ("linux", 1024)])
def test_without_proc_the_unit_is_that_of_the_system(monkeypatch, system, unit):
    def missing(*_: object, **__: object) -> str:
        raise OSError

    monkeypatch.setattr(process.Path, "read_text", missing)
    monkeypatch.setattr(process.sys, "platform", system)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert process.peak_memory() == process.resident_memory() == most * unit
    assert np.isfinite(most)


def test_the_largest_child_is_counted_once_it_has_ended():
    code = (
        "import subprocess, sys; from qsim import process; before = process.peak_memory_of_children();"
        "subprocess.run([sys.executable, '-c', 'bytearray(200_000_000)']);"
        "print(before, process.peak_memory_of_children())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    before, after = map(int, done.stdout.split())
    assert before == 0
    assert 200e6 < after < 400e6
