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
from importlib import import_module
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
    with _naming(folder):
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


@contextlib.contextmanager
def replacing_described(path: Path, description: Path) -> Iterator[tuple[BinaryIO, BinaryIO]]:
    """As `replacing`, for a file and its description: what is there under the second name always describes the first.

    Both are complete and synced before the old description goes, so that it is missing for three renames only.
    """
    parts = [file.with_name(f"{file.name}.tmp-{os.getpid()}") for file in (path, description)]
    try:
        with _naming(description, parts[1]), _naming(path, parts[0]):
            with open(parts[0], "wb") as file, open(parts[1], "wb") as text:
                yield file, text
                for written in (file, text):
                    written.flush()
                    os.fsync(written.fileno())
            description.unlink(missing_ok=True)
            os.replace(parts[0], path)
            os.replace(parts[1], description)
    except BaseException:
        for part in parts:
            part.unlink(missing_ok=True)
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
        if error.errno is not None and (error.filename is None or str(error.filename) == str(temporary)):
            error.filename = str(path)
            with contextlib.suppress(AttributeError):
                del error.filename2  # None would be printed: "-> None"
        raise


def wording(error: BaseException) -> str:
    """An error in one line; an `OSError` of the system as `FILE: reason`, without number, quotes and second file."""
    if isinstance(error, OSError) and error.strerror:
        return f"{os.fsdecode(error.filename)}: {error.strerror}" if error.filename else error.strerror
    return " ".join(str(error).split()) or type(error).__name__


_LEFTOVER = re.compile(r"(.+)\.(?:tmp|removed)-\d+", re.DOTALL)


def sweep(path: Path) -> None:
    """Delete what killed writers of `path` left beside it: NAME.tmp-PID and NAME.removed-PID, of this exact NAME.

    Only for a caller who holds the lock that all writers of `path` take.
    """
    for leftover in path.parent.iterdir():
        found = _LEFTOVER.fullmatch(leftover.name)
        if found and found[1] == path.name:
            _remove(leftover)


def sweep_below(folder: Path) -> None:
    """Delete every temporary file in `folder` and below; for a caller who is the only writer there."""
    for leftover in list(folder.rglob("*.tmp-*")):
        if _LEFTOVER.fullmatch(leftover.name):
            _remove(leftover)


def _remove(path: Path) -> None:
    """Delete a file or folder; of a symbolic link only the link."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


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


def check_ours(folder: Path, names: str) -> None:
    """`FileExistsError` that names what a folder holds beside files whose relative paths match the pattern `names`.

    For whoever is about to delete the folder: only what the program made itself is replaced.
    """
    for item in sorted(folder.rglob("*")):
        relative = item.relative_to(folder).as_posix()
        if item.is_symlink() or not (item.is_dir() or re.fullmatch(rf"(?:{names})(?:\.tmp-.*)?", relative)):
            raise FileExistsError(
                f"{item}: was not made by this program, and --force replaces only what it made; move it away, or name "
                "another output"
            )


def remove_folder(folder: Path) -> None:
    """Delete a folder so that no moment leaves something that looks whole: it first loses its name.

    `ValueError` for a symbolic link, which stays, with what it points to.
    """
    if folder.is_symlink():
        raise ValueError(
            f"{folder}: is a symbolic link to {os.readlink(folder)}, which is not replaced; move the folder here, "
            "or delete the link"
        )
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


def lazy_names(package: str, homes: dict[str, str]) -> Callable[[str], Any]:
    """`__getattr__` of a package that imports each public name from its module when it is first asked for."""

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{homes[name]}"), name)

    return get
