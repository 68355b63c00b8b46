"""Reads published sets as clips: those of a folder or of object storage, for training, restoring and comparing.

    PublishedSet.open("s3://bucket/set").clips("train")     opened one by one, as those of a data set

Light and codes of a window are read by their positions in a shard (located.py): a few rows of a local file, and blocks
of frames of a remote one, of which the last stay in memory. Parquet and compressed ground truth are read array by
array. Memory does not grow with the set.
"""

from __future__ import annotations

import hashlib
import json
import os
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import descriptions, files, records
from qsim.checks import SPLITS
from qsim.clip.clip_folder import ClipFolder
from qsim.clip.clip_info import ClipInfo
from qsim.dataset.clip_list import ClipList
from qsim.dataset.dataset import Part, checked_part
from qsim.files import Progress
from qsim.host import own_numbers
from qsim.lazy_array import LazyArray
from qsim.optics.radiometry import Crop, check_crop
from qsim.publishing.contents import CHANNELS, DescribedStream, Description
from qsim.publishing.located import Entry, Located
from qsim.publishing.place import Place, is_address, place
from qsim.publishing.record import CURE, SET, SetInfo, ShardSummary, load, read_place, reader_of
from qsim.sensor import packing
from qsim.streams.clip import Clip
from qsim.streams.event_stream import EventStream
from qsim.streams.stream import Stream
from qsim.streams.stream_info import StreamInfo

BLOCK = 16  # frames that are read from a remote shard at a time
KEPT = 1 << 27  # bytes of blocks and arrays that stay in memory, of a process
PIECE = 1 << 22  # bytes that are read at once of a shard that is checked


