"""Publishes a data set: shards that programs load without qsim, a data card and Croissant metadata.

    clips --sample_of--> fields of each clip --Writer--> shards, record by record --> README.md, croissant.json

The shards are a function of the set and the settings, so processes share them and an interrupted run resumes with
those whose records are missing. Memory is that of one clip, or of one group of rows. The card, the metadata and the
description come last: a set that has them is complete.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from qsim import files, records
from qsim.checks import SPLITS
from qsim.dataset.clip_list import ClipList
from qsim.dataset.dataset import Dataset, Part, checked_part
from qsim.files import Progress
from qsim.host import own_numbers
from qsim.kinds import Positive
from qsim.notebook import reporting
from qsim.publishing import croissant, data_card
from qsim.publishing.contents import FIELDS, Field, Sample, sample_of, sensed
from qsim.publishing.place import Folder, Place, place, write
from qsim.publishing.record import (
    CARD,
    CROISSANT,
    MODULES,
    OURS,
    SET,
    Kind,
    SetInfo,
    ShardRecord,
    ShardSummary,
    load,
    loaded,
    place_lines,
    places_name,
    store,
)
from qsim.publishing.statistics import Statistics, statistics_of
from qsim.streams.clip import Clip
from qsim.streams.sensing import Sensing

MOST_CLIPS = 1000  # of a shard
BYTES = {"flow": 8, "flow_back": 8, "valid": 1, "depth": 4, "body_id": 4, "saturated": 0}  # of a pixel
PICTURED = 4  # clips in the data card

Fields = Annotated[tuple[Field, ...], Meta(min_length=1)]


@dataclass(frozen=True, kw_only=True)
class Publication:
    """What is published of each clip, and how."""

    to: Kind = "webdataset"
    fields: Fields = FIELDS
    packed: bool = False  # codes as packed bits
    shard_size: Positive = 256.0  # MB, about
    licence: str | None = None  # of the set, as in CC-BY-4.0
    sensings: tuple[Sensing, ...] = ()  # codes that are drawn; without any, those of the stored streams

    def __post_init__(self) -> None:
        kinds: dict[str, Any] = {"to": Kind, "fields": Fields, "shard_size": Positive}
        for name, kind in kinds.items():
            object.__setattr__(self, name, records.convert(getattr(self, name), kind, name))


@dataclass(frozen=True)
class Published:
    """What `publish` did."""

    address: str
    clips: int  # of the set
    shards: int  # of the set
    made: int  # shards that were written now
    size: int  # bytes of the complete shards
    complete: bool  # whether the set has its data card


@dataclass(frozen=True)
class Shard:
    """A shard of the plan: clips start ... stop - 1 of a split."""

    split: str
    number: int
    start: int
    stop: int
    first: int  # number of the first clip in the set

    @property
    def name(self) -> str:
        return f"{self.split}-{self.number:05d}"


@dataclass(frozen=True)
class Source:
    """The clips of a data set or of one folder, and the settings with which they are published."""

    path: Path
    name: str
    clips: Mapping[str, ClipList]  # by split
    wanted: Publication

    @staticmethod
    def open(path: Path, wanted: Publication) -> Source:
        """Open a data set or a clip; `ValueError` for a set that lacks clips."""
        if (path / "clip.json").is_file():
            clip = Clip.open(path)
            return Source(path, clip.name, {clip.info.split or "train": ClipList.of([clip])}, wanted)
        data = Dataset.open(path)
        left = int((~data.finished()).sum())
        if left:
            raise ValueError(f"{path}: the data set lacks {left} of its clips; finish `qsim generate` first")
        return Source(path, data.name, {split: found for split in SPLITS if (found := data.clips(split))}, wanted)

    @functools.cached_property
    def alike(self) -> list[tuple[str, Clip]]:
        """Split and clip of those that stand for all."""
        return [(split, clip) for split, clips in self.clips.items() for clip in clips.alike()]

    @functools.cached_property
    def streams(self) -> tuple[str, ...]:
        """The names of the stored streams that are published."""
        if self.wanted.sensings:
            return ()
        return tuple(dict.fromkeys(name for _, clip in self.alike for name in clip.streams))

    @property
    def codes(self) -> tuple[str, ...]:
        """The names of all codes."""
        return (*self.streams, *(sensing.stream_name for sensing in self.wanted.sensings))

    def sample(self, clip: Clip, number: int, split: str) -> Sample:
        """Return what is published of a clip; `ValueError` for a stream that the first clips of the set lack."""
        more = set() if self.wanted.sensings else set(clip.streams) - set(self.streams)
        if more:
            raise ValueError(
                f"{clip.path}: has the stream {min(more)}, which the first clip of its kind lacks; sense the whole set "
                "alike with `qsim sense`, or delete this stream"
            )
        return sample_of(
            clip,
            f"{number:09d}",
            fields=self.wanted.fields,
            streams=self.streams,
            sensings=self.wanted.sensings,
            packed=self.wanted.packed,
            split=split,
        )

    @functools.cached_property
    def columns(self) -> tuple[str, ...]:
        """The fields of any clip. A field of some clips of a kind is always among them."""
        found = dict.fromkeys(name for split, clip in self.alike for name in self.sample(clip, 0, split).arrays)
        sometimes = [name for name in self.wanted.fields if name == "saturated"]
        columns = tuple(dict.fromkeys([*found, *sometimes]))
        if not found:
            raise ValueError(f"{self.path}: has none of the fields {', '.join(self.wanted.fields)}; name others")
        return columns

    @functools.cached_property
    def digest(self) -> str:
        """What tells this publication from others."""
        wanted = {name: value for name, value in vars(self.wanted).items() if name != "sensings"}
        first = next(iter(self.alike))[1]
        drawn = [sensed(first, sensing).info.compared for sensing in self.wanted.sensings]
        stored = [clip.stream(name).info.compared for _, clip in self.alike for name in self.streams_of(clip)]
        clips = {split: found.digest() for split, found in self.clips.items()}
        return files.sha256(files.to_json([records.plain(wanted), self.name, drawn, stored, clips]))

    def streams_of(self, clip: Clip) -> list[str]:
        """Return the stored streams of a clip that are published."""
        return [name for name in self.streams if name in clip.streams]

    @functools.cached_property
    def shards(self) -> list[Shard]:
        """The shards of the set."""
        # Shards are planned before anything is written: sizes come from the largest clip, so
        # parts that are made on different machines agree on what each shard holds.
        largest = max(self._bytes(clip) for _, clip in self.alike)
        step = min(MOST_CLIPS, max(1, int(self.wanted.shard_size * 1e6 // largest)))
        found = []
        first = 0
        for split, clips in self.clips.items():
            for number, start in enumerate(range(0, len(clips), step)):
                stop = min(start + step, len(clips))
                found.append(Shard(split, number, start, stop, first + start))
            first += len(clips)
        return found

    def _bytes(self, clip: Clip) -> int:
        """Return about how many bytes a clip takes, not compressed."""
        frames, height, width = clip.shape
        bands = 1 if clip.bands is None else 3
        of_pixel = {"radiance": 2 * bands, "sharp": 2 * bands * clip.info.has_sharp}
        of_pixel |= {"codes": len(self.codes), "truth": 4 * bands * len(self.codes)}
        of_pixel |= BYTES if clip.has_truth else {}
        return frames * height * width * max(1, sum(of_pixel.get(field, 0) for field in self.wanted.fields))


@own_numbers
def publish(
    source: str | os.PathLike[str],
    address: str | os.PathLike[str],
    wanted: Publication | None = None,
    *,
    part: Part | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Published:
    """Publish a data set, or one clip, in a folder or at an address of fsspec, as s3://bucket/set; resume if begun.

    `part` (i, n) makes the i-th of n parts of the shards; who makes the last one writes the data card. `force` replaces
    another published set. `progress(done, total)` counts clips; a notebook shows a bar without it. `ValueError` for a
    set that lacks clips, `FileExistsError` where others' files are, `OSError` where a storage fails: what is there is
    complete.
    """
    found = Source.open(Path(source), wanted or Publication())
    columns = found.columns
    for package in MODULES[found.wanted.to].PACKAGES:
        importlib.import_module(package)  # a missing one is named before anything is written
    chosen = found.shards if part is None else found.shards[checked_part(part)[0] - 1 :: part[1]]
    where = place(address)
    if force and part is not None:
        raise ValueError("shard: parts of a published set do not replace it; run without force=True, after deleting it")
    _begin(where, found.digest, force)
    with reporting(progress, found.name, "clip") as heard:
        made = _write_missing(where, found, chosen, columns, heard)
    complete = _finish(where, found)
    sizes = [complete[shard.name].size for shard in found.shards if shard.name in complete]
    clips = sum(map(len, found.clips.values()))
    return Published(where.address, clips, len(found.shards), made, sum(sizes), len(sizes) == len(found.shards))


def _write_missing(
    where: Place, found: Source, chosen: Sequence[Shard], columns: Sequence[str], progress: Progress | None
) -> int:
    """Write those shards that are not complete; return their number."""
    total = sum(shard.stop - shard.start for shard in chosen)
    done = 0
    made = 0
    for shard in chosen:
        if not _is_complete(where, shard, found.digest):
            count = functools.partial(_count, progress, done, total)
            _write_shard(where, found, shard, columns, count)
            made += 1
        done += shard.stop - shard.start
        _count(progress, done, total, 0)
    return made


def _count(progress: Progress | None, before: int, total: int, done: int) -> None:
    """Report clips that are done."""
    if progress is not None:
        progress(before + done, total)


def _begin(where: Place, digest: str, force: bool) -> None:
    """Prepare the place; `FileExistsError` for others' files, and for another published set without `force`."""
    if isinstance(where, Folder):
        _check_folder(where)
    names = where.names()
    ours = any(name == SET or name.startswith(("records/", "places/", "shards/")) for name in names)
    foreign = [name for name in names if not (ours and re.fullmatch(OURS, name))]
    if foreign:
        raise FileExistsError(
            f"{where.address}/{foreign[0]}: was not made by this command, which replaces only what it made; move it "
            "away, or name another output"
        )
    if force:
        _clear(where, names)
        return
    known = [name for name in names if name == SET] or [name for name in names if name.startswith("records/")][:1]
    for name in known:
        kind: type[SetInfo] | type[ShardRecord] = SetInfo if name == SET else ShardRecord
        if load(where, name, kind).digest != digest:
            raise FileExistsError(
                f"{where.address}: holds another published set, or this one with other settings; name another output, "
                "or replace it with force=True"
            )


