"""Grows a cell of the restorer's scores: a file of clips by methods, of which only what is missing is measured.

RESULTS/NAME.json = {format, quiver, frames, name, restorer, weights, scores: {clip: {method: row}}}

With other weights only the rows of the restorer are measured again. A cell of another program, or of other clips, is
not mixed with this one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qsim.files import VERSION, read_json, write_json
from qsim.streams.clip import Clip
from quiver.data.illumination import Illumination
from quiver.model.weights import digest
from quiver.restoration.restorers import weights_path

RESTORER = "restorer"  # the method whose weights are tried, in every clip of a cell

# (clip, names of methods) -> a row for each, and what else is kept of the clip
Measure = Callable[[Clip, Sequence[str]], dict[str, Any]]


@dataclass(frozen=True)
class Place:
    """One cell: its name, and the sensor and light."""

    name: str
    light: Illumination


def digest_of(weights: str) -> str:
    """Return the digest of weights: a name that ships, a weights file or a run folder."""
    return digest(weights_path(weights))


def grow(
    path: Path, clips: Sequence[Clip], weights: str, methods: Sequence[str], measure: Measure, **same: object
) -> dict[str, Any]:
    """Measure what the cell at `path` lacks, write it after every clip, and return it.

    `same` is what all rows of a cell have in common, as its format. `ValueError` if it was measured otherwise.
    """
    same |= {"quiver": VERSION}
    tried = {"restorer": weights, "weights": digest_of(weights)}
    found = read_json(path) if path.exists() else {**same, "name": path.stem, "scores": {}}
    changed = [key for key, value in same.items() if found.get(key) != value]
    if changed:
        raise ValueError(f"{path}: was measured with another {', '.join(changed)}; choose another --out, or remove it")
    foreign = sorted(set(found["scores"]) - {clip.name for clip in clips})
    if foreign:
        raise ValueError(f"{path}: holds clips that the data set lacks, as {foreign[0]}; choose another --out")
    if any(found.get(key) != value for key, value in tried.items()):
        for rows in found["scores"].values():
            rows.pop(RESTORER, None)
        found |= tried
    for clip in clips:
        rows = found["scores"].setdefault(clip.name, {})
        missing = [name for name in (RESTORER, *methods) if name not in rows]
        if missing:
            rows |= measure(clip, missing)
            write_json(path, found)
            print(f"{path}: {clip.name}", flush=True)
    return found
