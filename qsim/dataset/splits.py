"""Refuses recipes whose sections name a clip twice or share scenes between splits; works on ranges, not on clips.

A (family, seed) belongs to one split at every speed, and a family of the test split to no other split.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from qsim.dataset.job import clip_name, speed_suffix
from qsim.dataset.jobs import JobSeries
from qsim.scene.animated.gltf_body import GLTF_SUFFIXES
from qsim.scene.animated.gltf_scene import cameras_in

SPLIT_CURE = "splits are by scene, at any speed: give one of them other seeds"
FILE_CURE = "the file is the same scene at every seed: leave one of them out"


class Run(NamedTuple):
    """Consecutive seeds of a section."""

    first: int
    last: int
    section: int


def check_sections(sections: Sequence[JobSeries]) -> None:
    """Raise `ValueError` with place for a clip listed twice, or a split that shares a scene or a test family."""
    stems: dict[str, list[int]] = {}
    for number, section in enumerate(sections):
        stems.setdefault(section.example.stem, []).append(number)
        _check_speeds(section, number)
    for stem, numbers in stems.items():
        splits = {sections[number].example.split for number in numbers}
        if len(splits) > 1 and _is_one_scene(sections[numbers[0]].example.family):
            _refuse_same(sections, numbers, stem)
        for one, other in _overlapping(sections, numbers):
            _check_pair(sections, one, other)
        if len(splits) > 1 and "test" in splits:
            number = next(number for number in numbers if sections[number].example.split != "test")
            raise ValueError(
                f"scenes[{number}]: family {stem} is in the splits '{sections[number].example.split}' and 'test'; the "
                "test split holds families that training never sees: move its scenes"
            )


def _is_one_scene(family: str) -> bool:
    """Return whether a family has the same bodies at every seed: a file with a scene and its camera."""
    return family.endswith(".xml") or (family.endswith(GLTF_SUFFIXES) and bool(cameras_in(family)))


def _check_speeds(section: JobSeries, number: int) -> None:
    """Raise `ValueError` for two speeds of which the names of clips say the same."""
    seen: set[str] = set()
    for speed in section.speeds:
        if speed_suffix(speed) in seen:
            raise _twice(number, clip_name(section.example.stem, section.seeds[0], speed))
        seen.add(speed_suffix(speed))


def _refuse_same(sections: Sequence[JobSeries], numbers: Sequence[int], stem: str) -> None:
    first = sections[numbers[0]].example.split
    number = next(number for number in numbers if sections[number].example.split != first)
    split = sections[number].example.split
    raise ValueError(f"scenes[{number}]: scene {stem} is in the splits '{first}' and '{split}'; {FILE_CURE}")


def _check_pair(sections: Sequence[JobSeries], one: Run, other: Run) -> None:
    """Raise `ValueError` where two runs that have seeds in common name a clip twice or are of two splits."""
    earlier, later = sorted((one.section, other.section))
    stem = sections[later].example.stem
    seed = max(one.first, other.first)
    speeds = {speed_suffix(speed) for speed in sections[earlier].speeds}
    for speed in sections[later].speeds:
        if speed_suffix(speed) in speeds:
            raise _twice(later, clip_name(stem, seed, speed))
    splits = [sections[number].example.split for number in (earlier, later)]
    if splits[0] != splits[1]:
        raise ValueError(
            f"scenes[{later}]: scene {stem}:{seed} is in the splits '{splits[0]}' and '{splits[1]}'; {SPLIT_CURE}"
        )


def _twice(section: int, name: str) -> ValueError:
    return ValueError(f"scenes[{section}]: the clip {name} is listed twice; give one of them other seeds")


def _overlapping(sections: Sequence[JobSeries], numbers: Sequence[int]) -> Iterator[tuple[Run, Run]]:
    """Yield each two runs of different sections that have seeds in common."""
    open_runs: list[Run] = []
    # A sweep along the seeds: runs that ended before this one began cannot meet it or any later one.
    for run in sorted(run for number in numbers for run in _runs(sections[number].seeds, number)):
        open_runs = [other for other in open_runs if other.last >= run.first]
        yield from ((other, run) for other in open_runs if other.section != run.section)
        open_runs.append(run)


def _runs(seeds: Sequence[int], section: int) -> Iterator[Run]:
    """Yield the runs of consecutive numbers among seeds, in any order."""
    if isinstance(seeds, range):
        yield Run(seeds[0], seeds[-1], section)
        return
    ordered = sorted(seeds)
    starts = [0, *(i for i, (a, b) in enumerate(itertools.pairwise(ordered), 1) if b != a + 1), len(ordered)]
    yield from (Run(ordered[a], ordered[b - 1], section) for a, b in itertools.pairwise(starts))
