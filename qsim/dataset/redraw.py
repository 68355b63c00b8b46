"""Draws stored streams again with the reference engine, from description and clip alone (`qsim check --redraw`).

A checksum shows that codes are those that were written; a second draw shows whether they are right.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from qsim import files
from qsim.dataset.dataset import Dataset
from qsim.dataset.job_runner import record_path
from qsim.files import Progress
from qsim.streams.clip import Clip
from qsim.streams.simulation import stored
from qsim.streams.stream import Stream

PROMISED = 5e-6  # share of codes in which the compiled engine may differ from the reference
_BLOCK_PIXELS = 1 << 20


@dataclass(frozen=True)
class Redrawn:
    """Result of drawing one stream again."""

    path: Path  # streams/NAME.npy
    codes: int  # compared
    differ: int = 0  # codes
    first: int | None = None  # frame with a difference
    why: str | None = None  # the stream could not be drawn again
    cure: str = ""

    @property
    def wrong(self) -> bool:
        """Return whether more codes differ than the compiled engine may."""
        return self.differ > PROMISED * self.codes

    def line(self) -> str | None:
        """Return the line about this stream; None where every code equals the reference's."""
        if self.why is not None:
            return f"{self.path}: not drawn again: {self.why}"
        if not self.differ:
            return None
        found = f"{self.path}: {self.differ} of {self.codes} codes differ from the reference's"
        if not self.wrong:
            return f"{found}, as many as the compiled engine may"
        return f"{found}, first in frame {self.first}; {self.cure}"


def redraw(path: Path, progress: Progress | None = None) -> list[Redrawn]:
    """Draw one stream again, or every stream of a clip or a data set; `check` names the damaged ones.

    `progress(done, total)` is called after each stream. `FileNotFoundError` or `ValueError` if there is none. Restored
    video has none, and its result is empty.
    """
    found = _streams(path)
    if not found and path.is_dir():
        raise ValueError(f"{path}: holds no stream to draw again")
    results = []
    for done, (clip, json_path, again) in enumerate(found, 1):
        results.append(_redrawn(clip, json_path, again))
        if progress is not None:
            progress(done, len(found))
    return results


def _redrawn(place: Path, json_path: Path, dataset: Path | None) -> Redrawn:
    """Draw one stream of the clip at `place` again; `dataset` is the data set whose recipe made it, if any."""
    path = json_path.with_suffix(".npy")
    try:
        stream = Stream.open(json_path)
        draw = dataclasses.replace(stored(stream), engine="reference")
        clip = Clip.open(place)
        frames, height, width = stream.shape
        found = Redrawn(path, frames * height * width, cure=_cure(dataset))
        step = max(1, _BLOCK_PIXELS // (height * width * draw.planes))
        start = 0
        for block in draw.blocks(clip, 0, frames, step):
            wrong = block != stream.codes(start, start + len(block))
            if wrong.any():
                first = start + int(wrong.any(axis=(1, 2)).argmax()) if found.first is None else found.first
                found = dataclasses.replace(found, differ=found.differ + int(wrong.sum()), first=first)
            start += len(block)
    except (ValueError, OSError) as error:
        return Redrawn(path, 0, why=str(error).removeprefix(f"{path}: "))
    return found


def _cure(dataset: Path | None) -> str:
    """Return what to do about wrong codes, so that `check` passes afterwards."""
    if dataset is None:
        return "sense it again with --force"
    return f"delete the file and run `qsim generate RECIPE -o {dataset} --repair`"


def _streams(path: Path) -> list[tuple[Path, Path, Path | None]]:
    """Return clip, description and, where its recipe made it, data set of every stream below a path."""
    if (path / "dataset.json").is_file():
        names = Dataset.open(path).names()
        return [each for name in names for each in _of_clip(path / "clips" / name, record_path(path, name), path)]
    if (path / "clip.json").is_file() or not path.with_suffix(".json").is_file():
        if not (path / "clip.json").is_file():
            Clip.open(path)  # raises the error that names what is missing
        return _of_clip(path)
    described = path.with_suffix(".json")
    if "ppp_factor" not in files.read_json(described):  # restored video
        return []
    return [(described.absolute().parents[1], described, None)]


def _of_clip(
    path: Path, record: Path | None = None, dataset: Path | None = None
) -> list[tuple[Path, Path, Path | None]]:
    made = set() if record is None else _made_by_recipe(record)
    return [
        (path, json_path, dataset if json_path.stem in made else None)
        for json_path in sorted((path / "streams").glob("*.json"))
    ]


def _made_by_recipe(record: Path) -> set[str]:
    """Return the names of the streams in a record."""
    try:
        return set(files.read_json(record).get("streams", {}))
    except (ValueError, OSError):  # `check` names it
        return set()


def lines(found: list[Redrawn]) -> list[str]:
    """Return a line per stream that differs or could not be drawn, and one with the totals."""
    found_lines = [line for one in found if (line := one.line()) is not None]
    drawn = [one for one in found if one.why is None]
    wrong = sum(one.wrong for one in drawn)
    total = sum(one.codes for one in drawn)
    right = "all hold the reference's codes" if drawn else "so nothing is known of them"
    verdict = f"{wrong} hold wrong codes" if wrong else right
    return [*found_lines, f"drawn again: {len(drawn)} of {len(found)} streams, {total} codes; {verdict}"]
