"""Files that are either whole or absent: temporary names, sync, rename, checksums, locks.

    write_bytes / write_json:  NAME.tmp-PID -> fsync -> rename, so that a killed writer leaves nothing a reader accepts.
    Lock:                      an advisory lock that the system releases when its holder dies.

Every file that `qsim` makes goes through here, which is also where tests inject a full disk.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import shutil
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

FULL = (errno.ENOSPC, errno.EDQUOT)  # of an `OSError`: no space left


def sha256(source: bytes | Path) -> str:
    """Hexadecimal SHA-256 of some bytes or of a file."""
    if isinstance(source, bytes):
        return hashlib.sha256(source).hexdigest()
    with open(source, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sync_folder(folder: Path) -> None:
    """Make renames inside `folder` survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A binary file that appears under `path` when the block ends well, and not at all otherwise.

    An `OSError` of the system (a full disk, a folder that is not ours) names the file.
    """
    temporary = path.with_name(f"{path.name}.tmp-{os.getpid()}")
    try:
        with _naming(path, temporary):
            with open(temporary, "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def append_line(path: Path, line: bytes) -> None:
    """Add a line to a journal, synced; a killed writer leaves at most a last line cut short."""
    with _naming(path), open(path, "ab") as journal:
        journal.write(line + b"\n")
        journal.flush()
        os.fsync(journal.fileno())


@contextlib.contextmanager
def _naming(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Writes that fail do not say where, or name a temporary file: put the file's own name into their `OSError`."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename in (None, str(temporary)):
            error.filename = str(path)
            error.filename2 = None
        raise


def sweep(folder: Path, pattern: str = "*") -> None:
    """Delete what killed writers of `folder` left: temporary files and half-removed folders of files named `pattern`.

    Only for a caller who holds the lock that all writers of the folder take.
    """
    for leftover in [*folder.rglob(f"{pattern}.tmp-*"), *folder.glob(f"{pattern}.removed-*")]:
        if leftover.is_dir():
            shutil.rmtree(leftover)
        else:
            leftover.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> str:
    """Write a whole file atomically; returns its SHA-256."""
    with replacing(path) as file:
        file.write(content)
    return sha256(content)


def to_json(value: Any) -> bytes:
    """JSON with sorted keys and one stable spelling, so that equal contents are equal bytes; NaN is refused."""
    return (json.dumps(value, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()


def write_json(path: Path, value: Any) -> str:
    """Write `value` atomically as JSON; returns the SHA-256 of the file."""
    return write_bytes(path, to_json(value))


def differs(path: Path, expected: str | None) -> list[str]:
    """What is wrong with a file that had this SHA-256, in words; empty if nothing is."""
    if not path.is_file():
        return [f"{path}: missing"]
    return [] if sha256(path) == expected else [f"{path}: contents changed (checksum differs)"]


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """A TOML file; `FileNotFoundError` that says `what` is missing, `ValueError` for another kind of file."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such {what}")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not a TOML file: {error}") from None


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file; `ValueError` with the file's name if it is damaged or not an object."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: not readable as JSON ({error}); the file is damaged, make it again") from None
    if not isinstance(value, dict):
        raise ValueError(f"{path}: expected a JSON object, found a {type(value).__name__}")
    return value


def check_version(path: Path, found: object, known: int) -> None:
    """`ValueError` that names both versions if a file has another format version than this program."""
    if found == known:
        return
    newer = isinstance(found, int) and found > known
    advice = "it was made by a newer qsim: update this one" if newer else "make it again with this qsim"
    raise ValueError(f"{path}: format version {found!r}, this qsim reads version {known}; {advice}")


def remove_folder(folder: Path) -> None:
    """Delete a folder so that no moment leaves something that looks whole: it first loses its name."""
    doomed = folder.with_name(f"{folder.name}.removed-{os.getpid()}")
    os.replace(folder, doomed)
    shutil.rmtree(doomed)


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
        # Open as long as the lock is held; for reading too, because NFS wants that for a shared lock.
        file = open(self.path, "a+b")  # noqa: SIM115
        try:
            fcntl.flock(file, self.mode | fcntl.LOCK_NB)
        except BlockingIOError:
            if not wait:
                file.close()
                return False
            if on_wait is not None:
                on_wait()
            fcntl.flock(file, self.mode)
        self._file = file
        return True

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
