"""Data sets of several blocks of clips, which are two clips here: the same commands, in folders of two."""

import functools
import shutil
from pathlib import Path

import pytest
from fakes import HERE, RECIPE, fail_on_tumble, make, tree
from forks import killed_at

from qsim.dataset import recipe, series
from qsim.dataset.checking import check, redraw
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import FramesDone, Options, Summary, generate

TEXT = RECIPE.replace("seeds = [0, 1]", 'seeds = "0..3"')
BLOCKS = ("000/000", "000/001", "001/000")
KEYS = [
    f"{BLOCKS[i // 2]}/{name}" for i, name in enumerate(["fan_0000", "fan_0001", "fan_0002", "fan_0003", "tumble_0004"])
]


@pytest.fixture(autouse=True)
def two_clips_a_block(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(series, "BLOCK", 2)


def keys_in(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if (path / "clip.json").is_file())


def test_clips_records_and_logs_lie_in_their_blocks(tmp_path: Path):
    wanted = recipe.parse(TEXT)
    assert generate(wanted, tmp_path / "d", HERE, make=make) == Summary(5, 5, 5, {}, ())
    assert keys_in(tmp_path / "d" / "clips") == KEYS
    for key in KEYS:
        assert (tmp_path / "d" / "jobs" / f"{key}.json").is_file()
        assert (tmp_path / "d" / "logs" / f"{key}.log").is_file()
    data = Dataset.open(tmp_path / "d")
    for folder in ("clips", "jobs", "logs", "work", "failed", "locks/clips"):
        for block in BLOCKS:
            for place in (data.path / folder, (data.path / folder / block).parent, data.path / folder / block):
                assert len(list(place.iterdir())) <= 2 if place.is_dir() else folder == "failed"
    assert sorted(path.name for path in (data.path / "locks").iterdir()) == ["clips", "generate", "manifest"]
    assert check(data.path) == []
    assert [clip.name for clip in data.clips("test")] == ["tumble_0004"]
    assert all(one.differ == 0 and one.why is None for one in redraw(data.path))
    assert generate(wanted, data.path, HERE, make=make).made == 0


def test_shards_share_their_blocks_and_give_the_same_bytes(tmp_path: Path):
    wanted = recipe.parse(TEXT)
    generate(wanted, tmp_path / "whole", HERE, make=make)
    for i in (2, 3, 1):
        generate(wanted, tmp_path / "d", Options(workers=0, shard=(i, 3)), make=make)
    assert tree(tmp_path / "d") == tree(tmp_path / "whole")


def test_a_part_is_checked_and_repaired_alone(tmp_path: Path):
    wanted = recipe.parse(TEXT)
    folder = tmp_path / "d"
    generate(wanted, folder, HERE, make=make)
    codes = next((folder / "clips" / KEYS[2] / "streams").glob("*.npy"))
    before = codes.read_bytes()
    codes.write_bytes(before[:-1])
    assert [len(check(folder, shard=(i, 5))) for i in range(1, 6)] == [0, 0, 1, 0, 0]
    assert generate(wanted, folder, Options(workers=0, shard=(1, 5), repair=True), make=make).repaired == ()
    assert len(generate(wanted, folder, Options(workers=0, shard=(3, 5), repair=True), make=make).repaired) == 1
    assert codes.read_bytes() == before
    with pytest.raises(ValueError, match="shard: is a part of a data set"):
        check(folder / "clips" / KEYS[0], shard=(1, 2))


def test_failures_are_noted_in_their_block(tmp_path: Path):
    wanted = recipe.parse(TEXT)
    generate(wanted, tmp_path / "d", HERE, make=fail_on_tumble)
    assert (tmp_path / "d" / "failed" / f"{KEYS[4]}.json").is_file()
    assert list(Dataset.open(tmp_path / "d").failed()) == ["tumble_0004"]
    assert generate(wanted, tmp_path / "d", HERE, make=make).failed.keys() == {"tumble_0004"}
    assert generate(wanted, tmp_path / "d", Options(workers=0, retry=True), make=make).failed == {}


def test_another_order_is_refused_because_it_means_other_folders(tmp_path: Path):
    head, fan, tumble = TEXT.split("[[scenes]]")
    tumble, streams = tumble.split("[[streams]]")
    generate(recipe.parse(TEXT), tmp_path / "d", HERE, make=make)
    turned = f"{head}[[scenes]]{tumble}[[scenes]]{fan}[[streams]]{streams}"
    with pytest.raises(ValueError, match="lists its clips in another order, from tumble_0004 on"):
        generate(recipe.parse(turned), tmp_path / "d", HERE, make=make)


def test_a_kill_in_a_block_is_made_good(tmp_path: Path):
    head, _, tumble = TEXT.split("[[scenes]]")
    wanted = recipe.parse(f"{head}[[scenes]]{tumble}".replace("[4]", '"4..6"'))
    shard = Options(workers=0, shard=(3, 3))
    generate(wanted, tmp_path / "whole", shard, make=make)
    for step in (20, 45, 70, 95):
        folder = tmp_path / str(step)
        run = functools.partial(generate, wanted, folder, shard, make=make)
        assert killed_at(step, folder, run)
        assert run().failed == {}
        assert tree(folder) == tree(tmp_path / "whole")
        assert not list(folder.rglob(".qsim-*"))
        shutil.rmtree(folder)


def test_progress_looks_at_some_clips_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    wanted = recipe.parse(TEXT)
    generate(wanted, tmp_path / "d", HERE, make=make)
    monkeypatch.setattr(FramesDone, "LOOK", 2)
    seen = FramesDone(tmp_path / "d", wanted.jobs)
    assert [seen.look() for _ in range(4)] == [6, 12, 14, 14]
