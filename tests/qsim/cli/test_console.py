"""Tests completion of every option, quiet and verbose runs, warnings in one line, Ctrl-C."""

import json
import shlex
import shutil
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip
from PIL import Image
from waves import wave_clip

import qsim.cli.program
import quiver.cli.program
from qsim.cli import console
from qsim.cli.command import Printing
from qsim.cli.program import main
from qsim.clip.writer import ClipWriter
from qsim.streams.clip import Clip

ROOT = Path(__file__).parents[3]
PROGRAMS = {"qsim": qsim.cli.program, "quiver": quiver.cli.program}


def completion(capsys: pytest.CaptureFixture[str], program: str, shell: str) -> str:
    assert PROGRAMS[program].main(["completion", shell]) == 0
    return capsys.readouterr().out


def complete(script: str, program: str, *words: str, cwd: Path) -> list[str]:
    """What a real bash offers for the last word."""
    (cwd / program).write_text(f'#!/bin/sh\nexec {sys.executable} -m {program} "$@"\n')
    (cwd / program).chmod(0o755)
    code = (
        f'{script}\nPATH="$PWD:$PATH" COMP_WORDS=({program} "$@"); COMP_CWORD=$#; _{program}; '
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "-c", code, "bash", *words], capture_output=True, text=True, check=True, cwd=cwd)
    return done.stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
def test_bash_completes_commands_options_and_choices(capsys, tmp_path):
    script = completion(capsys, "qsim", "bash")
    assert complete(script, "qsim", "re", cwd=tmp_path) == ["render", "recipes", "report"]
    assert complete(script, "qsim", "render", "--fr", cwd=tmp_path) == ["--frames", "--frame-rate"]
    assert complete(script, "qsim", "calibrate", "--model", "", cwd=tmp_path) == ["qis", "spad"]
    assert complete(script, "qsim", "validate", "s", cwd=tmp_path) == ["sensor"]


@pytest.mark.parametrize(
    ("program", "words", "offered"),
    [
        ("qsim", "render fa", "fan"),
        ("qsim", "sense --sensor spad-", "spad-320x240"),
        ("qsim", "generate st", "starter"),
        ("qsim", "recipes --print de", "demo"),
        ("qsim", "tradeoff gea", "gears"),
        ("quiver", "restore --method mo", "moment"),
        ("quiver", "evaluate --methods naive,m", "naive,moment"),
        ("quiver", "evaluate --methods al", "all"),
        ("quiver", "train --start me", "mergenet"),
    ],
)
def test_shells_are_told_the_names_of_scenes_sensors_recipes_and_methods(capsys, program, words, offered):
    """What the scripts ask the program for, and files beside them."""
    PROGRAMS[program].main(["__complete", *words.split()])
    assert offered in capsys.readouterr().out.splitlines()


def test_files_are_completed_beside_names(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fan_of_mine.py").touch()
    main(["__complete", "render", "fan_"])
    assert "fan_of_mine.py" in capsys.readouterr().out.splitlines()


@pytest.mark.parametrize("program", ["qsim", "quiver"])
def test_every_help_has_examples_that_are_understood(capsys, program):
    """And --json, --quiet, --verbose, within 80 columns but for examples; the programs say their version."""
    module = PROGRAMS[program]
    assert module.main(["--version"]) == 0
    assert capsys.readouterr().out == f"{program} {qsim.__version__}\n"
    for command in module.PROGRAM.commands:
        assert module.main([command, "--help"]) == 0
        text, _, examples = capsys.readouterr().out.partition("example:\n")
        assert all(option in text for option in ("--json", "--quiet", "--verbose"))
        assert max(map(len, text.splitlines())) <= 80
        for line in examples.strip().split("\n"):
            words = shlex.split(line.strip())
            words = words[: next((i for i, word in enumerate(words) if word in (">", ">>")), len(words))]
            assert words[0] in (program, "torchrun")
            if words[0] == program:
                assert words[1] == command
                found, _ = module.PROGRAM.read(words[1:])
                assert found is module.PROGRAM.declared(command)


@pytest.mark.parametrize("program", ["qsim", "quiver"])
def test_every_option_is_in_every_script(capsys, program):
    scripts = [completion(capsys, program, shell) for shell in ("bash", "zsh", "fish")]
    known = PROGRAMS[program].PROGRAM
    for command in known.commands:
        for setting in known.declared(command).settings:
            if not setting.positional:
                assert all(setting.option in script for script in scripts), (command, setting.option)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_scripts_are_valid_where_the_shell_is_there(capsys, tmp_path, shell):
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} here")
    script = tmp_path / "script"
    script.write_text(completion(capsys, "qsim", shell))
    subprocess.run([shell, "-n", script], check=True)


