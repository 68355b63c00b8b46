"""Data sets under rough treatment: names that begin alike, links, removed folders, wrong answers of workers."""

import errno
import itertools
import os
import random
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from fakes import RECIPE, make, make_slowly, tree

from qsim import files
from qsim.clip.writer import ClipWriter
from qsim.dataset import job_runner, recipe
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import Options, generate
from qsim.dataset.job import Job

HERE = Options(workers=0)
ALIKE = RECIPE.replace("seeds = [0, 1]", "seeds = [0, 1000, 10000]\nspeed = [1.0, 2.0, 2.5]").replace("[1, 3]", "[3]")
ALIKE = ALIKE.replace("frames = 3", "frames = 1")


def halting(outer: Job, inner: Job, folder: Path, count: int, monkeypatch: pytest.MonkeyPatch):
    """An `os.fsync` that does the job `inner` while `outer` syncs its record, and once after so many other syncs."""
    sync, left = os.fsync, [count]

    def halted(descriptor: int) -> None:
        place = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        sync(descriptor)
        left[0] -= 1
        recording = place.parent.name == "jobs" and place.name.startswith(f"{outer.name}.json.tmp-")
        if recording or left[0] == 0:
            with monkeypatch.context() as other:  # another process, with another number
                other.setattr(os, "fsync", sync)
                other.setattr(os, "getpid", lambda: 100_000)
                assert job_runner.run_job(inner, folder, make).state == "done"

    return halted


