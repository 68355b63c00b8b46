"""Lists of clips: of data sets by their indices, of others one by one."""

from pathlib import Path

import numpy as np
import pytest
from fakes import HERE, RECIPE, make

from qsim.dataset import recipe
from qsim.dataset.clip_list import ClipList
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import generate
from qsim.streams.clip import Clip


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A data set with three clips to train and one to test."""
    text = RECIPE.replace("seeds = [0, 1]", 'seeds = "0..2"')
    folder = tmp_path_factory.mktemp("list") / "d"
    generate(recipe.parse(text), folder, HERE, make=make)
    return Dataset.open(folder)


def names(clips: ClipList) -> list[str]:
    return [clip.name for clip in clips]


def test_items_and_slices_are_those_of_a_list(data: Dataset):
    clips = data.clips("train") + ClipList.of([data.clips("test")[0]])
    all_names = ["fan_0000", "fan_0001", "fan_0002", "tumble_0004"]
    assert names(clips) == all_names
    assert [clips[i].name for i in (-1, -4, 2)] == ["tumble_0004", "fan_0000", "fan_0002"]
    for start in range(-5, 6):
        for step in (1, 2, 3, -1, -2):
            assert names(clips[start::step]) == all_names[start::step]
            assert names(clips[:start:step]) == all_names[:start:step]
    with pytest.raises(IndexError):
        clips[4]


def test_the_first_clip_of_each_series_stands_for_all(data: Dataset):
    single = ClipList.of(list(data.clips("train"))[1:])
    assert [clip.name for clip in data.clips().alike()] == ["fan_0000", "tumble_0004"]
    assert [clip.name for clip in data.clips("train")[1:].alike()] == ["fan_0001"]
    assert [clip.name for clip in single.alike()] == ["fan_0001", "fan_0002"]


def test_clips_are_left_out_wherever_they_are_listed(data: Dataset):
    one = ClipList.of([Clip.open(data.path / "clips" / ".." / "clips" / "fan_0001")])
    assert names(data.clips().without(one)) == ["fan_0000", "fan_0002", "tumble_0004"]
    assert names(one.without(data.clips("train"))) == []
    assert names(one.without(data.clips("test"))) == ["fan_0001"]
    assert names(one.without(one)) == []


def test_a_digest_tells_which_clips_are_listed_and_not_where(data: Dataset, tmp_path: Path):
    (tmp_path / "link").symlink_to(data.path)
    assert Dataset.open(tmp_path / "link").clips().digest() == data.clips().digest()
    assert data.clips("train").digest() != data.clips().digest()


def test_a_list_of_a_million_clips_is_one_array(data: Dataset):
    assert data.indices("train").dtype == np.int64
    assert data.indices("train").nbytes == 8 * 3
