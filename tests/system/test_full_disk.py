"""A full disk under every command that writes: one line that names a file, and nothing left to read."""

import importlib
import mmap
import multiprocessing
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip
from fakes import RECIPE, make, tree

from qsim.cli.program import main
from qsim.dataset import recipe
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import Options, Summary, generate
from qsim.dataset.job_runner import RenderJob
from qsim.formats import exporting, importing
from qsim.formats.exporting import Export
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense


@pytest.fixture
def full(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 KiB."""
    mount = tmp_path / "tmpfs"
    mount.mkdir()
    tried = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(mount)], capture_output=True)
    if tried.returncode != 0:
        pytest.skip("a tmpfs may not be mounted here; an injected full disk is tested in test_dataset.py")
    yield mount
    subprocess.run(["umount", str(mount)], check=True)


def fails_in_one_line(capsys: pytest.CaptureFixture[str], line: str, where: Path) -> None:
    assert main(line.split()) == 2
    error = capsys.readouterr().err.strip()
    assert "\n" not in error
    assert str(where) in error
    assert "No space left on device" in error


@pytest.mark.parametrize("kind", ["cube", "mp4", "png", "exr", "zarr"])
def test_exports(tmp_path: Path, full: Path, kind: str):
    clip = write_clip(tmp_path / "clip", frames=16, height=64, width=128)
    source = sense(clip, Sensing("quiver-physical", 1, ppp=3.25))[0] if kind == "cube" else clip
    (full / "rest").write_bytes(bytes(60 << 10))
    with pytest.raises((OSError, ValueError), match="No space left on device"):
        exporting.export(source, full / "out", Export(kind))
    assert not (full / "out").exists()
    (full / "rest").unlink()
    subprocess.run(["mount", "-o", "remount,size=16m", str(full)], check=True)
    assert exporting.export(source, full / "out", Export(kind)).exists()


def test_sensing_and_importing(tmp_path: Path, full: Path, capsys: pytest.CaptureFixture[str]):
    clip = write_clip(tmp_path / "clip", frames=16, height=64, width=128)
    for name, array in [("codes", np.ones((16, 64, 128), bool)), ("light", np.ones((16, 64, 128), np.float32))]:
        np.save(tmp_path / f"{name}.npy", array)
    (full / "rest").write_bytes(bytes(60 << 10))
    streams = clip.path / "streams"  # on the full disk, without a link, which is refused
    streams.mkdir()
    subprocess.run(["mount", "--bind", str(full), str(streams)], check=True)
    try:
        fails_in_one_line(capsys, f"sense {clip.path} --ppp 3.25 --bits 3", clip.path)
    finally:
        subprocess.run(["umount", str(streams)], check=True)
    assert clip.streams == ()
    for name in ("codes", "light"):
        fails_in_one_line(capsys, f"convert {tmp_path}/{name}.npy {full}/{name} --frame-rate 1000", full)
        assert not [path for path in full.iterdir() if path.name.startswith(name) and not path.name.endswith(".part")]
    with pytest.raises(FileNotFoundError, match=r"unfinished \(only light\.part is there\)|no such clip"):
        importing.Clip.open(full / "light")


# Data sets that are made by two worker processes

SMALL = recipe.parse(RECIPE)
PAIR = Options(workers=2)
_FULL_RENDERER = '''"""As in fakes.py, but for one job the disk is full while the folder holds a file `full`."""

import errno
import os

import fakes


def make(job, path):
    if (path.parents[1] / "full").exists() and job.name == "NAME":
        path.with_name(path.name + ".part").mkdir()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    return fakes.make(job, path)
'''


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("undisturbed") / "small"
    assert generate(SMALL, folder, PAIR, make=make) == Summary(3, 3, 3, {}, ())
    return tree(folder)


def stops_at_a_full_disk(folder: Path, maker: RenderJob) -> str:
    """Generate with two workers on a full disk: one line with the folder and what to do, and all that is read is whole.

    Returns the line.
    """
    with pytest.raises(OSError, match="No space left on device") as caught:
        generate(SMALL, folder, PAIR, make=maker)
    told = str(caught.value)
    assert told.startswith(f"{folder}: No space left on device")
    assert told.endswith("; nothing is lost: make space and run the same command again")
    assert "\n" not in told
    assert multiprocessing.active_children() == []
    if (folder / "dataset.json").is_file():
        found = Dataset.open(folder)
        assert set(found.names()) < {job.name for job in SMALL.jobs}
        assert [problem for problem in found.verify() if ": not made yet;" not in problem] == []
        assert all(len(clip.streams) == 2 for clip in found.clips())
    assert not list(folder.glob("failed/*.json")), "a full disk is not the fault of a job: it is done again unasked"
    return told


def resize(mount: Path, size: int) -> None:
    """Give a tmpfs so many bytes."""
    subprocess.run(["mount", "-o", f"remount,size={size}", str(mount)], check=True)


@pytest.mark.parametrize("pages", [20, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 36))])
def test_two_workers_on_a_disk_that_is_really_full(full: Path, undisturbed: dict[str, bytes], pages: int):
    """Full from the start, in the middle, and near the end: here a file takes a page, and all of them take 38.

    Trying again on the full disk says the same; with space, the same command finishes with the same bytes.
    """
    assert len(undisturbed) + len(SMALL.jobs) == 38, "every job has a log too"
    resize(full, pages * mmap.PAGESIZE)
    for _ in range(2):
        told = stops_at_a_full_disk(full / "d", make)
        assert ("while making" in told) == (pages > 1)  # the lock of the folder takes the only page
    # Of 36 pages the manifest takes 1 and each of the first two jobs at most 15 (13 files, journal, temporary file).
    assert pages < 36 or Dataset.open(full / "d").names()
    resize(full, 16 << 20)
    assert generate(SMALL, full / "d", PAIR, make=make).done == 3
    assert tree(full / "d") == undisturbed


@pytest.mark.parametrize("name", ["tumble_0004", pytest.param("fan_0000", marks=pytest.mark.slow)])
def test_two_workers_of_which_one_meets_a_full_disk(
    tmp_path: Path, undisturbed: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, name: str
):
    """The first job or the last; needs no tmpfs. Worker processes import the renderer from a file of this test."""
    module = f"full_renderer_{name}"
    (tmp_path / f"{module}.py").write_text(_FULL_RENDERER.replace("NAME", name))
    monkeypatch.syspath_prepend(tmp_path)
    maker = importlib.import_module(module).make
    folder = tmp_path / "d"
    folder.mkdir()
    (folder / "locks").mkdir()  # without it the folder would be somebody else's
    (folder / "full").touch()
    told = stops_at_a_full_disk(folder, maker)
    assert f"while making {name};" in told
    done = Dataset.open(folder).names()
    assert name not in done
    assert done or name == "fan_0000", "with two workers the last job begins when another is done"
    (folder / "full").unlink()
    assert generate(SMALL, folder, PAIR, make=maker).done == 3
    assert tree(folder) == undisturbed