def _check_folder(where: Folder) -> None:
    """Delete what killed writers left; `FileExistsError` for a file, a link, and a place in a clip or data set."""
    if where.path.is_symlink() or (where.path.exists() and not where.path.is_dir()):
        raise FileExistsError(f"{where.path}: is a file or a link, and a folder is needed; name another output")
    for above in (where.path.absolute(), *where.path.absolute().parents):
        for mark, kind in (("clip.json", "clip"), ("dataset.json", "data set")):
            if (above / mark).is_file():
                raise FileExistsError(
                    f"{where.path}: is in the {kind} {above}, which holds nothing else; name another output"
                )
    if where.path.is_dir():
        where.sweep()


def _clear(where: Place, names: Sequence[str]) -> None:
    """Delete a published set: first what says that it is complete, then the records, last the shards: they prove it."""

    def rank(name: str) -> int:
        if name in (SET, CROISSANT, CARD):
            return (SET, CROISSANT, CARD).index(name)
        return {"records": 3, "shards": 5}.get(name.partition("/")[0], 4)

    for name in sorted(names, key=rank):
        where.remove(name)


def _is_complete(where: Place, shard: Shard, digest: str) -> bool:
    """Return whether a shard is there with its record."""
    record = loaded(where, f"records/{shard.name}.json", ShardRecord)
    return record is not None and record.digest == digest and where.size(record.file) == record.size


