"""Reads files that a mesh file names: regular ones of bounded size, beside it or in a folder below."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

from qsim import limits, opening
from qsim.scene.image_files import decoded
from qsim.scene.materials import Picture


def regular_bytes(path: Path, where: str) -> bytes:
    """Return the bytes of a regular file that a document names; errors as of `opening.content`."""
    try:
        return opening.content(path, most=limits.ASSET)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def file_beside(document: Path, where: str, name: str, folder: Path | None = None) -> Path:
    """Return the path of a file that a document names, from `folder` (None: that of the document).

    It lies in the document's folder or below. `ValueError` for a name that leads out of it, `FileNotFoundError` for a
    file that is missing.
    """
    if ":" in name.partition("/")[0] or "\0" in name:
        raise ValueError(f"{where}: uri {name[:60]!r}; the name of a file beside it is expected")
    root = document.parent.resolve()
    target = (folder or document.parent) / name
    try:
        inside = target.resolve().is_relative_to(root)
        there = target.exists()
    except OSError as error:  # a name that is too long
        raise ValueError(f"{where}: uri {name[:60]!r} is no name of a file ({error.strerror})") from None
    if not inside:
        raise ValueError(f"{where}: uri {name[:60]!r} leads out of {root}; a file beside it or below is expected")
    if not there:
        raise FileNotFoundError(f"{where}: the file is missing: {target}; put it there, or export again")
    return target


def picture_of(document: Path, where: str, name: str, folder: Path | None = None) -> tuple[Picture, str]:
    """Return an image file that a document names, and its SHA-256; errors as of `file_beside` and `picture_in`."""
    return picture_in(bytes_beside(document, where, name, folder), f"{where}: {name:.60}")


def bytes_beside(document: Path, where: str, name: str, folder: Path | None = None) -> bytes:
    """Return the bytes of a file that a document names; errors as of `file_beside` and `regular_bytes`."""
    return regular_bytes(file_beside(document, where, name, folder), where)


def picture_in(raw: bytes, where: str) -> tuple[Picture, str]:
    """Return the picture in the bytes of an image file, and their SHA-256; `ValueError` if it cannot be read.

    Rows are as they are stored: texture coordinates know nothing of an orientation tag.
    """
    return Picture(decoded(io.BytesIO(raw), where, turned=False)), hashlib.sha256(raw).hexdigest()
