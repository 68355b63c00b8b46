"""Tests the demo: every command that it runs is one that the programs take, and a failure names its step."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fakes import write_records

import qsim.cli.program
import quiver.cli.program
from qsim.cli import demo

PROGRAMS = {"qsim": qsim.cli.program.PROGRAM, "quiver": quiver.cli.program.PROGRAM}


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, list[str]]]:
    """The commands of the demo, parsed in place of being run."""
    found: list[tuple[str, list[str]]] = []

    def parse(words: list[str], capture: bool) -> str:
        program = words[2]
        arguments = words[3:]
        _, values = PROGRAMS[program].read(arguments)
        found.append((program, arguments))
        if arguments[0] == "generate":
            values["output"].mkdir()
            write_records(values["output"])
        return "{}"

    monkeypatch.setattr(demo, "call", parse)
    return found


def test_every_step_is_a_command_of_the_programs(ran, tmp_path: Path):
    demo.steps(tmp_path, quiet=False)
    commands = [f"{program} {words[0]}" for program, words in ran]
    assert commands == [
        *("qsim generate", "quiver train", "quiver restore", "quiver restore", "qsim convert", "qsim sense"),
        *("quiver restore", "quiver evaluate", "quiver evaluate", "qsim report"),
    ]
    assert ran[0][1][1] == "demo"
    _, train = PROGRAMS["quiver"].read(ran[1][1])
    assert (train["network"], train["start"], train["minutes"]) == ("mergenet", "mergenet", 2)
    assert np.load(tmp_path / "ball_12bit.npy").shape == (15, 384, 384)
    assert all(Path(word).is_file() for _, words in ran for word in words if word.endswith(".npz"))


def test_a_finished_restoration_is_not_repeated(ran, tmp_path: Path):
    (tmp_path / "b_0000_shipped.json").touch()
    demo.steps(tmp_path, quiet=True)
    restored = [words for program, words in ran if words[0] == "restore"]
    assert len(restored) == 2
    assert all("--quiet" in words for _, words in ran)


def test_a_failed_step_is_named(tmp_path: Path, monkeypatch, capsys):
    def fail(words: list[str], capture: bool) -> None:
        raise subprocess.CalledProcessError(1, words)

    monkeypatch.setattr(demo, "call", fail)
    assert qsim.cli.program.main(["demo", str(tmp_path / "d"), "-q"]) == 1
    told = capsys.readouterr().err
    assert "stopped at 'qsim generate demo -o" in told
    assert told.endswith(f"; `qsim demo {tmp_path / 'd'}` resumes there\n")
    assert qsim.cli.program.main(["demo", str(tmp_path / "d"), "--json"]) == 1
    out, err = capsys.readouterr()
    assert json.loads(out) == {"error": err.strip(), "exit_code": 1}


def test_a_step_returns_what_it_printed_or_its_failure():
    assert demo.call([sys.executable, "-c", "print(3)"], True) == "3\n"
    assert demo.call([sys.executable, "-c", ""], False) == ""
    with pytest.raises(subprocess.CalledProcessError) as failed:
        demo.call([sys.executable, "-c", "raise SystemExit(3)"], False)
    assert failed.value.returncode == 3


def test_ctrl_c_waits_for_the_step_which_saves_its_state(tmp_path: Path):
    """A step that needs a second after SIGINT, as a training does, is not killed before."""
    (tmp_path / "child.py").write_text(
        "import pathlib, signal, time\n"
        "signal.signal(signal.SIGINT, lambda *_: (time.sleep(1), pathlib.Path('saved').touch(), exit(130)))\n"
        "pathlib.Path('ready').touch()\n"
        "time.sleep(60)\n"
    )
    code = "import sys; from qsim.cli import demo; demo.call([sys.executable, 'child.py'], True)"
    root = Path(__file__).parents[3]
    parent = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(root)},
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # shells ignore it in what they put behind
    )
    end = time.monotonic() + 60
    while not (tmp_path / "ready").exists():
        assert time.monotonic() < end
        time.sleep(0.02)
    os.killpg(parent.pid, signal.SIGINT)  # as a terminal does
    _, err = parent.communicate(timeout=60)
    assert (tmp_path / "saved").exists()
    assert b"KeyboardInterrupt" in err
