"""Writes shards as zarr groups in a zip file: KEY/FIELD, with its description in the attributes of the group KEY.

The zip stores its entries as they are, so a chunk lies at a known position.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import files
from qsim.publishing.contents import Sample
from qsim.publishing.located import COMPRESSED, Entry, Located, little, of_type
from qsim.publishing.place import Place

PACKAGES: tuple[str, ...] = ("zarr",)  # that its writer needs
SUFFIX = "zarr.zip"
LEVEL = 4  # of gzip


class Writer:
    """A zip file; equal clips make equal bytes."""

    def __init__(self, path: Path, columns: object = None) -> None:
        self.file = zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True)
        self._stored("zarr.json", files.to_json({"attributes": {}, "zarr_format": 3, "node_type": "group"}))

    def add(self, sample: Sample) -> Entry:
        attributes = {"attributes": {"description": sample.description}, "zarr_format": 3, "node_type": "group"}
        text = files.to_json(attributes)
        place = self._stored(f"{sample.key}/zarr.json", text)
        arrays = {}
        for field, compute in sample.arrays.items():
            array = little(compute())
            positions = [self._stored(f"{sample.key}/{name}", content) for name, content in _chunks(field, array)]
            at = None if field in COMPRESSED else tuple(positions[1:])
            arrays[field] = Located(**of_type(array), at=at)
        return Entry(key=sample.key, clip=sample.clip.name, description=(place, len(text)), arrays=arrays)

    def _stored(self, name: str, content: bytes | memoryview) -> int:
        """Add an entry; return the position of its first byte."""
        self.file.writestr(zipfile.ZipInfo(name), content)
        assert self.file.fp is not None
        return self.file.fp.tell() - len(content)

    def close(self) -> None:
        self.file.close()


def _chunks(field: str, array: Array) -> list[tuple[str, bytes]]:
    """Return the files of an array: zarr.json, and the chunk of each frame."""
    import zarr

    store: dict[str, Any] = {}
    compressors = zarr.codecs.GzipCodec(level=LEVEL) if field in COMPRESSED else None
    zarr.create_array(
        zarr.storage.MemoryStore(store),
        name=field,
        data=array,
        chunks=(1, *array.shape[1:]),
        compressors=compressors,
        filters=None,
        config={"write_empty_chunks": True},
    )
    frames = [f"{field}/c/{t}{'/0' * (array.ndim - 1)}" for t in range(len(array))]
    return [(name, store[name].to_bytes()) for name in (f"{field}/zarr.json", *frames)]


class Reader:
    """Reads compressed arrays by zarr, from the files of one array alone."""

    def array(self, where: Place, file: str, entry: Entry, field: str) -> Array:
        import zarr
        from zarr.core.buffer import default_buffer_prototype

        head = f"{entry.key}/{field}/"
        made = default_buffer_prototype().buffer.from_bytes
        with where.opened(file) as opened, zipfile.ZipFile(opened) as stored:
            parts = {name.removeprefix(head): made(stored.read(name)) for name in stored.namelist() if head in name}
        return np.asarray(zarr.open_array(zarr.storage.MemoryStore(parts), mode="r")[...])

    def description(self, where: Place, file: str, entry: Entry) -> bytes:
        assert entry.description is not None
        at, size = entry.description
        return where.read(file, at, at + size)