def test_no_job_tidies_up_what_another_one_is_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Names that begin alike (fan_0000, fan_0000_x2; fan_1000, fan_10000): every job starts inside every other's write.

    One is halted while it syncs its record or another of its files, drawn at random, and the other is done meanwhile.
    """
    wanted = recipe.parse(ALIKE)
    alike = ("fan_0000", "fan_0000_x2", "fan_0000_x2.5", "fan_1000", "fan_10000")
    chosen = [job for job in wanted.jobs if job.name in alike]
    assert len(chosen) == len(alike)
    folder, rng = tmp_path / "d", random.Random(0)
    generate(wanted, folder, HERE, make=make)
    expected = tree(folder)
    (folder / "clips").rename(tmp_path / "clips")
    for outer, inner in itertools.permutations(chosen, 2):
        shutil.rmtree(folder / "clips", ignore_errors=True)
        (folder / "clips").mkdir()
        for job in (outer, inner):
            (folder / "jobs" / f"{job.name}.json").unlink(missing_ok=True)
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", halting(outer, inner, folder, rng.randrange(12), monkeypatch))
            assert job_runner.run_job(outer, folder, make) == job_runner.Result(outer.name, "done")
    shutil.rmtree(folder / "clips")
    (tmp_path / "clips").rename(folder / "clips")
    assert tree(folder) == expected


@pytest.mark.parametrize("name", ["fan", "fan_x2", "fan.tmp-1", "fan.removed-7x"])
def test_only_exact_leftovers_are_swept(tmp_path: Path, name: str):
    """Of `fan` only fan.tmp-N and fan.removed-N, with a whole number; links go, what they point to stays."""
    target = tmp_path / "elsewhere"
    target.mkdir()
    (target / "precious").touch()
    leftovers = [f"{name}.tmp-12", f"{name}.removed-3"]
    others = ["fan0.tmp-1", "fan_x2.json.tmp-1", f"{name}.tmp-", f"{name}.tmp-1_0000", f"{name}.part", name, "x.tmp-1"]
    for kept in others:
        (tmp_path / kept).mkdir()
    (tmp_path / leftovers[0]).touch()
    (tmp_path / leftovers[1]).symlink_to(target)
    files.remove_leftovers(tmp_path / name)
    assert sorted(os.listdir(tmp_path)) == sorted({*others, "elsewhere"})
    assert (target / "precious").exists()


# Links


def moved(folder: Path, name: str, place: Path) -> Path:
    """The clip on another disk, with a link in its place."""
    shutil.move(folder / "clips" / name, place)
    (folder / "clips" / name).symlink_to(place)
    return folder / "clips" / name


def test_a_clip_that_was_moved_and_linked(tmp_path: Path):
    """It is read and its streams are mended through the link; what needs a new clip is refused, and nothing changes."""
    wanted, folder, place = recipe.parse(RECIPE), tmp_path / "d", tmp_path / "disk2"
    generate(wanted, folder, HERE, make=make)
    expected = tree(folder)
    link = moved(folder, "fan_0000", place)
    assert generate(wanted, folder, Options(workers=0, repair=True), make=make).repaired == ()
    codes = next(place.glob("streams/*.npy"))
    codes.write_bytes(b"damaged")
    assert generate(wanted, folder, Options(workers=0, repair=True), make=make).made == 1
    assert link.is_symlink()
    assert Dataset.open(folder).verify() == []
    frame = next(place.glob("radiance/*.exr"))
    whole = frame.read_bytes()
    frame.write_bytes(b"damaged")
    for again in ({"repair": True}, {"repair": True, "retry": True}):
        with pytest.raises(ValueError, match=r"fan_0000 is a symbolic link to .*disk2, and --repair replaces no links"):
            generate(wanted, folder, Options(workers=0, **again), make=make)
        assert link.is_symlink()
        assert frame.read_bytes() == b"damaged"
    assert generate(wanted, folder, HERE, make=make).failed == {}
    frame.write_bytes(whole)
    assert Dataset.open(folder).verify() == []
    frame.unlink()
    link.unlink()  # as the message says: the clip is made here
    assert generate(wanted, folder, Options(workers=0, repair=True), make=make).failed == {}
    assert tree(folder) == expected


def test_a_link_whose_disk_is_not_there(tmp_path: Path):
    """The job is listed, not rendered for nothing; when the disk is back, --retry is enough."""
    wanted, folder, place = recipe.parse(RECIPE), tmp_path / "d", tmp_path / "disk2"
    generate(wanted, folder, HERE, make=make)
    moved(folder, "fan_0000", place)
    place.rename(tmp_path / "unplugged")
    (folder / "jobs" / "fan_0000.json").unlink()
    found = generate(wanted, folder, HERE, make=make)
    assert "is a symbolic link to" in found.failed["fan_0000"]
    assert "which is not there; mount or move it back, or delete the link" in found.failed["fan_0000"]
    (tmp_path / "unplugged").rename(place)
    assert generate(wanted, folder, Options(workers=0, retry=True), make=make).failed == {}
    assert Dataset.open(folder).verify() == []


def test_a_leftover_link_of_an_earlier_version_does_not_stop_the_job(tmp_path: Path):
    wanted, folder, place = recipe.parse(RECIPE), tmp_path / "d", tmp_path / "disk2"
    generate(wanted, folder, HERE, make=make)
    moved(folder, "fan_0000", place).rename(folder / "clips" / "fan_0000.removed-77")
    (folder / "jobs" / "fan_0000.json").unlink()
    assert generate(wanted, folder, HERE, make=make).failed == {}
    assert (place / "clip.json").is_file(), "only the link goes"
    assert Dataset.open(folder).verify() == []


def test_force_writes_through_a_link(tmp_path: Path):
    """`qsim render -o LINK --force`: the clip at the other place is replaced, the link stays."""
    job = recipe.parse(RECIPE).jobs[0]
    make(job, tmp_path / "disk2" / "far")
    (tmp_path / "near").symlink_to(tmp_path / "disk2" / "far")
    meta = {
        "shape": [1, 2, 3], "frame_rate": 1000.0, "exposure": 1e-3, "radiance_unit": "relative", "camera": None
    }  # fmt: skip
    with ClipWriter(tmp_path / "near", meta, force=True) as writer:
        writer.add(0, np.ones((2, 3)))
    assert (tmp_path / "near").is_symlink()
    assert files.read_json(tmp_path / "disk2" / "far" / "clip.json")["name"] == "near"
    assert sorted(os.listdir(tmp_path)) == ["disk2", "near"]
    assert os.listdir(tmp_path / "disk2") == ["far"]


# Words of the system's errors


@pytest.mark.parametrize("number", [errno.EACCES, errno.ENOENT, errno.EXDEV])
def test_a_systems_error_is_worded_with_its_file_and_nothing_else(tmp_path: Path, number: int, monkeypatch):
    """Wherever a job's write fails, failed/ says `FILE: reason`: no number, no quotes, no '-> None'."""
    wanted = recipe.parse(RECIPE)
    for name, step in itertools.product(("fsync", "replace"), (0, 11)):
        folder = tmp_path / f"{name}-{step}"
        found = generate(wanted, folder, HERE, make=make, run=failing(name, step, number, monkeypatch))
        (message,) = found.failed.values()
        assert message.startswith(str(folder)), message
        assert message.endswith(f": {os.strerror(number)}"), message
        assert not any(word in message for word in (".tmp-", "None", "'")), message
        assert generate(wanted, folder, Options(workers=0, retry=True), make=make).failed == {}


def failing(name: str, step: int, number: int, monkeypatch: pytest.MonkeyPatch):
    """Runs one job, in which the so-many-th call of os.NAME fails."""
    action, left = getattr(os, name), [step]

    def fail(*args, **kwargs):
        left[0] -= 1
        if left[0] == -1:
            raise OSError(number, os.strerror(number), *([None] if name == "fsync" else args[:1]))
        return action(*args, **kwargs)

    def run(chosen, place, maker):
        with monkeypatch.context() as patch:
            patch.setattr(os, name, fail)
            yield job_runner.run_job(chosen[0], place, maker)

    return run


def test_wordings():
    two = OSError(errno.EXDEV, "Invalid cross-device link", "a", None, "b")
    assert files.wording(two) == "a: Invalid cross-device link"
    assert files.wording(OSError(errno.EIO, "Input/output error")) == "Input/output error"
    assert files.wording(OSError("two\nlines")) == "two lines"
    assert files.wording(ValueError()) == "ValueError"
    with pytest.raises(OSError) as caught, files.replacing(Path("/nowhere/x")):
        pass
    assert "None" not in str(caught.value)


# Folders that go