def _write_shard(where: Place, source: Source, shard: Shard, columns: Sequence[str], count: Any) -> None:
    """Write a shard, the places of its clips, and its record."""
    module = MODULES[source.wanted.to]
    file = f"shards/{shard.name}.{module.SUFFIX}"
    clips = source.clips[shard.split]
    entries = []
    statistics = Statistics()
    with where.writing(file) as path:
        with _closing(module.Writer(path, columns)) as writer:
            for position in range(shard.start, shard.stop):
                sample = source.sample(clips[position], shard.first + position - shard.start, shard.split)
                more = set(sample.arrays) - set(columns)
                if more:
                    raise ValueError(f"{sample.clip.path}: has {min(more)}, which the first clip of its kind lacks")
                entries.append(writer.add(sample))
                statistics = statistics + statistics_of(sample)
                count(position - shard.start + 1)
        size = path.stat().st_size
        sha256 = files.sha256(path)
    places, line = place_lines(entries)
    write(where, places_name(file), places)
    record = ShardRecord(
        digest=source.digest,
        file=file,
        size=size,
        sha256=sha256,
        line=line,
        split=shard.split,  # type: ignore[arg-type]
        statistics=statistics,
    )
    store(where, f"records/{shard.name}.json", record)


@contextlib.contextmanager
def _closing(writer: Any) -> Iterator[Any]:
    """Close a writer at the end of the block; after an error, its own errors are of no interest."""
    try:
        yield writer
    except BaseException:
        with contextlib.suppress(Exception):
            writer.close()
        raise
    writer.close()


