"""One row for every option of every command: the option changes a result, or it is refused.

A row runs a command in a copy of one small work folder, without and with the option, and compares what was made. Rows
of one command share the run without the option.
Results are compared: pixels, codes, weights, numbers. A change of a description alone is not an effect.
"""

from __future__ import annotations

import contextlib
import json
import re
import shlex
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from compiled_cases import loaded_drjit

from qsim.cli.setting_options import option_names
from qsim.cli.usage import Program

Main = Callable[[list[str]], int]


@dataclass(frozen=True)
class Run:
    """What one run of a command left behind."""

    code: int
    out: str
    err: str
    folder: Path
    threads: tuple[int, ...]  # that the compiled engine was set to, one after the other


Result = Callable[[Run], Any]


def arrays(run: Run) -> dict[str, Any]:
    """Every array and picture in the folder, by path: numbers only, no descriptions."""
    found: dict[str, Any] = {}
    for path in sorted(p for p in run.folder.rglob("*") if p.is_file()):
        name = path.relative_to(run.folder).as_posix()
        if path.suffix == ".npy":
            found[name] = np.load(path).tobytes()
        elif path.suffix == ".npz":
            with np.load(path) as archive:
                found[name] = {key: archive[key].tobytes() for key in archive.files}
        elif path.suffix != ".json":
            found[name] = path.read_bytes()
    return found


def names(run: Run) -> set[str]:
    """The files of the folder, by path: for options that say where a result goes."""
    return {p.relative_to(run.folder).as_posix() for p in run.folder.rglob("*") if p.is_file()}


def stdout(run: Run) -> str:
    """What the command prints as its result, without times."""
    return re.sub(r"\d+(\.\d+)? (s|ms|minutes|hours)\b", "", run.out)


def stderr(run: Run) -> str:
    """What the command tells a person beside the result."""
    return run.err


def numbers(*keys: str) -> Result:
    """Values of the JSON object that a command prints with --json, by their keys."""

    def chosen(run: Run) -> dict[str, Any]:
        found = json.loads(run.out)
        return {key: found[key] for key in keys}

    return chosen


def exit_code(run: Run) -> int:
    """How the command ended: for options that turn a finding into a failure."""
    return run.code


def threads(run: Run) -> tuple[int, ...]:
    """Threads that the compiled engine was set to: for an option that changes speed alone."""
    return run.threads


@dataclass(frozen=True)
class Acts:
    """With the option the result differs; both runs end with one of `codes`."""

    command: str  # as typed, in a work folder that holds what `work` made; the option is appended
    option: str  # as typed, with its value
    result: Result = arrays
    codes: tuple[int, ...] = (0,)  # exit codes that are no failure here
    before: str | Callable[[Path], None] = ""  # a command, or an action on the folder, that comes first in both copies
    after: str = ""  # a command that is run last in both copies
    slow: bool = False


@dataclass(frozen=True)
class Refused:
    """The option cannot act here: one line that holds `says`, exit code 2, and nothing changed on disk."""

    command: str
    option: str
    says: str
    before: str | Callable[[Path], None] = ""
    slow: bool = False


Row = Acts | Refused


def loudness(lines: dict[str, str]) -> dict[tuple[str, str], list[Row]]:
    """Rows of --quiet and --verbose of commands, each with a line of arguments that its parser takes."""
    return {
        (command, option): [Acts(f"{NOTE} {line}", option, stderr)]
        for command, line in lines.items()
        for option in ("--quiet", "--verbose")
    }


NOTE = "only a note:"  # before a command line: its own work is replaced by one line for people


def options(program: Program) -> Iterator[tuple[str, str]]:
    """(command, longest name) of every option of a program, but --help."""
    yield ("", "--version")
    for name in program.commands:
        for setting in program.declared(name).settings:
            if not setting.positional:
                yield from ((name, option) for option in option_names(setting) if option.startswith("--"))


def names_of(program: Program, command: str, option: str) -> set[str]:
    """Every spelling of an option of a command."""
    if not command:
        return {option}
    settings = program.declared(command).settings
    return next(set(option_names(setting)) for setting in settings if option in option_names(setting))


