"""Sets are published to object storage and read from there, over the wire, and a broken upload leaves nothing half."""

from __future__ import annotations

import os
import re

import numpy as np
import pytest

from qsim.cli.program import main
from qsim.dataset.dataset import Dataset
from qsim.publishing import Publication, PublishedSet, publish
from qsim.publishing.place import place

pytest.importorskip("s3fs")
pytest.importorskip("moto")
from s3_server import serving


@pytest.fixture(scope="module")
def server():
    with pytest.MonkeyPatch.context() as patch, serving(patch) as found:
        yield found


@pytest.fixture(autouse=True)
def mended(server):
    yield
    server.uploads_left = None


def contents(address: str) -> dict[str, bytes]:
    where = place(address)
    return {name: where.read(name) for name in where.names()}


@pytest.mark.parametrize("kind", ["webdataset", "parquet"])
def test_what_is_published_to_a_bucket_is_what_is_published_to_a_folder(server, data, published, kind):
    address = f"s3://bucket/{kind}"
    made = publish(data, address, Publication(to=kind, shard_size=0.4, licence="CC-BY-4.0"))
    assert made.complete
    assert contents(address) == contents(str(published[kind]))
    for mine, clip in zip(PublishedSet.open(address).clips(), Dataset.open(data).clips(), strict=True):
        assert np.array_equal(mine.radiance(3), clip.radiance(3))
        assert np.array_equal(mine.flow(3), clip.flow(3))
        assert np.array_equal(mine.stream("spad-320x240_0.8ppp")[5], clip.stream("spad-320x240_0.8ppp")[5])


def test_a_broken_upload_leaves_no_set_and_the_same_command_resumes(server, data, published, capsys):
    line = ["publish", str(data), "-o", "s3://bucket/cut", "--shard-size", "0.4", "--licence", "CC-BY-4.0", "-q"]
    server.uploads_left = 4  # the first shard with its two descriptions, and half of the second one's upload
    assert main(line) == 2
    told = capsys.readouterr().err
    assert re.search(r"s3://bucket/cut/.*the same command resumes", told), told
    there = place("s3://bucket/cut").names()
    assert "shards/train-00000.tar" in there
    assert not {"published.json", "README.md", "croissant.json"} & set(there)
    with pytest.raises(FileNotFoundError, match="no complete published set"):
        PublishedSet.open("s3://bucket/cut")
    complete = [name for name in there if name.startswith("records/")]
    assert complete == ["records/train-00000.json"]
    server.uploads_left = None
    assert main(line) == 0
    assert contents("s3://bucket/cut") == contents(str(published["webdataset"]))


def test_another_set_is_not_replaced(server, data):
    publish(data, "s3://bucket/taken", Publication(fields=("codes",)))
    with pytest.raises(FileExistsError, match="another published set"):
        publish(data, "s3://bucket/taken", Publication(fields=("truth",)))
    made = publish(data, "s3://bucket/taken", Publication(fields=("truth",)), force=True)
    assert made.complete
    assert PublishedSet.open("s3://bucket/taken").info.columns == ("truth_0", "truth_1")


def test_a_window_reads_blocks_of_frames_and_not_the_shard(server, data):
    """One clip of the set has 14 frames of radiance in one block: 44 kB of a shard of 700 kB."""
    publish(data, "s3://bucket/window")
    clip = PublishedSet.open("s3://bucket/window").clips("val")[0]
    size = place("s3://bucket/window").size("shards/train-00000.tar")
    before = server.bytes_read
    frames = [clip.radiance(t, (0, 0, 16, 16)) for t in range(11)]
    assert np.shape(frames) == (11, 16, 16)
    assert 14 * 36 * 44 * 2 <= server.bytes_read - before < size / 4


def test_errors_are_one_sentence(server, data, capsys, monkeypatch):
    assert main(["publish", str(data), "-o", "s3://no-bucket/x", "-q"]) == 2
    assert "s3://no-bucket/x" in capsys.readouterr().err
    assert main(["publish", str(data), "-o", "nosuch://x/y", "-q"]) == 2
    assert "nosuch://: is not a storage" in capsys.readouterr().err
    assert os.environ["AWS_ENDPOINT_URL"].startswith("http://127.0.0.1:")
