"""Defines the folder of a clip: names of its files, and the checks of new and of stored clips."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qsim import descriptions, files, records
from qsim.clip.clip_info import ClipInfo, frame_file

OURS = (
    r"clip\.json|(radiance|sharp|truth|saturated)/[0-9]{6,}\.exr"
    r"|(streams|events)/lock|(streams|events)/[A-Za-z0-9._-]+\.(npy|json)"
)
TRUTH = {  # channel of the EXR file -> quantity
    "u": "flow",
    "v": "flow",
    "bu": "flow_back",
    "bv": "flow_back",
    "valid": "valid",
    "Z": "depth",
    "id": "body_id",
}
_DAMAGED = "the file is damaged; make the clip again, or take clip.json from a copy"


def read_info(path: Path) -> ClipInfo:
    """Return the description in clip.json; `ValueError` names file and key if it is damaged or of another version."""
    info = descriptions.read(path, ClipInfo, _DAMAGED)
    for t in range(info.shape[0]):
        if not info.has("radiance", t):
            raise ValueError(f"{path}: checksums lack {frame_file('radiance', t)} of frame {t}; {_DAMAGED}")
    return info


def info_of(path: Path, values: ClipInfo | Mapping[str, Any]) -> ClipInfo:
    """Return the description of a new clip, also of its plain values; `ValueError` names the clip and the wrong key."""
    if isinstance(values, ClipInfo):
        return values
    return records.convert(dict(values), ClipInfo, str(path))


def target_of(path: str | os.PathLike[str], force: bool) -> Path:
    """Return the folder that a clip of this path is written to: a symbolic link stays, and its target is written.

    `FileExistsError` for a folder that may not be replaced, `NotADirectoryError` for a path below a file,
    `PermissionError` for one below a folder that cannot be written.
    """
    found = Path(path)
    files.check_name(found.name)
    if found.is_symlink():
        found = found.resolve()
    if found.exists() and not force:
        raise FileExistsError(f"{found}: exists; name another, or replace it with force=True")
    check_replaced(found)
    above = next(parent for parent in found.absolute().parents if parent.exists())
    if not above.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(found))
    if not os.access(above, os.W_OK | os.X_OK):
        raise PermissionError(f"{found}: no permission to write into {above}; name another")
    return found


def check_replaced(path: Path) -> None:
    """Raise `FileExistsError` if something else than a clip, or a clip with other files in it, would be replaced."""
    if path.exists() and not (path / "clip.json").is_file():
        raise FileExistsError(f"{path}: exists and is not a clip, which is all that is replaced; name another")
    if path.exists():
        files.check_ours(path, OURS)


def check_outside(path: Path) -> None:
    """Raise `FileExistsError` for an output in a clip or in its streams, where its .json would count as one."""
    for above in path.absolute().parents[:2]:
        if (above / "clip.json").is_file():
            raise FileExistsError(f"{path}: lies in the clip {above}, which holds nothing else; name another place")
