"""Draws windows from a data set that is still rendered: which clips a sample may draw is written down before it does.

    finished clips -> Schedule (a file of the run) -> GrowingWindows: sample n draws one of the first m(n) clips

Clips enter the schedule in the order in which they are finished, each with the first sample that may draw it. A run
that was killed reads the same schedule again, and draws the same samples; clips that came later enter where it goes
on. Processes that draw samples read the file themselves. It is written before its samples are given out.
"""

from __future__ import annotations

import itertools
import os
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qsim import records
from qsim.dataset.clip_list import ClipList, ClipsOfDataset
from qsim.dataset.dataset import Dataset
from qsim.files import Damaged, read_json, write_json
from qsim.streams.clip import Clip
from quiver.data.windows import Prepare, Windows, WindowSettings

DRAWN = 9  # of the random numbers that choose a clip, apart from those of the windows


@dataclass(frozen=True, eq=False)
class PlannedClips(ClipsOfDataset):
    """All clips of a split, finished or not; a clip that is asked for must be finished."""

    data: Dataset

    def alike(self) -> list[int]:
        """Return the positions of the first finished clip of each series that has one."""
        done = self.data.finished()[self.indices]
        found: list[int] = []
        starts = np.searchsorted(self.indices, self.data.listing.starts)
        for first, last in itertools.pairwise(starts):
            found += (int(first) + np.flatnonzero(done[first:last])[:1]).tolist()
        return found


def planned(data: Dataset, split: str) -> ClipList:
    """Return all clips of one split of a data set, finished or not."""
    parts = [np.arange(part.start, part.stop) for part in data.parts(split)]
    return ClipList((PlannedClips(data, np.concatenate(parts) if parts else np.zeros(0, np.int64)),))


@dataclass(frozen=True)
class Entries:
    """The clips of a schedule by their names, and the first sample that may draw each."""

    clips: tuple[str, ...] = ()
    samples: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        records.settle(self)
        if len(self.clips) != len(self.samples) or sorted(self.samples) != list(self.samples):
            raise ValueError("clips and samples must be as many, and samples must not fall")


class Schedule:
    """The file of a run that states which clips its samples may draw."""

    def __init__(self, path: Path, data: Dataset, split: str = "train") -> None:
        self.path = path
        self.data = data
        self.indices = np.concatenate([np.arange(part.start, part.stop) for part in data.parts(split)])
        self._seen: tuple[int, int] | None = None  # the file that was read, by its time and size
        self._entries = Entries()
        self._positions: list[int] = []

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_seen": None}  # another process reads the file itself

    def look(self, sample: int) -> None:
        """Let clips that are finished now be drawn from this sample on, if none is scheduled from a later one."""
        entries = self._read()
        if len(entries.clips) == len(self.indices):
            return
        known = set(entries.clips)
        done = self.data.finished()[self.indices]
        new = [name for index in self.indices[done].tolist() if (name := self.data.listing.name(index)) not in known]
        if not new:
            return
        start = max(sample, *entries.samples[-1:], 0)
        found = Entries((*entries.clips, *new), (*entries.samples, *(start for _ in new)))
        write_json(self.path, records.plain(found))

    def position(self, sample: int, seed: int) -> int:
        """Return the position of the clip that a sample draws, among all clips of the split."""
        entries = self._read()
        count = bisect_right(entries.samples, sample)
        if not count:
            raise ValueError(f"{self.path}: no clip is scheduled for sample {sample}; start again with force=True")
        chosen = int(np.random.default_rng((seed, sample, DRAWN)).integers(count))
        return self._positions[chosen]

    def _read(self) -> Entries:
        """Return what the file holds, read again only if it was written."""
        try:
            state = os.stat(self.path)
        except FileNotFoundError:
            return self._entries
        now = (state.st_mtime_ns, state.st_size)
        if now != self._seen:
            try:
                entries = records.convert(read_json(self.path), Entries, str(self.path))
                found = [self.data.listing.find(name) for name in entries.clips]
                self._positions = [self._position(index) for index in found]
            except ValueError as error:
                raise Damaged(f"{self.path}: {error}", "start again with force=True") from None
            self._entries = entries
            self._seen = now
        return self._entries

    def _position(self, index: int | None) -> int:
        place = -1 if index is None else int(np.searchsorted(self.indices, index))
        if index is None or place == len(self.indices) or self.indices[place] != index:
            raise ValueError("names a clip that the data set does not have")
        return place


class GrowingWindows(Windows):
    """Windows of clips that are finished one after another; which of them a sample may draw, its schedule states."""

    def __init__(
        self, clips: Sequence[Clip], settings: WindowSettings, schedule: Schedule, prepare: Prepare | None = None
    ) -> None:
        """Choose the noise from the clips that are finished now."""
        self.schedule = schedule
        super().__init__(clips, settings, prepare=prepare)

    def clip_of(self, n: int) -> int:
        """Return the number of the clip that sample n draws."""
        return self.schedule.position(n, self.settings.seed)
