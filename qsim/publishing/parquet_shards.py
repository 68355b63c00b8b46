"""Writes shards as Parquet: a row for each clip, arrays as the bytes of .npy files, which numpy.load reads.

Columns key, clip, split, description (JSON), picture (the middle frame as a PNG) and one for each field.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy import ndarray as Array

from qsim import files
from qsim.publishing.contents import Sample
from qsim.publishing.located import COMPRESSED, Entry, Located, little, npy_header, of_type
from qsim.publishing.place import Place

PACKAGES: tuple[str, ...] = ("pyarrow.parquet",)  # that its writer needs
SUFFIX = "parquet"
GROUP = 1 << 24  # bytes of a group of rows, at least: a clip that is larger has one to itself
TEXTS = ("key", "clip", "split", "description")


class Writer:
    """A Parquet file; columns are those of the set, and empty in the rows of clips that lack them."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        import pyarrow.parquet as parquet

        self.columns = columns
        self.schema = schema(columns)
        compression = {name: "zstd" if name in (*TEXTS, *COMPRESSED) else "none" for name in (*TEXTS, *columns)}
        compression |= {"picture.bytes": "none", "picture.path": "none"}
        self.file = parquet.ParquetWriter(
            path, self.schema, compression=compression, use_dictionary=False, write_statistics=False
        )
        self._rows: list[dict[str, Any]] = []
        self._bytes = 0
        self._group = 0

    def add(self, sample: Sample) -> Entry:
        row: dict[str, Any] = dict.fromkeys(self.columns)
        row |= {"key": sample.key, "clip": sample.clip.name, "split": sample.description["split"]}
        row["description"] = files.to_json(sample.description).decode()
        row["picture"] = {"bytes": sample.picture(), "path": None}
        arrays = {}
        for field, compute in sample.arrays.items():
            array = little(compute())
            row[field] = npy_header(array) + array.tobytes()
            arrays[field] = Located(**of_type(array))
            self._bytes += len(row[field])
        entry = Entry(key=sample.key, clip=sample.clip.name, row=len(self._rows), group=self._group, arrays=arrays)
        self._rows.append(row)
        if self._bytes >= GROUP:
            self._flush()
        return entry

    def _flush(self) -> None:
        """Write the rows that wait as a group."""
        import pyarrow as pa

        if self._rows:
            self.file.write_table(pa.Table.from_pylist(self._rows, self.schema), row_group_size=len(self._rows))
        self._rows = []
        self._bytes = 0
        self._group += 1

    def close(self) -> None:
        self._flush()
        self.file.close()


def schema(columns: Sequence[str]) -> Any:
    """Return the types of the columns, with the note by which the package datasets shows `picture`."""
    import pyarrow as pa

    picture = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    types = [*((name, pa.string()) for name in TEXTS), ("picture", picture)]
    types += [(name, pa.large_binary()) for name in columns]
    features: dict[str, object] = {name: {"dtype": "string", "_type": "Value"} for name in TEXTS}
    features["picture"] = {"_type": "Image"}
    features |= {name: {"dtype": "large_binary", "_type": "Value"} for name in columns}
    note = json.dumps({"info": {"features": features}})
    return pa.schema(types, metadata={"huggingface": note})


class Reader:
    """Reads cells by pyarrow."""

    def array(self, where: Place, file: str, entry: Entry, field: str) -> Array:
        return files.read_npy(Path(where.address) / file, io.BytesIO(_cell(where, file, entry, field)))

    def description(self, where: Place, file: str, entry: Entry) -> bytes:
        text: str = _cell(where, file, entry, "description")
        return text.encode()


def _cell(where: Place, file: str, entry: Entry, column: str) -> Any:
    """Return the value of a column in the row of a clip."""
    import pyarrow.parquet as parquet

    with where.opened(file) as opened, parquet.ParquetFile(opened) as stored:
        return stored.read_row_group(entry.group, columns=[column])[column][entry.row].as_py()
