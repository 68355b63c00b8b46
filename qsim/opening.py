"""Opens files that others may have made: every reader of a user's file comes through here.

    content(path, most)    bytes of a small file              text(path)   its text
    opened(path)           an open file                       regular(path)   its name, for libraries that open names

The file is regular: a pipe would be waited for, a device has no end. It has at most `most` bytes, counted before any is
read. With `beside`, a folder whose description names the file, no link leads out of that folder.
"""

from __future__ import annotations

import io
import os
import stat
from pathlib import Path

from qsim import limits

_OPENING = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC  # a pipe without a writer is opened at once, and refused


def opened(path: Path, what: str = "file", *, most: int | None = None, beside: Path | None = None) -> io.BufferedReader:
    """Return a regular file, open for reading; `FileNotFoundError` names `what` is missing.

    `ValueError` for a folder, a pipe or a device, for more than `most` bytes, and for a link out of `beside`.
    """
    _check_place(path, beside)
    try:
        descriptor = os.open(path, _OPENING)
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(f"{path}: no such {what}") from None
    except OSError as error:
        if isinstance(error, PermissionError):
            raise
        raise ValueError(f"{path}: cannot be opened ({error.strerror}); a {what} is expected") from None
    try:
        _check(path, os.fstat(descriptor), what, most)
    except BaseException:
        os.close(descriptor)
        raise
    return open(path, "rb", opener=lambda _name, _flags: descriptor)  # has the name, which libraries ask for


def regular(path: Path, what: str = "file", *, most: int | None = None, beside: Path | None = None) -> Path:
    """Return the path of a regular file, for a library that opens it by name; errors as of `opened`."""
    opened(path, what, most=most, beside=beside).close()
    return path


def content(path: Path, what: str = "file", *, most: int = limits.TEXT, beside: Path | None = None) -> bytes:
    """Return the bytes of a regular file; errors as of `opened`, also if it grows beyond `most` meanwhile."""
    with opened(path, what, most=most, beside=beside) as file:
        found = file.read(most + 1)
    _check_size(path, len(found), most)
    return found


def text(path: Path, what: str = "file", *, most: int = limits.TEXT, beside: Path | None = None) -> str:
    """Return the text of a regular file in UTF-8, without a mark of byte order; `ValueError` for other bytes."""
    try:
        return content(path, what, most=most, beside=beside).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file in UTF-8 ({error}); a {what} is expected") from None


def _check(path: Path, status: os.stat_result, what: str, most: int | None) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise ValueError(f"{path}: is a folder, a pipe or a device, no regular file; a {what} is expected")
    if most is not None:
        _check_size(path, status.st_size, most)


def _check_size(path: Path, size: int, most: int) -> None:
    if size > most:
        raise ValueError(f"{path}: has {size} bytes; at most {most} are read")


def _check_place(path: Path, beside: Path | None) -> None:
    """Raise `ValueError` for a file that a link puts outside the folder of its description."""
    if beside is not None and not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(beside)):
        raise ValueError(f"{path}: is a link out of {beside}; put the file itself there")
