"""Tests locks whose file is deleted, and a system that has none."""

import subprocess
import sys
from pathlib import Path

from qsim import locks


def test_a_lock_whose_file_is_deleted_is_taken_on_the_new_one(tmp_path: Path):
    """A process that waited for a deleted file must not hold the lock as well."""
    first, second, third = (locks.Lock(tmp_path / "lock") for _ in range(3))
    assert first.acquire()
    (tmp_path / "lock").unlink()
    assert second.acquire(), "the name is free"
    first.release()
    assert not third.acquire()
    second.delete()
    assert third.acquire()
    third.delete()
    assert list(tmp_path.iterdir()) == []


def test_a_system_without_posix_locks_is_named():
    code = "import sys; sys.modules['fcntl'] = None; import qsim.locks"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert found.returncode == 1
    assert "ImportError: qsim runs on Linux and macOS: it locks files by fcntl" in found.stderr
