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
import re
import shutil
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

FULL = (errno.ENOSPC, errno.EDQUOT)  # of an `OSError`: no space left
LARGEST = 1 << 64  # whole numbers in files stay below: seeds and keys have 64 bits
DEEPEST = 64  # levels of nesting in a file
_TOO_LARGE = "a whole number of more than 64 bits"
_TOO_DEEP = f"nested more than {DEEPEST} levels deep"


def sha256(source: bytes | memoryview | Path) -> str:
    """Hexadecimal SHA-256 of some bytes or of a file."""
    if not isinstance(source, Path):
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


def write_bytes(path: Path, content: bytes | memoryview) -> str:
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


def checksum(description: dict[str, Any]) -> str:
    """SHA-256 of what a description says, without the checksum that it holds itself."""
    return sha256(to_json({key: value for key, value in description.items() if key != "checksum"}))


def sealed(description: dict[str, Any]) -> dict[str, Any]:
    """The description with the checksum of its other keys, as all descriptions are written."""
    return description | {"checksum": checksum(description)}


def write_description(path: Path, value: dict[str, Any]) -> str:
    """Write `value`, sealed, atomically as JSON; returns the SHA-256 of the file."""
    return write_json(path, sealed(value))


def check_own(path: Path, description: dict[str, Any], cure: str) -> None:
    """`ValueError` if a description is not what was written; one without a checksum (earlier versions) passes."""
    if "checksum" in description and description["checksum"] != checksum(description):
        raise ValueError(f"{path}: contents changed (checksum differs); {cure}")


def differs(path: Path, expected: str | None) -> list[str]:
    """What is wrong with a file that had this SHA-256, in words; empty if nothing is."""
    if not path.is_file():
        return [f"{path}: missing"]
    return [] if sha256(path) == expected else [f"{path}: contents changed (checksum differs)"]


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """A TOML file; `FileNotFoundError` that says `what` is missing, `ValueError` with the line for another content."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such {what}")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file: {error}") from None
    return parse_toml(path, text)


def parse_toml(path: Path, text: str) -> dict[str, Any]:
    """The tables of a TOML text; `ValueError` as `FILE:LINE: ...` if it is not TOML, nests deeply or counts too far."""
    if re.search(
        rf"(?<![\w\"'.-])(?:[\w\"'-]+[ \t]*\.[ \t]*){{{DEEPEST}}}", text
    ):  # the parser takes quadratic time for these
        raise ValueError(f"{path}:{_line_of_depth(text)}: not valid TOML: {_TOO_DEEP}")
    try:
        value = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        found = re.search(r"at line (\d+)", str(error))
        line = found[1] if found else len(text.splitlines())  # else the parser says "at end of document"
        raise ValueError(f"{path}:{line}: not valid TOML: {error}") from None
    except RecursionError:
        raise ValueError(f"{path}:{_line_of_depth(text)}: not valid TOML: {_TOO_DEEP}") from None
    except ValueError:  # of `int` for thousands of digits
        raise ValueError(f"{path}:{_line_of_number(text)}: not valid TOML: {_TOO_LARGE}") from None
    if problem := _too_much(value, text, infinite=True):  # which TOML can spell; each key's check refuses it
        raise ValueError(f"{path}:{problem[0]}: not valid TOML: {problem[1]}")
    return value


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file; `ValueError` with the file's name if it is damaged or not an object.

    NaN, infinity, whole numbers beyond 64 bits and deep nesting are refused: nothing of ours writes them.
    """
    try:
        text = path.read_text(encoding="utf-8")
        value = json.loads(text, parse_constant=_no_constant)
        problem = _too_much(value, text)
    except RecursionError:
        problem, value = (_line_of_depth(text), _TOO_DEEP), None
    except (json.JSONDecodeError, UnicodeDecodeError, _NotFinite) as error:
        raise ValueError(f"{path}: not readable as JSON ({error}); the file is damaged, make it again") from None
    except ValueError:  # of `int` for thousands of digits
        problem, value = (_line_of_number(text), _TOO_LARGE), None
    if problem:
        raise ValueError(
            f"{path}: not readable as JSON ({problem[1]} in line {problem[0]}); the file is damaged, make it again"
        )
    if not isinstance(value, dict):
        raise ValueError(f"{path}: expected a JSON object, found a {type(value).__name__}")
    return value


class _NotFinite(ValueError):
    """NaN or infinity in JSON."""


def _no_constant(name: str) -> float:
    raise _NotFinite(f"{name} where a number is needed")


def _too_much(value: Any, text: str, infinite: bool = False) -> tuple[int, str] | None:
    """(line, problem) of the first value that is nested too deeply or too large; None if there is none."""
    waiting: list[tuple[Any, int]] = [([value], 0)]
    while waiting:
        item, depth = waiting.pop()
        for inner in item.values() if isinstance(item, dict) else item:
            if isinstance(inner, dict | list):
                if depth == DEEPEST:
                    return _line_of_depth(text), _TOO_DEEP
                waiting.append((inner, depth + 1))
            elif isinstance(inner, int) and abs(inner) >= LARGEST:
                return _line_of_number(text), _TOO_LARGE
            elif isinstance(inner, float) and not infinite and abs(inner) == float("inf"):
                return 1, "a number of more than 1e308"
    return None


def _line_of_depth(text: str) -> int:
    """The first line that nests too deeply, by brackets or by dots; 1 if none is found."""
    depth = 0
    for n, line in enumerate(text.splitlines(), 1):
        bare = re.sub(r'"(?:\\.|[^"\\])*"', "", line)
        if len(re.findall(r"[\w\"'-]\s*\.", line)) >= DEEPEST:
            return n
        for sign in bare:
            depth += (sign in "[{") - (sign in "]}")
            if depth > DEEPEST:
                return n
    return 1


def _line_of_number(text: str) -> int:
    """The line of the first whole number of more than 18 digits; 1 if none is found."""
    digits = r"(?<![\w\"'.])(?:0[xob][0-9A-Fa-f_]{16,}|[0-9][0-9_]{18,})(?![\w\"'.])"
    return next((n for n, line in enumerate(text.splitlines(), 1) if re.search(digits, line)), 1)


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

    def is_current(self) -> bool:
        """Whether the locked file still has its name: a holder before us may have deleted it while we opened it."""
        try:
            return self._file is not None and os.path.samestat(os.fstat(self._file.fileno()), os.stat(self.path))
        except FileNotFoundError:
            return False

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
