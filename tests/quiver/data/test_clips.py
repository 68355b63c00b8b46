"""Clips of a data set: splits that share no clip, what identifies them, and what is missing."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from clips import write_dataset

from quiver.data.clips import clips_digest, open_clips, split_clips, unfinished


def test_a_clip_that_trains_does_not_validate(tiny_dataset):
    """However its folder is written; only the split `train` validates on what trains."""
    inside = open_clips(tiny_dataset, "val")[0].path
    other = Path(f"{inside.parent}/../clips/{inside.name}")
    training, validating = split_clips((tiny_dataset, other), "val")
    assert [clip.name for clip in training] == ["train_0000", "train_0001", "train_0002", "val_0000"]
    assert [clip.name for clip in validating] == ["val_0001"]
    assert split_clips(inside, "val")[1] == []
    assert [[clip.name for clip in part] for part in split_clips(inside, "train")] == [["val_0000"], ["val_0000"]]


def test_clips_are_known_by_their_names_and_files(tiny_dataset, tmp_path):
    copied = shutil.copytree(tiny_dataset, tmp_path / "copied")
    one = open_clips(tiny_dataset)
    other = open_clips(copied)
    assert clips_digest(one[:3], one[3:]) == clips_digest(other[:3], other[3:])
    found = {clips_digest(one[:3]), clips_digest(one[:2]), clips_digest(one[:2], one[2:3]), clips_digest(one[1:4])}
    assert len(found) == 4


@pytest.mark.parametrize("away", [0, 2])
def test_a_data_set_that_lacks_clips_is_named(tmp_path, tiny_dataset, away):
    data = write_dataset(tmp_path / "d", {"train": 3})
    for i in range(away):
        (data / f"jobs/train_{i:04d}.json").unlink()
    clip = open_clips(tiny_dataset)[0].path
    lines = unfinished([str(data), str(clip), str(tiny_dataset)])
    told = [f"{data}: the data set lacks {away} of its clips"] if away else []
    assert [line.partition(";")[0] for line in lines] == told
