"""Lets HDF5 write to a disk that may be full: the library ends the process (SIGSEGV) where its own writing fails.

with writable(file) as (stored, check):     an h5py.File
    ... check()                              raises the `OSError` of a write that failed, as the end of the block does
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO


class _Output(io.RawIOBase):
    """A file, as HDF5 sees it: no write fails, and no Ctrl-C ends one. What is written after either is kept in memory,
    for HDF5 to close.
    """

    def __init__(self, file: BinaryIO) -> None:
        self.error: BaseException | None = None  # the first one
        self._descriptor = file.fileno()
        self._place = 0
        self._size = 0
        self._kept: list[tuple[int, bytes]] = []

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._size}[whence]
        self._place = start + offset
        return self._place

    def tell(self) -> int:
        return self._place

    def write(self, content: Any) -> int:
        place = self._place
        try:
            return self._write(content)
        except BaseException as error:  # a signal
            self.error = self.error or error
            self._place = place
            return self._write(content)

    def _write(self, content: Any) -> int:
        rest = memoryview(content).cast("B")
        total = len(rest)
        while len(rest):
            rest = rest[self._written(rest) :]
        return total

    def _written(self, rest: memoryview) -> int:
        """Write or keep a part of the bytes; return how many."""
        done = 0
        if self.error is None:
            try:
                done = os.pwrite(self._descriptor, rest, self._place)
            except BaseException as error:
                self.error = error
        if self.error is not None:
            done = len(rest)
            self._kept.append((self._place, bytes(rest)))
        self._place += done
        self._size = max(self._size, self._place)
        return done

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        wanted = max(0, min(len(view), self._size - self._place))
        found = os.pread(self._descriptor, wanted, self._place)
        view[:wanted] = found + bytes(wanted - len(found))
        for place, content in self._kept:
            first = max(place, self._place)
            last = min(place + len(content), self._place + wanted)
            if first < last:
                view[first - self._place : last - self._place] = content[first - place : last - place]
        self._place += wanted
        return wanted

    def truncate(self, size: int | None = None) -> int:
        self._size = self._place if size is None else size
        if self.error is None:
            try:
                os.truncate(self._descriptor, self._size)
            except BaseException as error:
                self.error = error
        return self._size


@contextlib.contextmanager
def writable(file: BinaryIO) -> Iterator[tuple[Any, Callable[[], None]]]:
    """Return an open `h5py.File` that is written to a file, and a function that raises what its writing met.

    That is the `OSError` of a full disk, or the `KeyboardInterrupt` of a signal.
    """
    import h5py

    output = _Output(file)

    def check() -> None:
        if output.error is not None:
            raise output.error

    with h5py.File(output, "w") as stored:
        yield stored, check
    check()
