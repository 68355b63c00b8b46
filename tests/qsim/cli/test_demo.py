"""Tests the demo: every command that it runs is one that the programs take, and a failure names its step."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from option_rows import parser_of

import qsim.cli.program
import quiver.cli.program
from qsim.cli import demo

PARSERS = {
    "qsim": parser_of(qsim.cli.program.main, qsim.cli.program),
    "quiver": parser_of(quiver.cli.program.main, quiver.cli.program),
}


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, list[str]]]:
    """The commands of the demo, parsed in place of being run."""
    found: list[tuple[str, list[str]]] = []

    def parse(words: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        program, arguments = words[2], words[3:]
        args = PARSERS[program].parse_args(arguments)
        found.append((program, arguments))
        if args.command == "generate":
            args.output.mkdir()
            jobs = {"a": {"split": "train"}, "b": {"split": "test"}}
            (args.output / "dataset.json").write_text(json.dumps({"jobs": jobs}))
        return subprocess.CompletedProcess(words, 0, stdout="{}")

    monkeypatch.setattr(subprocess, "run", parse)
    return found


def test_every_step_is_a_command_of_the_programs(ran, tmp_path: Path):
    demo.steps(tmp_path, quiet=False)
    commands = [f"{program} {words[0]}" for program, words in ran]
    assert commands == [
        *("qsim generate", "quiver train", "quiver restore", "quiver restore", "qsim convert", "qsim sense"),
        *("quiver restore", "quiver evaluate", "quiver evaluate", "qsim report"),
    ]
    assert ran[0][1][1] == "demo"
    train = PARSERS["quiver"].parse_args(ran[1][1])
    assert (train.preset, train.start, train.minutes) == ("mergenet", "mergenet", 2)
    assert np.load(tmp_path / "ball_12bit.npy").shape == (15, 384, 384)
    assert all(Path(word).is_file() for _, words in ran for word in words if word.endswith(".npz"))


def test_a_finished_restoration_is_not_repeated(ran, tmp_path: Path):
    (tmp_path / "b_shipped.json").touch()
    demo.steps(tmp_path, quiet=True)
    restored = [words for program, words in ran if words[0] == "restore"]
    assert len(restored) == 2
    assert all("--quiet" in words for _, words in ran)


def test_a_failed_step_is_named(tmp_path: Path, monkeypatch, capsys):
    def fail(words: list[str], **_: object) -> None:
        raise subprocess.CalledProcessError(1, words)

    monkeypatch.setattr(subprocess, "run", fail)
    assert qsim.cli.program.main(["demo", str(tmp_path / "d"), "-q"]) == 1
    assert "stopped at 'qsim generate demo -o" in capsys.readouterr().err
