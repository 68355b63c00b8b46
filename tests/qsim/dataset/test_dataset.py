"""Data sets: the same bytes whatever happens on the way, and nothing accepted that is not whole."""

import builtins
import errno
import functools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import small_scenes
from fakes import RECIPE, crash_on_tumble, fail_on_tumble, hoard_on_tumble, make, make_slowly, tree
from forks import forked, killed_at

from qsim import files, locks
from qsim.clip.sensing import Sensing, sense
from qsim.dataset import job_runner, provenance, recipe
from qsim.dataset.checking import check
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import Options, Summary, generate, watching
from qsim.dataset.job_runner import RenderJob
from qsim.dataset.worker_pool import Limits, run_here
from qsim.scene import Body, Diffuse, Texture, textures

TESTS = Path(__file__).parents[2]
PYTHONPATH = f"{TESTS.parent}{os.pathsep}{TESTS / 'support'}"  # of child processes; the package first
HERE = Options(workers=0)
SMALL = recipe.parse(RECIPE)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("undisturbed") / "small"
    assert generate(SMALL, folder, HERE, make=make) == Summary(3, 3, 3, {}, ())
    return tree(folder)


def test_a_finished_data_set(tmp_path: Path):
    generate(SMALL, tmp_path / "d", HERE, make=make)
    found = Dataset.open(tmp_path / "d")
    assert [clip.name for clip in found.clips()] == ["fan_0000", "fan_0001", "tumble_0004"]
    assert [clip.name for clip in found.clips("test")] == ["tumble_0004"]
    assert found.clips("val") == []
    assert found.meta["complete"] is True
    assert found.missing == found.verify() == []
    assert found.recipe["recipe"]["frames"] == 3
    clip = found.clips()[1]
    assert clip.streams == ("quiver-physical_1bit_3.25ppp", "quiver-physical_3bit_3.25ppp")
    assert clip.meta["split"] == "train"
    assert clip.stream(clip.streams[1]).codes().shape == (3, 8, 10)
    with pytest.raises(ValueError, match="unknown split 'tset'"):
        found.clips("tset")


def test_a_second_run_does_nothing(tmp_path: Path, undisturbed: dict[str, bytes]):
    generate(SMALL, tmp_path / "d", HERE, make=make)
    times = {path: path.stat().st_mtime_ns for path in (tmp_path / "d" / "clips").rglob("*")}
    assert generate(SMALL, tmp_path / "d", HERE, make=make) == Summary(3, 3, 0, {}, ())
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "d" / "clips").rglob("*")} == times
    assert tree(tmp_path / "d") == undisturbed


@pytest.mark.parametrize("options", [Options(workers=1), Options(workers=2, limits=Limits(jobs=1))])
def test_any_number_of_workers_gives_the_same_bytes(tmp_path: Path, undisturbed: dict[str, bytes], options: Options):
    assert generate(SMALL, tmp_path / "d", options, make=make).made == 3
    assert tree(tmp_path / "d") == undisturbed


def test_shards_in_any_order_give_the_same_bytes(tmp_path: Path, undisturbed: dict[str, bytes]):
    for i in (3, 1, 2):
        summary = generate(SMALL, tmp_path / "d", Options(workers=0, shard=(i, 3)), make=make)
        assert (summary.jobs, summary.made) == (1, 1)
    assert tree(tmp_path / "d") == undisturbed
    with pytest.raises(ValueError, match="shard 4/3"):
        generate(SMALL, tmp_path / "d", Options(shard=(4, 3)), make=make)


def in_child(action: Callable[[], Any], seconds: float) -> bool:
    """Run `action` in a fork and kill it after so many seconds; True if it came to its end before."""
    child = forked(action)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            assert os.waitstatus_to_exitcode(status) == 0
            return True
        time.sleep(0.001)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


