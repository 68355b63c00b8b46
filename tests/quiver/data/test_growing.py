"""A data set that grows while windows are drawn: the schedule decides, and a resumed run draws the same samples."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import fakes
import numpy as np
import pytest

from qsim.dataset import recipe
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import Options, generate
from quiver.data.growing import GrowingWindows, Schedule, planned
from quiver.data.windows import WindowSettings

CLIPS = 9
RECIPE = recipe.parse(
    """[recipe]
name = "growing"
frames = 6
height = 12
width = 14

[[scenes]]
family = "fan"
seeds = [0, 1, 2, 3]

[[scenes]]
family = "plain"
seeds = [8]
split = "val"

[[scenes]]
family = "tumble"
seeds = [4, 5, 6, 7, 8]
"""
)


def grow(folder: Path, part: int) -> Dataset:
    """Make the clips of one of three parts."""
    generate(RECIPE, folder, Options(workers=0, shard=(part, 3)), make=fakes.make)
    return Dataset.open(folder)


def windows_of(data: Dataset, path: Path) -> GrowingWindows:
    settings = WindowSettings(frames=3, crop=8, seed=5)
    return GrowingWindows(planned(data, "train"), settings, Schedule(path, data))


def name_of(windows: GrowingWindows, n: int) -> str:
    return windows.clip(windows.place(n).clip).name


def test_a_sample_draws_what_was_finished_before_it(tmp_path):
    data = grow(tmp_path / "data", 1)
    windows = windows_of(data, tmp_path / "schedule.json")
    finished = []
    for part, first in ((1, 0), (2, 40), (3, 80)):
        grow(tmp_path / "data", part)
        windows.schedule.look(first)
        finished.append(set(data.names("train")))
    assert [len(names) for names in finished] == sorted({len(names) for names in finished})
    for names, samples in zip(finished, (range(40), range(40, 80), range(80, 200)), strict=True):
        drawn = [name_of(windows, n) for n in samples]
        assert set(drawn) <= names
        assert len(set(drawn)) == len(names)  # forty draws of nine clips at most: each comes with 99 %
    assert len(finished[-1]) == CLIPS


def test_a_resumed_run_draws_the_same_samples(tmp_path):
    """Killed after sample 40: what was scheduled from 60 on stays so, and what is finished now comes after it."""
    data = grow(tmp_path / "data", 1)
    windows = windows_of(data, tmp_path / "schedule.json")
    windows.schedule.look(0)
    grow(tmp_path / "data", 2)
    windows.schedule.look(60)
    before = [windows[n]["codes"] for n in range(30, 80)]
    grow(tmp_path / "data", 3)
    again = windows_of(data, tmp_path / "schedule.json")
    again.schedule.look(40)
    first = json.loads((tmp_path / "schedule.json").read_text())["samples"]
    assert first == sorted(first)
    assert first[-1] == 60
    assert all((again[n]["codes"] == before[n - 30]).all() for n in range(30, 60))


def test_another_process_reads_what_was_written_since(tmp_path):
    data = grow(tmp_path / "data", 1)
    windows = windows_of(data, tmp_path / "schedule.json")
    windows.schedule.look(0)
    worker = pickle.loads(pickle.dumps(windows))
    assert [worker.place(n).clip for n in range(9)] == [windows.place(n).clip for n in range(9)]
    grow(tmp_path / "data", 2)
    windows.schedule.look(9)
    assert [worker.place(n).clip for n in range(9, 60)] == [windows.place(n).clip for n in range(9, 60)]
    np.testing.assert_array_equal(worker[20]["codes"], windows[20]["codes"])


def test_a_clip_that_is_not_finished_stands_for_none(tmp_path):
    data = grow(tmp_path / "data", 2)
    clips = planned(data, "train")
    assert len(clips) == CLIPS
    assert {clip.name for clip in clips.alike()} <= set(data.names("train"))
    assert len(planned(data, "val")) == 1
    assert planned(data, "train").digest() == planned(grow(tmp_path / "data", 3), "train").digest()


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ('{"clips": ["fan_99"], "samples": [0]}', "names a clip that the data set does not have"),
        ('{"clips": ["fan_s0000"], "samples": []}', "must be as many"),
        ('{"clips": 3}', "expected"),
        ("{", "schedule.json"),
    ],
)
def test_a_damaged_schedule_is_one_sentence(tmp_path, content, named):
    data = grow(tmp_path / "data", 1)
    windows = windows_of(data, tmp_path / "schedule.json")
    windows.schedule.look(0)
    (tmp_path / "schedule.json").write_text(content)
    with pytest.raises(ValueError, match=named) as error:
        windows.place(0)
    assert "\n" not in str(error.value)
    assert "schedule.json" in str(error.value)


def test_a_sample_before_any_clip_is_refused(tmp_path):
    data = grow(tmp_path / "data", 1)
    windows = windows_of(data, tmp_path / "schedule.json")
    windows.schedule.look(5)
    with pytest.raises(ValueError, match="no clip is scheduled for sample 4"):
        windows.place(4)