def _finish(where: Place, source: Source) -> dict[str, ShardRecord]:
    """Write card, metadata and description if all shards are complete; return the records that are there."""
    names = set(where.names())
    complete = {
        shard.name: load(where, f"records/{shard.name}.json", ShardRecord)
        for shard in source.shards
        if f"records/{shard.name}.json" in names
    }
    if SET in names or len(complete) < len(source.shards):
        return complete
    info = _describe(source, complete)
    totals: dict[str, Statistics] = {}
    for record in complete.values():
        totals[record.split] = totals.get(record.split, Statistics()) + record.statistics
    licences = {found.name: found.read_bytes() for found in _licence_files(source.path)}
    for name, content in licences.items():
        write(where, name, content)
    pictures = {}
    for split, clip in source.alike[:PICTURED]:
        name = f"pictures/{clip.name}.png"
        write(where, name, data_card.picture(source.sample(clip, 0, split)))
        pictures[clip.name] = name
    write(where, CROISSANT, files.to_json(croissant.metadata(info, totals)))
    write(where, CARD, data_card.text(info, totals, pictures, tuple(licences)).encode())
    store(where, SET, info)
    return complete


def _licence_files(path: Path) -> list[Path]:
    """Return the licences that lie in a data set, as warped photographs have them."""
    return sorted(found for found in path.glob("LICEN[CS]E*") if found.is_file() and re.fullmatch(OURS, found.name))


def _describe(source: Source, complete: Mapping[str, ShardRecord]) -> SetInfo:
    """Return the description of a complete set."""
    shards: dict[Any, list[ShardSummary]] = {}
    for shard in source.shards:
        record = complete[shard.name]
        summary = ShardSummary(
            file=record.file,
            clips=shard.stop - shard.start,
            size=record.size,
            sha256=record.sha256,
            line=record.line,
        )
        shards.setdefault(shard.split, []).append(summary)
    return SetInfo(
        name=source.name,
        digest=source.digest,
        to=source.wanted.to,
        columns=source.columns,
        streams=source.codes,
        packed=source.wanted.packed,
        licence=source.wanted.licence,
        shards={split: tuple(found) for split, found in shards.items()},
        alike={split: tuple(clips.alike_positions()) for split, clips in source.clips.items()},  # type: ignore[misc]
    )
