"""Lists clips without opening them: those of data sets by their indices, others one by one.

A list of a million clips takes 8 MB, and item n is opened when it is asked for. `alike` names the clips that stand for
all: the first of each series of a data set, whose clips share their settings, and every clip that is listed by itself.
"""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, overload

import numpy as np
from numpy import ndarray as Array

from qsim.dataset.series import Listing
from qsim.files import sha256, to_json
from qsim.streams.clip import Clip


class Indexed(Protocol):
    """A data set, as this list sees it."""

    @property
    def name(self) -> str:
        """The name of the data set."""

    @property
    def listing(self) -> Listing:
        """Its clips."""

    def folder(self, index: int) -> Path:
        """Return the folder of a clip."""


@dataclass(frozen=True, eq=False)
class ClipsOfDataset:
    """Finished clips of one data set."""

    data: Indexed
    indices: Array  # int64, ascending

    def __len__(self) -> int:
        return len(self.indices)

    def clip(self, position: int) -> Clip:
        return Clip.open(self.data.folder(int(self.indices[position])))

    def paths(self, positions: Iterable[int]) -> list[Path]:
        return [self.data.folder(int(self.indices[position])) for position in positions]

    def alike(self) -> list[int]:
        """Return the positions of the first clip of each series."""
        starts = np.searchsorted(self.indices, self.data.listing.starts)
        return [int(first) for first, last in itertools.pairwise(starts) if last > first]

    def without(self, folders: set[Path]) -> ClipsOfDataset:
        """Return these clips but those in some resolved folders."""
        gone = [index for folder in folders if (index := self._index(folder)) is not None]
        return ClipsOfDataset(self.data, self.indices[~np.isin(self.indices, gone)]) if gone else self

    def holds(self, folder: Path) -> bool:
        """Return whether one of these clips is in a resolved folder."""
        index = self._index(folder)
        return index is not None and index in self.indices

    def _index(self, folder: Path) -> int | None:
        """Return the index of the clip in a resolved folder; None if there is none."""
        index = self.data.listing.find(folder.name)
        return index if index is not None and self.data.folder(index).resolve() == folder else None

    def part(self, positions: range) -> ClipsOfDataset:
        return ClipsOfDataset(self.data, self.indices[np.arange(positions.start, positions.stop, positions.step)])

    def digest(self) -> list[str]:
        """Return what tells these clips from others, whatever their folder."""
        series = [each.digest for each in self.data.listing.series]
        return [self.data.name, *series, sha256(self.indices.astype("<i8").tobytes())]


@dataclass(frozen=True, eq=False)
class ListedClips:
    """Opened clips, one by one."""

    clips: tuple[Clip, ...]

    def __len__(self) -> int:
        return len(self.clips)

    def clip(self, position: int) -> Clip:
        return self.clips[position]

    def paths(self, positions: Iterable[int]) -> list[Path]:
        return [self.clips[position].path for position in positions]

    def alike(self) -> Sequence[int]:
        return range(len(self.clips))

    def without(self, folders: set[Path]) -> ListedClips:
        """Return these clips but those in some resolved folders."""
        return ListedClips(tuple(clip for clip in self.clips if clip.path.resolve() not in folders))

    def part(self, positions: range) -> ListedClips:
        return ListedClips(tuple(self.clips[position] for position in positions))

    def digest(self) -> list[tuple[str, dict[str, str]]]:
        """Return what tells these clips from others, whatever their folder."""
        return [(clip.name, clip.info.checksums) for clip in self.clips]


class Part(Protocol):
    """Clips from one source, opened when they are asked for."""

    def __len__(self) -> int: ...

    def clip(self, position: int) -> Clip:
        """Open a clip."""

    def paths(self, positions: Iterable[int]) -> list[Path]:
        """Return folders of clips."""

    def alike(self) -> Sequence[int]:
        """Return the positions of the clips that stand for all."""

    def without(self, folders: set[Path]) -> Part:
        """Return these clips but those in some resolved folders."""

    def part(self, positions: range) -> Part:
        """Return some of these clips."""

    def digest(self) -> Any:
        """Return what tells these clips from others."""


class ClipList(Sequence[Clip]):
    """Clips of data sets and others, one after another."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self.parts = tuple(parts)
        self._starts = [0, *itertools.accumulate(map(len, self.parts))]

    @staticmethod
    def of(clips: Iterable[Clip]) -> ClipList:
        """Return clips as such a list; one that is given stays as it is."""
        return clips if isinstance(clips, ClipList) else ClipList((ListedClips(tuple(clips)),))

    def __len__(self) -> int:
        return self._starts[-1]

    @overload
    def __getitem__(self, wanted: int) -> Clip: ...
    @overload
    def __getitem__(self, wanted: slice) -> ClipList: ...
    def __getitem__(self, wanted: int | slice) -> Clip | ClipList:
        if isinstance(wanted, slice):
            positions = range(len(self))[wanted]
            if positions.step < 0:
                return ClipList.of(self[position] for position in positions)
            return ClipList([part.part(inside) for part, inside in self._inside(positions)])
        position = range(len(self))[wanted]
        number = bisect_right(self._starts, position) - 1
        return self.parts[number].clip(position - self._starts[number])

    def _inside(self, positions: range) -> Iterator[tuple[Part, range]]:
        """Yield each part with the positions that ascending `positions` of the whole list take of it."""
        for part, start in zip(self.parts, self._starts, strict=False):
            first = max(0, -(-(start - positions.start) // positions.step))
            last = max(0, -(-(start + len(part) - positions.start) // positions.step))
            chosen = positions[first:last]
            yield part, range(chosen.start - start, chosen.stop - start, chosen.step)

    def __add__(self, other: ClipList) -> ClipList:
        return ClipList((*self.parts, *other.parts))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and len(self) == len(other) and all(map(Clip.__eq__, self, other))

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"<{len(self)} clips>"

    def alike(self) -> list[Clip]:
        """Return the clips that stand for all: the first of each series, and those that are listed by themselves."""
        return [part.clip(position) for part in self.parts for position in part.alike()]

    def alike_positions(self) -> list[int]:
        """Return the positions of the clips that stand for all."""
        starts = zip(self.parts, self._starts, strict=False)
        return [start + position for part, start in starts for position in part.alike()]

    def without(self, others: ClipList) -> ClipList:
        """Return these clips but those of `others`; the splits of one data set have none in common."""
        listed = {path.resolve() for path in others.listed_folders()}
        parts = [part.without(listed) for part in self.parts]
        return ClipList([_outside(part, others) if isinstance(part, ListedClips) else part for part in parts])

    def listed_folders(self) -> list[Path]:
        """Return the folders of the clips that are listed by themselves."""
        return [clip.path for part in self.parts if isinstance(part, ListedClips) for clip in part.clips]

    def digest(self) -> str:
        """Return the SHA-256 of what tells these clips from others, whatever their folders."""
        return sha256(to_json([part.digest() for part in self.parts]))


def _outside(part: ListedClips, others: ClipList) -> ListedClips:
    """Return listed clips but those that are clips of the data sets in `others`."""
    folders = [clip.path.resolve() for clip in part.clips]
    sets = [other for other in others.parts if isinstance(other, ClipsOfDataset)]
    return part.without({folder for folder in folders for other in sets if other.holds(folder)})
