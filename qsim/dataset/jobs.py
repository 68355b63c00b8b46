"""The jobs of a recipe as a sequence that makes each job when it is asked for: index -> job.

A part of it, as a shard, is a range of indices. So a shard knows its jobs without a list of the others.
"""

from __future__ import annotations

import functools
import itertools
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import overload

from qsim.dataset.job import Job
from qsim.dataset.series import Listing, Series, short_seeds


@dataclass(frozen=True)
class JobSeries:
    """The jobs of one section [[scenes]]: `example` at every seed and speed."""

    example: Job
    seeds: Sequence[int]
    speeds: tuple[float, ...] = (1.0,)

    @staticmethod
    def of(job: Job) -> JobSeries:
        """Return the series of one job."""
        return JobSeries(job, (job.scene_seed,), (job.speed,))

    def stored(self) -> Series:
        """Return the series as a data set stores it; reads the files that decide the clips."""
        job = self.example
        return Series(
            stem=job.stem,
            seeds=short_seeds(self.seeds),
            speeds=self.speeds,
            split=job.split,
            digest=job.series_digest,
        )


class Jobs(Sequence[Job]):
    """Some jobs of a recipe, all of them by default, in the order of their indices."""

    def __init__(self, sections: Iterable[JobSeries], chosen: tuple[range, ...] | None = None) -> None:
        self.sections = tuple(sections)
        self._names = Listing([_unread(each) for each in self.sections])
        self.chosen = (range(len(self._names)),) if chosen is None else chosen
        self._starts = [0, *itertools.accumulate(map(len, self.chosen))]

    @staticmethod
    def of(jobs: Iterable[Job]) -> Jobs:
        """Return jobs that are listed one by one."""
        return Jobs(JobSeries.of(job) for job in jobs)

    @functools.cached_property
    def listing(self) -> Listing:
        """The listing of all jobs of the recipe with their digests; the files that decide them are read once."""
        return Listing([section.stored() for section in self.sections])

    def __len__(self) -> int:
        return self._starts[-1]

    @overload
    def __getitem__(self, wanted: int) -> Job: ...
    @overload
    def __getitem__(self, wanted: slice) -> Jobs: ...
    def __getitem__(self, wanted: int | slice) -> Job | Jobs:
        if isinstance(wanted, slice):
            return Jobs(self.sections, tuple(self._part(range(len(self))[wanted])))
        position = range(len(self))[wanted]
        piece = bisect_right(self._starts, position) - 1
        return self.job(self.chosen[piece][position - self._starts[piece]])

    def _part(self, positions: range) -> Iterator[range]:
        """Yield the indices at some positions: one range per piece."""
        if len(self.chosen) == 1:
            yield self.chosen[0][positions.start : positions.stop : positions.step] if positions else range(0)
            return
        yield from (range(index, index + 1) for index in (self._index(position) for position in positions))

    def _index(self, position: int) -> int:
        piece = bisect_right(self._starts, position) - 1
        return self.chosen[piece][position - self._starts[piece]]

    def job(self, index: int) -> Job:
        """Return the job of an index of the recipe."""
        _, seed, speed = self._names.scene(index)
        example = self.sections[self._names.number(index)].example
        return replace(example, scene_seed=seed, speed=speed, block=self._names.block(index))

    def find(self, name: str) -> Job | None:
        """Return the recipe's job of this name; None if there is none."""
        index = self._names.find(name)
        return None if index is None else self.job(index)

    def names(self) -> list[str]:
        """Return the names of these jobs."""
        return [self._names.name(index) for piece in self.chosen for index in piece]

    def changed(self, change: Callable[[Job], Job]) -> Jobs:
        """Return the same jobs after `change`, which acts on all jobs of a section alike."""
        return Jobs((replace(each, example=change(each.example)) for each in self.sections), self.chosen)

    def by_section(self) -> list[Jobs]:
        """Return the jobs of each section that has any among these."""
        found = []
        for start, stop in itertools.pairwise(self._names.starts):
            pieces = tuple(part for piece in self.chosen if (part := _within(piece, start, stop)))
            if pieces:
                found.append(Jobs(self.sections, pieces))
        return found

    def together(self, other: Jobs) -> Jobs:
        """Return these jobs and those of another part of the same recipe."""
        return Jobs(self.sections, self.chosen + other.chosen)

    def frames(self) -> int:
        """Return the number of frames of all these jobs."""
        return sum(len(part) * part[0].settings.frames for part in self.by_section())


_NO_DIGEST = "0" * 64


def _unread(section: JobSeries) -> Series:
    """Return what the names of a section's clips follow from; the files that decide its digest are not read."""
    job = section.example
    seeds = short_seeds(section.seeds)
    return Series(stem=job.stem, seeds=seeds, speeds=section.speeds, split=job.split, digest=_NO_DIGEST)


def _within(piece: range, start: int, stop: int) -> range:
    """Return the numbers of an ascending range that are in start ... stop - 1."""
    first = max(0, -(-(start - piece.start) // piece.step))
    last = max(0, -(-(stop - piece.start) // piece.step))
    return piece[first:last]