@pytest.mark.parametrize("program", ["qsim", "quiver"])
def test_a_program_alone_prints_its_help(capsys, program):
    assert PROGRAMS[program].main([]) == 0
    found = capsys.readouterr()
    assert found.out.startswith(f"usage: {program} ")
    assert not found.err


@pytest.mark.parametrize("line", ["check none --json", "render fan --fps 3 --json", "sense --json", "frob --json"])
def test_a_failure_with_json_is_an_object_and_a_line(capsys, line):
    assert main(line.split()) == 2
    found = capsys.readouterr()
    assert json.loads(found.out) == {"error": found.err.strip(), "exit_code": 2}
    assert len(found.err.splitlines()) == 1


def test_an_interrupted_command_with_json_is_an_object(tmp_path, monkeypatch, capsys):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("qsim.dataset.checking.check", interrupt)
    assert main(["check", str(tmp_path), "--json"]) == 130
    found = capsys.readouterr()
    assert json.loads(found.out) == {"error": found.err.strip(), "exit_code": 130}


def interrupt_at(patch: pytest.MonkeyPatch, clip: str, frame: int) -> None:
    """Let Ctrl-C come when a frame of a clip is to be written."""
    add = ClipWriter.add

    def stop(self: ClipWriter, t: int, *rest: object, **named: object) -> None:
        if (self.name, t) == (clip, frame):
            raise KeyboardInterrupt
        add(self, t, *rest, **named)  # type: ignore[arg-type]

    patch.setattr(ClipWriter, "add", stop)


def test_an_interrupted_import_resumes_and_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save("light.npy", np.random.default_rng(0).random((4, 6, 8)).astype(np.float32))
    words = ["convert", "light.npy", "c", "--transfer", "linear", "--frame-rate", "9"]
    for frame, then in ((0, console.STARTS_AGAIN), (2, console.RESUMES)):
        with monkeypatch.context() as patch:
            interrupt_at(patch, "c", frame)
            assert main(words) == 130
        assert capsys.readouterr().err.endswith(f"\nqsim: interrupted; {then}\n")
        assert Path("c.part").exists() == (frame > 0)
    assert main(words) == 0