@pytest.mark.parametrize("part", [None, "locks", "jobs"])
def test_a_folder_that_is_removed_while_workers_write(tmp_path: Path, part: str | None, capfd):
    """One line, no worker's traceback; what is left is a data set to the next run, which makes the same files."""
    wanted, folder = recipe.parse(RECIPE.replace("[0, 1]", "[0, 1, 2, 3, 5, 6]")), tmp_path / "d"
    stop = threading.Event()

    def remove() -> None:
        while not stop.is_set():  # as `rm -r` that is repeated until nothing is left
            if any((folder / "logs").glob("*")):
                shutil.rmtree(folder / part if part else folder, ignore_errors=True)
            stop.wait(0.02)

    thread = threading.Thread(target=remove)
    thread.start()
    try:
        with pytest.raises(FileNotFoundError) as caught:
            generate(wanted, folder, Options(workers=2), make=make_slowly)
    finally:
        stop.set()
        thread.join()
    assert str(folder) in files.wording(caught.value)
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err
    assert generate(wanted, folder, Options(workers=0, retry=True), make=make).failed == {}
    assert Dataset.open(folder).verify() == []


def test_a_folder_of_somebody_else_is_still_refused(tmp_path: Path):
    (tmp_path / "d" / "clips").mkdir(parents=True)
    (tmp_path / "d" / "thesis.tex").touch()
    with pytest.raises(ValueError, match="is not empty and not a data set"):
        generate(recipe.parse(RECIPE), tmp_path / "d", HERE, make=make)
    assert sorted(os.listdir(tmp_path / "d")) == ["clips", "thesis.tex"]


# Answers of workers


def first(folder: Path, pattern: str) -> Path:
    return min((folder / "clips" / "fan_0000").glob(pattern))


LIES = {  # name -> what a worker does to a job's files before it answers "done"; the record is written last
    "an empty record": lambda folder, record: record.write_text("{}"),
    "no JSON": lambda folder, record: record.write_text("done"),
    "the record of another job": lambda folder, record: record.write_bytes(
        (folder / "jobs" / "fan_0001.json").read_bytes()
    ),
    "no clip": lambda folder, record: shutil.rmtree(folder / "clips" / "fan_0000"),
    "another clip.json": lambda folder, record: first(folder, "clip.json").write_text(
        first(folder, "clip.json").read_text() + " "
    ),
    "a missing frame": lambda folder, record: first(folder, "radiance/*.exr").unlink(),
    "an empty frame": lambda folder, record: first(folder, "truth/*.exr").write_bytes(b""),
    "a stream without json": lambda folder, record: first(folder, "streams/*.json").unlink(),
    "a stream without codes": lambda folder, record: first(folder, "streams/*.npy").unlink(),
    "codes cut short": lambda folder, record: first(folder, "streams/*.npy").write_bytes(
        first(folder, "streams/*.npy").read_bytes()[:-3]
    ),
}


@pytest.mark.parametrize("lie", LIES)
def test_an_answer_counts_only_when_its_files_agree(tmp_path: Path, lie: str):
    wanted, folder = recipe.parse(RECIPE), tmp_path / "d"

    def run(chosen, place, maker):
        for job in reversed(chosen):
            found = job_runner.run_job(job, place, maker)
            if job.name == "fan_0000":
                LIES[lie](place, place / "jobs" / "fan_0000.json")
            yield found

    found = generate(wanted, folder, HERE, make=make, run=run)
    assert (found.done, found.made, set(found.failed)) == (2, 2, {"fan_0000"})
    assert found.failed["fan_0000"].startswith("a worker says that it is done, but ")
    opened = Dataset.open(folder)
    assert opened.names() == ["fan_0001", "tumble_0004"]
    assert opened.meta["jobs"]["fan_0000"]["state"] == "failed"


def test_an_answer_for_a_job_that_nobody_asked_for(tmp_path: Path):
    def run(chosen, place, maker):
        yield job_runner.Result("fan_0099", "done")
        yield job_runner.Result("fan_0000", "done")

    found = generate(recipe.parse(RECIPE), tmp_path / "d", HERE, make=make, run=run)
    assert (found.done, found.made) == (0, 0)
    assert "given to none" in found.failed["fan_0099"]
    assert "it is not here" in found.failed["fan_0000"]


def test_jumps_of_the_clock_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The wall clock and the times of files go back and forth by years between and during two runs: the same bytes."""
    wanted = recipe.parse(RECIPE)
    generate(wanted, tmp_path / "undisturbed", HERE, make=make)
    rng, now = random.Random(0), time.time
    monkeypatch.setattr(time, "time", lambda: now() + rng.uniform(-1e9, 1e9))

    def make_then_shake(job: Job, path: Path) -> object:
        made = make(job, path)
        for file in (tmp_path / "d").rglob("*"):
            moment = rng.uniform(0, 2e9)
            os.utime(file, (moment, moment))
        return made

    for _ in range(2):
        assert generate(wanted, tmp_path / "d", HERE, make=make_then_shake).done == 3
    assert tree(tmp_path / "d") == tree(tmp_path / "undisturbed")
    assert Dataset.open(tmp_path / "d").verify() == []
