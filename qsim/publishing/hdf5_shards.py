"""Writes shards as HDF5 files: a group for each clip, /KEY/FIELD, with its description as a string of JSON."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim import files
from qsim.publishing.contents import Sample
from qsim.publishing.located import COMPRESSED, Entry, Located, little, of_type
from qsim.publishing.place import Place

PACKAGES: tuple[str, ...] = ("h5py",)  # that its writer needs
SUFFIX = "h5"


class Writer:
    """An HDF5 file; codes and light are stored in one piece each, ground truth frame by frame and compressed."""

    def __init__(self, path: Path, columns: object = None) -> None:
        import h5py

        self.file = h5py.File(path, "w")

    def add(self, sample: Sample) -> Entry:
        group = self.file.create_group(sample.key)
        text = files.to_json(sample.description)
        stored = group.create_dataset("description", data=np.bytes_(text))
        place = stored.id.get_offset()
        arrays = {}
        for field, compute in sample.arrays.items():
            array = little(compute())
            if field in COMPRESSED:
                chunk = (1, *array.shape[1:])
                group.create_dataset(field, data=array, chunks=chunk, compression="gzip", shuffle=True)
                arrays[field] = Located(**of_type(array))
            else:
                at = group.create_dataset(field, data=array).id.get_offset()
                arrays[field] = Located(**of_type(array), at=at)
        return Entry(key=sample.key, clip=sample.clip.name, description=(place, len(text)), arrays=arrays)

    def close(self) -> None:
        self.file.close()


class Reader:
    """Reads compressed arrays by h5py."""

    def array(self, where: Place, file: str, entry: Entry, field: str) -> Array:
        import h5py

        with where.opened(file) as opened, h5py.File(opened, "r") as stored:
            return np.asarray(stored[entry.key][field][()])

    def description(self, where: Place, file: str, entry: Entry) -> bytes:
        assert entry.description is not None
        at, size = entry.description
        return where.read(file, at, at + size)
