"""Reads and writes files: atomic writes (scratch folder, fsync, rename), checksums, JSON, TOML and arrays.

    write_bytes / write_json:  .qsim-TOKEN/0 (scratch.py) -> fsync -> rename

A killed writer leaves nothing that a reader accepts. All files of `qsim` are written here, and tests inject a full
disk here.
"""

from __future__ import annotations

import contextlib
import errno
import gzip
import hashlib
import json
import math
import os
import re
import shutil
import stat
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np

from qsim import opening
from qsim.lazy_array import LazyArray
from qsim.parsing import parse_json, parse_toml
from qsim.scratch import Scratch, is_scratch, sweep
from qsim.stored_array import StoredArray
from qsim.thread_warnings import warnings_here

Progress = Callable[[int, int], None]  # is called with (done, total)
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")  # of clips and streams: a safe file name
FULL = (errno.ENOSPC, errno.EDQUOT)  # of an `OSError`: no space left


class Blocked(FileExistsError):
    """The place of an output is taken: `problem` says by what, and `cure` what to do, which a command may replace."""

    def __init__(self, problem: str, cure: str) -> None:
        super().__init__(f"{problem}; {cure}")
        self.problem = problem
        self.cure = cure


class Damaged(ValueError):
    """A file of our own cannot be read: `problem` says why, and `cure` what to do, which a command may replace."""

    def __init__(self, problem: str, cure: str) -> None:
        super().__init__(f"{problem}; {cure}")
        self.problem = problem
        self.cure = cure


DISTRIBUTION = "qsim-quiver"  # on a package index, where `qsim` is another program


def _version() -> str:
    """Return the version of the installed package, or of a source tree without installation."""
    try:
        return metadata.version(DISTRIBUTION)
    except metadata.PackageNotFoundError:
        project = Path(__file__).parents[1] / "pyproject.toml"
        return str(parse_toml(project, project.read_text(encoding="utf-8"))["project"]["version"])


VERSION = _version()


def sha256(source: bytes | memoryview | Path, most: int | None = None) -> str:
    """Return the hexadecimal SHA-256 of bytes or of a file of at most `most` bytes; errors as of `opening.opened`."""
    if not isinstance(source, Path):
        return hashlib.sha256(source).hexdigest()
    with opening.opened(source, most=most) as file:
        return digest_of(file)


