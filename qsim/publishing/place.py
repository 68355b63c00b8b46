"""Stores files of a published set in a folder or in object storage: each is complete or absent.

    place("out/published")      a folder: files are written under temporary names, synced and renamed
    place("s3://bucket/set")    any address of fsspec: a file is made here and uploaded when it is complete

S3 and Google Cloud Storage show an object when its upload is complete. Other storages may show a part of one, so the
record of a shard is uploaded after it, and the description of the set last.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from qsim import files, limits, opening, scratch

_ADDRESS = re.compile(r"([a-z][a-z0-9+.-]*)://.*", re.DOTALL)


def is_address(text: str | os.PathLike[str]) -> bool:
    """Return whether a text is the address of a storage, as in s3://bucket/set, and not a path."""
    return _ADDRESS.fullmatch(os.fspath(text)) is not None


class Place(Protocol):
    """Where the files of a published set are; names have `/` between their parts."""

    address: str
    is_remote: bool

    def names(self) -> list[str]:
        """Return the names of all files there; empty if there is no such place."""

    def size(self, name: str) -> int | None:
        """Return the bytes of a file; None if there is none."""

    def read(self, name: str, start: int = 0, stop: int | None = None) -> bytes:
        """Return bytes start ... stop - 1 of a file; `FileNotFoundError` if there is none."""

    def opened(self, name: str) -> BinaryIO:
        """Open a file for reading at any position."""

    def writing(self, name: str) -> contextlib.AbstractContextManager[Path]:
        """Return a context that gives the path of a local file, which has its name at the end of the block."""

    def remove(self, name: str) -> None:
        """Delete a file, if there is one."""


def place(address: str | os.PathLike[str]) -> Place:
    """Return the place of an address; `ModuleNotFoundError` for a storage whose package is not installed.

    `ValueError` for an address without a bucket.
    """
    text = os.fspath(address)
    if text.startswith("file://"):
        text = text.removeprefix("file://")
    if not is_address(text):
        return Folder(Path(text))
    if not text.partition("://")[2].strip("/"):
        raise ValueError(f"{text}: names no bucket; give one, as in {text.partition(':')[0]}://BUCKET/SET")
    return Storage(text.rstrip("/"))


def write(where: Place, name: str, content: bytes) -> None:
    """Write a small file; it is complete or absent."""
    with where.writing(name) as path:
        path.write_bytes(content)


class Folder:
    """A folder of the file system."""

    is_remote = False

    def __init__(self, path: Path) -> None:
        self.path = path
        self.address = str(path)

    def names(self) -> list[str]:
        found = (item for item in self.path.rglob("*") if item.is_symlink() or not item.is_dir())
        return sorted(item.relative_to(self.path).as_posix() for item in found if not scratch.is_scratch(item))

    def size(self, name: str) -> int | None:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            return (self.path / name).stat().st_size
        return None

    def read(self, name: str, start: int = 0, stop: int | None = None) -> bytes:
        with self.opened(name) as file:
            file.seek(start)
            return file.read(limits.TEXT + 1 if stop is None else stop - start)

    def opened(self, name: str) -> BinaryIO:
        return opening.opened(self.path / name, beside=self.path)

    @contextlib.contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        target = self.path / name
        files.make_folder(target.parent)
        with files.replacing(target) as part:
            yield Path(part.name)

    def remove(self, name: str) -> None:
        file = self.path / name
        with contextlib.suppress(FileNotFoundError):
            file.unlink()
            files.sync_folder(file.parent)  # what is deleted later is not lost before it

    def sweep(self) -> None:
        """Delete what killed writers left."""
        for folder in [self.path, *(item for item in self.path.glob("*") if item.is_dir() and not item.is_symlink())]:
            scratch.sweep(folder)


class Storage:
    """Object storage, or another file system behind an address of fsspec."""

    is_remote = True

    def __init__(self, address: str) -> None:
        self.address = address
        _ = self._system  # a package that is missing is named at once

    @property
    def _system(self) -> Any:
        """The file system, which does not outlive a fork."""
        return _system(self.address.partition("://")[0], os.getpid())

    def _path(self, name: str) -> str:
        return f"{self.address}/{name}"

    def names(self) -> list[str]:
        with self._reaching(""):
            system = self._system
            system.invalidate_cache()
            try:
                found = system.find(self.address)
            except FileNotFoundError:
                return []
            root = system._strip_protocol(self.address).rstrip("/")
            return sorted(str(path)[len(root) :].lstrip("/") for path in found)

    def size(self, name: str) -> int | None:
        with self._reaching(name):
            system = self._system
            system.invalidate_cache()
            try:
                return int(system.size(self._path(name)))
            except FileNotFoundError:
                return None

    def read(self, name: str, start: int = 0, stop: int | None = None) -> bytes:
        with self._reaching(name):
            return bytes(self._system.cat_file(self._path(name), start=start or None, end=stop))

    def opened(self, name: str) -> BinaryIO:
        with self._reaching(name):
            file: BinaryIO = self._system.open(self._path(name), "rb")
            return file

    @contextlib.contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        # what a killed process left here is deleted by the next one
        with scratch.Scratch(Path(tempfile.gettempdir()) / "upload") as made:
            path = made.new()
            yield path
            with self._reaching(name):
                system = self._system
                if self.address.partition("://")[0] not in _WITHOUT_FOLDERS:
                    system.makedirs(self._path(name).rpartition("/")[0], exist_ok=True)
                system.put_file(str(path), self._path(name))

    def remove(self, name: str) -> None:
        with self._reaching(name), contextlib.suppress(FileNotFoundError):
            self._system.rm_file(self._path(name))

    @contextlib.contextmanager
    def _reaching(self, name: str) -> Iterator[None]:
        """Turn errors of a storage's own kind into an `OSError` with the address."""
        try:
            yield
        except FileNotFoundError:  # the clients' own words name a request or nothing
            raise FileNotFoundError(f"{self._path(name)}: no such bucket or file") from None
        except Exception as error:  # clients raise errors of their own
            raise OSError(
                f"{self._path(name)}: {files.wording(error)}; files that are there are complete, and the same command "
                "resumes"
            ) from error


@functools.lru_cache(maxsize=8)
def _system(protocol: str, process: int) -> Any:
    """Return a file system for one process; `ModuleNotFoundError` or `ValueError` where its package is missing."""
    import fsspec

    try:
        return fsspec.filesystem(protocol)
    except ImportError as error:
        package = getattr(error.__cause__, "name", None) or _PACKAGES.get(protocol, protocol)
        if package == "s3fs":
            raise ModuleNotFoundError(f"{protocol}:// needs {package}", name=package) from None  # of our extra `s3`
        raise ValueError(
            f"{protocol}://: needs the package {package}, which is not installed: pip install {package}"
        ) from None
    except ValueError:
        problem = f"{protocol}://: is not a storage that fsspec knows; name a folder, or s3://BUCKET/SET"
        raise ValueError(problem) from None


_WITHOUT_FOLDERS = ("s3", "gs", "gcs", "az", "abfs")  # where this would make a bucket
_PACKAGES = {"s3": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "az": "adlfs", "abfs": "adlfs"}
