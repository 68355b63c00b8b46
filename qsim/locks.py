"""Advisory locks on files, exclusive or shared, which the system releases when their holder ends."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import BinaryIO


class Lock:
    """An exclusive or shared advisory lock on a file; the system frees it when the process ends, however it ends.

    `acquire` returns False when another process holds it and `wait` is False.
    """

    def __init__(self, path: Path, *, shared: bool = False) -> None:
        self.path = path
        self.mode = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        self._file: BinaryIO | None = None

    def acquire(self, *, wait: bool = False, on_wait: Callable[[], None] | None = None) -> bool:
        """Take the lock. With `wait`, `on_wait` is called once before waiting for another holder."""
        while True:
            # Open as long as the lock is held; for reading too, because NFS wants that for a shared lock.
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
            file.close()  # its holder deleted it: the lock is on another file by now

    def _is_current(self, file: BinaryIO) -> bool:
        """Whether the opened file is still the one of that name."""
        try:
            return os.path.samestat(os.fstat(file.fileno()), os.stat(self.path))
        except FileNotFoundError:
            return False

    def delete(self) -> None:
        """Delete the lock's file and give the lock back; who waits for it takes a new one."""
        if self._file is not None:
            self.path.unlink(missing_ok=True)
        self.release()

    def release(self) -> None:
        """Give the lock back; harmless if it is not held."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> Lock:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()
