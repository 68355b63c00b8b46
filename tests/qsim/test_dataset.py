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
from fakes import RECIPE, die_on_tumble, fail_on_tumble, hoard_on_tumble, make, make_slowly, tree
from forks import forked

from qsim import files, jobs, recipe
from qsim.dataset import Dataset
from qsim.generation import Options, Summary, generate
from qsim.jobs import Make
from qsim.workers import Limits

TESTS = Path(__file__).parents[1]
PYTHONPATH = f"{TESTS.parent}{os.pathsep}{TESTS}"  # of child processes; the package first: tests/qsim is no package
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


def test_a_killed_parent_leaves_no_workers_and_its_folder_resumes(tmp_path: Path, undisturbed: dict[str, bytes]):
    folder = tmp_path / "d"
    code = "import sys; from fakes import *; from qsim import recipe; from qsim.generation import *;"
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
        for module in (files, jobs):
            patch.setattr(module, "open", measure.open, raising=False)
        generate(SMALL, tmp_path / "whole", HERE, make=make)
    needed = (1 << 30) - measure.space
    for step in range(10):
        folder = tmp_path / f"d{step}"
        disk = FullDisk(needed * step // 10)
        with monkeypatch.context() as patch:
            for module in (files, jobs):
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
        for module in (files, jobs):
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
    ("maker", "why"),
    [(die_on_tumble, "signal SIGKILL"), (hoard_on_tumble, "more memory than --memory")],
)
def test_a_dying_worker_takes_down_only_its_job(tmp_path: Path, maker: Make, why: str):
    options = Options(workers=2, limits=Limits(memory=0.7))
    summary = generate(SMALL, tmp_path / "d", options, make=maker)
    assert summary.done == 2
    assert list(summary.failed) == ["tumble_0004"]
    assert "died 2 times" in summary.failed["tumble_0004"]
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
        if name == "dataset.json":
            continue
        damage(folder / name, kind)
        problems = Dataset.open(folder).verify()
        assert any(Path(name).stem in problem for problem in problems), f"{name}: {problems}"
        kept = {path: path.stat().st_ino for path in folder.glob("clips/*") if path.name not in name}
        summary = generate(SMALL, folder, Options(workers=0, repair=True), make=make)
        assert summary.made == 1, name
        assert tree(folder) == undisturbed, name
        assert kept == {path: path.stat().st_ino for path in kept}


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
    generate(SMALL, tmp_path / "d", HERE, make=make)
    assert tree(tmp_path / "d") == undisturbed


def test_two_generators_on_one_folder(tmp_path: Path):
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    lock = files.Lock(folder / "locks" / "generate")
    assert lock.acquire()
    with pytest.raises(ValueError, match="another generator is at work here"):
        generate(SMALL, folder, HERE, make=make)
    with pytest.raises(ValueError, match="another generator is at work here"):
        generate(SMALL, folder, Options(workers=0, shard=(1, 2)), make=make)
    lock.release()
    shard = files.Lock(folder / "locks" / "generate", shared=True)
    assert shard.acquire()
    assert generate(SMALL, folder, Options(workers=0, shard=(1, 2)), make=make).done == 2
    with pytest.raises(ValueError, match="another generator is at work here"):
        generate(SMALL, folder, HERE, make=make)
    shard.release()


def test_the_second_generator_waits_when_asked(tmp_path: Path, undisturbed: dict[str, bytes]):
    """Two at once: the first makes everything, the second finds it done."""
    folder = tmp_path / "d"
    children = []
    code = "import sys; from fakes import *; from qsim import recipe; from qsim.generation import *;"
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
        path.write_text(json.dumps(json.loads(path.read_text()) | {"assets": assets}))
    shared = generate(SMALL, tmp_path / "d", HERE, make=make).shared
    assert len(shared) == 1
    assert f"its {asset} is also in fan_0001, which is not a test clip" in shared[0]
    assert shared[0] in Dataset.open(tmp_path / "d").verify()


def test_assets_of_a_scene():
    described = {"kind": "Scene", "bodies": [{"kind": "Body", "mesh": {"kind": "Mesh", "vertices": {"sha256": "m"}},
                 "material": {"kind": "Diffuse", "reflectance": {"kind": "Texture", "image": {"sha256": "t"}}}}],
                 "lights": [{"kind": "EnvironmentImage", "image": "sky.hdr"}]}  # fmt: skip
    assert jobs.assets(described) == ["mesh m", "texture sky.hdr", "texture t"]
