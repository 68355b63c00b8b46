"""Measures published sets beside the data set: size, seconds to publish, and training windows per second.

    python benchmarks/publish_rows.py SET --out docs/results/publish.json      # about two minutes
    python benchmarks/publish_rows.py --page                                   # writes docs/results/publish.md

Windows are those of `quiver.windows`, 11 frames of 128 x 128 px, drawn one after the other in one process; the first
`WARM` are not counted. `in order` reads whole arrays of radiance by the library of the format, without qsim.
"""

from __future__ import annotations

import argparse
import io
import json
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import result_page

import quiver
from qsim.dataset.dataset import Dataset
from qsim.process import peak_memory
from qsim.publishing import Publication, publish
from qsim.publishing.record import Kind
from qsim.tables import markdown_table

ROOT = Path(__file__).parents[1]
ROWS = ROOT / "docs" / "results" / "publish.json"
PAGE = ROOT / "docs" / "results" / "publish.md"
WARM = 20
WINDOWS = 200
CROP = 128


def windows_per_second(path: Path) -> float:
    """Return the training windows that one process draws in a second."""
    data = quiver.windows(path, split="train", crop=CROP)
    for n in range(WARM):
        _ = data[n]
    began = time.perf_counter()
    for n in range(WARM, WARM + WINDOWS):
        _ = data[n]
    return WINDOWS / (time.perf_counter() - began)


def frames_per_second(read: Callable[[], Iterator[np.ndarray]]) -> float:
    """Return the frames of radiance that are read in a second, all clips in order."""
    began = time.perf_counter()
    frames = sum(len(np.ascontiguousarray(clip)) for clip in read())
    return frames / (time.perf_counter() - began)


def of_set(path: Path) -> Iterator[np.ndarray]:
    """Yield the radiance of each clip, half as the published ones."""
    for clip in Dataset.open(path).clips():
        yield clip[:].astype(np.float16)


def of_webdataset(path: Path) -> Iterator[np.ndarray]:
    for shard in sorted(path.glob("shards/*.tar")):
        with tarfile.open(shard) as file:
            for member in file:
                if member.name.endswith(".radiance.npy"):
                    opened = file.extractfile(member)
                    assert opened is not None
                    yield np.load(io.BytesIO(opened.read()))


def of_parquet(path: Path) -> Iterator[np.ndarray]:
    import pyarrow.parquet as parquet

    for shard in sorted(path.glob("shards/*.parquet")):
        for batch in parquet.ParquetFile(shard).iter_batches(columns=["radiance"]):
            for cell in batch["radiance"]:
                yield np.load(io.BytesIO(cell.as_py()))


def of_hdf5(path: Path) -> Iterator[np.ndarray]:
    import h5py

    for shard in sorted(path.glob("shards/*.h5")):
        with h5py.File(shard) as file:
            for clip in file.values():
                yield clip["radiance"][()]


def of_zarr(path: Path) -> Iterator[np.ndarray]:
    import zarr

    for shard in sorted(path.glob("shards/*.zarr.zip")):
        with zarr.storage.ZipStore(shard, mode="r") as store:
            for _, clip in zarr.open_group(store, mode="r").groups():
                yield np.asarray(clip["radiance"][...])


READERS = {"webdataset": of_webdataset, "parquet": of_parquet, "hdf5": of_hdf5, "zarr": of_zarr}


def size_of(path: Path) -> int:
    """Return the bytes of all files in a folder."""
    return sum(item.stat().st_size for item in path.rglob("*") if item.is_file())


def measured(source: Path, folder: Path) -> dict[str, Any]:
    """Return the rows, the data set first."""
    clips = Dataset.open(source).clips()
    rows = [
        {
            "what": "data set",
            "bytes": size_of(source),
            "windows": windows_per_second(source),
            "in_order": frames_per_second(lambda: of_set(source)),
        }
    ]
    for kind in get_args(Kind):
        for packed in (False, True):
            target = folder / f"{kind}-{packed}"
            began = time.perf_counter()
            publish(source, target, Publication(to=kind, packed=packed))
            seconds = time.perf_counter() - began
            row = {"what": f"{kind}, packed codes" if packed else kind, "bytes": size_of(target), "seconds": seconds}
            if not packed:
                row["windows"] = windows_per_second(target)
                row["in_order"] = frames_per_second(lambda kind=kind, target=target: READERS[kind](target))
            rows.append(row)
    shape = clips[0].shape
    return {"clips": len(clips), "shape": list(shape), "memory": peak_memory(), "rows": rows}


HEAD = (
    "\n".join(result_page.head("Published sets", "publish_rows.py --page"))
    + """
[`qsim publish`](../publish.md) wrote a rendered data set of {clips} clips of {frames} frames of {height} x {width} px,
with one stream of 3 bits, in every format. `windows` are those of `quiver.windows`: 11 frames of {crop} x {crop} px per
second, drawn by one process, with noise. `in order` are the frames of radiance per second that the library of the
format reads, one clip after the other.

"""
)
TAIL = """
- The data set stores no `truth` in photons, and its ground truth lies in one zipped file per frame. Published sets hold
  `truth` in float32, not compressed, and each channel of ground truth is compressed alone.
- Files were read from the cache of the system, on two cores that other programs shared. A second run differs by up to a
  third.
- Drawing the noise is most of the time of a window, so formats differ less in `windows` than in `in order`.
"""


def page(found: dict[str, Any]) -> str:
    """Return the page."""
    frames, height, width = found["shape"]
    head = HEAD.format(clips=found["clips"], frames=frames, height=height, width=width, crop=CROP)
    rows = [
        [
            row["what"],
            f"{row['bytes'] / 1e6:.1f}",
            f"{row['seconds']:.1f}" if "seconds" in row else "",
            f"{row['windows']:.0f}" if "windows" in row else "",
            f"{11 * row['windows']:.0f}" if "windows" in row else "",
            f"{row['in_order']:.0f}" if "in_order" in row else "",
        ]
        for row in found["rows"]
    ]
    names = ["what", "MB", "publishing [s]", "windows/s", "images/s in windows", "images/s in order"]
    return head + "\n".join(markdown_table(rows, names)) + "\n" + TAIL


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="a data set with one stream")
    parser.add_argument("--out", type=Path, default=ROWS)
    parser.add_argument("--page", action="store_true", help="write the page from the rows")
    asked = parser.parse_args()
    if asked.data is not None:
        with tempfile.TemporaryDirectory() as folder:
            asked.out.write_text(json.dumps(measured(asked.data, Path(folder)), indent=1) + "\n")
    if asked.page:
        PAGE.write_text(page(json.loads(asked.out.read_text())))


if __name__ == "__main__":
    main()
