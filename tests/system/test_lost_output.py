"""Progress and messages never decide a result: streams that are full, closed, missing or without a reader."""

from __future__ import annotations

import io
import os
import shlex
import shutil
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TextIO

import numpy as np
import pytest
from clips import write_clip, write_dataset

import qsim.cli
import quiver.cli
from qsim.cli import console
from qsim.terminal import Tolerant

pytestmark = pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")

COMMANDS = (  # each shows progress
    "qsim check lit",
    "qsim sense lit --ppp 3.25 --bits 3",
    "qsim preview lit -o film.gif",
    "qsim report lit -o page.html",
    "qsim explore lit -o sliders.html",
    "qsim convert light.npy video --frame-rate 100 --exposure 1e-3 --transfer linear",
    "quiver restore lit --ppp 3.25 --bits 3 -o restored.npy --method moment",
    "quiver evaluate data -o scores --ppp 3.25 --bits 3 --methods naive",
    "quiver train data -o run --ppp 3.25 --bits 3 --preset mergenet --steps 1 --batch 1 --crop 16",
)
KINDS = ("full", "closed", "missing", "without a reader")
PAIRS = [("missing", "missing"), *((kind, None) for kind in KINDS), *((None, kind) for kind in KINDS)]
LONGER = ("qsim report", "quiver evaluate", "quiver train")  # of these, three pairs


def broken(kind: str) -> TextIO | None:
    """A stream of text, buffered as standard output is."""
    if kind == "full":
        return open("/dev/full", "w")
    if kind == "missing":
        return None
    if kind == "closed":
        closed = io.TextIOWrapper(io.BytesIO())
        closed.close()
        return closed
    reader, writer = os.pipe()
    os.close(reader)
    return os.fdopen(writer, "w")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_clip(folder / "lit", frames=12, height=16, width=24)
    write_dataset(folder / "data", {"train": 1, "val": 1, "test": 1})
    np.save(folder / "light.npy", np.random.default_rng(0).random((3, 8, 10)))
    return folder


def run(line: str) -> int:
    program, *words = shlex.split(line)
    return {"qsim": qsim.cli, "quiver": quiver.cli}[program].main(words)


def results(folder: Path) -> dict[str, bytes]:
    """What a command made: its files, and the contents of those that hold no time."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and "tfevents" not in path.name]
    return {str(p.relative_to(folder)): p.read_bytes() if p.suffix == ".npy" else b"" for p in files}


@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_does_its_work_whatever_happens_to_its_output(line, inputs, tmp_path, monkeypatch):
    monkeypatch.setattr(console, "SHOWN_AFTER", 0)  # the bars of short work, too
    made = []
    pairs = [("missing", "missing"), ("full", None), (None, "full")] if line.startswith(LONGER) else PAIRS
    for out, err in pairs:
        here = tmp_path / f"{out}-{err}"
        shutil.copytree(inputs, here)
        monkeypatch.chdir(here)
        printed, said = (broken(kind) if kind else io.StringIO() for kind in (out, err))
        with redirect_stdout(printed), redirect_stderr(said):
            code = run(line)
        message = said.getvalue() if err is None else ""
        assert code == (1 if out in ("full", "closed") else 0), message
        assert ("its report is lost" in message) == (code == 1)
        for stream in (printed, said):
            if stream is not None:
                stream.close()  # as at the end of the interpreter: nothing is left to write
        made.append(results(here))
    assert all(found == made[0] for found in made)


@pytest.mark.parametrize(
    ("line", "redirection", "code"),
    [
        ("qsim check lit", "2>/dev/full", 0),
        ("qsim check lit", ">/dev/full", 1),
        ("qsim --version", ">/dev/full", 1),
        ("qsim sense lit --ppp 3.25 --bits 3", "0<&- 1>&- 2>&-", 0),
    ],
)
def test_the_interpreter_ends_as_the_command_did(line, redirection, code, inputs, tmp_path):
    """It writes what streams keep when it ends; and a data file must not take the number of a closed stream."""
    shutil.copytree(inputs / "lit", tmp_path / "lit")
    words = f"exec {shlex.quote(sys.executable)} -m {line} {redirection}"
    ended = subprocess.run(["/bin/sh", "-c", words], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == code
    assert "Exception ignored" not in ended.stderr
    if "sense" in line:
        assert qsim.cli.main(["check", str(tmp_path / "lit")]) == 0


def test_characters_that_the_terminal_lacks_are_escaped():
    kept = io.BytesIO()
    stream = Tolerant(io.TextIOWrapper(kept, encoding="ascii"))
    stream.write("1.1 µm\n")
    stream.flush()
    assert kept.getvalue() == b"1.1 \\xb5m\n"
    assert stream.failure is None
