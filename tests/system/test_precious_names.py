"""A file, folder, link or pipe of the user under any name that a writer could take for its own stays as it is.

The names are those that this and earlier versions made from the name of an output.
"""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip

from qsim.cli import main as qsim
from qsim.clip.sensing import Sensing, sense
from qsim.scratch import is_scratch
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


@pytest.mark.parametrize("name", COMMANDS)
def test_nothing_precious_is_touched(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.chdir(tmp_path)
    clip = write_clip(tmp_path / "clip", frames=2, height=12, width=10)
    sense(clip, Sensing("quiver-physical", bits=3, ppp=3.0))
    np.save("light.npy", np.ones((2, 6, 8), np.float32))
    main, words = COMMANDS[name]
    output = next(word for word in words if word.startswith("r") and word != "restore")
    inputs = state(tmp_path)
    for i, ending in enumerate(ENDINGS):
        for kind in [KINDS[i % 4], KINDS[(i + 1) % 4]] if name == "restore" else KINDS:  # it is slower
            (tmp_path / "elsewhere").write_text("far away")
            stem = Path(output).stem
            for taken in {f"{output}{ending}", f"{stem}{ending}", f".{stem}{ending}"} - {output}:
                precious(tmp_path / taken, kind, tmp_path / "elsewhere")
            before = state(tmp_path)
            code = main([*words, "-q"])
            said = capsys.readouterr().err
            after = state(tmp_path)
            assert {key: after.get(key) for key in before} == before, (ending, kind)
            assert code == 0 or (code == 2 and said.count("\n") == 1), (ending, kind, said)
            assert not [key for key in after if is_scratch(Path(key))], (ending, kind)
            for key in sorted(after, reverse=True):
                if key not in inputs and os.path.lexists(key):
                    shutil.rmtree(key) if os.path.isdir(key) and not os.path.islink(key) else os.unlink(key)