def digest_of(file: Any) -> str:
    """Return the hexadecimal SHA-256 of an open file from its position on."""
    return hashlib.file_digest(file, "sha256").hexdigest()


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that renames inside it survive a power cut."""
    with naming(folder):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def sync_file(path: Path) -> None:
    """Sync the contents of a file that somebody else wrote, or that was written through a memory map."""
    with open(path, "rb") as file:
        os.fsync(file.fileno())


def sync_tree(folder: Path) -> None:
    """Sync all files and names in a folder and below, which a library wrote."""
    for place, _, names in os.walk(folder, topdown=False):
        for name in names:
            sync_file(Path(place) / name)
        sync_folder(Path(place))


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, unless they exist; a power cut leaves it if it leaves what lies in it."""
    if folder.is_dir():
        return
    make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    sync_folder(folder.parent)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Open a binary file that appears under `path` only if the block succeeds.

    An `OSError` of the system (a full disk, a folder without permission) names the file. `ValueError` where `path` is
    neither free nor a file: a pipe or a device is no output.
    """
    with _replacing(path) as (file,):
        yield file


@contextlib.contextmanager
def replacing_described(path: Path, description: Path) -> Iterator[tuple[BinaryIO, BinaryIO]]:
    """Open a file and its description as `replacing` does; a description that exists always describes its file.

    Both are complete and synced before the old description is deleted: it is missing during three renames only.
    """
    with _replacing(path, description) as (file, text):
        yield file, text


@contextlib.contextmanager
def _replacing(*paths: Path) -> Iterator[Sequence[BinaryIO]]:
    """Open new files; at the end of the block all but the first old file are deleted and the new ones named in turn."""
    _refuse_pipes(paths)
    with contextlib.ExitStack() as stack:
        stack.enter_context(naming(paths[0]))
        scratch = stack.enter_context(Scratch(paths[0]))
        parts = [scratch.new(number) for number in range(len(paths))]
        opened = [stack.enter_context(open(part, "x+b")) for part in parts]
        yield opened
        # Contents reach the disk before their names do: after a power cut a name never stands for half a file.
        for file in opened:
            file.flush()
            os.fsync(file.fileno())
        scratch.name(*zip(parts, paths, strict=True))
    sync_folder(paths[0].parent)


def _refuse_pipes(paths: Sequence[Path]) -> None:
    """Raise `ValueError` if an output is a pipe or a device, which a rename would replace."""
    for path in paths:
        mode = _mode(path)
        if mode is not None and not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
            raise ValueError(f"{path}: is a pipe or a device, not a file; name another output")


@contextlib.contextmanager
def replacing_together(*paths: Path) -> Iterator[tuple[Path, ...]]:
    """Return paths for files that describe one another, of the same names in a folder of their own.

    Those that the block makes appear together at its end, the descriptions last; also if this process is killed then:
    the next command that writes there gives them their names. `ValueError` if one is a pipe or a device.
    """
    _refuse_pipes(paths)
    with naming(paths[0]), Scratch(paths[0]) as scratch:
        place = scratch.new()
        place.mkdir()
        parts = tuple(place / path.name for path in paths)
        yield parts
        made = [(part, path) for part, path in zip(parts, paths, strict=True) if part.is_file()]
        for part, _ in made:
            # Synced by another descriptor than the one that wrote: fsync is about the file, not about who opened it.
            with open(part, "rb") as file:
                os.fsync(file.fileno())
        scratch.name(*made)
    sync_folder(paths[0].parent)


def append_line(path: Path, line: bytes) -> None:
    """Append a line to a journal and sync it; a killed writer leaves at most an incomplete last line."""
    with naming(path), open(path, "ab", opener=own) as journal:
        journal.write(line + b"\n")
        journal.flush()
        os.fsync(journal.fileno())


def own(path: str, flags: int) -> int:
    """Open a regular file without following a link in its place: an `opener` of `open`."""
    descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "is not a regular file", path)
    return descriptor


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Put the name of the file into an `OSError` that names no file, or one in a scratch folder."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and (error.filename is None or is_scratch(Path(os.fsdecode(error.filename)))):
            error.filename = str(path)
            with contextlib.suppress(AttributeError):
                del error.filename2  # None would be printed: "-> None"
        raise


def wording(error: BaseException) -> str:
    """Return an error in one line; an `OSError` of the system as `FILE: reason`, without number and second file."""
    if isinstance(error, OSError) and error.strerror:
        return f"{os.fsdecode(error.filename)}: {error.strerror}" if error.filename else error.strerror
    return " ".join(str(error).split()) or type(error).__name__


def native(path: Path | str) -> str:
    """Return a path for libraries in C and C++, which take UTF-8.

    In a locale without it (LC_ALL=C) Python keeps such names as surrogates, which these libraries refuse by TypeError.
    `ValueError` if the name is not UTF-8 in any case.
    """
    try:
        return os.fsencode(path).decode("utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{str(path)!a}: the name is not UTF-8, so no library reads it; rename it") from None


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


def differs(path: Path, expected: str | None, most: int | None = None, beside: Path | None = None) -> list[str]:
    """Return one message if a file is missing or has another SHA-256; else an empty list.

    A file of more than `most` bytes, or behind a link out of the folder `beside`, differs and is not read.
    """
    try:
        with opening.opened(path, most=most, beside=beside) as file:
            same = digest_of(file) == expected
    except FileNotFoundError:
        return [f"{path}: missing"]
    except ValueError as error:
        return [f"{path}: contents changed ({str(error).removeprefix(f'{path}: ')})"]
    return [] if same else [f"{path}: contents changed (checksum differs)"]


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Return the tables of a TOML file; `FileNotFoundError` names `what` is missing, `ValueError` names the line."""
    return parse_toml(path, opening.text(path, what))


