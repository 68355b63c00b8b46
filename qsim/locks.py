"""Locks files, exclusively or shared; the system releases a lock when its process ends.

A lock file appears with its content, `RECORD`, in one step. So a file, link or pipe that somebody else put under the
name of a lock is known as such: it is refused, and neither locked nor deleted.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from qsim.files import naming
from qsim.scratch import Scratch

try:
    import fcntl
except ModuleNotFoundError:
    raise ImportError("qsim runs on Linux and macOS: it locks files by fcntl, which this system lacks") from None

RECORD = b"a lock of qsim\n"
_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS)  # of a file system without hard links


class Lock:
    """An advisory lock on a file, exclusive or shared.

    `acquire` returns False if another process holds the lock and `wait` is False.
    """

    def __init__(self, path: Path, *, shared: bool = False) -> None:
        self.path = path
        self.mode = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        self._file: BinaryIO | None = None

    def acquire(self, *, wait: bool = False, on_wait: Callable[[], None] | None = None) -> bool:
        """Take the lock. With `wait`, `on_wait` is called once before waiting for another holder.

        `FileExistsError` if something else than a lock is there.
        """
        while True:
            file = self._opened()  # while the lock is held
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

    def _opened(self) -> BinaryIO:
        """Return the lock file, made if there is none; open for reading too, which NFS needs for a shared lock."""
        foreign = FileExistsError(f"{self.path}: exists and is not a lock of this program; move it away")
        while True:
            try:
                descriptor = os.open(self.path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
            except FileNotFoundError:
                self._create()
                continue
            except OSError as error:
                if error.errno in (errno.ELOOP, errno.EISDIR):
                    raise foreign from None
                raise
            file = os.fdopen(descriptor, "r+b", buffering=0)
            if stat.S_ISREG(os.fstat(descriptor).st_mode) and os.pread(descriptor, len(RECORD) + 1, 0) == RECORD:
                return file
            file.close()
            raise foreign

    def _create(self) -> None:
        """Make the lock file in one step, unless another process made it meanwhile."""
        with naming(self.path), Scratch(self.path) as scratch:
            with open(scratch.new(), "xb") as file:
                file.write(RECORD)
                file.flush()
                os.fsync(file.fileno())  # after a power cut an empty lock would be somebody else's
            try:
                os.link(scratch.new(), self.path)
            except FileExistsError:
                return
            except OSError as error:
                if error.errno not in _NO_LINKS:
                    raise
                with open(self.path, "xb") as file:
                    file.write(RECORD)

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
