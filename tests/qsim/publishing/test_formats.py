"""Published sets load with the libraries of their formats, without qsim, and hold the bits of the clips."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray as Array
from published import KINDS, same

from qsim.dataset.dataset import Dataset
from qsim.publishing import PublishedSet

HEAVY = """
import io, json, os, sys, warnings
import numpy
folder = sys.argv[1]
from datasets import load_dataset
sets = load_dataset(folder + "/parquet")
import mlcroissant, webdataset
rows = {row["clip"]: row for split in sets.values() for row in split}
names = [name for name in rows["train_0000"] if isinstance(rows["train_0000"][name], bytes)]
cells = {f"{clip}/{name}": row[name] for clip, row in rows.items() for name in names}
numpy.savez("parquet.npz", **{name: numpy.load(io.BytesIO(cell)) for name, cell in cells.items()})
found = {}
for shard in sorted(os.listdir(folder + "/webdataset/shards")):
    for clip in webdataset.WebDataset(f"{folder}/webdataset/shards/{shard}", shardshuffle=False).decode():
        name = clip["json"]["clip"]
        found |= {f"{name}/{n.split('.')[0]}": value for n, value in clip.items() if ".npy" in n}
numpy.savez("webdataset.npz", **found)
problems = {}
for kind in ("webdataset", "parquet", "hdf5", "zarr"):
    read = mlcroissant.Dataset(jsonld=f"{folder}/{kind}/croissant.json")
    problems[kind] = sorted(read.metadata.issues.errors)
records = [record for record in mlcroissant.Dataset(jsonld=folder + "/parquet/croissant.json").records("clips")]
print(json.dumps({
    "splits": {name: len(split) for name, split in sets.items()},
    "picture": rows["val_0000"]["picture"].size,
    "problems": problems,
    "records": sorted(record["clips/clip"].decode() for record in records),
    "qsim": "qsim" in sys.modules,
}))
"""


@pytest.fixture(scope="module")
def loaded(published, tmp_path_factory) -> tuple[dict, Path]:
    """What datasets, webdataset and mlcroissant find, in a process of their own, which is offline."""
    for package in ("datasets", "webdataset", "mlcroissant"):
        pytest.importorskip(package)
    place = tmp_path_factory.mktemp("loaded")
    root = published["parquet"].parent
    environment = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(place / "home"), "PATH": "", "HOME": str(place)}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", HEAVY, str(root)], cwd=place, env=environment, capture_output=True
    )
    assert done.returncode == 0, done.stderr.decode()
    return json.loads(done.stdout.decode().splitlines()[-1]), place


def by_clip(path: Path) -> dict[str, dict[str, Array]]:
    found: dict[str, dict[str, Array]] = {}
    with np.load(path) as archive:
        for name in archive.files:
            clip, field = name.split("/")
            found.setdefault(clip, {})[field] = archive[name]
    return found


def arrays_of(clips: dict[str, dict[str, Array]], data: Path) -> None:
    """Assert that all clips of a set are there with their bits."""
    wanted = Dataset.open(data).clips()
    assert set(clips) == {clip.name for clip in wanted}
    for clip in wanted:
        same(clips[clip.name], clip)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["parquet", "webdataset"])
def test_datasets_and_webdataset_load_the_bits(loaded, data, kind):
    about, place = loaded
    assert not about["qsim"]
    arrays_of(by_clip(place / f"{kind}.npz"), data)


@pytest.mark.slow
def test_load_dataset_finds_the_splits_and_pictures_offline(loaded):
    about, _ = loaded
    assert about["splits"] == {"train": 2, "val": 1}
    assert about["picture"] == [44, 36]


@pytest.mark.slow
def test_mlcroissant_validates_every_format_and_reads_parquet(loaded):
    about, _ = loaded
    assert about["problems"] == {kind: [] for kind in KINDS}
    assert about["records"] == ["train_0000", "train_0001", "val_0000"]


def test_pyarrow_loads_the_bits(published, data):
    parquet = pytest.importorskip("pyarrow.parquet")
    shards = (published["parquet"] / "shards").iterdir()
    rows = [row for shard in shards for row in parquet.read_table(shard).to_pylist()]
    cells = {row["clip"]: {name: cell for name, cell in row.items() if isinstance(cell, bytes)} for row in rows}
    loaded = {clip: {name: np.load(io.BytesIO(cell)) for name, cell in row.items()} for clip, row in cells.items()}
    arrays_of(loaded, data)


def test_h5py_loads_the_bits(published, data):
    import h5py

    found = {}
    for shard in (published["hdf5"] / "shards").glob("*.h5"):
        with h5py.File(shard) as file:
            for group in file.values():
                name = json.loads(group["description"][()])["clip"]
                found[name] = {field: group[field][()] for field in group if field != "description"}
    arrays_of(found, data)


def test_zarr_loads_the_bits(published, data):
    import zarr

    found = {}
    for shard in (published["zarr"] / "shards").glob("*.zarr.zip"):
        with zarr.storage.ZipStore(shard, mode="r") as store:
            for _, group in zarr.open_group(store, mode="r").groups():
                arrays = {name: np.asarray(array[...]) for name, array in group.arrays()}
                found[group.attrs["description"]["clip"]] = arrays
    arrays_of(found, data)


def test_tar_and_numpy_are_enough_for_webdataset(published, data):
    found: dict[str, dict[str, Array]] = {}
    for shard in (published["webdataset"] / "shards").glob("*.tar"):
        with tarfile.open(shard) as file:
            members = {member.name: file.extractfile(member).read() for member in file}
        key = next(iter(members)).partition(".")[0]
        name = json.loads(members[f"{key}.json"])["clip"]
        found[name] = {"radiance": np.load(io.BytesIO(members[f"{key}.radiance.npy"]))}
    for clip in Dataset.open(data).clips():
        assert np.array_equal(found[clip.name]["radiance"].astype(np.float32), clip[:])


@pytest.mark.parametrize("kind", KINDS)
def test_a_published_clip_reads_as_the_clip(published, data, kind):
    read = PublishedSet.open(published[kind]).clips()
    for mine, clip in zip(read, Dataset.open(data).clips(), strict=True):
        assert mine.name == clip.name
        assert mine.info.asked == clip.info.asked | {"name": clip.name}
        t = len(clip) // 2
        crop = (5, 7, 20, 13)
        assert np.array_equal(mine.radiance(t, crop), clip.radiance(t, crop))
        assert np.array_equal(mine.sharp(t), clip.sharp(t))
        assert np.array_equal(mine.flow(t), clip.flow(t))
        assert np.array_equal(mine.valid(t), clip.valid(t))
        assert np.array_equal(mine[2:5], clip[2:5])
        for name in clip.streams:
            assert np.array_equal(mine.stream(name).codes(3, 6, crop), clip.stream(name).codes(3, 6, crop))
            assert np.array_equal(mine.stream(name).packed, clip.stream(name).packed)
            assert np.array_equal(mine.stream(name).truth(1, 3), clip.stream(name).truth(1, 3))
