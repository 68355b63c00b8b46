"""Jobs beside each other, jobs whose clip is a link, and the messages of failed jobs."""

import errno
import itertools
import os
import random
import shutil
from pathlib import Path

import pytest
from fakes import HERE, RECIPE, make, moved, tree

from qsim.dataset import job_runner, recipe
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import Options, generate
from qsim.dataset.job import Job

ALIKE = RECIPE.replace("seeds = [0, 1]", "seeds = [0, 1000, 10000]\nspeed = [1.0, 2.0, 2.5]").replace("[1, 3]", "[3]")
ALIKE = ALIKE.replace("frames = 3", "frames = 1")


def halting(outer: Job, inner: Job, folder: Path, count: int, monkeypatch: pytest.MonkeyPatch):
    """Return an `os.fsync` that runs the job `inner` while `outer` syncs its record, and once after `count` syncs."""
    sync = os.fsync
    left = [count]

    def halted(descriptor: int) -> None:
        place = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        sync(descriptor)
        left[0] -= 1
        recording = place.parent.name == "jobs" and place.name.startswith(f"{outer.name}.json.tmp-")
        if recording or left[0] == 0:
            with monkeypatch.context() as other:  # another process with another id
                other.setattr(os, "fsync", sync)
                other.setattr(os, "getpid", lambda: 100_000)
                assert job_runner.run_job(inner, folder, make).state == "done"

    return halted


def test_no_job_tidies_up_what_another_one_is_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Names that begin alike (fan_0000, fan_0000_x2; fan_1000, fan_10000): every job starts inside every other's write.

    One job is halted while it syncs its record or another file, drawn at random, and the other runs meanwhile.
    """
    wanted = recipe.parse(ALIKE)
    alike = ("fan_0000", "fan_0000_x2", "fan_0000_x2.5", "fan_1000", "fan_10000")
    chosen = [job for job in wanted.jobs if job.name in alike]
    assert len(chosen) == len(alike)
    folder = tmp_path / "d"
    rng = random.Random(0)
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


def test_a_link_whose_disk_is_not_there(tmp_path: Path):
    """The job is listed, not rendered in vain; when the disk is back, --retry is enough."""
    wanted = recipe.parse(RECIPE)
    folder = tmp_path / "d"
    place = tmp_path / "disk2"
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
    wanted = recipe.parse(RECIPE)
    folder = tmp_path / "d"
    place = tmp_path / "disk2"
    generate(wanted, folder, HERE, make=make)
    moved(folder, "fan_0000", place).rename(folder / "clips" / "fan_0000.removed-77")
    (folder / "jobs" / "fan_0000.json").unlink()
    assert generate(wanted, folder, HERE, make=make).failed == {}
    assert (place / "clip.json").is_file(), "only the link goes"
    assert Dataset.open(folder).verify() == []


@pytest.mark.parametrize("number", [errno.EACCES, errno.ENOENT, errno.EXDEV])
def test_a_systems_error_is_worded_with_its_file_and_nothing_else(tmp_path: Path, number: int, monkeypatch):
    """Wherever a job's write fails, failed/ holds `FILE: reason`: no number, no quotes, no '-> None'."""
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
    """Return an executor of one job in which one call of os.NAME fails."""
    action = getattr(os, name)
    left = [step]

    def fail(*args, **kwargs):
        left[0] -= 1
        if left[0] == -1:
            raise OSError(number, os.strerror(number), *([None] if name == "fsync" else args[:1]))
        return action(*args, **kwargs)

    def run(chosen, place, maker):
        job = next(iter(chosen))
        with monkeypatch.context() as patch:
            patch.setattr(os, name, fail)
            yield job_runner.run_job(job, place, maker)

    return run


def test_the_budget_hides_behind_the_noise_of_a_clip_frame(monkeypatch):
    """A code of 7 planes or 12 slices averages the noise of its frames, so each frame has a share of its photons.

    What repeats in all frames of a code is compared with the electrons of the code. Frames share the noise of a code
    unless its rows begin elsewhere, or it sees a part of them.
    """
    from qsim.rendering import fidelity

    asked = []
    monkeypatch.setattr(fidelity, "choose_budget", lambda scene, **given: asked.append(given))
    head = '[recipe]\nname = "t"\nframes = 12\nheight = 7\nwidth = 9\n[[scenes]]\nfamily = "fan"\n'
    summed = '[[streams]]\nsensor = "spad512s"\nbits = 3\ngroup = true\nppp = 14.0\n'
    sliced = '[[streams]]\nsensor = "quiver-physical"\nbits = 3\nslices = 12\nppp = 36.0\n'
    single = '[[streams]]\nsensor = "quiver-physical"\nbits = 3\nppp = 9.0\n'
    for streams, ppp, efficiency, planes, codes in (
        (single, 9.0, 0.8, 1, [1]),
        (summed, 2.0, 0.5, 7, [7]),
        (summed + "row_delay = 1e-6", 2.0, 0.5, 7, [1]),
        (sliced, 3.0, 0.8, 12, [12]),
        (sliced + "exposures = [1.0, 0.25]", 3.0, 0.8, 12, [1]),
        (summed + sliced, 3.0, 0.8, 12, [7, 12]),
        (single + sliced, 9.0, 0.8, 4, [1, 12]),  # 28.8 electrons per code, 7.2 per frame
    ):
        (job,) = recipe.parse(head + streams).jobs
        job_runner.choose_budget(job, job_runner.load_scene(job))
        assert asked[-1]["ppp"] == pytest.approx(ppp)
        assert asked[-1]["quantum_efficiency"] == pytest.approx(efficiency)
        assert asked[-1]["planes"] == pytest.approx(planes)
        assert asked[-1]["codes"] == codes