def execute(main: Main, line: str, folder: Path, capsys: Any, monkeypatch: Any) -> Run:
    """Run a command line in a folder, in this process."""
    monkeypatch.chdir(folder)
    capsys.readouterr()
    dr = loaded_drjit()
    noted = _only_a_note() if line.startswith(NOTE) else contextlib.nullcontext()
    with noted, mock.patch.object(dr, "set_thread_count", wraps=dr.set_thread_count) as asked:
        code = main(shlex.split(line.removeprefix(NOTE)))
    captured = capsys.readouterr()
    threads = tuple(call.args[0] for call in asked.call_args_list)
    return Run(code, captured.out, captured.err, folder, threads)


@contextlib.contextmanager
def _only_a_note() -> Iterator[None]:
    """Inside, a command that is parsed writes one note in place of its work."""
    from qsim.cli import console

    read = Program.read

    def noted() -> int:
        console.note("a note")
        return 0

    def replaced(program: Program, words: Any) -> Any:
        command, values = read(program, words)
        return (command and replace(command, run=noted, idle=())), values

    with mock.patch.object(Program, "read", replaced):
        yield


def prepared(
    row: Row, main: Main, work: Path, folder: Path, capsys: Any, monkeypatch: Any, option: str = "", named: bool = False
) -> Path:
    """A copy of the work folder in which the row's command can run; with `named`, of what the row names alone."""
    words = f"{row.command} {option} {row.before}"

    def left_out(place: str, entries: list[str]) -> list[str]:
        return [name for name in entries if named and place == str(work) and name.partition(".")[0] not in words]

    shutil.copytree(work, folder, symlinks=True, ignore=left_out)
    if callable(row.before):
        monkeypatch.chdir(folder)
        row.before(folder)
    elif row.before:
        first = execute(main, row.before, folder, capsys, monkeypatch)
        assert first.code == 0, f"{row.before}: {first.err}"
    return folder


_WITHOUT: dict[tuple[Any, ...], Run] = {}


def without(row: Acts, main: Main, work: Path, capsys: Any, monkeypatch: Any, named: bool = False) -> Run:
    """The run without the option: once for all rows of one command, whose results are read from its folder."""
    key = (main, work, row.command, row.before, row.after)
    if key not in _WITHOUT:
        folder = Path(tempfile.mkdtemp(prefix="without", dir=work.parent)) / "work"
        prepared(row, main, work, folder, capsys, monkeypatch, named=named)
        _WITHOUT[key] = finished(row, row.command, main, folder, capsys, monkeypatch)
    return _WITHOUT[key]


def finished(row: Acts, line: str, main: Main, folder: Path, capsys: Any, monkeypatch: Any) -> Run:
    """A run of a command line, and of what comes after it."""
    run = execute(main, line, folder, capsys, monkeypatch)
    assert run.code in row.codes, run.err
    if row.after:
        last = execute(main, row.after, folder, capsys, monkeypatch)
        assert last.code == 0, f"{row.after}: {last.err}"
    return run


def _check_refusal(row: Refused, run: Run) -> None:
    """One sentence, exit code 2."""
    lines = [line for line in run.err.splitlines() if re.match(r"(qsim|quiver)( [a-z-]+)?: ", line)]
    assert run.code == 2, f"accepted: {run.out}{run.err}"
    assert row.says in run.err, run.err
    assert len(lines) <= 1, run.err
    assert "Traceback" not in run.err, run.err


def check(row: Row, main: Main, work: Path, tmp_path: Path, capsys: Any, monkeypatch: Any, named: bool = False) -> None:
    """Assert what a row says. With `named`, rows name all that their commands need of the work folder."""
    line = f"{row.command} {row.option}"
    if isinstance(row, Refused):
        folder = prepared(row, main, work, tmp_path / "work", capsys, monkeypatch, row.option, named)
        before = _state(folder)
        _check_refusal(row, execute(main, line, folder, capsys, monkeypatch))
        assert _state(folder) == before, "something was changed or left behind"
        return
    plain = without(row, main, work, capsys, monkeypatch, named)
    assert plain.code in row.codes, plain.err
    folder = prepared(row, main, work, tmp_path / "work", capsys, monkeypatch, row.option, named)
    changed = finished(row, line, main, folder, capsys, monkeypatch)
    assert row.result(plain) != row.result(changed), "the option changes nothing"


def _state(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
