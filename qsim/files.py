"""Reads and writes files: atomic writes (temporary file, fsync, rename), checksums, JSON, TOML and arrays.

    write_bytes / write_json:  NAME.tmp-PID -> fsync -> rename

A killed writer leaves nothing that a reader accepts. All files of `qsim` are written here, and tests inject a full
disk here.
"""

from __future__ import annotations

import contextlib
import errno
import gzip
import hashlib
import json
import os
import re
import shutil
import warnings
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np

from qsim.parsing import parse_json, parse_toml

Progress = Callable[[int, int], None]  # is called with (done, total)
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")  # of clips and streams: a safe file name
FULL = (errno.ENOSPC, errno.EDQUOT)  # of an `OSError`: no space left


def _version() -> str:
    """Return the version of the installed package, or of a source tree without installation."""
    try:
        return metadata.version("qsim")
    except metadata.PackageNotFoundError:
        project = Path(__file__).parents[1] / "pyproject.toml"
        return str(parse_toml(project, project.read_text(encoding="utf-8"))["project"]["version"])


VERSION = _version()


def sha256(source: bytes | memoryview | Path) -> str:
    """Return the hexadecimal SHA-256 of bytes or of a file."""
    if not isinstance(source, Path):
        return hashlib.sha256(source).hexdigest()
    with open(source, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that renames inside it survive a power cut."""
    with _naming(folder):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Open a binary file that appears under `path` only if the block succeeds.

    An `OSError` of the system (a full disk, a folder without permission) names the file.
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
    """Open a file and its description as `replacing` does; a description that exists always describes its file.

    Both are complete and synced before the old description is deleted: it is missing during three renames only.
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
    """Append a line to a journal and sync it; a killed writer leaves at most an incomplete last line."""
    with _naming(path), open(path, "ab") as journal:
        journal.write(line + b"\n")
        journal.flush()
        os.fsync(journal.fileno())


@contextlib.contextmanager
def _naming(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Put the name of the file into an `OSError` that names no file, or a temporary one."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and (error.filename is None or str(error.filename) == str(temporary)):
            error.filename = str(path)
            with contextlib.suppress(AttributeError):
                del error.filename2  # None would be printed: "-> None"
        raise


def wording(error: BaseException) -> str:
    """Return an error in one line; an `OSError` of the system as `FILE: reason`, without number and second file."""
    if isinstance(error, OSError) and error.strerror:
        return f"{os.fsdecode(error.filename)}: {error.strerror}" if error.filename else error.strerror
    return " ".join(str(error).split()) or type(error).__name__


_LEFTOVER = re.compile(r"(.+)\.(?:tmp|removed)-\d+", re.DOTALL)


def remove_leftovers(path: Path) -> None:
    """Delete NAME.tmp-PID and NAME.removed-PID beside `path`, which killed writers of this exact NAME left.

    The caller must hold the lock that all writers of `path` take.
    """
    for leftover in path.parent.iterdir():
        found = _LEFTOVER.fullmatch(leftover.name)
        if found and found[1] == path.name:
            _remove(leftover)


def remove_leftovers_below(folder: Path) -> None:
    """Delete every temporary file in `folder` and below; the caller must be the only writer there."""
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
    """Write a file atomically; return its SHA-256."""
    with replacing(path) as file:
        file.write(content)
    return sha256(content)


def to_json(value: Any) -> bytes:
    """Return JSON with sorted keys: equal contents are equal bytes. NaN is refused."""
    return (json.dumps(value, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()


def write_json(path: Path, value: Any) -> str:
    """Write `value` atomically as JSON; return the SHA-256 of the file."""
    return write_bytes(path, to_json(value))


def checksum(description: dict[str, Any]) -> str:
    """Return the SHA-256 of a description without its key `checksum`."""
    return sha256(to_json({key: value for key, value in description.items() if key != "checksum"}))


def sealed(description: dict[str, Any]) -> dict[str, Any]:
    """Return the description with the checksum of its other keys, as all descriptions are stored."""
    return description | {"checksum": checksum(description)}


def write_description(path: Path, value: dict[str, Any]) -> str:
    """Write `value` with its checksum atomically as JSON; return the SHA-256 of the file."""
    return write_json(path, sealed(value))


def check_own(path: Path, description: dict[str, Any], cure: str) -> None:
    """Raise `ValueError` unless a description holds the checksum of its other keys."""
    if description.get("checksum") != checksum(description):
        raise ValueError(f"{path}: contents changed (checksum differs); {cure}")


def differs(path: Path, expected: str | None) -> list[str]:
    """Return one message if a file is missing or has another SHA-256; else an empty list."""
    if not path.is_file():
        return [f"{path}: missing"]
    return [] if sha256(path) == expected else [f"{path}: contents changed (checksum differs)"]


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Return the tables of a TOML file; `FileNotFoundError` names `what` is missing, `ValueError` names the line."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such {what}")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file; a {what} is TOML in UTF-8") from None
    return parse_toml(path, text)


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; `ValueError` as `parse_json`, also for a file that is not text."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not readable as JSON ({error}); the file is damaged, make it again") from None
    return parse_json(path, text)


def check_version(path: Path, found: object, known: int) -> None:
    """Raise `ValueError` with both versions if a file has another format version than this program."""
    if found == known:
        return
    newer = isinstance(found, int) and found > known
    advice = "it was made by a newer qsim: update this one" if newer else "make it again with this qsim"
    raise ValueError(f"{path}: format version {found!r}, this qsim reads version {known}; {advice}")


def check_ours(folder: Path, names: str) -> None:
    """Raise `FileExistsError` if a folder holds files whose relative paths do not match the pattern `names`.

    Called before the folder is deleted: only files that this program wrote are replaced.
    """
    for item in sorted(folder.rglob("*")):
        relative = item.relative_to(folder).as_posix()
        if item.is_symlink() or not (item.is_dir() or re.fullmatch(rf"(?:{names})(?:\.tmp-.*)?", relative)):
            raise FileExistsError(
                f"{item}: was not made by this program, which replaces only what it made; move it away, or name "
                "another output"
            )


def remove_folder(folder: Path) -> None:
    """Delete a folder; it is renamed first, so that an interrupted deletion leaves nothing that looks complete.

    `ValueError` for a symbolic link; the link and its target stay.
    """
    if folder.is_symlink():
        raise ValueError(
            f"{folder}: is a symbolic link to {os.readlink(folder)}, which is not replaced; move the folder here, "
            "or delete the link"
        )
    doomed = folder.with_name(f"{folder.name}.removed-{os.getpid()}")
    os.replace(folder, doomed)
    shutil.rmtree(doomed)


def check_name(name: Any) -> str:
    """Return the name of a stream or clip if it is a safe file name, else raise `ValueError`."""
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise ValueError(f"name {name!r:.80}: use letters, digits, '.', '_' and '-' only, as in fan_03 or qis-3bit")
    return name


@contextlib.contextmanager
def decoding_errors(path: Path, what: str) -> Iterator[None]:
    """Turn errors and warnings of a decoder into one `ValueError`; a missing file stays `FileNotFoundError`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except Exception as error:  # decoders raise errors of tokenizer, zlib, struct and their own
        text = " ".join(str(error).split())
        if text.startswith(str(path)):
            raise ValueError(text) from None
        raise ValueError(f"{path}: not readable as {what} ({text or type(error).__name__})") from None


def load_array(path: Path) -> np.ndarray:
    """Return a .npy array of numbers as a memory map, or a .npy.gz in memory.

    `FileNotFoundError`, or `ValueError` for other files, objects, a number without axes, and wrong headers.
    """
    if path.suffix == ".gz":
        with decoding_errors(path, "gzipped .npy"), gzip.open(path, "rb") as packed:
            return read_npy(path, packed)
    with decoding_errors(path, ".npy"):
        with open(path, "rb") as file:
            if file.read(2) == b"PK":
                raise ValueError(f"{path}: is an archive (.npz) under another name; save the array alone with np.save")
        array = np.lib.format.open_memmap(path, mode="r")
        if array.ndim == 0:
            raise ValueError(f"{path}: a single number without axes; an array is expected")
        if array.dtype.hasobject or array.dtype.kind not in "buif":
            raise ValueError(f"{path}: an array of {array.dtype}; numbers are expected")
        if array.ndim and array.nbytes + 64 > path.stat().st_size:
            raise ValueError(f"{path}: the header states {array.nbytes} bytes, the file has {path.stat().st_size}")
        return array


def read_npy(path: Path, file: IO[bytes] | gzip.GzipFile) -> np.ndarray:
    """Return a .npy array of numbers from a stream; memory grows with the bytes that are there, not with the header.

    `ValueError` as for `load_array`, with the name `path`; errors of the stream itself are its own.
    """
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise ValueError(f"{path}: version {version} of .npy is not known")
    reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = reader(file)
    if dtype.hasobject or dtype.kind not in "buif":
        raise ValueError(f"{path}: an array of {dtype}; numbers are expected")
    if not shape:
        raise ValueError(f"{path}: a single number without axes; an array is expected")
    wanted = int(np.prod(shape, dtype=object)) * dtype.itemsize
    content = bytearray()
    while len(content) < wanted:
        block = file.read(min(1 << 24, wanted - len(content)))
        if not block:
            raise ValueError(f"{path}: the header states {wanted} bytes, the file has {len(content)}")
        content += block
    return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")
