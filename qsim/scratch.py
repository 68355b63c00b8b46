"""Keeps what a writer has not finished in a folder that is provably its own, beside the output.

    .qsim-TOKEN/record.json   the token again; locked while the writer lives
    .qsim-TOKEN/0, 1          new files or folders, which are renamed to their output when they are complete
    .qsim-TOKEN/old           a folder that was replaced, until it is deleted

TOKEN is 128 random bits and the folder is made exclusively, so no file or link of anybody lies under its names. Of a
writer that was killed, `sweep` deletes the folder: only if its record states the folder's own token, its lock is free,
this user owns it, and it holds nothing but these names. A writer that was killed before it wrote its record left an
empty folder, or one with an empty record. Whatever else looks like it stays.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import shutil
import stat
from pathlib import Path
from types import TracebackType

try:
    import fcntl
except ModuleNotFoundError:
    raise ImportError("qsim runs on Linux and macOS: it locks files by fcntl, which this system lacks") from None

RECORD = "record.json"
OLD = "old"
_NEW = re.compile(r"[0-9]{1,3}")
_FOLDER = re.compile(r"\.qsim-([0-9a-f]{32})")
_EXCLUSIVE = os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC
_LARGEST_RECORD = 1 << 12  # bytes


class Scratch:
    """A new folder beside an output; with everything in it, it is deleted at the end of the block."""

    def __init__(self, output: Path) -> None:
        self._parent = output.parent
        self._lock: int | None = None

    def __enter__(self) -> Scratch:
        while not self._made():  # another process swept the folder before it had its record
            pass
        return self

    def _made(self) -> bool:
        """Make the folder and its record, locked; return False if they were taken for those of a killed writer."""
        token = secrets.token_hex(16)
        self.folder = self._parent / f".qsim-{token}"
        os.mkdir(self.folder, 0o700)
        try:
            lock = os.open(self.folder / RECORD, _EXCLUSIVE, 0o600)
        except FileNotFoundError:
            return False
        except BaseException:
            self.folder.rmdir()
            raise
        try:
            made = self._record(lock, token)
        except BaseException:
            os.close(lock)
            _delete(self.folder)
            raise
        if made:
            self._lock = lock
        else:
            os.close(lock)
        return made

    def _record(self, lock: int, token: str) -> bool:
        """Lock and write the record; return False if another process has taken it."""
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:  # a file system without locks, where nothing is swept
            pass
        os.write(lock, json.dumps({"software": "qsim", "token": token}).encode())
        return (self.folder / RECORD).exists()

    def new(self, number: int = 0) -> Path:
        """Return the name of a new file or folder, which the caller makes, completes and renames."""
        return self.folder / str(number)

    @property
    def old(self) -> Path:
        """Return the name to which a folder that is replaced is moved."""
        return self.folder / OLD

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(OSError):
            _delete(self.folder)
        if self._lock is not None:
            os.close(self._lock)


def sweep(folder: Path) -> None:
    """Delete what killed writers left directly in a folder; a folder that cannot be read or written is left alone."""
    with contextlib.suppress(OSError), os.scandir(folder) as items:
        names = [item.name for item in items if _FOLDER.fullmatch(item.name) and item.is_dir(follow_symlinks=False)]
        for name in names:
            with contextlib.suppress(OSError):
                _sweep(folder / name)


def is_scratch(path: Path) -> bool:
    """Return whether a path lies in a folder whose name is that of a `Scratch`."""
    return any(_FOLDER.fullmatch(part) for part in path.parts)


def _sweep(folder: Path) -> None:
    if os.stat(folder).st_uid != os.geteuid():
        return
    with contextlib.suppress(OSError):
        folder.rmdir()  # an empty one
        return
    lock = os.open(folder / RECORD, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if not stat.S_ISREG(os.fstat(lock).st_mode):
            return
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # an error while its writer lives
        if _is_proven(folder, os.read(lock, _LARGEST_RECORD)):
            _delete(folder)
    finally:
        os.close(lock)


def _is_proven(folder: Path, record: bytes) -> bool:
    """Return whether a record names its folder, which holds only what a writer makes."""
    names = os.listdir(folder)
    if not record:
        return names == [RECORD]
    try:
        found = json.loads(record)
    except ValueError:
        return False
    ours = isinstance(found, dict) and f".qsim-{found.get('token')}" == folder.name
    return ours and all(name in (RECORD, OLD) or _NEW.fullmatch(name) for name in names)


def _delete(folder: Path) -> None:
    """Delete the contents, then the record, which proves that they are ours, then the folder."""
    for name in sorted(os.listdir(folder), key=lambda name: name == RECORD):
        item = folder / name
        if item.is_dir() and not item.is_symlink():
            shutil.rmtree(item)
        else:
            os.unlink(item)
    folder.rmdir()