def is_published(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is an address of fsspec or the folder of a published set."""
    return is_address(path) or (Path(path) / SET).is_file()


@own_numbers
@dataclass(frozen=True, eq=False)
class PublishedSet:
    """A published set, in a folder or in object storage."""

    address: str
    info: SetInfo

    @staticmethod
    def open(address: str | os.PathLike[str]) -> PublishedSet:
        """Open a set; `FileNotFoundError` if it is missing or not complete, `ValueError` if it is damaged."""
        where = place(address)
        if where.size(SET) is None:
            raise FileNotFoundError(
                f"{where.address}: no complete published set (it has no {SET}); `qsim publish` makes and resumes one"
            )
        return PublishedSet(where.address, load(where, SET, SetInfo))

    def __repr__(self) -> str:
        counts = ", ".join(f"{self._count(split)} {split}" for split in SPLITS if split in self.info.shards)
        return f"<PublishedSet {self.info.name}: clips {counts}, as {self.info.to}>"

    def verify(self, progress: Progress | None = None, part: Part | None = None) -> list[str]:
        """Return one message for each shard that is missing or has another SHA-256 than its record; empty if intact.

        `part` (i, n) takes the i-th of n parts. `progress(done, total)` is called after each shard.
        """
        shards = [shard for split in SPLITS for shard in self.info.shards.get(split, ())]  # type: ignore[call-overload]
        chosen = shards if part is None else shards[checked_part(part)[0] - 1 :: part[1]]
        problems = []
        for done, shard in enumerate(chosen, 1):
            problems += self._differs(shard)
            if progress is not None:
                progress(done, len(chosen))
        return problems

    def _differs(self, shard: ShardSummary) -> list[str]:
        name = f"{self.address}/{shard.file}"
        if self.where.size(shard.file) is None:
            return [f"{name}: missing; {CURE}"]
        digest = hashlib.sha256()
        with self.where.opened(shard.file) as file:
            while block := file.read(PIECE):
                digest.update(block)
        same = digest.hexdigest() == shard.sha256
        return [] if same else [f"{name}: contents changed (checksum differs); {CURE}"]

    def clips(self, split: str | None = None) -> ClipList:
        """Return the clips of one split, or of all. `ValueError` for an unknown split."""
        if split is not None and split not in SPLITS:
            raise ValueError(f"{self.address}: unknown split {split!r}; there are {', '.join(SPLITS)}")
        chosen = [name for name in SPLITS if name in self.info.shards and split in (None, name)]
        return ClipList([ClipsOfPublished(self, name, np.arange(self._count(name))) for name in chosen])

    def _count(self, split: Any) -> int:
        return sum(shard.clips for shard in self.info.shards[split])

    def _check_size(self, shard: ShardSummary) -> None:
        """Raise `ValueError` for a shard of another size than when it was published; each is asked for once."""
        if shard.file in self._sized:
            return
        size = self.where.size(shard.file)
        if size is not None and size != shard.size:  # a missing one is named when it is opened
            raise ValueError(
                f"{self.address}/{shard.file}: has {size} bytes, not the {shard.size} it was published with; {CURE}"
            )
        self._sized.add(shard.file)

    @cached_property
    def _sized(self) -> set[str]:
        """The shards whose size was compared."""
        return set()

    @cached_property
    def where(self) -> Place:
        """The place of its files."""
        return place(self.address)

    @cached_property
    def _ends(self) -> dict[str, list[int]]:
        """The numbers of the clips behind each shard, by split."""
        return {split: list(accumulate(shard.clips for shard in shards)) for split, shards in self.info.shards.items()}

    def clip(self, split: Any, position: int) -> PublishedClip:
        """Open a clip of a split."""
        number = bisect_right(self._ends[split], position)
        shard = self.info.shards[split][number]
        before = self._ends[split][number - 1] if number else 0
        self._check_size(shard)
        return PublishedClip.of(self, shard, read_place(self.where, shard, position - before))


@dataclass(frozen=True, eq=False)
class ClipsOfPublished:
    """Clips of one split of a published set, as a part of a `ClipList`."""

    data: PublishedSet
    split: Any
    indices: Array  # int64, ascending

    def __len__(self) -> int:
        return len(self.indices)

    def clip(self, position: int) -> Clip:
        return self.data.clip(self.split, int(self.indices[position]))

    def paths(self, positions: Iterable[int]) -> list[Path]:
        return [self.clip(position).path for position in positions]

    def alike(self) -> list[int]:
        """Return the positions of the clips that stand for all, as in the data set that was published."""
        return np.flatnonzero(np.isin(self.indices, self.data.info.alike[self.split])).tolist()

    def without(self, folders: set[Path]) -> ClipsOfPublished:
        """Return these clips: none lies in a folder."""
        return self

    def holds(self, folder: Path) -> bool:
        """Return False: none of these clips is a folder."""
        return False

    def part(self, positions: range) -> ClipsOfPublished:
        chosen = self.indices[np.arange(positions.start, positions.stop, positions.step)]
        return ClipsOfPublished(self.data, self.split, chosen)

    def digest(self) -> list[str]:
        """Return what tells these clips from others, wherever they are."""
        return [self.data.info.digest, self.split, json.dumps(self.indices.tolist())]


# ---- Arrays


class Kept:
    """Arrays that were read last, up to so many bytes."""

    def __init__(self, most: int) -> None:
        self.most = most
        self._arrays: OrderedDict[Any, Array] = OrderedDict()
        self._bytes = 0

    def get(self, key: Any, read: Callable[[], Array]) -> Array:
        """Return the array of a key, read if it is not there."""
        if key in self._arrays:
            self._arrays.move_to_end(key)
            return self._arrays[key]
        found = read()
        found.setflags(write=False)
        self._arrays[key] = found
        self._bytes += found.nbytes
        while self._bytes > self.most and len(self._arrays) > 1:
            self._bytes -= self._arrays.popitem(last=False)[1].nbytes
        return found


_KEPT = Kept(KEPT)


@dataclass(frozen=True)
class Stored:
    """The arrays of a published clip."""

    data: PublishedSet
    file: str  # of the shard
    entry: Entry

    @cached_property
    def description(self) -> Description:
        """The description of the clip."""
        path = Path(self.data.address) / self.file
        with files.decoding_errors(path, self.data.info.to):
            content = reader_of(self.data.info.to).description(self.data.where, self.file, self.entry)
            found: dict[str, Any] = json.loads(content)
        inside = found.get("attributes", {}).get("description") if self.data.info.to == "zarr" else found
        if not isinstance(inside, dict) or inside.get("clip") != self.entry.clip:
            raise ValueError(f"{self.data.address}/{self.file}: is not the shard that is described; {CURE}")
        return records.convert(inside, Description, f"{path}/{self.entry.clip}: its description", cure=CURE)

    def frames(self, name: str, start: int, stop: int, crop: Crop | None = None) -> Array:
        """Return frames start ... stop - 1 of an array, of the rows and columns of a crop."""
        located = self.entry.arrays[name]
        if located.at is None or located.bytes is not None:
            return _cut(self._whole(name)[start:stop], crop)
        if self.data.where.is_remote:
            return _cut(self._blocks(name, located, start, stop), crop)
        return np.stack([self._rows(located, t, crop) for t in range(start, stop)])

    def _whole(self, name: str) -> Array:
        """Return an array, read by its format."""

        def read() -> Array:
            path = Path(self.data.address) / self.file
            with files.decoding_errors(path, self.data.info.to):
                found = reader_of(self.data.info.to).array(self.data.where, self.file, self.entry, name)
            located = self.entry.arrays[name]
            if found.shape != located.shape or found.dtype != np.dtype(located.dtype):
                raise ValueError(f"{path}: {name} is {found.dtype} {list(found.shape)}, other than described; {CURE}")
            return found

        return _KEPT.get((self.data.info.digest, self.data.address, self.entry.key, name), read)

    def _blocks(self, name: str, located: Located, start: int, stop: int) -> Array:
        """Return frames of a remote array, read in blocks."""
        found = []
        for first in range(start - start % BLOCK, stop, BLOCK):
            last = min(first + BLOCK, located.shape[0])
            key = (self.data.info.digest, self.data.address, self.entry.key, name, first)
            block = _KEPT.get(key, lambda first=first, last=last: self._at(located, first, last))  # type: ignore[misc]
            found.append(block[max(start - first, 0) : stop - first])
        return found[0] if len(found) == 1 else np.concatenate(found)

    def _at(self, located: Located, start: int, stop: int) -> Array:
        """Return frames from their positions, by one read."""
        size = located.frame_bytes
        if isinstance(located.at, tuple):
            begins = located.at[start:stop]
            content = self._read(begins[0], begins[-1] + size)
            parts = [content[begin - begins[0] : begin - begins[0] + size] for begin in begins]
            content = b"".join(parts)
        else:
            assert located.at is not None
            content = self._read(located.at + start * size, located.at + stop * size)
        return np.frombuffer(content, located.dtype).reshape(stop - start, *located.shape[1:])

    def _rows(self, located: Located, t: int, crop: Crop | None) -> Array:
        """Return frame t, of which only the rows of the crop are read."""
        if crop is None or len(located.shape) != 3:
            return _cut(self._at(located, t, t + 1)[0], crop)
        y, x, height, width = crop
        assert located.at is not None
        begin = located.at[t] if isinstance(located.at, tuple) else located.at + t * located.frame_bytes
        row = located.frame_bytes // located.shape[1]
        content = self._read(begin + y * row, begin + (y + height) * row)
        return np.frombuffer(content, located.dtype).reshape(height, located.shape[2])[:, x : x + width]

    def _read(self, start: int, stop: int) -> bytes:
        content = self.data.where.read(self.file, start, stop)
        if len(content) != stop - start:
            raise ValueError(f"{self.data.address}/{self.file}: is shorter than it was; {CURE}")
        return content


def _cut(array: Array, crop: Crop | None) -> Array:
    """Return a crop = (y, x, height, width) of an array [..., H, W]."""
    if crop is None:
        return array
    y, x, height, width = crop
    return array[..., y : y + height, x : x + width]


# ---- Clips and streams


@own_numbers
@dataclass(frozen=True, eq=False)
class PublishedClip(Clip):
    """A clip of a published set, with the fields that were published; nothing is written to it."""

    stored: Stored = field(default=None, repr=False)  # type: ignore[assignment]

    @staticmethod
    def of(data: PublishedSet, shard: ShardSummary, entry: Entry) -> PublishedClip:
        """Open a clip at its place."""
        stored = Stored(data, shard.file, entry)
        path = Path(data.address) / shard.file / entry.clip
        info = descriptions.of_values(path, stored.description["info"], ClipInfo, CURE)
        return PublishedClip(path, info, None, stored)

    @property
    def streams(self) -> tuple[str, ...]:
        """Names of the streams that were published."""
        return tuple(sorted(self.stored.description["streams"]))

    def stream(self, name: str) -> Stream:
        """Return a published stream; `FileNotFoundError` lists the existing ones."""
        described = self.stored.description["streams"].get(name)
        if described is None:
            raise FileNotFoundError(
                f"{self.path}: no stream {name!r}; there are: {', '.join(self.streams) or 'none; none was published'}"
            )
        path = self.path / "streams" / f"{name}.npy"
        info = descriptions.of_values(path.with_suffix(".json"), described["info"], StreamInfo, CURE)
        return PublishedStream(path, info, None, self)

    def sense(self, *_: Any, **settings: Any) -> Stream:
        """Raise `ValueError`: a published set is not written to."""
        raise ValueError(f"{self.path}: a published set is not written to; sense the data set that it was made of")

    def sense_events(self, *_: Any, **settings: Any) -> EventStream:
        """Raise `ValueError`: a published set is not written to, and events are not published."""
        raise ValueError(f"{self.path}: a published set is not written to; draw events of the set that it was made of")

    def verify(self, progress: Any = None) -> list[str]:
        """Return no problems: shards are compared as a whole with the SHA-256 in their records."""
        return []

    def _half(self, folder: str, t: int, crop: Crop | None) -> Array:
        self._check_frame(t)
        if crop is not None:
            check_crop(crop, *self.shape[1:], str(self.path))
        row = self._row(folder, folder, t)
        found: Array = self.stored.frames(folder, row, row + 1, crop)[0].astype(np.float32)
        return found

    def _channels(self, folder: str, t: int) -> dict[str, Array]:
        self._check_frame(t)
        if folder == "saturated":
            return {folder: self._one("saturated", folder, t)}
        found: dict[str, Array] = {}
        for name, channels in CHANNELS.items():
            if name in self.stored.entry.arrays:
                frame = self._one(name, folder, t)
                parts = frame if len(channels) == 2 else frame[None]
                found |= dict(zip(channels, parts, strict=True))
        if not found:
            raise FileNotFoundError(f"{self.path}: no ground truth of frame {t} was published")
        return found

    def _one(self, name: str, folder: str, t: int) -> Array:
        row = self._row(name, folder, t)
        return self.stored.frames(name, row, row + 1)[0]

    def _row(self, name: str, folder: str, t: int) -> int:
        """Return the place of frame t in an array; `FileNotFoundError` for a field that was not published."""
        if name not in self.stored.entry.arrays:
            raise FileNotFoundError(f"{self.path}: its field {name} was not published; publish it, too, with fields=")
        listed = self.stored.description["frames"].get(name)
        if listed is None:
            return t
        if t not in listed:
            raise FileNotFoundError(f"{self.path}: {name} has no frame {t}")
        return int(listed.index(t))

    @property
    def _frames(self) -> LazyArray:
        def read(start: int, stop: int, crop: Crop | None) -> Array:
            return self.stored.frames("radiance", start, stop, crop).astype(np.float32)

        frames, height, width = self.shape
        shape = self.shape if self.bands is None else (frames, 3, height, width)
        return LazyArray(shape, np.dtype(np.float32), read)


@own_numbers
@dataclass(frozen=True, eq=False)
class PublishedStream(Stream):
    """A stream of a published set."""

    of_clip: PublishedClip = field(default=None, repr=False)  # type: ignore[assignment]

    @cached_property
    def clip(self) -> ClipFolder:
        """The clip that these codes were sensed from."""
        return self.of_clip

    @property
    def _described(self) -> DescribedStream:
        return self.of_clip.stored.description["streams"][self.name]

    @cached_property
    def packed(self) -> LazyArray:
        """The packed codes, uint8 [T, H, ceil(W*bits/8)]; reading raises `ValueError` if codes were not published."""

        def read(start: int, stop: int, crop: Crop | None) -> Array:
            found = self._published(start, stop, None)
            return _cut(found if self._described["packed"] else packing.pack(found, self.bits), crop)

        frames, height, width = self.shape
        return LazyArray((frames, height, packing.packed_width(width, self.bits)), np.dtype(np.uint8), read)

    def _published(self, start: int, stop: int, crop: Crop | None) -> Array:
        name = self._described.get("codes")
        if name is None:
            raise ValueError(f"{self.path}: its codes were not published; publish them, too, with fields=")
        return self.of_clip.stored.frames(name, start, stop, crop)

    def _read(self, start: int, stop: int, crop: Crop | None) -> Array:
        self._existing(start, stop)
        _, height, width = self.shape
        y, x, h, w = check_crop(crop, height, width, str(self.path))
        if not self._described["packed"]:
            return self._published(start, stop, (y, x, h, w))
        row = packing.packed_width(width, self.bits)
        rows = self._published(start, stop, (y, 0, h, row))
        return packing.unpack(np.ascontiguousarray(rows), self.bits, width)[..., x : x + w]

    def verify(self, progress: Any = None) -> list[str]:
        """Return no problems: shards are compared as a whole with the SHA-256 in their records."""
        return []