def test_killed_at_random_moments_sixty_times(tmp_path: Path, undisturbed: dict[str, bytes]):
    """The moments are spread over a whole run; each killed folder is resumed by the next run, and killed again."""
    moments = random.Random(5)
    started = time.monotonic()
    generate(SMALL, tmp_path / "timing", HERE, make=make)
    whole = time.monotonic() - started
    killed = rounds = 0
    while killed < 60:
        folder = tmp_path / f"d{rounds}"
        rounds += 1
        run = functools.partial(generate, SMALL, folder, HERE, make=make)
        while not in_child(run, moments.uniform(0, whole / 2)):
            killed += 1
            if (folder / "dataset.json").is_file():
                for clip in Dataset.open(folder).clips():  # whatever a reader accepts is whole
                    assert clip.verify() == []
                    assert len(clip.streams) == 2
        assert tree(folder) == undisturbed
        shutil.rmtree(folder)
    assert rounds < 60


def test_killed_before_every_step(tmp_path: Path):
    """One job; whatever was opened, made, removed or renamed last, the same command then makes the same bytes."""
    head, _, tumble = RECIPE.split("[[scenes]]")
    one = recipe.parse(f"{head}[[scenes]]{tumble}".replace("[1, 3]", "[3]"))
    generate(one, tmp_path / "undisturbed", HERE, make=make)
    expected = tree(tmp_path / "undisturbed")
    killed, steps = True, 0
    while killed:
        folder = tmp_path / str(steps)
        steps += 1
        run = functools.partial(generate, one, folder, HERE, make=make)
        killed = killed_at(steps, folder, run)
        assert run().failed == {}
        assert tree(folder) == expected
    assert steps > 50


def test_a_killed_parent_leaves_no_workers_and_its_folder_resumes(tmp_path: Path, undisturbed: dict[str, bytes]):
    folder = tmp_path / "d"
    code = "import sys; from fakes import *; from qsim.dataset import recipe; from qsim.dataset.generation import *;"
    code += "generate(recipe.parse(RECIPE), sys.argv[1], Options(workers=2), make=make_slowly)"
    env = os.environ | {"PYTHONPATH": PYTHONPATH}
    parent = subprocess.Popen([sys.executable, "-c", code, str(folder)], env=env)
    wait_for(lambda: len(list((folder / "logs").glob("*"))) == 2)
    parent.kill()
    parent.wait()
    assert generate(SMALL, folder, Options(workers=1), make=make_slowly).done == 3
    assert tree(folder) == undisturbed


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


class FullDisk:
    """Opens files on a disk with so many bytes left; a write that does not fit writes what fits, then ENOSPC."""

    def __init__(self, space: int) -> None:
        self.space = space

    def open(self, path: Any, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
        file = builtins.open(path, mode, *args, **kwargs)  # noqa: SIM115
        return _Limited(file, self) if "w" in mode or "a" in mode else file


class _Limited:
    def __init__(self, file: Any, disk: FullDisk) -> None:
        self.file, self.disk = file, disk

    def write(self, content: Any) -> int:
        fits = min(len(content), self.disk.space)
        self.disk.space -= fits
        self.file.write(content[:fits])
        if fits < len(content):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return len(content)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)

    def __enter__(self) -> "_Limited":
        return self

    def __exit__(self, *_: Any) -> None:
        self.file.close()


