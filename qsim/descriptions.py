"""Reads and writes descriptions: JSON files that hold one record, the version of their format, and their own checksum.

    record --write--> {"format_version": 1, "checksum": SHA-256 of the other keys, field: value, ...} --read--> record

A record whose class has a constant FORMAT is stored with it as key `format`: its file has no name of its own.
Fields that hold their default are left out. Damage, another version and unknown keys are refused with the file's name.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from qsim import files, records
from qsim.checks import file_path
from qsim.parsing import require_readable

FORMAT_VERSION = 1  # of clips, streams, data sets and restored videos; only this one is read
Made = TypeVar("Made")


def values_of(record: Any) -> dict[str, Any]:
    """Return what the file of a record holds."""
    values = {"format_version": FORMAT_VERSION} | _kind(type(record)) | records.plain(record)
    require_readable(values, "a description")
    return sealed(values)


def write(path: Path, record: Any) -> str:
    """Write a record atomically; return the SHA-256 of the file."""
    return files.write_json(path, values_of(record))


def read(path: Path, kind: type[Made], cure: str) -> Made:
    """Return the record in a file; `ValueError` that ends with `cure` if it is damaged or of another version."""
    return of_values(path, files.read_json(path), kind, cure)


def opened(path: str | Path, kind: type[Made], what: str, cure: str) -> tuple[Path, Made]:
    """Return the array file NAME.npy that a description NAME.json describes, and its record; errors as of `read`.

    `FileNotFoundError` if there is no such description of `what`.
    """
    description = file_path(path)
    if not description.is_file():
        raise FileNotFoundError(f"{description}: no such {what}")
    return description.with_suffix(".npy"), read(description, kind, cure)


def of_values(path: Path, found: dict[str, Any], kind: type[Made], cure: str) -> Made:
    """Return the record in the contents of a file; errors as of `read`."""
    check_version(path, found)
    expected = _kind(kind)
    if {key: found.get(key) for key in expected} != expected:
        raise ValueError(f"{path}: expected the format {expected['format']}, got {found.get('format')!r:.60}; {cure}")
    values = {key: value for key, value in found.items() if key not in ("format_version", "checksum", *expected)}
    record = records.convert(values, kind, str(path), cure=cure)
    _check_own(path, found, cure)
    return record


def _kind(kind: Any) -> dict[str, str]:
    """Return the key `format` of the files of a record, if its class states one."""
    return {"format": kind.FORMAT} if hasattr(kind, "FORMAT") else {}


def check_version(path: Path, found: dict[str, Any]) -> None:
    """Raise `ValueError` with both versions if the contents of a file are of another format version."""
    version = found.get("format_version")
    if version == FORMAT_VERSION:
        return
    newer = isinstance(version, int) and version > FORMAT_VERSION
    advice = "it was made by a newer qsim: update this one" if newer else "make it again with this qsim"
    raise ValueError(f"{path}: format version {version!r}, this qsim reads version {FORMAT_VERSION}; {advice}")


def write_values(path: Path, values: dict[str, Any]) -> str:
    """Write the contents of a description with their checksum, atomically; return the SHA-256 of the file."""
    return files.write_json(path, sealed(values))


def sealed(values: dict[str, Any]) -> dict[str, Any]:
    """Return the contents of a description with the checksum of their other keys."""
    return values | {"checksum": _checksum(values)}


def _checksum(values: dict[str, Any]) -> str:
    """Return the SHA-256 of the contents of a description without its key `checksum`."""
    return files.sha256(files.to_json({key: value for key, value in values.items() if key != "checksum"}))


def _check_own(path: Path, found: dict[str, Any], cure: str) -> None:
    """Raise `ValueError` unless a description holds the checksum of its other keys."""
    if found.get("checksum") != _checksum(found):
        raise ValueError(f"{path}: contents changed (checksum differs); {cure}")
