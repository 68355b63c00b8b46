"""Properties of every setting of every command: what does not fit is one line, exit code 2, and nothing is written.

The settings are those that the commands declare; a new one is tested without a line here.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

import qsim.cli.program
import quiver.cli.program
from qsim.cli.setting_options import choices_of, is_flag, items_of, option_names
from qsim.cli.usage import Program
from qsim.records import bare_type, bounds_of, members_of
from qsim.settings import Setting

ROOT = Path(__file__).parents[2]
PROGRAMS = (qsim.cli.program, quiver.cli.program)


class Case(NamedTuple):
    """A setting of a command, and the words that the command needs before it."""

    module: Any
    command: str
    setting: Setting

    @property
    def before(self) -> list[str]:
        """Words for what the command needs beside this setting."""
        words = []
        for one in self.module.PROGRAM.declared(self.command).settings:
            if one.required and one.name != self.setting.name:
                value = choices_of(one)[0] if choices_of(one) else "x.npy"
                words += [value] if one.positional else [option_names(one)[0], value]
        return words

    def words(self, value: str) -> list[str]:
        """A command line in which the setting has a value, which stands where its own kind of argument does."""
        if self.setting.positional:
            named = [one for one in self.module.PROGRAM.declared(self.command).settings if one.positional]
            words = [value if one.name == self.setting.name else "x.npy" for one in named if one.required]
            words += [] if self.setting.required else [value]
            rest = [word for word in self.before if word not in ("x.npy",) or not words]
            options = self.before[self.before.index("-o") :] if "-o" in self.before else []
            return [self.command, *words, *options] if rest or options else [self.command, *words]
        return [self.command, *self.before, f"--{self.setting.option}={value}"]


def cases() -> list[Any]:
    found = []
    for module in PROGRAMS:
        program: Program = module.PROGRAM
        for command in program.commands:
            for setting in program.declared(command).settings:
                case = Case(module, command, setting)
                found.append(pytest.param(case, id=f"{program.name} {command} {setting.option}"))
    return found


CASES = cases()
VALUED = [case for case in CASES if not is_flag(case.values[0].setting)]
NAMED = [case for case in CASES if not case.values[0].setting.positional]


def outside(setting: Setting) -> Iterator[str]:
    """Yield words that are no value of a setting: beside its bounds, of another type, none of its choices."""
    if setting.read is not None:
        yield "no such value"
        return
    hints = items_of(setting.hint) or (setting.hint,)
    kinds = [bare_type(member) for hint in hints for member in members_of(hint)]
    if choices_of(setting):
        yield "no_such_choice"
        return
    if str in kinds or Path in kinds or any(kind not in (int, float) for kind in kinds):
        return
    yield "three"
    yield "nan"
    for member in members_of(hints[0]):
        bounds = bounds_of(member)
        low = bounds.get("ge", bounds.get("gt"))
        high = bounds.get("le", bounds.get("lt"))
        if low is not None:
            yield str(low - 1) if isinstance(low, int) else repr(low - max(1.0, abs(low)))
        if high is not None:
            yield str(high + 1) if isinstance(high, int) else repr(2 * high)
        if bare_type(member) is int:
            yield "2.5"


def refused(case: Case, words: list[str], folder: Path, monkeypatch: Any, capsys: Any) -> str:
    """The one line that a command line gets, which writes nothing."""
    monkeypatch.chdir(folder)
    code = case.module.main(words)
    out, err = capsys.readouterr()
    assert code == 2, f"accepted: {words}"
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith(f"{case.module.PROGRAM.name} {case.command}: ")
    assert err.endswith(f"; see {case.module.PROGRAM.name} {case.command} --help\n")
    assert list(folder.iterdir()) == []
    return str(err)


@pytest.mark.parametrize("case", VALUED)
def test_a_value_that_does_not_fit_is_refused(case, tmp_path, monkeypatch, capsys):
    """Below and above its bounds, of a wrong type, none of its choices, and an empty text."""
    name = case.setting.shown or case.setting.option.upper() if case.setting.positional else f"--{case.setting.option}"
    for value in outside(case.setting):
        said = refused(case, case.words(value), tmp_path, monkeypatch, capsys)
        assert f"argument {name}: " in said
        assert value in said
    assert "got an empty text" in refused(case, case.words(""), tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize("case", NAMED)
def test_a_misspelt_name_is_refused_with_the_one_that_was_meant(case, tmp_path, monkeypatch, capsys):
    """A letter too many, and a name cut short: abbreviations are not taken."""
    for wrong in (f"--{case.setting.option}x", f"--{case.setting.option[:-1]}"):
        known = {name for one in case.module.PROGRAM.declared(case.command).settings for name in option_names(one)}
        if wrong in known:
            continue
        said = refused(case, [case.command, *case.before, wrong], tmp_path, monkeypatch, capsys)
        assert f"unknown option {wrong}" in said


@pytest.mark.parametrize("case", NAMED)
def test_a_value_that_is_missing_is_refused_and_a_flag_takes_none(case, tmp_path, monkeypatch, capsys):
    option = f"--{case.setting.option}"
    flag = is_flag(case.setting)
    words = [case.command, *case.before, f"{option}=maybe" if flag else option]
    said = refused(case, words, tmp_path, monkeypatch, capsys)
    assert f"argument {option}: {'takes no value' if flag else 'needs'}" in said


def test_every_setting_is_read():
    """A setting that no code reads, as an attribute or a key, would be ignored."""
    sources = [path for room in ("qsim", "quiver") for path in (ROOT / room).rglob("*.py")]
    read = set(re.findall(r"\.(\w+)|\"(\w+)\"", "\n".join(path.read_text(encoding="utf-8") for path in sources)))
    names = {name for pair in read for name in pair}
    for case in CASES:
        assert case.values[0].setting.name in names, case.id


def test_every_help_is_one_line_without_a_full_stop():
    for case in CASES:
        text = case.values[0].setting.help
        assert text
        assert not re.search(r"\.$|\n", text), case.id
