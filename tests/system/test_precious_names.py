"""A file, folder, link or pipe of the user under any name that a writer could take for its own stays as it is.

The names are those that this and earlier versions made from the name of an output.
"""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip, write_dataset
from fakes import write_records
from waves import wave_clip

from qsim.cli import demo
from qsim.cli import main as qsim
from qsim.scratch import is_scratch
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from quiver.cli import main as quiver

ENDINGS = (".part", ".part.json", ".lock", ".json", ".tmp-2", ".removed-20260102", ".tmp", ".new.safetensors", ".npy")
KINDS = ("file", "folder", "link", "pipe")
COMMANDS: dict[str, tuple[Callable[[list[str]], int], list[str]]] = {
    "preview": (qsim, ["preview", "clip", "-o", "r.png"]),
    "png": (qsim, ["convert", "clip", "r", "--to", "png"]),
    "mp4": (qsim, ["convert", "clip", "r.mp4", "--to", "mp4"]),
    "import": (qsim, ["convert", "light.npy", "r", "--frame-rate", "9", "--transfer", "linear"]),
    "restore": (quiver, ["restore", "clip", "-o", "r.npy", "--method", "moment"]),
}


def precious(path: Path, kind: str, elsewhere: Path) -> None:
    match kind:
        case "file":
            path.write_text("years of work")
        case "folder":
            path.mkdir()
            (path / "precious").touch()
        case "link":
            path.symlink_to(elsewhere)
        case "pipe":
            os.mkfifo(path)


def state(place: Path) -> dict[str, object]:
    """Return what lies below a folder: kinds, links and contents."""
    found: dict[str, object] = {}
    for path in sorted(place.rglob("*")):
        name = path.relative_to(place).as_posix()
        if path.is_symlink():
            found[name] = os.readlink(path)
        else:
            found[name] = path.read_bytes() if path.is_file() else os.lstat(path).st_mode
    return found


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The present folder, with the inputs of all commands."""
    monkeypatch.chdir(tmp_path)
    clip = write_clip(tmp_path / "clip", frames=2, height=12, width=10)
    sense(clip, Sensing("quiver-physical", bits=3, ppp=3.0))
    np.save("light.npy", np.ones((2, 6, 8), np.float32))
    return tmp_path


def clean(inputs: dict[str, object]) -> None:
    """Delete everything but the inputs."""
    for key in sorted(state(Path()), reverse=True):
        if key not in inputs and os.path.lexists(key):
            shutil.rmtree(key) if os.path.isdir(key) and not os.path.islink(key) else os.unlink(key)


@pytest.mark.parametrize("name", COMMANDS)
def test_nothing_precious_is_touched(name: str, place: Path, capsys):
    main, words = COMMANDS[name]
    output = next(word for word in words if word.startswith("r") and word != "restore")
    inputs = state(place)
    for i, ending in enumerate(ENDINGS):
        for kind in [KINDS[i % 4], KINDS[(i + 1) % 4]] if name == "restore" else KINDS:  # it is slower
            (place / "elsewhere").write_text("far away")
            for taken in names_beside(output, ending):
                precious(place / taken, kind, place / "elsewhere")
            before = state(place)
            code = main([*words, "-q"])
            said = capsys.readouterr().err
            after = state(place)
            assert {key: after.get(key) for key in before} == before, (ending, kind)
            assert code == 0 or (code == 2 and said.count("\n") == 1), (ending, kind, said)
            assert not [key for key in after if is_scratch(Path(key))], (ending, kind)
            clean(inputs)


# Commands that work longer: all names at once, and each name that they write


def names_beside(output: str, ending: str) -> set[str]:
    """Return the names with an ending that a writer could take beside an output."""
    stem = Path(output).stem
    return {f"{output}{ending}", f"{stem}{ending}", f".{stem}{ending}"} - {output}


LONGER: dict[str, tuple[Callable[[list[str]], int], str]] = {
    "report": (qsim, "report clip -o r.html"),
    "explore": (qsim, "explore clip -o r.html"),
    "tradeoff": (qsim, "tradeoff wave --ppp 1 --bits 1 --instants 1 -o r"),
    "calibrate": (qsim, "calibrate --summed 50 --dark dark.npy 1e-5 -o r.toml"),
    "train": (quiver, "train set -o r --preset unet --steps 1 --crop 16 --batch 1"),
    "evaluate": (quiver, "evaluate set -o r --methods moment"),
    "bench": (quiver, "bench --methods moment --size 16x16 -o r"),
    "demo": (qsim, "demo r"),
}


SLOW = {"bench"}
NAMES = [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in LONGER]


@pytest.fixture
def longer(place: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """More inputs, and a demo whose steps write one file each; return the state before any command."""
    write_dataset(place / "set", {"train": 1, "val": 1, "test": 1})
    wave_clip(place / "wave", 3, 1)
    planes = np.random.default_rng(0).binomial(50, 0.2, (4, 6, 8)).astype(np.uint8)
    np.save("dark.npy", planes)

    def call(words: list[str], capture: bool) -> str:
        if words[3] == "generate":
            (place / "r" / "data").mkdir(exist_ok=True)
            write_records(place / "r" / "data")
        return "{}"

    monkeypatch.setattr(demo, "call", call)
    monkeypatch.setattr(demo, "MEASUREMENTS", place)
    np.savez("ball_12bit.npz", frames=np.ones((1, 2, 2), np.uint16))
    (place / "elsewhere").write_text("far away")
    return state(place)


def written(name: str) -> tuple[int, dict[str, object]]:
    main, words = LONGER[name]
    return main([*words.split(), "-q"]), state(Path())


@pytest.mark.parametrize("shift", range(2))
@pytest.mark.parametrize("name", NAMES)
def test_nothing_precious_beside_an_output_is_touched(name: str, shift: int, longer, place: Path, capsys):
    output = LONGER[name][1].split(" -o ")[-1].split()[0].removeprefix("demo ") if name != "demo" else "r"
    for i, ending in enumerate(ENDINGS):
        for taken in names_beside(output, ending):
            if not os.path.lexists(taken):
                precious(place / taken, KINDS[(i + 2 * shift) % 4], place / "elsewhere")
    before = state(place)
    code, after = written(name)
    said = capsys.readouterr().err
    assert {key: after.get(key) for key in before} == before
    assert code in (0, 1) or said.count("\n") == 1, said
    assert not [key for key in after if is_scratch(Path(key))]


@pytest.mark.parametrize("name", NAMES)
def test_no_file_of_an_output_replaces_another_without_force(name: str, longer, place: Path, capsys):
    """Every name that the command writes is taken in turn, by a file and by a link to a file elsewhere."""
    code, made = written(name)
    assert code in (0, 1), capsys.readouterr().err
    names = [key for key in made if key not in longer and not (place / key).is_dir()]
    assert names
    for i, taken in enumerate(names):
        clean(longer)
        (place / taken).parent.mkdir(parents=True, exist_ok=True)
        precious(place / taken, ("file", "link")[i % 2], place / "elsewhere")
        before = state(place)
        code, after = written(name)
        said = capsys.readouterr().err
        assert {key: after.get(key) for key in before} == before, (taken, said)
        assert code == 2, (taken, said)
        assert said.count("\n") == 1, (taken, said)
