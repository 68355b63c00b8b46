"""Counts the clips of a data set from its series, without a list of them: index -> name, seed, speed and folder.

    series    the clips of one section [[scenes]]: one per seed and speed, all with the same settings
    listing   the series of a data set, one after another; the clips have the indices 0 ... n - 1
    block     a thousand clips in the order of the indices; the last digits of an index, in base 1000, are left out

A data set of at most a thousand clips has no blocks: its files are in `clips/NAME`. Those of a larger one are in
`clips/012/NAME`, above a million clips in `clips/000/012/NAME`: no folder holds more than a thousand entries.
"""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from qsim.dataset.job import clip_name, job_digest, speed_suffix
from qsim.kinds import Digest, Name, Seed, Speed, Split, text_like

BLOCK = 1000  # clips of a block, and blocks of a folder of blocks
LARGEST_SEED = 2**31 - 1

SeedRange = Annotated[str, text_like(r"[0-9]{1,10}\.\.[0-9]{1,10}", 'a range of seeds, as "0..999"')]
Seeds = Seed | Annotated[tuple[Seed, ...], Meta(min_length=1)] | SeedRange


@dataclass(frozen=True, kw_only=True)
class Series:
    """The clips of one section [[scenes]] of a recipe: one per seed and speed, in this order."""

    stem: Name  # of the family
    seeds: Seeds
    speeds: tuple[Speed, ...] = (1.0,)
    split: Split
    digest: Digest  # of everything else that decides their files

    def __len__(self) -> int:
        return len(seed_numbers(self.seeds)) * len(self.speeds)


def seed_numbers(seeds: int | tuple[int, ...] | str) -> Sequence[int]:
    """Return seeds as numbers: one, some, or those of a range `"0..999"`; `ValueError` for a range that is none."""
    if isinstance(seeds, int):
        return (seeds,)
    if isinstance(seeds, tuple):
        return seeds
    first, last = (int(number) for number in seeds.split(".."))
    if first > last or last > LARGEST_SEED:
        raise ValueError(f'seeds: "{seeds}" is no range; give "FIRST..LAST", at most {LARGEST_SEED}')
    return range(first, last + 1)


def short_seeds(numbers: Sequence[int]) -> int | tuple[int, ...] | str:
    """Return the shortest way to write seeds: equal seeds are written alike."""
    if len(numbers) == 1:
        return numbers[0]
    if isinstance(numbers, range) or list(numbers) == list(range(numbers[0], numbers[0] + len(numbers))):
        return f"{numbers[0]}..{numbers[-1]}"
    return tuple(numbers)


class Listing:
    """The clips of some series by their indices; it holds the series alone."""

    def __init__(self, series: Sequence[Series]) -> None:
        self.series = tuple(series)
        self._seeds = [seed_numbers(each.seeds) for each in self.series]
        sizes = [len(seeds) * len(each.speeds) for seeds, each in zip(self._seeds, self.series, strict=True)]
        self.starts = [0, *itertools.accumulate(sizes)]

    def __len__(self) -> int:
        return self.starts[-1]

    def number(self, index: int) -> int:
        """Return the number of the series that holds a clip."""
        return bisect_right(self.starts, index) - 1

    def scene(self, index: int) -> tuple[Series, int, float]:
        """Return the series of a clip, the seed of its scene and its speed."""
        number = self.number(index)
        series = self.series[number]
        seed, speed = divmod(index - self.starts[number], len(series.speeds))
        return series, self._seeds[number][seed], series.speeds[speed]

    def name(self, index: int) -> str:
        """Return the name of a clip."""
        series, seed, speed = self.scene(index)
        return clip_name(series.stem, seed, speed)

    def digest(self, index: int) -> str:
        """Return the digest of a clip's job."""
        series, seed, speed = self.scene(index)
        return job_digest(series.digest, seed, speed)

    def block(self, index: int) -> str:
        """Return the folder of a clip's files below `clips`, `jobs` and so on; empty for at most a thousand clips."""
        return block_folder(index, len(self))

    def key(self, index: int) -> str:
        """Return the name of a clip with its folder, as `012/fan_0003`."""
        block = self.block(index)
        return f"{block}/{self.name(index)}" if block else self.name(index)

    def find(self, name: str) -> int | None:
        """Return the index of the clip of this name; None if there is none."""
        for number, series in enumerate(self.series):
            if not name.startswith(f"{series.stem}_"):
                continue
            seed, _, speed = name.removeprefix(f"{series.stem}_").partition("_")
            suffixes = [speed_suffix(each) for each in series.speeds]
            suffix = f"_{speed}" if speed else ""
            if not (seed.isdecimal() and seed.isascii()) or suffix not in suffixes:
                continue
            seeds = self._seeds[number]
            if int(seed) in seeds:
                found = self.starts[number] + seeds.index(int(seed)) * len(suffixes) + suffixes.index(suffix)
                if self.name(found) == name:
                    return found
        return None

    def names(self, start: int, stop: int) -> Iterator[str]:
        """Yield the names of the clips start ... stop - 1."""
        for number in range(self.number(start), len(self.series)):
            first = self.starts[number]
            if first >= stop:
                return
            series = self.series[number]
            inside = range(max(start, first) - first, min(stop, self.starts[number + 1]) - first)
            seeds = self._seeds[number]
            if series.speeds == (1.0,):
                head = series.stem
                yield from (f"{head}_{seed:04d}" for seed in seeds[inside.start : inside.stop])
            else:
                yield from (self.name(first + i) for i in inside)

    def blocks(self) -> Iterator[tuple[str, range]]:
        """Yield folder and indices of each block."""
        for start in range(0, len(self), BLOCK):
            yield self.block(start), range(start, min(start + BLOCK, len(self)))

    @property
    def splits(self) -> list[tuple[Split, range]]:
        """Return split and indices of each series."""
        return [
            (series.split, range(start, stop))
            for series, (start, stop) in zip(self.series, itertools.pairwise(self.starts), strict=True)
        ]


def block_folder(index: int, total: int) -> str:
    """Return the folder of the block of clip `index` among `total`: its number in base 1000, empty for one block."""
    parts: list[str] = []
    number = index // BLOCK
    blocks = -(-total // BLOCK)
    while blocks > 1:
        parts.insert(0, f"{number % BLOCK:03d}")
        number //= BLOCK
        blocks = -(-blocks // BLOCK)
    return "/".join(parts)