def test_a_full_disk_everywhere(tmp_path: Path, undisturbed: dict[str, bytes], monkeypatch: pytest.MonkeyPatch):
    """Space for 0, 1/10, ... of what a run writes: one clear error, nothing accepted, and resuming gives the same."""
    measure = FullDisk(1 << 30)
    with monkeypatch.context() as patch:
        for module in (files, job_runner):
            patch.setattr(module, "open", measure.open, raising=False)
        generate(SMALL, tmp_path / "whole", HERE, make=make)
    needed = (1 << 30) - measure.space
    for step in range(10):
        folder = tmp_path / f"d{step}"
        disk = FullDisk(needed * step // 10)
        with monkeypatch.context() as patch:
            for module in (files, job_runner):
                patch.setattr(module, "open", disk.open, raising=False)
            with pytest.raises(OSError, match=r"No space left on device.*make space and run the same command again"):
                generate(SMALL, folder, HERE, make=make)
        if (folder / "dataset.json").is_file():
            assert all(clip.verify() == [] for clip in Dataset.open(folder).clips())
        assert generate(SMALL, folder, HERE, make=make).done == 3
        assert tree(folder) == undisturbed
        shutil.rmtree(folder)


class FullAt:
    """From the n-th operation that needs space on, every such operation fails: open, write, sync, rename, mkdir."""

    def __init__(self, left: int, patch: pytest.MonkeyPatch) -> None:
        self.left = left
        for module in (files, job_runner):
            patch.setattr(module, "open", self.open, raising=False)
        for name in ("fsync", "replace", "mkdir"):
            patch.setattr(os, name, self.guarded(getattr(os, name)))

    def guarded(self, action: Callable[..., Any]) -> Callable[..., Any]:
        def act(*args: Any, **kwargs: Any) -> Any:
            self.left -= 1
            if self.left < 0:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return action(*args, **kwargs)

        return act

    def open(self, path: Any, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
        if "r" in mode:
            return builtins.open(path, mode, *args, **kwargs)
        file = self.guarded(builtins.open)(path, mode, *args, **kwargs)
        return _Guarded(file, self.guarded(file.write))


class _Guarded:
    def __init__(self, file: Any, write: Callable[..., Any]) -> None:
        self.file, self.write = file, write

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)

    def __enter__(self) -> "_Guarded":
        return self

    def __exit__(self, *_: Any) -> None:
        self.file.close()


@pytest.mark.parametrize("stride", [23, pytest.param(1, marks=pytest.mark.slow)])
def test_a_disk_that_is_full_from_any_operation_on(
    tmp_path: Path, undisturbed: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, stride: int
):
    """Every place in a run where the system may say ENOSPC, one after the other (in the quick tests: one in 23)."""
    plenty = 1 << 30
    with monkeypatch.context() as patch:
        measure = FullAt(plenty, patch)
        generate(SMALL, tmp_path / "whole", HERE, make=make)
        needed = plenty - measure.left
    assert needed > 200
    for left in range(0, needed, stride):
        folder = tmp_path / f"d{left}"
        with monkeypatch.context() as patch:
            FullAt(left, patch)
            with pytest.raises(OSError, match=r"No space left on device.*make space and run the same command again"):
                generate(SMALL, folder, HERE, make=make)
        if (folder / "dataset.json").is_file():
            for clip in Dataset.open(folder).clips():
                assert clip.verify() == []
        assert generate(SMALL, folder, HERE, make=make).done == 3, left
        assert tree(folder) == undisturbed, left
        shutil.rmtree(folder)


def test_a_disk_that_is_really_full(tmp_path: Path, undisturbed: dict[str, bytes]):
    mount = tmp_path / "tmpfs"
    mount.mkdir()
    tried = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=96k", "tmpfs", str(mount)], capture_output=True)
    if tried.returncode != 0:
        pytest.skip("a tmpfs may not be mounted here; the injected full disk is tested in any case")
    try:
        with pytest.raises(OSError, match=r"No space left on device.*make space"):
            generate(SMALL, mount / "d", HERE, make=make)
        subprocess.run(["mount", "-o", "remount,size=16m", str(mount)], check=True)
        assert generate(SMALL, mount / "d", HERE, make=make).done == 3
        assert tree(mount / "d") == undisturbed
    finally:
        subprocess.run(["umount", str(mount)], check=True)


def test_a_failing_job_is_listed_and_retried(tmp_path: Path, undisturbed: dict[str, bytes]):
    why = "scene tumble: no light and no glowing body"
    first = generate(SMALL, tmp_path / "d", HERE, make=fail_on_tumble)
    assert (first.done, first.failed) == (2, {"tumble_0004": why})
    assert Dataset.open(tmp_path / "d").meta["jobs"]["tumble_0004"]["state"] == "failed"
    again = generate(SMALL, tmp_path / "d", HERE, make=make)
    assert (again.made, again.failed) == (0, {"tumble_0004": why}), "it is retried only when asked"
    assert "ValueError" in (tmp_path / "d" / "logs" / "tumble_0004.log").read_text()
    assert generate(SMALL, tmp_path / "d", Options(workers=0, retry=True), make=make) == Summary(3, 3, 1, {}, ())
    assert tree(tmp_path / "d") == undisturbed


@pytest.mark.parametrize(
    "note", ["{}", "[]", "x", "", '{"error": [1, {}]}', '{"error": null}', '{"why": "?"}', "[" * 999]
)
def test_a_note_of_failure_that_cannot_be_read_stops_nothing(tmp_path: Path, undisturbed: dict[str, bytes], note: str):
    """An empty object ended `generate` in a KeyError, other damage in one line for good, with --retry too or not."""
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    (folder / "jobs" / "fan_0001.json").unlink()
    (folder / "failed" / "fan_0001.json").write_text(note)
    summary = generate(SMALL, folder, HERE, make=make)
    assert (summary.done, list(summary.failed)) == (2, ["fan_0001"])
    assert Dataset.open(folder).missing == ["fan_0001"]
    assert generate(SMALL, folder, Options(workers=0, retry=True), make=make).made == 1
    assert tree(folder) == undisturbed


def test_clips_that_were_made_somewhere_else_are_named(tmp_path: Path):
    """Workers whose folder of that name is another one say "done" and mean it."""
    generate(SMALL, tmp_path / "there", HERE, make=make)
    summary = generate(
        SMALL, tmp_path / "here", make=make, run=lambda todo, _, make: run_here(todo, tmp_path / "there", make)
    )
    assert (summary.made, summary.done) == (0, 0)
    assert set(summary.failed) == {job.name for job in SMALL.jobs}
    assert all("does every worker have this folder" in why for why in summary.failed.values())


@pytest.mark.parametrize(
    ("maker", "why"),
    [(crash_on_tumble, "signal SIGKILL"), (hoard_on_tumble, "more memory than --memory")],
)
def test_a_crashing_worker_takes_down_only_its_job(tmp_path: Path, maker: RenderJob, why: str):
    options = Options(workers=2, limits=Limits(memory=0.7))
    summary = generate(SMALL, tmp_path / "d", options, make=maker)
    assert summary.done == 2
    assert list(summary.failed) == ["tumble_0004"]
    assert "crashed 2 times" in summary.failed["tumble_0004"]
    assert why in summary.failed["tumble_0004"]


def damage(path: Path, kind: str) -> None:
    content = bytearray(path.read_bytes())
    if kind == "missing":
        path.unlink()
    elif kind == "truncated":
        path.write_bytes(content[: len(content) // 2])
    else:
        content[len(content) // 2] ^= 4
        path.write_bytes(content)


@pytest.mark.parametrize("kind", ["missing", "truncated", "bit-flipped"])
def test_every_damaged_file_is_named_and_only_it_is_made_again(
    tmp_path: Path, undisturbed: dict[str, bytes], kind: str
):
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    for name in undisturbed:
        damage(folder / name, kind)
        # a clip whose record is gone does not count as made
        named = name.replace("jobs/", "clips/").removesuffix(".json") if kind == "missing" and "jobs" in name else name
        assert any(f"{folder / named}: " in problem for problem in problems_of(folder)), name
        kept = {path: path.stat().st_ino for path in folder.glob("clips/*") if path.name not in name}
        summary = generate(SMALL, folder, Options(workers=0, repair=True), make=make)
        assert summary.made == (name != "dataset.json"), name
        assert tree(folder) == undisturbed, name
        assert kept == {path: path.stat().st_ino for path in kept}


def problems_of(folder: Path) -> list[str]:
    """What `qsim check` says."""
    try:
        return Dataset.open(folder).verify()
    except (ValueError, OSError) as error:
        return [str(error)]


def test_no_flipped_bit_of_records_and_manifest_escapes(tmp_path: Path):
    """Every byte of one record, every seventh of the manifest: the file is named, whatever JSON makes of the bit."""
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    for path, step in ((folder / "jobs" / "fan_0000.json", 1), (folder / "dataset.json", 7)):
        content = path.read_bytes()
        for at in range(0, len(content), step):
            flipped = bytearray(content)
            flipped[at] ^= 1 << at % 7
            path.write_bytes(flipped)
            assert any(str(path) in problem for problem in problems_of(folder)), (
                path.name,
                at,
                flipped[at - 5 : at + 5],
            )
        path.write_bytes(content)
    assert problems_of(folder) == []


def test_a_damaged_record_costs_no_rendering_but_vouches_for_nothing(tmp_path: Path, undisturbed: dict[str, bytes]):
    """The clip behind it stays if the manifest still knows it, and goes if its clip.json has changed too."""
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    damage(folder / "jobs" / "tumble_0004.json", "bit-flipped")
    summary = generate(SMALL, folder, Options(workers=0, repair=True), make=fail_on_tumble)
    assert summary.made == 1
    damage(folder / "jobs" / "tumble_0004.json", "bit-flipped")
    about = folder / "clips" / "tumble_0004" / "clip.json"
    about.write_text(about.read_text().replace('"exposure": 0.0005', '"exposure": 0.0004'))
    summary = generate(SMALL, folder, Options(workers=0, repair=True), make=make)
    assert (summary.made, tree(folder)) == (1, undisturbed)


def test_repair_names_the_streams_that_go_with_a_clip(tmp_path: Path):
    """What `qsim sense` has added is in no recipe: it cannot come back by itself."""
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    for damaged in ("radiance/000000.exr", "streams/own.npy"):
        drawn, _ = sense(Dataset.open(folder).clips()[0], Sensing("quiver-physical", bits=2, name="own"))
        damage(drawn.path.parents[1] / damaged, "bit-flipped")
        repaired = generate(SMALL, folder, Options(workers=0, repair=True), make=make).repaired
        assert f"{drawn.path}: was added by `qsim sense` and is gone; sense it again" in repaired
        assert not drawn.path.exists()
        assert problems_of(folder) == []


def test_repair_does_not_take_the_clips_of_another_recipe(tmp_path: Path):
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    before = tree(folder)
    other = recipe.parse(RECIPE.replace("frames = 3", "frames = 4").replace("frames = 2", "frames = 3"))
    for kind in ("bit-flipped", "missing"):
        damage(folder / "dataset.json", kind)
        with pytest.raises(ValueError, match="none of its 3 finished clips is of this recipe"):
            generate(other, folder, Options(workers=0, repair=True), make=make)
    assert {name: content for name, content in before.items() if name != "dataset.json"} == tree(folder)


def test_repairing_a_stream_does_not_render(tmp_path: Path, undisturbed: dict[str, bytes]):
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    damage(next((folder / "clips" / "fan_0001" / "streams").glob("*.npy")), "bit-flipped")
    summary = generate(SMALL, folder, Options(workers=0, repair=True), make=fail_on_tumble)
    assert (summary.made, len(summary.repaired)) == (1, 1)
    assert "rendering" not in (folder / "logs" / "fan_0001.log").read_text().split("done on")[1]
    assert tree(folder) == undisturbed


def test_a_damaged_manifest_is_made_again(tmp_path: Path, undisturbed: dict[str, bytes]):
    generate(SMALL, tmp_path / "d", HERE, make=make)
    manifest = tmp_path / "d" / "dataset.json"
    manifest.write_text(manifest.read_text()[:100])
    with pytest.raises(ValueError, match=r"dataset\.json: not readable as JSON"):
        Dataset.open(tmp_path / "d")
    manifest.unlink()
    with pytest.raises(FileNotFoundError, match=r"dataset\.json: missing; `qsim generate"):
        check(tmp_path / "d")
    generate(SMALL, tmp_path / "d", HERE, make=make)
    assert tree(tmp_path / "d") == undisturbed


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
    env = os.environ | {"PYTHONPATH": PYTHONPATH}
    for _ in range(2):
        children.append(subprocess.Popen([sys.executable, "-c", code, str(folder)], env=env, stdout=subprocess.PIPE))
    made = sorted(int(child.communicate(timeout=60)[0]) for child in children)
    assert made == [0, 3]
    assert tree(folder) == undisturbed


def test_another_recipe_in_the_same_folder_is_refused(tmp_path: Path):
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    for old, new, message in [
        ("frames = 3", "frames = 4", "clip fan_0000 was asked for with other settings"),
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


@pytest.mark.parametrize(("version", "advice"), [(2, "newer qsim"), (0, "make it again")])
def test_other_format_versions(tmp_path: Path, version: int, advice: str):
    generate(SMALL, tmp_path / "d", HERE, make=make)
    manifest = tmp_path / "d" / "dataset.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"format_version": version}))
    for action in (lambda: Dataset.open(tmp_path / "d"), lambda: generate(SMALL, tmp_path / "d", HERE, make=make)):
        with pytest.raises(ValueError, match=f"format version {version}, this qsim reads version 1; .*{advice}"):
            action()


@pytest.mark.parametrize("asset", ["texture abc", "mesh abc"])
def test_what_training_sees_of_the_test_split_is_reported(tmp_path: Path, asset: str):
    generate(SMALL, tmp_path / "d", HERE, make=make)
    for name, assets in [("fan_0001", [asset, "mesh m"]), ("tumble_0004", ["mesh n", asset])]:
        path = tmp_path / "d" / "clips" / name / "clip.json"
        files.write_description(path, files.read_json(path) | {"assets": assets})
    shared = generate(SMALL, tmp_path / "d", HERE, make=make).shared
    assert len(shared) == 1
    assert f"its {asset} is also in fan_0001, which is not a test clip" in shared[0]
    assert shared[0] in Dataset.open(tmp_path / "d").verify()


def test_assets_of_a_scene():
    described = {"kind": "Scene", "bodies": [{"kind": "Body", "mesh": {"kind": "Mesh", "vertices": {"sha256": "m"}},
                 "material": {"kind": "Diffuse", "reflectance": {"kind": "Texture", "image": {"sha256": "t"}}}}],
                 "lights": [{"kind": "EnvironmentImage", "image": "sky.hdr"}]}  # fmt: skip
    assert provenance.assets(described) == ["mesh m", "texture sky.hdr", "texture t"]


def test_a_photograph_in_another_range_is_the_same_photograph():
    """One picture stretched two ways has two checksums: splits that share it must still be told."""
    made = []
    for high in (0.45, 0.7):
        material = Diffuse(Texture(textures.photograph("gravel", 0.15, high)))
        made.append(small_scenes.scene(Body("plate", small_scenes.square(), material)))
    first, second = (set(provenance.assets(scene.to_dict())) for scene in made)
    assert first
    assert not first & second
    assert [provenance.photographs(scene) for scene in made] == [["photograph gravel"], ["photograph gravel"]]


def test_progress_counts_the_frames_of_whoever_renders(tmp_path: Path):
    """Finished clips whole, a clip at work by the lines of its journal, nothing for the others."""
    jobs_wanted = list(SMALL.jobs)
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