def _mode(path: Path) -> int | None:
    """Return type and permissions of a file, None without one, asked once: another process may replace it meanwhile."""
    with contextlib.suppress(OSError):
        return path.stat().st_mode
    return None


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; `ValueError` as `parse_json`, also for what is no file, or no text."""
    return parse_json(path, opening.text(path))


def check_ours(folder: Path, names: str) -> None:
    """Raise `FileExistsError` if a folder holds files whose relative paths do not match the pattern `names`.

    Called before the folder is deleted: only files that this program wrote are replaced. What killed writers left in
    it is deleted.
    """
    for place in [folder, *(item for item in folder.rglob("*") if item.is_dir() and not item.is_symlink())]:
        sweep(place)
    for item in sorted(folder.rglob("*")):
        relative = item.relative_to(folder).as_posix()
        if item.is_symlink() or not (item.is_dir() or re.fullmatch(rf"(?:{names})", relative)):
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
    with Scratch(folder) as scratch:
        # A deletion takes time and may be killed: under its old name half a folder would look whole.
        os.replace(folder, scratch.old)
        sync_folder(folder.parent)  # after a power cut no half of it has its name
        shutil.rmtree(scratch.old)


def check_name(name: Any) -> str:
    """Return the name of a stream or clip if it is a safe file name, else raise `ValueError`."""
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise ValueError(f"name {name!r:.80}: use letters, digits, '.', '_' and '-' only, as in fan_03 or qis-3bit")
    return name


@contextlib.contextmanager
def decoding_errors(path: Path, what: str) -> Iterator[None]:
    """Turn errors and warnings of a decoder into one `ValueError`; a missing file stays `FileNotFoundError`."""
    try:
        with warnings_here("error"):
            yield
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except Exception as error:  # decoders raise errors of tokenizer, zlib, struct and their own
        text = " ".join(str(error).split())
        if text.startswith(str(path)):
            raise ValueError(text) from None
        raise ValueError(f"{path}: not readable as {what} ({text or type(error).__name__})") from None


def load_array(path: Path, beside: Path | None = None) -> LazyArray:
    """Return a .npy array of numbers, read when it is used, or a .npy.gz in memory; `beside` as of `opening.opened`.

    `FileNotFoundError`, or `ValueError` for other files, objects, a number without axes, and wrong headers.
    """
    if path.suffix == ".gz":
        with decoding_errors(path, "gzipped .npy"), opening.opened(path) as file, gzip.open(file, "rb") as packed:
            array = read_npy(path, packed)
            return LazyArray(array.shape, array.dtype, lambda start, stop, _: array[start:stop])
    with decoding_errors(path, ".npy"), opening.opened(path, beside=beside) as file:
        if file.read(2) == b"PK":
            raise ValueError(f"{path}: is an archive (.npz) under another name; save the array alone with np.save")
        file.seek(0)
        shape, fortran, dtype = read_npy_header(path, file)
        start = file.tell()
        size = os.fstat(file.fileno()).st_size
        # A header may state any size: memory and reads are bounded by what the file has.
        wanted = math.prod(shape) * dtype.itemsize
        if start + wanted > size:
            raise ValueError(f"{path}: the header states {wanted} bytes, the file has {size - start}")
        return StoredArray(path, os.dup(file.fileno()), start, shape, dtype, fortran=fortran)


def read_npy_header(path: Path, file: IO[bytes] | gzip.GzipFile) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, order (True: Fortran's) and type of a .npy array of numbers from a stream, up to its first value.

    `ValueError` for objects, a number without axes, negative sides, and versions that are not known.
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
    if min(shape) < 0:
        raise ValueError(f"{path}: the header states a side of {min(shape)}; the file is damaged")
    return shape, fortran, dtype


def read_npy(path: Path, file: IO[bytes] | gzip.GzipFile) -> np.ndarray:
    """Return a .npy array of numbers from a stream; memory grows with the bytes that are there, not with the header.

    `ValueError` as for `load_array`, with the name `path`; errors of the stream itself are its own.
    """
    shape, fortran, dtype = read_npy_header(path, file)
    wanted = math.prod(shape) * dtype.itemsize
    content = bytearray()
    while len(content) < wanted:
        block = file.read(min(1 << 24, wanted - len(content)))
        if not block:
            raise ValueError(f"{path}: the header states {wanted} bytes, the file has {len(content)}")
        content += block
    return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")
