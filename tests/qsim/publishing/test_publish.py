"""`qsim publish` resumes, shares its shards between processes, and refuses what it cannot replace or publish."""

from __future__ import annotations

import json
import os
import shutil
import sys

import numpy as np
import pytest
from clips import write_clip, write_dataset

from qsim.cli.program import main
from qsim.dataset.dataset import Dataset
from qsim.publishing import Publication, PublishedSet, place, publish
from qsim.publishing.publication import Source
from qsim.streams.sensing import Sensing


def contents(folder) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture
def clip(tmp_path):
    return write_clip(tmp_path / "clip", frames=3, height=8, width=12)


def test_parts_make_what_one_command_makes_and_a_lost_shard_is_made_again(data, published, tmp_path):
    wanted = Publication(shard_size=0.4, licence="CC-BY-4.0")
    for part in ((2, 2), (1, 2)):
        made = publish(data, tmp_path / "p", wanted, part=part)
    assert made.complete
    assert contents(tmp_path / "p") == contents(published["webdataset"])
    (tmp_path / "p" / "shards" / "val-00000.tar").unlink()
    assert publish(data, tmp_path / "p", wanted).made == 1
    assert publish(data, tmp_path / "p", wanted).made == 0
    assert contents(tmp_path / "p") == contents(published["webdataset"])


def test_drawn_codes_are_those_that_sense_stores_and_nothing_is_stored(clip, tmp_path):
    sensings = (Sensing("quiver-physical", bits=3, ppp=2.0), Sensing("spad-320x240", ppp=1.0))
    for packed in (False, True):
        publish(clip.path, tmp_path / f"{packed}", Publication(sensings=sensings, packed=packed))
    assert clip.streams == ()
    for sensing in sensings:
        stored = clip.sense(sensing.sensor, bits=sensing.bits, ppp=sensing.ppp)
        for packed in (False, True):
            (found,) = PublishedSet.open(tmp_path / f"{packed}").clips()
            mine = found.stream(sensing.stream_name)
            assert np.array_equal(mine[:], stored[:])
            assert np.array_equal(mine.truth(), stored.truth())
            assert mine.info.compared == stored.info.compared


def test_force_replaces_another_format_and_nothing_of_it_stays(clip, tmp_path):
    publish(clip.path, tmp_path / "p", Publication(to="hdf5"))
    with pytest.raises(FileExistsError, match="another published set"):
        publish(clip.path, tmp_path / "p")
    publish(clip.path, tmp_path / "p", force=True)
    assert [path.name for path in (tmp_path / "p" / "shards").iterdir()] == ["train-00000.tar"]


@pytest.mark.parametrize(
    ("name", "why"),
    [("clip", "in the clip"), ("clip/streams", "in the clip"), ("taken", "was not made by"), ("file", "is a file")],
)
def test_places_of_others_are_refused_also_with_force(clip, tmp_path, capsys, name, why):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "README.md").write_text("mine")
    (tmp_path / "file").write_text("mine")
    before = contents(tmp_path)
    for more in ([], ["--force"]):
        assert main(["publish", str(clip.path), "-o", str(tmp_path / name), *more, "-q"]) == 2
        assert why in capsys.readouterr().err
    assert contents(tmp_path) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_named(clip, tmp_path, capsys):
    (tmp_path / "closed").mkdir(mode=0o500)
    assert main(["publish", str(clip.path), "-o", str(tmp_path / "closed" / "p"), "-q"]) == 2
    assert "closed" in capsys.readouterr().err


def test_an_address_without_a_bucket_is_refused(clip):
    with pytest.raises(ValueError, match="names no bucket"):
        publish(clip.path, "s3://")


def test_a_missing_package_is_one_sentence(clip, tmp_path, capsys, monkeypatch):
    for package, line in {
        "pyarrow.parquet": [str(tmp_path / "p"), "--to", "parquet"],
        "s3fs": ["s3://bucket/set"],
        "gcsfs": ["gs://bucket/set"],
    }.items():
        monkeypatch.setitem(sys.modules, package, None)
        place._system.cache_clear()
        assert main(["publish", str(clip.path), "-o", *line, "-q"]) == 2
        (told,) = capsys.readouterr().err.splitlines()
        name = package.partition(".")[0]
        assert f"needs the package {name}, which is not installed: pip install {name}" in told
    assert not (tmp_path / "p").exists()


def test_a_set_that_lacks_clips_is_refused(tmp_path):
    write_dataset(tmp_path / "set", {"train": 2})
    (tmp_path / "set" / "jobs" / "train_0001.json").unlink()
    with pytest.raises(ValueError, match="lacks 1 of its clips"):
        publish(tmp_path / "set", tmp_path / "p")


def test_a_stream_of_one_clip_alone_is_not_left_out_silently(tmp_path):
    write_dataset(tmp_path / "set", {"train": 1})
    source = Source.open(tmp_path / "set", Publication())
    assert source.streams == ()  # of the clips that stand for all
    (clip,) = Dataset.open(tmp_path / "set").clips()
    clip.sense("quiver-physical", ppp=3)
    with pytest.raises(ValueError, match="has the stream quiver-physical_3ppp, which the first clip"):
        source.sample(clip, 0, "train")


def test_check_names_a_shard_that_changed(published, tmp_path, capsys):
    shutil.copytree(published["hdf5"], tmp_path / "p")
    assert main(["check", str(tmp_path / "p"), "-q"]) == 0
    shard = tmp_path / "p" / "shards" / "val-00000.h5"
    content = bytearray(shard.read_bytes())
    content[-1] ^= 1
    shard.write_bytes(content)
    assert main(["check", str(tmp_path / "p"), "-q"]) == 1
    assert "val-00000.h5: contents changed" in capsys.readouterr().out


def read_all(folder):
    """Read light and flow of all frames of the clips of `val`."""
    for clip in PublishedSet.open(folder).clips("val"):
        for t in range(len(clip)):
            clip.radiance(t)
            clip.flow(t)


@pytest.mark.parametrize("kind", ["webdataset", "parquet", "hdf5", "zarr"])
def test_a_shard_that_was_cut_is_an_error_and_no_other_light(published, tmp_path, kind):
    shutil.copytree(published[kind], tmp_path / "p")
    (shard,) = (tmp_path / "p" / "shards").glob("val-*")
    shard.write_bytes(shard.read_bytes()[: shard.stat().st_size // 3])
    with pytest.raises(ValueError, match=r"val-00000\S*: has \d+ bytes, not the \d+ it was published with"):
        read_all(tmp_path / "p")


@pytest.mark.parametrize(
    ("wanted", "why"),
    [
        ({"shard_size": float("nan")}, "shard_size: expected"),
        ({"fields": ()}, "fields: expected"),
        ({"to": "zip"}, "to:"),
    ],
)
def test_a_publication_refuses_what_the_command_refuses(wanted, why):
    with pytest.raises(ValueError, match=why):
        Publication(**wanted)


def test_the_card_states_counts_light_motion_and_licence(published):
    card = (published["parquet"] / "README.md").read_text()
    assert 'license: "cc-by-4.0"' in card
    assert "| train | 2 | 28 | 14 x 36 x 44 | 2 |" in card
    assert "| motion of what moves [px/frame] |" in card
    assert "![train_0000: " in card
    metadata = json.loads((published["parquet"] / "croissant.json").read_text())
    assert metadata["license"] == "CC-BY-4.0"
