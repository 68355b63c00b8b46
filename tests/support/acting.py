"""The property "every setting acts or is refused", over the settings that the commands declare.

A `Situation` is a command line in which a command works. Each setting of the command is added to each of its
situations: the result differs, or the program refuses it in one line and changes nothing. Somewhere it has to act.
Words for the settings are drawn from their declarations, or stand in a table by the name of the setting; a new setting
needs no row.

Results are compared: pixels, codes, weights, numbers. A change of a description alone is not an effect.
"""

from __future__ import annotations

import contextlib
import json
import re
import shlex
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar
from unittest import mock

import numpy as np
import pytest
from compiled_cases import loaded_drjit

from qsim.cli.setting_options import choices_of, is_flag, items_of, option_names
from qsim.cli.usage import Program
from qsim.records import bare_type, bounds_of, members_of
from qsim.settings import Setting

Main = Callable[[list[str]], int]
Before = str | Callable[[Path], None]  # a command, or an action on the folder


# ---- What a run leaves behind


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


def exit_code(run: Run) -> int:
    """How the command ended."""
    return run.code


def threads(run: Run) -> tuple[int, ...]:
    """Threads that the compiled engine was set to: for an option that changes speed alone."""
    return run.threads


# ---- Situations


@dataclass(frozen=True)
class Situation:
    """A command line in which a command works, in a copy of a work folder."""

    line: str
    result: Result = arrays
    words: Mapping[str, str] = field(default_factory=dict)  # of settings that need others here
    before: Before = ""  # comes first, in both runs
    after: str = ""  # a command that is run last in both runs
    codes: tuple[int, ...] = (0,)  # exit codes that are no failure here
    only: tuple[str, ...] = ()  # the settings it is about; empty: all that its line does not state
    slow: bool = False

    @property
    def command(self) -> str:
        return self.line.split()[0]

    def is_about(self, setting: Setting, prepared: Iterable[str]) -> bool:
        """Whether a setting is tried here."""
        if self.only or setting.name in prepared:
            return setting.name in self.only
        return not any(name in self.line.split() for name in option_names(setting))


@dataclass(frozen=True)
class Commands:
    """A program, its situations, and the words of its settings."""

    program: Program
    main: Main
    situations: tuple[Situation, ...]
    words: Mapping[str, str]  # by the name of a setting; by `command.name` where a command needs others
    results: Mapping[str, Result]  # of settings that do not change what the situation compares
    may_be_silent: frozenset[str]  # settings that act on what is there, or on speed: without effect elsewhere
    prepared: frozenset[str]  # settings that are tried where a situation is about them alone
    never_here: Mapping[str, str]  # `command.name` -> why it cannot act on the machine of a test

    def settings(self, command: str) -> list[Setting]:
        """The options of a command, but those of every command."""
        return [one for one in self.program.declared(command).own if not one.positional]

    def cases(self) -> Iterator[Any]:
        """One parameter for each setting of each command; a second, slow one where situations render or train."""
        for command in self.program.commands:
            here = [one for one in self.situations if one.command == command]
            for setting in self.settings(command):
                name = f"{command} {setting.option}"
                asked = [one for one in here if one.is_about(setting, self.prepared)]
                assert asked, f"{name}: every situation states it; add one that is about it alone"
                quick = [one for one in asked if not one.slow]
                slow = [one for one in asked if one.slow]
                if quick:
                    yield pytest.param(setting, quick, not slow, id=name)
                if slow or not quick:
                    yield pytest.param(setting, [*quick, *slow], True, id=f"{name} slow", marks=pytest.mark.slow)

    def option(self, situation: Situation, setting: Setting) -> str:
        """An option as typed, with a value that is not its default."""
        given = f"--{setting.option}"
        if is_flag(setting):
            return self.words.get(f"{situation.command}.{setting.name}", given)
        for words, key in (
            (situation.words, setting.name),
            (self.words, f"{situation.command}.{setting.name}"),
            (self.words, setting.name),
        ):
            if key in words:
                return f"{given} {words[key]}"
        return f"{given} {_another(setting)}"


def _another(setting: Setting) -> str:
    """A word for a setting that is not its default, from its declaration."""
    choices = [word for word in choices_of(setting) if word != str(setting.default)]
    if choices:
        return choices[-1]
    hints = items_of(setting.hint) or (setting.hint,)
    member = members_of(hints[0])[0]
    kind = bare_type(member)
    if kind not in (int, float):
        raise AssertionError(f"no word for --{setting.option}: put one into the table")
    bounds = bounds_of(member)
    least = bounds.get("ge", bounds.get("gt", 0))
    default = setting.default if isinstance(setting.default, int | float) else least
    return f"{kind(default) + 1:g}"


# ---- Running


def execute(main: Main, line: str, folder: Path, capsys: Any, monkeypatch: Any) -> Run:
    """Run a command line in a folder, in this process."""
    monkeypatch.chdir(folder)
    capsys.readouterr()
    dr = loaded_drjit()
    with mock.patch.object(dr, "set_thread_count", wraps=dr.set_thread_count) as asked:
        code = main(shlex.split(line))
    captured = capsys.readouterr()
    threads = tuple(call.args[0] for call in asked.call_args_list)
    return Run(code, captured.out, captured.err, folder, threads)


@contextlib.contextmanager
def only_a_note() -> Iterator[None]:
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


