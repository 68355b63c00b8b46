"""Locks files, exclusively or shared; the system releases a lock when its process ends."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

try:
    import fcntl
except ModuleNotFoundError:
    raise ImportError("qsim runs on Linux and macOS: it locks files by fcntl, which this system lacks") from None


class Lock:
    """An advisory lock on a file, exclusive or shared.

    `acquire` returns False if another process holds the lock and `wait` is False.
    """

    def __init__(self, path: Path, *, shared: bool = False) -> None:
        self.path = path
        self.mode = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        self._file: BinaryIO | None = None

    def acquire(self, *, wait: bool = False, on_wait: Callable[[], None] | None = None) -> bool:
        """Take the lock. With `wait`, `on_wait` is called once before waiting for another holder."""
        while True:
            # The file is open while the lock is held; NFS needs it open for reading too for a shared lock.
            file = open(self.path, "a+b")  # noqa: SIM115
            try:
                try:
                    fcntl.flock(file, self.mode | fcntl.LOCK_NB)
                except BlockingIOError:
                    if not wait:
                        file.close()
                        return False
                    if on_wait is not None:
                        on_wait()
                        on_wait = None
                    fcntl.flock(file, self.mode)
                if self._is_current(file):
                    self._file = file
                    return True
            except BaseException:
                file.close()
                raise
            file.close()  # its holder deleted it: this lock is on a file without a name

    def _is_current(self, file: BinaryIO) -> bool:
        """Return whether the opened file still has its name."""
        try:
            return os.path.samestat(os.fstat(file.fileno()), os.stat(self.path))
        except FileNotFoundError:
            return False

    def delete(self) -> None:
        """Delete the file and release the lock; a waiting process then locks a new file."""
        if self._file is not None:
            self.path.unlink(missing_ok=True)
        self.release()

    def release(self) -> None:
        """Release the lock; does nothing if it is not held."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> Lock:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()
