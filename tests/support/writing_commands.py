"""The command lines that write, what they read, and the search for what an interruption leaves of them."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
from clips import write_clip, write_dataset
from kill_server import KillServer

from qsim.sensor.counting import CountingSPAD
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense

LINES = {  # what writes -> what it reads
    "qsim sense clip --ppp 3 --bits 3 --name n": ("clip",),
    "qsim events clip --ppp 300 --camera dvs --name n": ("clip",),
    **{f"qsim convert clip/events/e.json e.{kind}": ("clip",) for kind in ("h5", "npz")},
    "qsim convert codes.npy c --layout codes --bits 3 --frame-rate 9": ("codes.npy",),
    "qsim convert light.npy c --transfer linear --frame-rate 9": ("light.npy",),
    "qsim convert light.npy c --transfer linear --frame-rate 9 --rate 18": ("light.npy",),
    **{f"qsim convert clip e --to {kind}": ("clip",) for kind in ("png", "exr", "nerfstudio", "zarr")},
    **{f"qsim convert clip/streams/b.json e --to {kind}": ("clip",) for kind in ("cube", "spike")},
    "qsim convert clip/streams/f.json e --to photons": ("clip",),
    "qsim convert clip e.mp4": ("clip",),
    "qsim convert clip e.h5 --to pairs --window 2": ("clip",),
    **{f"qsim publish data -o e --to {kind}": ("data",) for kind in ("webdataset", "parquet", "hdf5", "zarr")},
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

# These hold seconds of their run, which two runs may round to the same.
MEASURED = re.compile(
    r"b/bench.*|run/(checkpoint.pt|curve.png|history.json)|table/(evaluation.(json|md)|rows.*)|r.json"
)


def write_work(folder: Path) -> None:
    """Write what the lines name."""
    rng = np.random.default_rng(0)
    clip = write_clip(folder / "clip", frames=4, height=16, width=24)
    sense(clip, Sensing("quiver-physical", bits=3, ppp=3.25, name="s"))
    sense(clip, Sensing("spad-320x240", name="b"))
    sense(clip, Sensing(CountingSPAD(0.5, 100.0, 2e-5, 3), ppp=3, follow=True, name="f"))
    clip.sense_events("dvs", ppp=300, name="e")
    write_clip(folder / "fast", frames=16, height=16, width=24, frame_rate=20000.0, exposure=5e-5)
    write_dataset(folder / "data", {"train": 1, "val": 1}, frames=12, height=16, width=24)
    np.save(folder / "codes.npy", rng.integers(0, 4, (3, 16, 24)).astype(np.uint8))
    np.save(folder / "light.npy", rng.integers(0, 60000, (3, 16, 24)).astype(np.uint16))
    np.save(folder / "planes.npy", (rng.random((200, 6, 8)) < 0.01).astype(np.uint8))


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
        same = {name: content for name, content in first.items() if second[name] == content}
        self.right = {name: content for name, content in same.items() if not MEASURED.fullmatch(name)}
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
        self.compare(place, f"{line}, killed at {step}")
        shutil.rmtree(place.parent)

    def compare(self, place: Path, what: str) -> None:
        """Assert that a folder holds the right files, and no others."""
        found = state(place)
        assert set(found) == self.names, f"{what}: {set(found) ^ self.names}"
        changed = [name for name, content in self.right.items() if found[name] != content]
        assert not changed, f"{what}: {changed}"
