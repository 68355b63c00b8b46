"""A quick, deterministic renderer for tests, with variants that are slow or broken.

It is not in a test module, so that worker processes can import it by name.
"""

import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from qsim import descriptions, records
from qsim.clip.clip_info import PHYSICAL
from qsim.clip.writer import ClipWriter
from qsim.dataset import recipe
from qsim.dataset.dataset import Dataset, DatasetInfo
from qsim.dataset.generation import Options
from qsim.dataset.job import Job
from qsim.dataset.provenance import origin
from qsim.dataset.series import Series
from qsim.optics.camera import Camera
from qsim.streams.clip import Clip

RECIPE = """[recipe]
name = "small"
frames = 3
height = 8
width = 10
frame_rate = 2000.0

[[scenes]]
family = "fan"
seeds = [0, 1]

[[scenes]]
family = "tumble"
seeds = [4]
split = "test"
frames = 2

[[streams]]
sensor = "quiver-physical"
bits = [1, 3]
ppp = 3.25
"""

SMALL = recipe.parse(RECIPE)
HERE = Options(workers=0)
SUPPORT = f"{Path(__file__).parents[2]}{os.pathsep}{Path(__file__).parent}"  # PYTHONPATH of children; packages first


def make(job: Job, path: Path) -> Clip:
    """Make a clip of moving noise, a function of the job alone."""
    settings = job.settings
    camera = Camera(8e-3, 2.8, 1.1e-6, settings.height, settings.width)
    meta = {
        "shape": [settings.frames, settings.height, settings.width],
        "frame_rate": settings.frame_rate,
        "shutter": settings.shutter,
        "exposure": 1 / settings.frame_rate,
        "radiance_unit": PHYSICAL,
        "camera": records.plain(camera),
    }
    with ClipWriter(path, meta | records.plain(origin(job))) as writer:
        for t in range(settings.frames):
            if not writer.has(t):
                rng = np.random.default_rng([job.scene_seed, len(job.family), t])
                radiance = rng.random((settings.height, settings.width))
                truth = {"flow": rng.normal(size=(2, settings.height, settings.width))}
                writer.add(t, radiance, truth=truth, error=1e-3)
    return Clip.open(path)


def make_slowly(job: Job, path: Path) -> Clip:
    """Make the same clip after a pause in which the process can be killed."""
    time.sleep(0.4)
    return make(job, path)


def make_once_allowed(job: Job, path: Path) -> Clip:
    """Make the same clip when a file `go` is in the data set's folder."""
    end = time.monotonic() + 120
    while not (path.parents[1] / "go").exists() and time.monotonic() < end:
        time.sleep(0.02)
    return make(job, path)


def fail_on_tumble(job: Job, path: Path) -> Clip:
    """Fail as a bad scene does."""
    if job.family == "tumble":
        raise ValueError("scene tumble: no light and no glowing body")
    return make(job, path)


def crash_on_tumble(job: Job, path: Path) -> Clip:
    """End as a process without memory does."""
    if job.family == "tumble":
        os.kill(os.getpid(), signal.SIGKILL)
    return make(job, path)


def hoard_on_tumble(job: Job, path: Path) -> Clip:
    """Take more memory than a worker may."""
    if job.family == "tumble":
        hoard = np.ones(1 << 27)  # 1 GiB
        time.sleep(20)
        del hoard
    return make(job, path)


def tree(folder: Path) -> dict[str, bytes]:
    """Return every file of a finished data set by name, without logs and locks."""
    kept = ("dataset.json", "clips", "jobs")
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.relative_to(folder).parts[0] in kept
    }


def make_with_pause(job: Job, path: Path) -> Clip:
    """Make the same clip, and wait after each frame for a file `go` in the data set's folder."""
    add = ClipWriter.add

    def add_and_wait(writer: ClipWriter, *args: Any, **kwargs: Any) -> None:
        add(writer, *args, **kwargs)
        end = time.monotonic() + 120
        while not (path.parents[1] / "go").exists() and time.monotonic() < end:
            time.sleep(0.02)

    with mock.patch.object(ClipWriter, "add", add_and_wait):
        return make(job, path)


def damage(path: Path, kind: str) -> None:
    """Damage a file: "missing", "truncated" or "bit-flipped"."""
    content = bytearray(path.read_bytes())
    if kind == "missing":
        path.unlink()
    elif kind == "truncated":
        path.write_bytes(content[: len(content) // 2])
    else:
        content[len(content) // 2] ^= 4
        path.write_bytes(content)


def problems_of(folder: Path) -> list[str]:
    """Return the problems that `qsim check` reports."""
    try:
        return Dataset.open(folder).verify()
    except (ValueError, OSError) as error:
        return [str(error)]


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait until a condition holds; fail after `seconds`."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def moved(folder: Path, name: str, place: Path) -> Path:
    """Move a clip to another disk and put a link in its place."""
    shutil.move(folder / "clips" / name, place)
    (folder / "clips" / name).symlink_to(place)
    return folder / "clips" / name


def write_records(folder: Path) -> None:
    """Write a data set of two finished clips, a_0000 to train and b_0000 to test, as far as their names."""
    series = [
        Series(stem=stem, seeds=0, split=split, digest="0" * 64) for stem, split in (("a", "train"), ("b", "test"))
    ]
    descriptions.write(folder / "dataset.json", DatasetInfo(name="demo", scenes=tuple(series)))
    (folder / "jobs").mkdir(exist_ok=True)
    for each in series:
        (folder / "jobs" / f"{each.stem}_0000.json").touch()