def test_an_interrupted_import_of_several_says_what_stays(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("many/a", "many/b"):
        Path(name).mkdir(parents=True)
        for t in range(2):
            Image.fromarray(np.full((6, 8), 40 + t, np.uint8)).save(f"{name}/{t}.png")
    words = ["convert", "many", "clips", "--transfer", "linear", "--frame-rate", "9"]
    with monkeypatch.context() as patch:
        interrupt_at(patch, "b", 1)
        assert main(words) == 130
    assert capsys.readouterr().err.endswith(f"\nqsim: interrupted; {console.MAKES_AGAIN}\n")
    assert sorted(path.name for path in Path("clips").iterdir()) == ["a", "b.part"]
    assert main(words) == 2
    assert main([*words, "--force"]) == 0


def test_an_interrupted_study_of_a_scene_resumes_and_says_so(tmp_path, monkeypatch, capsys):
    def render(name: str, path: Path, *_: object, **__: object) -> Clip:
        if path.name == "plain_x2":
            raise KeyboardInterrupt
        return Clip.open(path) if path.exists() else wave_clip(path, 4, 1)

    monkeypatch.setattr("qsim.studies.bit_depth.clips.render", render)
    words = ["tradeoff", "plain", "--speed", "1,2", "--ppp", "1", "--bits", "1", "-o", str(tmp_path / "o")]
    assert main(words) == 130
    assert capsys.readouterr().err.endswith(f"\nqsim: interrupted; {console.RESUMES}\n")


def test_an_interrupted_data_set_without_a_name_resumes_and_says_so(tmp_path, monkeypatch, capsys):
    def generate(_: object, folder: Path, *__: object, **___: object) -> None:
        folder.mkdir(parents=True)
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("qsim.dataset.generation.generate", generate)
    assert main(["generate", "demo"]) == 130
    assert capsys.readouterr().err.endswith(f"\nqsim: interrupted; {console.RESUMES}\n")


def test_a_bar_names_the_work_before_the_first_frame(capsys, monkeypatch):
    """After two seconds without a frame the bar says what is being done, and the name of the work from then on."""
    started: list[object] = []

    class Now:
        def __init__(self, seconds: float, function) -> None:
            started.append(seconds)
            self.function = function

        def start(self) -> None:
            self.function()

        def cancel(self) -> None: ...

    monkeypatch.setattr("qsim.cli.console.threading.Timer", Now)
    with console.bar("fan", first="pilot") as progress:
        assert "fan, pilot" in capsys.readouterr().err
        progress(1, 4)
    assert started == [2.0]
    with console.bar("fan"):
        pass
    assert not capsys.readouterr().err


def test_quiet_and_verbose_exclude_each_other(capsys):
    assert main(["doctor", "-q", "-v"]) == 2
    assert "not allowed with --quiet" in capsys.readouterr().err


def test_warnings_are_one_line_and_quiet_has_none(tmp_path, monkeypatch, capsys):
    def warned(clip: Clip, progress: object) -> list[str]:
        warnings.simplefilter("always")
        warnings.warn("the light is\n  dim", RuntimeWarning, stacklevel=1)
        return []

    clip = str(write_clip(tmp_path / "c", frames=2, height=8, width=10).path)
    monkeypatch.setattr("qsim.streams.clip.Clip.verify", warned)
    assert main(["check", clip]) == 0
    assert capsys.readouterr().err == "qsim: warning: the light is dim\n"
    assert main(["check", clip, "--quiet"]) == 0
    assert capsys.readouterr().err == ""


def test_verbose_says_time_and_memory_and_shows_the_traceback(tmp_path, capsys):
    clip = str(write_clip(tmp_path / "c", frames=2, height=8, width=10).path)
    assert main(["check", clip, "-v", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["problems"] == []
    assert " s, at most " in err
    assert main(["check", "/none", "-v", "--json"]) == 2
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert found["exit_code"] == 2
    assert err.startswith("Traceback (most recent call last):\n")
    assert f"\n{found['error']}\n" in err


def test_a_quiet_bar_shows_nothing(capsys):
    token = console._running.set(console.Running(printing=Printing(quiet=True)))
    try:
        with console.bar("rendering") as progress:
            progress(1, 2)
        console.note("working")
    finally:
        console._running.reset(token)
    assert capsys.readouterr().err == ""


def test_ctrl_c_of_a_command_that_starts_again(tmp_path):
    """A real process, SIGINT while a film is written: code 130, one line that says how to resume, no half file."""
    import os
    import signal

    clip = write_clip(tmp_path / "long", frames=1200, height=64, width=64)
    target = tmp_path / "film.gif"
    command = [sys.executable, "-m", "qsim", "preview", str(clip.path), "-o", str(target)]
    child = subprocess.Popen(
        command,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # shells ignore it in what they put behind
    )
    maps = Path(f"/proc/{child.pid}/maps")
    end = time.monotonic() + 60
    while maps.exists() and "_imaging" not in maps.read_text():  # Pillow is loaded: the command is at work
        assert time.monotonic() < end
        time.sleep(0.01)
    os.kill(child.pid, signal.SIGINT)
    out, err = child.communicate(timeout=60)
    assert (child.returncode, out) == (130, "")
    assert err.splitlines()[-1] == "qsim: interrupted; no incomplete file is left; run the same command again"
    assert "Traceback" not in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["long"]


def test_streams_that_force_replaces_are_not_resumed_without_it(tmp_path, monkeypatch, capsys):
    """Without --force, those that were not replaced yet would stay as they are."""
    clip = wave_clip(tmp_path / "c", 4, 1)

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("qsim.streams.storing.sense", interrupt)
    resumes = "the same command resumes with the missing streams"
    for words, then in (([], resumes), (["--force"], console.MAKES_AGAIN)):
        assert main(["sense", str(clip.path), "--ppp", "1", *words]) == 130
        assert capsys.readouterr().err.endswith(f"qsim: interrupted; {then}\n")
