"""The files that describe a published set: of each shard its record and the places of its clips, and of the set one.

shards/train-00003.tar      clips of one split
places/train-00003.json     where each clip lies in it (located.py), for reading parts
records/train-00003.json    its size and SHA-256, statistics; written last: the shard is complete when it exists
README.md, croissant.json   data card and metadata, once all shards are complete
published.json              the set; written at the very end
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from qsim import descriptions, files, records
from qsim.kinds import Count, Digest, Split, Text, text_like
from qsim.parsing import parse_json
from qsim.publishing import hdf5_shards, parquet_shards, tar_shards, zarr_shards
from qsim.publishing.located import Entry, ShardReader
from qsim.publishing.place import Place, write
from qsim.publishing.statistics import Statistics

Kind = Literal["webdataset", "parquet", "hdf5", "zarr"]
MODULES: dict[str, Any] = {
    "webdataset": tar_shards,
    "parquet": parquet_shards,
    "hdf5": hdf5_shards,
    "zarr": zarr_shards,
}
SET = "published.json"
CARD = "README.md"
CROISSANT = "croissant.json"
OTHERS = (
    r"published\.json|README\.md|croissant\.json|LICEN[CS]E[A-Za-z0-9._-]*|pictures/[A-Za-z0-9._-]+\.png"
    r"|places/(train|val|test)-[0-9]{5,}\.jsonl|records/(train|val|test)-[0-9]{5,}\.json"
)
SHARD = r"shards/(train|val|test)-[0-9]{5,}\.(tar|parquet|h5|zarr\.zip)"
ShardFile = Annotated[str, text_like(SHARD, "a name as shards/train-00000.tar")]
OURS = rf"{OTHERS}|{SHARD}"
CURE = "publish the set again with force=True"
Made = TypeVar("Made")


@dataclass(frozen=True, kw_only=True)
class ShardRecord:
    """A complete shard."""

    FORMAT: ClassVar[str] = "published shard"
    digest: Digest  # of what is published
    file: ShardFile
    size: Count  # bytes
    sha256: Digest
    line: Count  # bytes of a line of its places
    split: Split
    statistics: Statistics


@dataclass(frozen=True, kw_only=True)
class ShardSummary:
    """A shard as the description of the set lists it."""

    file: ShardFile
    clips: Count
    size: Count
    sha256: Digest
    line: Count


@dataclass(frozen=True, kw_only=True)
class SetInfo:
    """A published set."""

    FORMAT: ClassVar[str] = "published set"
    name: Text
    digest: Digest  # of what is published
    to: Kind
    columns: tuple[Text, ...]  # the fields of any clip
    streams: tuple[Text, ...] = ()
    packed: bool = False  # codes as bits
    licence: Text | None = None
    shards: dict[Split, tuple[ShardSummary, ...]] = field(default_factory=dict)
    alike: dict[Split, tuple[Count, ...]] = field(default_factory=dict)  # positions of clips that stand for all
    software: dict[str, str] = field(default_factory=lambda: {"qsim": files.VERSION})


def places_name(file: str) -> str:
    """Return the name of the places of a shard's clips."""
    return f"places/{Path(file).name.partition('.')[0]}.jsonl"


def place_lines(entries: Sequence[Entry]) -> tuple[bytes, int]:
    """Return the places of clips, and the bytes of one of their lines."""
    lines = [json.dumps(records.plain(entry), sort_keys=True, separators=(",", ":")).encode() for entry in entries]
    width = max(map(len, lines)) + 1
    return b"".join(line.ljust(width - 1) + b"\n" for line in lines), width


def read_place(where: Place, shard: ShardSummary, number: int) -> Entry:
    """Return where clip `number` of a shard lies; `ValueError` for a damaged line."""
    name = places_name(shard.file)
    shown = Path(where.address) / name
    line = where.read(name, number * shard.line, (number + 1) * shard.line)
    return records.convert(parse_json(shown, line.decode("utf-8", "replace")), Entry, str(shown), cure=CURE)


def reader_of(kind: str) -> ShardReader:
    """Return what reads the shards of a format."""
    made: ShardReader = MODULES[kind].Reader()
    return made


def store(where: Place, name: str, record: Any) -> str:
    """Write a record; return the SHA-256 of its file."""
    content = files.to_json(descriptions.values_of(record))
    write(where, name, content)
    return files.sha256(content)


def load(where: Place, name: str, kind: type[Made]) -> Made:
    """Return a record; `FileNotFoundError` if there is none, `ValueError` for a damaged one."""
    shown = Path(where.address) / name
    return descriptions.of_values(shown, parse_json(shown, where.read(name).decode("utf-8", "replace")), kind, CURE)


def loaded(where: Place, name: str, kind: type[Made]) -> Made | None:
    """Return a record; None if there is none."""
    return load(where, name, kind) if where.size(name) is not None else None
