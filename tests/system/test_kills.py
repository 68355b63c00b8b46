"""Every command that writes, killed at a file operation: the same command ends in the right result, or names the cure.

The right result is that of a run that nothing disturbed, with no file beside it. `-m slow` kills at every operation.
"""

from __future__ import annotations

import random
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip, write_dataset
from kill_server import KillServer

from qsim.sensor.counting import CountingSPAD
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense

LINES = {  # what writes -> what it reads
    "qsim sense clip --ppp 3 --bits 3 --name n": ("clip",),
    "qsim convert codes.npy c --layout codes --bits 3 --frame-rate 9": ("codes.npy",),
    "qsim convert light.npy c --transfer linear --frame-rate 9": ("light.npy",),
    **{f"qsim convert clip e --to {kind}": ("clip",) for kind in ("png", "exr", "nerfstudio", "zarr")},
    **{f"qsim convert clip/streams/b.json e --to {kind}": ("clip",) for kind in ("cube", "spike")},
    "qsim convert clip/streams/f.json e --to photons": ("clip",),
    "qsim convert clip e.mp4": ("clip",),
    "qsim convert clip e.h5 --to pairs --window 2": ("clip",),
    "qsim preview clip -o p.png --frame 0": ("clip",),
    "qsim preview clip -o p.gif": ("clip",),
    "qsim preview clip -o p.mp4": ("clip",),
    "qsim report clip -o r.html": ("clip",),
    "qsim explore clip -o x.html": ("clip",),
    "qsim calibrate --model spad --bits 1 --dark planes.npy 1e-5 -o s.toml": ("planes.npy",),
    "qsim tradeoff fast --ppp 3 --bits 1,2 -o st": ("fast",),
    "quiver restore clip --stream s -o r.npy --method moment": ("clip",),
    "quiver evaluate clip -o table --methods naive,moment --ppp 3": ("clip",),
    "quiver bench --methods moment --size 16x16 -o b": (),
    "quiver train data -o run --preset unet --protocol control --steps 2 --crop 16 --batch 1": ("data",),
}


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the lines name."""
    folder = tmp_path_factory.mktemp("work")
    rng = np.random.default_rng(0)
    clip = write_clip(folder / "clip", frames=4, height=16, width=24)
    sense(clip, Sensing("quiver-physical", bits=3, ppp=3.25, name="s"))
    sense(clip, Sensing("spad-320x240", name="b"))
    sense(clip, Sensing(CountingSPAD(0.5, 100.0, 2e-5, 3), ppp=3, follow=True, name="f"))
    write_clip(folder / "fast", frames=16, height=16, width=24, frame_rate=20000.0, exposure=5e-5)
    write_dataset(folder / "data", {"train": 1, "val": 1}, frames=12, height=16, width=24)
    np.save(folder / "codes.npy", rng.integers(0, 4, (3, 16, 24)).astype(np.uint8))
    np.save(folder / "light.npy", rng.integers(0, 60000, (3, 16, 24)).astype(np.uint16))
    np.save(folder / "planes.npy", (rng.random((200, 6, 8)) < 0.01).astype(np.uint8))
    return folder


@pytest.fixture(scope="module")
def server() -> Iterator[KillServer]:
    with KillServer() as found:
        yield found


def state(folder: Path) -> dict[str, bytes]:
    """Every file by its path."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    files = [path for path in files if not path.name.startswith("events.out.tfevents")]  # named by time and process
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


class Search:
    """Runs one command line, undisturbed and killed."""

    def __init__(self, server: KillServer, work: Path, folder: Path, line: str) -> None:
        self.server = server
        self.work = work
        self.folder = folder
        self.line = line
        self.runs = 0
        first, self.events = self.undisturbed()
        second, _ = self.undisturbed()
        assert set(first) == set(second)
        self.right = {name: content for name, content in first.items() if second[name] == content}
        self.names = set(first)

    def place(self) -> Path:
        """A new copy of what the line reads."""
        self.runs += 1
        place = self.folder / f"{self.runs}" / "w"
        place.mkdir(parents=True)
        for name in LINES[self.line]:
            source = self.work / name
            if source.is_dir():
                shutil.copytree(source, place / name)
            else:
                shutil.copy(source, place / name)
        return place

    def undisturbed(self) -> tuple[dict[str, bytes], int]:
        """The files that the command leaves, and how many operations it takes."""
        place = self.place()
        code, events, told = self.server.run(place, self.line)
        assert code == 0, told
        return state(place), events

    def killed(self, step: int, force: bool) -> None:
        """Kill the command at an operation, run it again, and compare; with `force` over a finished result."""
        place = self.place()
        line = self.line
        if force:
            code, _, told = self.server.run(place, line)
            assert code == 0, told
            line += " --force"
        code, _, told = self.server.run(place, line, step)
        assert code in (0, -9), f"{line}, killed at {step}: {told}"
        code, _, told = self.server.run(place, line)
        if code == 2 and not force:
            assert "--force" in told, f"{line}, killed at {step}, again: {told}"
            line += " --force"
            code, _, told = self.server.run(place, line)
        assert code == 0, f"{line}, killed at {step}, again: {told}"
        found = state(place)
        assert set(found) == self.names, f"{line}, killed at {step}: {set(found) ^ self.names}"
        changed = [name for name, content in self.right.items() if found[name] != content]
        assert not changed, f"{line}, killed at {step}: {changed}"
        shutil.rmtree(place.parent)


QUICK = (
    "qsim convert codes.npy c --layout codes --bits 3 --frame-rate 9",
    "qsim convert clip e --to png",
    "qsim convert clip e.mp4",
    "qsim preview clip -o p.gif",
    "qsim explore clip -o x.html",
)


@pytest.mark.parametrize("line", QUICK)
def test_a_killed_command_is_finished_by_the_same_command(line, server, work, tmp_path):
    search = Search(server, work, tmp_path, line)
    steps = random.Random(line).sample(range(1, search.events + 1), 2)
    search.killed(steps[0], force=False)
    search.killed(steps[1], force=True)


@pytest.mark.slow
@pytest.mark.parametrize("line", LINES)
def test_a_command_killed_anywhere_is_finished_by_the_same_command(line, server, work, tmp_path):
    search = Search(server, work, tmp_path, line)
    faults = []
    for force in (False, True):
        for step in range(1, search.events + 3 * force):  # with --force there is more to remove
            try:
                search.killed(step, force)
            except AssertionError as error:
                faults.append(str(error).partition("\n")[0])
    assert not faults, "\n".join(faults)
