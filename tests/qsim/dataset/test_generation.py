"""Generation: the same bytes after kills, in shards, beside another generator, and with false reports."""

import functools
import os
import random
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from fakes import (
    HERE,
    RECIPE,
    SMALL,
    SUPPORT,
    fail_on_tumble,
    make,
    tree,
)
from forks import in_child, killed_at

from qsim import locks
from qsim.dataset import job_runner, recipe
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import Options, Summary, generate, watching
from qsim.dataset.job import Job
from qsim.dataset.worker_pool import run_here


def test_a_second_run_does_nothing(tmp_path: Path, undisturbed: dict[str, bytes]):
    generate(SMALL, tmp_path / "d", HERE, make=make)
    times = {path: path.stat().st_mtime_ns for path in (tmp_path / "d" / "clips").rglob("*")}
    assert generate(SMALL, tmp_path / "d", HERE, make=make) == Summary(3, 3, 0, {}, ())
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "d" / "clips").rglob("*")} == times
    assert tree(tmp_path / "d") == undisturbed


def test_shards_in_any_order_give_the_same_bytes(tmp_path: Path, undisturbed: dict[str, bytes]):
    for i in (3, 1, 2):
        summary = generate(SMALL, tmp_path / "d", Options(workers=0, shard=(i, 3)), make=make)
        assert (summary.jobs, summary.made) == (1, 1)
    assert tree(tmp_path / "d") == undisturbed
    with pytest.raises(ValueError, match="shard 4/3"):
        generate(SMALL, tmp_path / "d", Options(shard=(4, 3)), make=make)


@pytest.mark.parametrize("kills", [15, pytest.param(60, marks=pytest.mark.slow)])
def test_killed_at_random_moments(tmp_path: Path, undisturbed: dict[str, bytes], kills: int):
    """The moments are spread over a complete run; the next run resumes each killed folder, and is killed again."""
    moments = random.Random(5)
    started = time.monotonic()
    assert in_child(functools.partial(generate, SMALL, tmp_path / "timing", HERE, make=make), 600)
    whole = time.monotonic() - started  # in a fork, as below: that of a large process is slower, and no job would end
    killed = rounds = 0
    while killed < kills:
        folder = tmp_path / f"d{rounds}"
        rounds += 1
        run = functools.partial(generate, SMALL, folder, HERE, make=make)
        while not in_child(run, moments.uniform(0, whole / 2)):
            killed += 1
            if (folder / "dataset.json").is_file():
                for clip in Dataset.open(folder).clips():  # every accepted clip is complete
                    assert clip.verify() == []
                    assert len(clip.streams) == 2
        assert tree(folder) == undisturbed
        shutil.rmtree(folder)
    assert rounds < kills


@pytest.mark.parametrize("every", [5, pytest.param(1, marks=pytest.mark.slow)])
def test_killed_before_every_step(tmp_path: Path, every: int):
    """One job; after a kill before any open, mkdir, remove or rename, the same command makes the same bytes.

    The quick test takes every fifth of them.
    """
    head, _, tumble = RECIPE.split("[[scenes]]")
    one = recipe.parse(f"{head}[[scenes]]{tumble}".replace("[1, 3]", "[3]"))
    generate(one, tmp_path / "undisturbed", HERE, make=make)
    expected = tree(tmp_path / "undisturbed")
    killed = True
    steps = 0
    while killed:
        folder = tmp_path / str(steps)
        steps += every
        run = functools.partial(generate, one, folder, HERE, make=make)
        killed = killed_at(steps, folder, run)
        assert run().failed == {}
        assert tree(folder) == expected
    assert steps > 50


def test_a_failing_job_is_listed_and_retried(tmp_path: Path, undisturbed: dict[str, bytes]):
    why = "scene tumble: no light and no glowing body"
    first = generate(SMALL, tmp_path / "d", HERE, make=fail_on_tumble)
    assert (first.done, first.failed) == (2, {"tumble_0004": why})
    assert Dataset.open(tmp_path / "d").failed() == {"tumble_0004": why}
    again = generate(SMALL, tmp_path / "d", HERE, make=make)
    assert (again.made, again.failed) == (0, {"tumble_0004": why}), "it is retried only when asked"
    assert "ValueError" in (tmp_path / "d" / "logs" / "tumble_0004.log").read_text()
    assert generate(SMALL, tmp_path / "d", Options(workers=0, retry=True), make=make) == Summary(3, 3, 1, {}, ())
    assert tree(tmp_path / "d") == undisturbed


@pytest.mark.parametrize(
    "note", ["{}", "[]", "x", "", '{"error": [1, {}]}', '{"error": null}', '{"why": "?"}', "[" * 999]
)
def test_a_note_of_failure_that_cannot_be_read_stops_nothing(tmp_path: Path, undisturbed: dict[str, bytes], note: str):
    """An empty object ended `generate` in a KeyError; other damage blocked it for good, with --retry or without."""
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    (folder / "jobs" / "fan_0001.json").unlink()
    (folder / "failed" / "fan_0001.json").write_text(note)
    summary = generate(SMALL, folder, HERE, make=make)
    assert (summary.done, list(summary.failed)) == (2, ["fan_0001"])
    assert Dataset.open(folder).missing == ["fan_0001"]
    assert generate(SMALL, folder, Options(workers=0, retry=True), make=make).made == 1
    assert tree(folder) == undisturbed