class Bench:
    """Runs situations in copies of a work folder; the run without the setting is made once."""

    def __init__(self, commands: Commands, work: Path, tmp_path: Path, capsys: Any, monkeypatch: Any) -> None:
        self.commands = commands
        self.work = work
        self.folder = tmp_path
        self.capsys = capsys
        self.monkeypatch = monkeypatch

    _plain: ClassVar[dict[tuple[Any, ...], Run]] = {}  # for all tests of a process

    def plain(self, situation: Situation) -> Run:
        """The run without the setting."""
        key = (self.work, situation.line, situation.before, situation.after)
        if key not in self._plain:
            folder = Path(tempfile.mkdtemp(prefix="without", dir=self.work.parent)) / "work"
            self.prepare(situation, folder)
            self._plain[key] = self.finished(situation, situation.line, folder)
        return self._plain[key]

    def prepare(self, situation: Situation, folder: Path, option: str = "") -> None:
        """Make a copy of what the lines name of the work folder, and run what comes before."""
        before = "" if callable(situation.before) else situation.before
        named = f"{situation.line} {option} {before} {situation.after}"

        def left_out(place: str, entries: list[str]) -> list[str]:
            return [name for name in entries if place == str(self.work) and not _is_named(name, named)]

        shutil.copytree(self.work, folder, symlinks=True, ignore=left_out)
        if callable(situation.before):
            self.monkeypatch.chdir(folder)
            situation.before(folder)
        elif situation.before:
            first = self.execute(situation.before, folder)
            assert first.code == 0, f"{situation.before}: {first.err}"

    def execute(self, line: str, folder: Path) -> Run:
        return execute(self.commands.main, line, folder, self.capsys, self.monkeypatch)

    def finished(self, situation: Situation, line: str, folder: Path) -> Run:
        """A run of a command line, and of what comes after it."""
        run = self.execute(line, folder)
        if run.code in situation.codes and situation.after:
            last = self.execute(situation.after, folder)
            assert last.code == 0, f"{situation.after}: {last.err}"
        return run

    def acts(self, setting: Setting, situation: Situation, number: int) -> bool:
        """Whether a setting acts in a situation; an error if it is ignored there."""
        option = self.commands.option(situation, setting)
        folder = self.folder / f"{number}"
        self.prepare(situation, folder, option)
        line = f"{situation.line} {option}"
        before = _state(folder)
        run = self.finished(situation, line, folder)
        if run.code == 2 and 2 not in situation.codes:
            _check_refusal(run, self.commands.settings(situation.command), option, line)
            assert _state(folder) == before, f"{line}: refused, and something was changed or left behind"
            return False
        plain = self.plain(situation)
        assert plain.code in situation.codes, f"{situation.line}: {plain.err}"
        command = situation.command
        result = self.commands.results.get(f"{command}.{setting.name}") or self.commands.results.get(setting.name)
        result = result or situation.result
        if result(plain) != result(run):
            assert run.code in (0, 1, *situation.codes), f"{line}: {run.err}"
            return True
        assert setting.name in self.commands.may_be_silent, f"{line}: changes nothing"
        return False

    def check(self, setting: Setting, situations: Sequence[Situation], everywhere: bool) -> None:
        """Assert that a setting acts or is refused in each situation, and acts in one of them if these are all."""
        found = [self.acts(setting, situation, number) for number, situation in enumerate(situations)]
        command = situations[0].command
        if everywhere and f"{command}.{setting.name}" not in self.commands.never_here:
            assert any(found), f"{command} --{setting.option}: acts in no situation; add one in which it does"


def _is_named(name: str, words: str) -> bool:
    """Whether an entry of the work folder is one that command lines name, or that others of them read."""
    return name.endswith(".py") or name.partition(".")[0] in words


def _check_refusal(run: Run, settings: Iterable[Setting], option: str, line: str) -> None:
    """One sentence, exit code 2, which names the option, its value, or another option that it needs."""
    lines = [text for text in run.err.splitlines() if re.match(r"(qsim|quiver)( [a-z-]+)?: (?!warning)", text)]
    assert len(lines) == 1, f"{line}: {run.err}"
    assert "Traceback" not in run.err, run.err
    values = [part for word in option.split()[1:] for part in word.split(",") if len(part) > 1]
    told = [name for one in settings for name in (*option_names(one), one.option, one.name) if len(name) > 2]
    assert any(word in lines[0] for word in (*values, *told)), f"{line}: names neither option nor value: {run.err}"


def _state(folder: Path) -> dict[str, bytes]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and "__pycache__" not in p.parts)
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


# ---- Options of every command


def check_printing(commands: Commands, line: str, folder: Path, capsys: Any, monkeypatch: Any) -> None:
    """Assert that --quiet is without a note, --verbose tells more, and that each is one of a command's options."""
    monkeypatch.chdir(folder)
    told = {}
    for option in ("", " --quiet", " --verbose"):
        with only_a_note():
            told[option] = execute(commands.main, line + option, folder, capsys, monkeypatch).err
    assert len(set(told.values())) == 3, told
    assert told[" --quiet"] == ""


def check_json(commands: Commands, line: str, work: Path, tmp_path: Path, capsys: Any, monkeypatch: Any) -> None:
    """Assert that a line prints one JSON object with --json, and another text without."""
    bench = Bench(commands, work, tmp_path, capsys, monkeypatch)
    situation = next((one for one in commands.situations if one.line == line), Situation(line))
    plain = bench.plain(situation)
    bench.prepare(situation, tmp_path / "json")
    run = bench.execute(f"{line} --json", tmp_path / "json")
    assert run.code == plain.code, run.err
    assert isinstance(json.loads(run.out), dict)
    with pytest.raises(json.JSONDecodeError):
        json.loads(plain.out)
