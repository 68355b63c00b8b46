"""Checks the folders that commands fill."""

from __future__ import annotations

from pathlib import Path


def check_free(folder: Path) -> None:
    """Raise `FileExistsError` for a clip, a folder in a clip, or a data set: no other results are stored there."""
    for place, mark, kind in (
        (folder, "clip.json", "is a clip"),
        (folder.parent, "clip.json", "is part of a clip"),
        (folder, "dataset.json", "is a data set"),
    ):
        if (place / mark).is_file():
            raise FileExistsError(f"{folder}: {kind}, which holds nothing else; name another folder")