def test_a_job_whose_worker_crashed_after_its_record_is_done(tmp_path: Path, undisturbed: dict[str, bytes]):
    """Its note of failure stayed for ever, because --retry runs no job that has a record."""
    folder = tmp_path / "d"
    why = "its worker process crashed 2 times"

    def run(chosen, place, maker):
        for job in chosen:
            job_runner.run_job(job, place, maker)
            job_runner.mark_failed(place, job, why)
            yield job_runner.Result(job.name, "crashed", why)

    assert generate(SMALL, folder, HERE, make=make, run=run) == Summary(3, 3, 3, {}, ())
    job_runner.mark_failed(folder, SMALL.jobs[0], why)
    assert generate(SMALL, folder, HERE, make=make) == Summary(3, 3, 0, {}, ())
    assert list((folder / "failed").iterdir()) == []
    assert tree(folder) == undisturbed


def test_clips_that_were_made_somewhere_else_are_named(tmp_path: Path):
    """Workers with another folder of that name report "done" in good faith."""
    generate(SMALL, tmp_path / "there", HERE, make=make)
    summary = generate(
        SMALL, tmp_path / "here", make=make, run=lambda todo, _, make: run_here(todo, tmp_path / "there", make)
    )
    assert (summary.made, summary.done) == (0, 0)
    assert set(summary.failed) == {job.name for job in SMALL.jobs}
    assert all("does every worker have this folder" in why for why in summary.failed.values())


def test_two_generators_on_one_folder(tmp_path: Path):
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    lock = locks.Lock(folder / "locks" / "generate")
    assert lock.acquire()
    with pytest.raises(ValueError, match="another generator is at work here"):
        generate(SMALL, folder, HERE, make=make)
    with pytest.raises(ValueError, match="another generator is at work here"):
        generate(SMALL, folder, Options(workers=0, shard=(1, 2)), make=make)
    lock.release()
    shard = locks.Lock(folder / "locks" / "generate", shared=True)
    assert shard.acquire()
    assert generate(SMALL, folder, Options(workers=0, shard=(1, 2)), make=make).done == 2
    with pytest.raises(ValueError, match="another generator is at work here"):
        generate(SMALL, folder, HERE, make=make)
    shard.release()


def test_the_second_generator_waits_when_asked(tmp_path: Path, undisturbed: dict[str, bytes]):
    """Two at once: the first makes everything, the second finds it done."""
    folder = tmp_path / "d"
    children = []
    code = "import sys; from fakes import *; from qsim.dataset import recipe; from qsim.dataset.generation import *;"
    code += "print(generate(recipe.parse(RECIPE), sys.argv[1], Options(workers=0, wait=True), make=make_slowly).made)"
    env = os.environ | {"PYTHONPATH": SUPPORT}
    for _ in range(2):
        children.append(subprocess.Popen([sys.executable, "-c", code, str(folder)], env=env, stdout=subprocess.PIPE))
    made = sorted(int(child.communicate(timeout=60)[0]) for child in children)
    assert made == [0, 3]
    assert tree(folder) == undisturbed


def test_another_recipe_in_the_same_folder_is_refused(tmp_path: Path):
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    for old, new, message in [
        ("frames = 3", "frames = 4", "clip fan_0000 was made with other settings"),
        ("seeds = [0, 1]", "seeds = [0, 1, 2]", "without the clip fan_0002"),
        ("seeds = [0, 1]", "seeds = [0]", "holds the clip fan_0001, which is not in this recipe"),
    ]:
        with pytest.raises(ValueError, match=message):
            generate(recipe.parse(RECIPE.replace(old, new)), folder, HERE, make=make)
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").touch()
    with pytest.raises(ValueError, match="is not empty and not a data set"):
        generate(SMALL, other, HERE, make=make)


def test_an_edited_recipe_is_refused_after_its_manifest_was_lost(tmp_path: Path, undisturbed: dict[str, bytes]):
    """Clips of the old settings were listed as done with the digests of the new ones; --repair makes them again."""
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    edited = recipe.parse(RECIPE.replace("frames = 2", "frames = 2\npsnr = 30"))
    (folder / "dataset.json").unlink()
    with pytest.raises(
        ValueError,
        match="other settings; use another folder, or make it again with repair=True",
    ):
        generate(edited, folder, HERE, make=make)
    assert not (folder / "dataset.json").exists()
    assert generate(SMALL, folder, HERE, make=make) == Summary(3, 3, 0, {}, ())
    assert tree(folder) == undisturbed
    (folder / "dataset.json").unlink()
    assert generate(edited, folder, Options(workers=0, repair=True), make=make).made == 1
    assert Dataset.open(folder).verify() == []


def test_a_folder_of_somebody_else_is_still_refused(tmp_path: Path):
    (tmp_path / "d" / "clips").mkdir(parents=True)
    (tmp_path / "d" / "thesis.tex").touch()
    with pytest.raises(ValueError, match="is not empty and not a data set"):
        generate(recipe.parse(RECIPE), tmp_path / "d", HERE, make=make)
    assert sorted(os.listdir(tmp_path / "d")) == ["clips", "thesis.tex"]


def test_progress_counts_the_frames_of_whoever_renders(tmp_path: Path):
    """All frames of finished clips, the lines of the journal of an unfinished one, none of the others."""
    jobs_wanted = SMALL.jobs
    total = sum(job.settings.frames for job in jobs_wanted)
    first, second, _ = jobs_wanted
    part = tmp_path / "work" / f"{second.name}.part"
    heard: list[tuple[int, int]] = []

    def until(count: int) -> None:
        end = time.monotonic() + 30
        while not heard or heard[-1] != (count, total):
            assert time.monotonic() < end, heard
            time.sleep(0.005)

    with watching(tmp_path, jobs_wanted, lambda done, of: heard.append((done, of)), every=0.01):
        until(0)
        part.mkdir(parents=True)
        for line in (1, 2):
            with open(part / "journal.jsonl", "a", encoding="utf-8") as journal:
                journal.write("{}\n")
            until(line)
        (tmp_path / "clips" / first.name).mkdir(parents=True)
        until(2 + first.settings.frames)
    assert heard == sorted(heard)


def test_jumps_of_the_clock_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The wall clock and the times of files jump by years between and during two runs: the same bytes."""
    wanted = recipe.parse(RECIPE)
    generate(wanted, tmp_path / "undisturbed", HERE, make=make)
    rng = random.Random(0)
    now = time.time
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


# Reports of workers


def first(folder: Path, pattern: str) -> Path:
    return min((folder / "clips" / "fan_0000").glob(pattern))


LIES = {  # name -> what a worker does to a job's files before it reports "done"; the record is written last
    "an empty record": lambda folder, record: record.write_text("{}"),
    "no JSON": lambda folder, record: record.write_text("done"),
    "the record of another job": lambda folder, record: record.write_bytes(
        (folder / "jobs" / "fan_0001.json").read_bytes()
    ),
    "no clip": lambda folder, record: shutil.rmtree(folder / "clips" / "fan_0000"),
    "another clip.json": lambda folder, record: first(folder, "clip.json").write_text(
        first(folder, "clip.json").read_text().replace('"frame_rate": 2000', '"frame_rate": 2001')
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
    wanted = recipe.parse(RECIPE)
    folder = tmp_path / "d"

    def run(chosen, place, maker):
        for job in reversed(list(chosen)):
            found = job_runner.run_job(job, place, maker)
            if job.name == "fan_0000":
                LIES[lie](place, place / "jobs" / "fan_0000.json")
            yield found

    found = generate(wanted, folder, HERE, make=make, run=run)
    assert (found.done, found.made, set(found.failed)) == (2, 2, {"fan_0000"})
    assert found.failed["fan_0000"].startswith("a worker reports that it is done, but ")
    opened = Dataset.open(folder)
    assert opened.names() == ["fan_0001", "tumble_0004"]
    assert list(opened.failed()) == ["fan_0000"]


def test_an_answer_for_a_job_that_nobody_asked_for(tmp_path: Path):
    def run(chosen, place, maker):
        assert [job.name for job in chosen] == ["fan_0000", "fan_0001", "tumble_0004"]
        yield job_runner.Result("fan_0099", "done")
        yield job_runner.Result("fan_0000", "done")

    found = generate(recipe.parse(RECIPE), tmp_path / "d", HERE, make=make, run=run)
    assert (found.done, found.made) == (0, 0)
    assert "no worker was given it" in found.failed["fan_0099"]
    assert "its record is missing" in found.failed["fan_0000"]


def test_a_job_is_retried_after_its_cause_was_removed_from_the_recipe(tmp_path: Path):
    """The digest of a clip that was never made refused the recipe without the cause."""
    folder = tmp_path / "d"
    slower = replace(
        SMALL,
        jobs=tuple(
            replace(job, settings=replace(job.settings, psnr=39.0)) if job.name == "tumble_0004" else job
            for job in SMALL.jobs
        ),
    )
    first = generate(SMALL, folder, HERE, make=fail_on_tumble)
    assert list(first.failed) == ["tumble_0004"]
    assert generate(slower, folder, HERE, make=make) == Summary(3, 3, 1, {}, ())
    assert not Dataset.open(folder).missing
    with pytest.raises(ValueError, match="its clip tumble_0004 was made with other settings"):
        generate(SMALL, folder, HERE, make=make)
